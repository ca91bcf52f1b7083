"""The site's own pages run, and the notebook gives what it shows."""

import importlib.util
import re
import sys
from pathlib import Path

import tour
import pytest
from pages import BLOCK, ENVIRONMENT, Page

ROOT = Path(__file__).parents[1]
DOCS = ROOT / ".site/docs"
NAMES = sorted(str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md"))
RUNNING = [name for name in NAMES if name == "tutorial.md" or name.startswith("howto/")]


@pytest.mark.parametrize("name", RUNNING)
def test_pages_do_what_they_show(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for variable, value in ENVIRONMENT.items():
        monkeypatch.setenv(variable, value)
    page = Page(DOCS / name)
    page.run()
    assert page.ran + len(page.left) > 0


@pytest.mark.parametrize("name", RUNNING)
def test_pages_begin_with_what_one_will_have(name):
    opening = (DOCS / name).read_text(encoding="utf-8").split("\n\n")[1]
    assert opening.startswith("At its end "), opening
