"""The notebook gives what it shows."""

import json
import subprocess
import sys

import nbformat
import tour


def test_the_notebook_gives_what_it_shows_and_readme_its_picture():
    done = subprocess.run([sys.executable, tour.__file__, "--check"], capture_output=True, text=True, check=False)
    assert not done.returncode, done.stderr
    assert tour.NOTEBOOK.stat().st_size < 300_000
    assert tour.picture(nbformat.read(tour.NOTEBOOK, as_version=4)) == tour.PICTURE.read_bytes()
    assert json.loads(tour.NOTEBOOK.read_text(encoding="utf-8"))["metadata"]["kernelspec"]["name"] == "python3"
