"""The wheel of this checkout holds what belongs in it, and works where it is installed."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BUILT_OF = "pyproject.toml", "README.md", "LICENSE", "scroll_tactile", "store"


def run(*words, **options):
    ended = subprocess.run([sys.executable, *map(str, words)], capture_output=True, text=True, check=False, **options)
    assert ended.returncode == 0, ended.stdout + ended.stderr


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built from a copy: setuptools leaves folders where it builds."""
    folder = tmp_path_factory.mktemp("wheel")
    (folder / "checkout").mkdir()
    for name in BUILT_OF:
        made, into = ROOT / name, folder / "checkout" / name
        if made.is_dir():
            shutil.copytree(made, into, ignore=shutil.ignore_patterns("__pycache__", "*.so"))
        else:
            shutil.copy(made, into)
    alone = "--no-deps", "--no-build-isolation", "--disable-pip-version-check"
    pytest.importorskip("setuptools", minversion="77", reason="the wheel is built without the network")
    run("-m", "pip", "wheel", *alone, "-w", folder, folder / "checkout", env={**os.environ, "CFLAGS": "-O0"})
    (made,) = folder.glob("*.whl")
    return made


def test_it_holds_the_two_packages_and_nothing_else(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"scroll_tactile", "scroll_tactile_store"}
    assert {
        "scroll_tactile/ARCHITECTURE.md",
        "scroll_tactile/CHANGELOG.md",
        "scroll_tactile/py.typed",
        "scroll_tactile_store/py.typed",
        "scroll_tactile/clients/firmware/main.c",
        "scroll_tactile/clients/firmware/Makefile",
        *(f"scroll_tactile/native/{file.name}" for file in (ROOT / "scroll_tactile/native").glob("*.[ch]")),
        *(str(file.relative_to(ROOT)) for file in (ROOT / "scroll_tactile").rglob("*.py")),
        *(str(file.relative_to(ROOT / "store")) for file in (ROOT / "store").rglob("*.py")),
    } <= set(names)


def test_a_session_runs_beside_a_folder_of_the_users_that_is_called_store(wheel, tmp_path):
    installed, home = tmp_path / "installed", tmp_path / "shop"
    run("-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", installed, wheel)
    (home / "store").mkdir(parents=True)
    (home / "store" / "__init__.py").write_text("raise ImportError('this is a shop')\n")
    (home / "session.py").write_text(
        "import doctest, sys, scroll_tactile\n"
        "assert scroll_tactile.__file__.startswith(sys.argv[1]), scroll_tactile.__file__\n"
        "failed, tried = doctest.testfile(sys.argv[2], module_relative=False, optionflags=doctest.ELLIPSIS)\n"
        "sys.exit(failed or tried < 10)\n"
    )
    run("session.py", installed, ROOT / "README.md", cwd=home, env={**os.environ, "PYTHONPATH": str(installed)})
    assert (home / "memory").is_dir()
