"""A memory is checked in a process of its own: whatever that does, the caller is told and lives."""

import os
import re
import sys
from pathlib import Path

import pytest
from scroll_tactile_store import NotAStoreError, Store, check_store
from touches import OBSERVED, SETTINGS, stream

from scroll_tactile import TactileLearner
from scroll_tactile.clients.learning import checking
from scroll_tactile.clients.learning.checking import check_in_process


@pytest.fixture
def path(tmp_path):
    with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
        for name, touch in OBSERVED:
            learner.observe(name, stream(touch))
    return tmp_path / "m"


def test_a_row_that_verifies_and_that_no_touch_could_have_made_is_found(path):
    with Store.open(path) as store:
        store.append("observe", "wool", bytes(32), attributes={"columns": 10**9})
    assert check_store(path) == []
    (problem,) = check_in_process(path)
    assert (problem.path, problem.kind) == (path, "lost")
    assert "row 13" in problem.what


def test_it_finds_what_the_check_here_finds_and_says_how_far_it_is(path):
    told = []
    assert check_in_process(path, progress=lambda *step: told.append(step)) == []
    assert {what for what, _, _ in told} >= {"checkpoints"}
    next((path / "checkpoints").glob("*/*-sums-*/zarr.json")).write_text("{}")
    found = check_in_process(str(path))
    assert [(problem.path, problem.kind) for problem in found] == [
        (problem.path, problem.kind) for problem in check_store(path)
    ]


def test_what_is_no_memory_is_refused_as_by_the_check_here(tmp_path):
    for place in (tmp_path / "none", "a\0b", tmp_path / "naïve\n"):
        with pytest.raises(NotAStoreError):
            check_in_process(place)


DEATHS = {
    "a crash": ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", r"died by signal 11 \(Segmentation fault\)"),
    "an end": ("import os; os._exit(3)", "ended with code 3"),
    "a hang": ("import time; time.sleep(600)", "did not end within"),
    "all memory": ("bytearray(2**36)", "more memory than its size explains"),
    "an error": ("{}['x']", "the check itself failed .*KeyError"),
}


@pytest.mark.parametrize("death", DEATHS)
def test_a_check_that_dies_is_damage(path, tmp_path, monkeypatch, death):
    """A module of the name of one that the check imports stands for a library that a forged file gets the better of."""
    if death == "all memory" and not Path("/proc/self/statm").exists():
        pytest.skip("there is no bound on memory here")
    statement, said = DEATHS[death]
    (tmp_path / "sitecustomize.py").write_text(
        "import scroll_tactile_store.survey\n"
        "def leftovers(self):\n"
        "    self.progress('rows', 1, 3)\n"
        f"    {statement}\n"
        "scroll_tactile_store.survey.Survey.leftovers = leftovers\n"
    )
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    if death == "a hang":  # the others end by themselves, however long a busy machine takes to start them
        monkeypatch.setattr(checking, "SPARE_SECONDS", 1.0)
    (problem,) = check_in_process(path)
    assert problem.kind == "lost"
    assert re.search(said, problem.what)


def test_nothing_is_imported_from_where_the_caller_happens_to_be(path, tmp_path, monkeypatch):
    (tmp_path / "json.py").write_text("import pathlib; pathlib.Path('ran').touch()")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    assert check_in_process(path) == []
    assert not os.path.lexists(tmp_path / "ran")
