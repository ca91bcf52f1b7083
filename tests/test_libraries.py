"""What is missing is named with a line that installs it from where this package was installed."""

import ast
import importlib.metadata
import json
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from scroll_tactile import libraries
from scroll_tactile.errors import InputError, MissingLibraryError
from scroll_tactile.libraries import install_line, missing, optional

ROOT = Path(__file__).parents[1]
PIP = [sys.executable, "-m", "pip", "install"]


class Installed:
    """A distribution with this record of where it came from."""

    def __init__(self, record: object) -> None:
        self.record = record

    def read_text(self, name: str) -> str | None:
        assert name == "direct_url.json"
        return self.record if self.record is None or isinstance(self.record, str) else json.dumps(self.record)


@pytest.mark.parametrize(
    ("record", "told"),
    [
        ({"url": "file://{folder}", "dir_info": {"editable": True}}, ["-e", "{folder}[torch]"]),
        ({"url": "file://{folder}", "dir_info": {}}, ["{folder}[torch]"]),
        (
            {"url": "https://a.org/s.git", "vcs_info": {"vcs": "git", "commit_id": "c0ffee"}},
            ["scroll-tactile[torch] @ git+https://a.org/s.git@c0ffee"],
        ),
        (
            {"url": "https://a.org/m.git", "vcs_info": {"vcs": "git", "commit_id": "c0ffee"}, "subdirectory": "s"},
            ["scroll-tactile[torch] @ git+https://a.org/m.git@c0ffee#subdirectory=s"],
        ),
        ({"url": "file:///a/s.whl", "archive_info": {}}, ["scroll-tactile[torch] @ file:///a/s.whl"]),
        ({"url": "file:///gone", "dir_info": {}}, ["torch"]),
        (None, ["-e", f"{ROOT}[torch]"]),  # this clone
        ("{", ["-e", f"{ROOT}[torch]"]),
    ],
)
def test_the_line_installs_from_where_this_was_installed(monkeypatch, tmp_path, record, told):
    folder = tmp_path / "a folder"
    folder.mkdir()
    if isinstance(record, dict):
        record["url"] = record["url"].format(folder=str(folder).replace(" ", "%20"))
    monkeypatch.setattr(importlib.metadata, "distribution", lambda name: Installed(record))
    assert shlex.split(install_line("torch", "torch")) == [*PIP, *(part.format(folder=folder) for part in told)]


def test_where_nothing_says_where_it_came_from_the_line_installs_the_library(monkeypatch, tmp_path):
    def absent(name: str) -> Installed:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", absent)
    monkeypatch.setattr(libraries, "__file__", str(tmp_path / "site-packages" / "scroll_tactile" / "libraries.py"))
    assert shlex.split(install_line("dask[distributed]", "fleet")) == [*PIP, "dask[distributed]"]


def test_it_is_caught_as_input_error_and_as_import_error():
    with (
        pytest.raises(MissingLibraryError, match=r"^a thing needs none_such, which is not installed: ") as raised,
        optional("none_such", "torch", "a thing"),
    ):
        import none_such  # noqa: F401
    assert isinstance(raised.value, InputError) and isinstance(raised.value, ImportError)
    assert raised.value.name == "none_such"
    assert str(missing("torch", "torch", "it", "leave it out")).endswith(", or leave it out")


@pytest.mark.parametrize(
    ("library", "there", "error", "said"),
    [
        ("torch", True, ImportError("libcudnn.so.9: cannot open shared object file"), "libcudnn.so.9: cannot open"),
        ("torch", True, ModuleNotFoundError("No module named 'sympy'", name="sympy"), "No module named 'sympy'"),
        ("numpy", True, ImportError("cannot import name 'x' from 'numpy'", name="numpy"), "cannot import name 'x'"),
        ("torch", True, ModuleNotFoundError("No module named 'torch.nn'", name="torch.nn"), None),
        ("torch", False, ModuleNotFoundError("No module named 'torch'", name="torch"), None),
        ("scikit-learn", False, ModuleNotFoundError("No module named 'sklearn'", name="sklearn"), None),
        ("dask[distributed]", True, ModuleNotFoundError("No module named 'distributed'", name="distributed"), None),
    ],
)
def test_one_that_is_installed_and_broken_is_not_called_absent(monkeypatch, library, there, error, said):
    asked = []

    def distribution(name: str) -> Installed:
        asked.append(name)
        if name != "scroll-tactile" and not there:
            raise importlib.metadata.PackageNotFoundError(name)
        return Installed(None)

    monkeypatch.setattr(importlib.metadata, "distribution", distribution)
    with (
        pytest.raises(MissingLibraryError) as raised,
        optional(library, "torch", "a thing", "leave it out"),
    ):
        raise error
    assert raised.value.__cause__ is error and raised.value.name == library
    assert str(raised.value).endswith(", or leave it out")
    if said is None:
        assert f"needs {library}, which is not installed: {sys.executable}" in str(raised.value)
    else:
        assert f"needs {library}, which cannot be imported ({said}" in str(raised.value)
        assert "not installed" not in str(raised.value)
    assert not any("[" in name for name in asked)


def test_every_extra_that_is_named_is_there():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = set()
    for path in [*(ROOT / "scroll_tactile").rglob("*.py"), *(ROOT / "examples").rglob("*.py")]:
        for call in ast.walk(ast.parse(path.read_text())):
            if isinstance(call, ast.Call) and getattr(call.func, "id", "") in ("optional", "missing", "install_line"):
                named.update(node.value for node in ast.walk(call.args[1]) if isinstance(node, ast.Constant))
    assert {"torch", "ros", "hdf5"} < named <= set(extras)


def test_no_text_has_one_install_from_a_package_index_where_it_is_not():
    texts = [
        path
        for kind in ("py", "md", "ipynb")
        for room in ("scroll_tactile", "examples")
        for path in (ROOT / room).rglob(f"*.{kind}")
    ]
    texts += [ROOT / "README.md", *(ROOT / ".site").rglob("*.md"), *(ROOT / ".github").rglob("*.md")]
    assert len(texts) > 300
    found = [path for path in texts if re.search(r"""pip install[^\n]* ['"\\]*scroll-tactile\b""", path.read_text())]
    assert found == []


TAKE_TORCH = [
    "scroll_tactile.Vision",
    "scroll_tactile.ModuleEmbedding",
    "scroll_tactile.Frames()",
    "importlib.import_module('scroll_tactile.finetune.fine_tune')",
]


def test_what_takes_torch_says_so_with_its_line():
    code = f"""
import importlib, sys
sys.modules["torch"] = None
import scroll_tactile
for use in {TAKE_TORCH}:
    try:
        eval(use)
    except scroll_tactile.errors.MissingLibraryError as error:
        assert "needs torch, which is not installed: " in str(error) and "[torch]" in str(error), (use, error)
    else:
        raise AssertionError(f"{{use}} is done without torch")
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_memory_is_made_and_asked_without_torch(tmp_path):
    code = f"""
import sys
sys.modules["torch"] = None
from scroll_tactile import TactileLearner, sensors
from scroll_tactile.simulation.scene import Scene
scene = Scene(sensors.ROBOSKIN)
with TactileLearner.open({str(tmp_path / "memory")!r}, sensor=sensors.ROBOSKIN) as learner:
    for name in ("felt", "oak"):
        learner.observe(name, scene.touch(name, 0))
    assert learner.predict(scene.touch("oak", 1)).material == "oak"
assert sys.modules["torch"] is None
"""
    subprocess.run([sys.executable, "-c", code], check=True)
