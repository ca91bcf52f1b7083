"""README in an environment that has what the package depends on, and no extra: no torch, no pytest.

A program of its own, which CI runs after README's first command: `.venv-plain/bin/python tests/plain.py`.
"""

import importlib.util
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import readme

SCRIPT = Path(sys.executable).with_name("scroll-tactile")
MISSING = {"fleet": "s3fs", "ros2": "rclpy"}  # what a line needs that is not there


def main() -> None:
    """Run the session, then the command lines; fail at the first that does not do as README says."""
    for absent in ("torch", "pytest", *MISSING.values()):
        assert importlib.util.find_spec(absent) is None, f"{absent} is installed: this is no plain environment"
    with tempfile.TemporaryDirectory() as session:
        os.chdir(session)
        for _ in range(2):  # again in the memory that is there: what it has it does not learn twice
            assert readme.run_session() == 0
        os.chdir(readme.ROOT)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        readme.lay_out(folder)
        for words in readme.command_lines():
            command = [str(SCRIPT), *words[1:]]
            done = subprocess.run(
                command, cwd=folder, env=readme.environment(), capture_output=True, text=True, check=False
            )
            print("$", *words, "\n", done.stdout + done.stderr)
            if words[1] in MISSING:
                assert done.returncode == 1 and MISSING[words[1]] in done.stderr and " -m pip install " in done.stderr
            else:
                assert done.returncode == 0 and readme.promised(words, folder, done.stdout), done.stderr


if __name__ == "__main__":
    main()
