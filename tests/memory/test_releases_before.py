"""A memory of 0.x, whose folder has a `journal.sqlite`, is refused in one sentence, and left as it is."""

import numpy as np
import pytest
from commands import refused
from scroll_tactile_store import VersionError
from touches import PAD, SETTINGS, stream

from scroll_tactile import Kernels, TactileLearner

SAID = "was made by a release 0.x, whose memories this one does not read"


@pytest.fixture
def path(tmp_path):
    (tmp_path / "m" / "generations" / "00000001").mkdir(parents=True)
    (tmp_path / "m" / "journal.sqlite").write_bytes(b"SQLite format 3\0" + bytes(4080))
    np.save(tmp_path / "t.npy", stream((0, 60)))
    return tmp_path / "m"


def test_it_is_refused_and_left_as_it_is(path):
    for settings in ({}, {"mode": "read"}, {"sensor": PAD}, {"sensor": PAD, "embedding": Kernels()}):
        with pytest.raises(VersionError, match=SAID):
            TactileLearner.open(path, **settings)
    with TactileLearner.open(path.parent / "ours", **SETTINGS) as ours, pytest.raises(VersionError, match=SAID):
        ours.merge(path)
    assert sorted(entry.name for entry in path.iterdir()) == ["generations", "journal.sqlite"]


@pytest.mark.parametrize(
    "words",
    [
        ("inspect", "M"),
        ("predict", "M", "T"),
        ("observe", "M", "felt", "T", "--sensor", "biotac"),
        ("memory", "repair", "M"),
        ("memory", "export", "M", "X"),
    ],
    ids=" ".join,
)
def test_each_command_says_so_in_one_sentence(path, words):
    places = {"M": path, "T": path.parent / "t.npy", "X": path.parent / "x"}
    assert SAID in refused(*(places.get(word, word) for word in words))
    assert sorted(entry.name for entry in path.iterdir()) == ["generations", "journal.sqlite"]
