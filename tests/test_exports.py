"""What can be imported, and what importing brings along."""

import ast
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import api
import pytest
import scroll_tactile_store

import scroll_tactile

PACKAGES = [
    scroll_tactile,
    scroll_tactile_store,
    *(importlib.import_module(f"scroll_tactile.{name}") for name in ("recordings", "testing")),
]


def modules():
    for package in (scroll_tactile, scroll_tactile_store):
        yield package.__name__
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            yield found.name


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.__name__)
def test_the_public_names_are_sorted_there_and_all_there_are(package):
    # As ruff sorts them: constants, classes, then the rest.
    names = package.__all__
    assert sorted(names, key=lambda name: (not name.isupper(), not name[0].isupper(), name)) == list(names)
    assert set(names) <= set(dir(package))
    assert len(set(names)) == len(names)
    leaked = [
        name
        for name, item in vars(package).items()
        if not name.startswith("_") and name not in names and not inspect.ismodule(item) and name != "annotations"
    ]
    assert leaked == []
    for name in names:
        assert hasattr(package, name)


@pytest.mark.parametrize("name", [name for name in modules() if not name.endswith("__main__")])
def test_every_module_names_what_it_offers(name):
    module = importlib.import_module(name)
    assert module.__doc__
    for public in getattr(module, "__all__", []):
        assert hasattr(module, public)


def test_types_are_shipped():
    for package in (scroll_tactile, scroll_tactile_store):
        assert (Path(package.__file__).parent / "py.typed").exists()


SOME_NEED = "matplotlib sklearn zarr typer rich hypothesis torch"
FORMATS = "rosbags pyarrow h5py zarr fsspec torch lz4 sqlite3 PIL"


@pytest.mark.parametrize(
    ("package", "others"),
    [
        ("scroll_tactile", SOME_NEED),
        ("scroll_tactile.recordings", FORMATS),
        ("scroll_tactile_store", "scroll_tactile torch"),
    ],
)
def test_importing_brings_no_library_that_only_some_need(package, others):
    code = f"import sys, {package}; print(*[name for name in {others.split()} if name in sys.modules])"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert said.stdout.split() == []


def test_the_newest_change_that_is_told_is_of_this_version():
    text = (Path(scroll_tactile.__file__).parent / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (\S+)$", text, re.MULTILINE)[0] == scroll_tactile.__version__


def test_the_page_of_public_names_says_what_their_docstrings_say():
    assert api.PAGE.read_text(encoding="utf-8") == api.page(), "python tests/api.py writes it"


def test_no_class_and_no_file_has_the_name_of_another():
    files = [
        path
        for package in (scroll_tactile, scroll_tactile_store)
        for path in Path(package.__file__).parent.rglob("*.py")
    ]
    trees = [ast.walk(ast.parse(path.read_text(encoding="utf-8"))) for path in files]
    found = {
        "class": Counter(node.name for tree in trees for node in tree if isinstance(node, ast.ClassDef)),
        "file": Counter(path.stem for path in files if not path.stem.startswith("__")),
    }
    assert {name: kind for kind, names in found.items() for name, count in names.items() if count > 1} == {}


BANNED = """
apart asked believed certainty familiar generation gone heard odd pooled recall recalled recollect recollection said
standing strange strangeness strangers strays surprise told trust trusted unseen upto usual
"""


def test_public_names_are_the_fields_words():
    headings = re.findall(r"^### (\w+)$", api.page(), re.MULTILINE)
    signatures = re.findall(r"^(?:- `|    )([\w.]+)(\(.*?\))?(?: ->|`|$)", api.page(), re.MULTILINE)
    names = {*headings, *(name for name, _ in signatures)}
    names |= {one for _, parameters in signatures for one in re.findall(r"(\w+):", parameters)}
    assert len(names) > 200
    words = {name: re.findall(r"[A-Z]?[a-z]+|[A-Z]+", name) for name in names}
    assert {name: own for name, own in words.items() if {word.lower() for word in own} & {*BANNED.split()}} == {}
