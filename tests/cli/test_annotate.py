"""`scroll-tactile annotate`, as it is typed."""

import io

import numpy as np
import pytest
from commands import run
from live_touches import slide
from rich.console import Console
from robot_sets import robot_set
from touches import PAD, SMALL

from scroll_tactile import TactileLearner
from scroll_tactile.clients.cli import terminal


@pytest.fixture(scope="module")
def memory(tmp_path_factory):
    folder, random = tmp_path_factory.mktemp("annotate") / "memory", np.random.default_rng(1)
    with TactileLearner.open(folder, sensor=PAD, embedding=SMALL) as made:
        for material in "abcabc":
            made.observe(material, slide(material, 50, random))
    return folder


def test_why_no_touch_was_found_depends_on_how_they_are_cut(memory, tmp_path):
    folder = robot_set(tmp_path / "nan", [("x", np.full((40, 2), np.nan))])
    words = ("annotate", folder, "--memory", memory, "--field", "pad")
    said = " ".join(run(*words).output.split())
    assert "no touch was found: the episodes are too short, or their readings not finite" in said
    said = " ".join(run(*words, "--cut", "contact", "--output", tmp_path / "out").output.split())
    assert "no touch was found: with --cut contact each episode has to begin with two seconds at rest" in said


def test_progress_shows_names_as_they_are(monkeypatch):
    screen = Console(file=io.StringIO(), force_terminal=True, width=120)
    monkeypatch.setattr(terminal, "console", lambda **_: screen)
    with terminal.progress_bar() as progress:
        progress("3 touches; a[oak].npy", 0, 1)
    assert "a[oak].npy" in screen.file.getvalue()
