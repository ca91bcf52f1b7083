"""Kept touches are a function of the set observed, whatever happened on the way, and of how many are kept."""

import numpy as np
import pytest
from scroll_tactile_store import Store
from touches import OBSERVED, PAD, SMALL, Windowed, fed, filled, held, kept_of, require_same, stream

from scroll_tactile import Kernels, TactileLearner
from scroll_tactile.errors import InputError, MismatchError
from scroll_tactile.matching.kept_arrays import KeptTouch
from scroll_tactile.memory.identity import Identity
from scroll_tactile.memory.state import KeptFields, Memory
from scroll_tactile.recipe import Recipe, default_kept_touches
from scroll_tactile.sensors import BIOTAC, GELSIGHT
from scroll_tactile.signals.levels import levels_of
from scroll_tactile.statistics.annotations import Annotation
from scroll_tactile.statistics.fields import decode, encode
from scroll_tactile.statistics.sample import Sample

FEW = 5
SPARE = [("d", (40 + i, 60)) for i in range(3)]


def test_levels_are_those_of_the_readings_and_at_most_twice_as_long_as_is_usual():
    for readings in (2, 50, 100, 101, 5000):
        levels = Memory(Recipe.of(PAD, SMALL)).levels(stream((0, readings)))
        assert levels.dtype == np.uint8
        assert np.array_equal(levels, levels_of(stream((0, readings))[:100], PAD))
    short = PAD.model_copy(update={"duration": 0.02})
    assert Memory(Recipe.of(short, SMALL)).levels(stream((0, 60))).shape == (2, 2)


@pytest.mark.parametrize("lengths", [[], [2], [30, 2, 150, 1]])
def test_they_come_back_from_their_arrays(lengths):
    kept = Sample(9)
    for i, columns in enumerate(lengths):
        material, key, levels = "ab"[i % 2], bytes([i]) * 32, np.full((2, columns), i, np.uint8)
        kept.add(material, key, KeptTouch(material, key, levels, Annotation(labels=(("slip", "n"),))))
    again = decode(KeptFields, *encode(KeptFields.of(kept)), {}).touches(2)
    assert [(one.material, one.key, one.levels.tolist(), one.annotation) for *_, one in again] == [
        (one.material, one.key, one.levels.tolist(), one.annotation) for one in kept.touches()
    ]


@pytest.mark.parametrize("theirs", [0, None])
def test_a_compacted_one_that_kept_others_is_refused_and_as_it_is_taken_in(tmp_path, theirs):
    ours, _ = filled(tmp_path / "m", kept_touches=FEW)
    other, _ = filled(tmp_path / "other", SPARE, kept_touches=theirs)
    with ours:
        ours.merge(other)
        require_same(ours, [*OBSERVED, *SPARE], kept_touches=FEW)
        ours.forget("d")
        other.compact()
        many = other.settings.kept_touches
        other.close()
        before = held(ours)
        with pytest.raises(MismatchError, match=rf"compacted and keeps kept_touches {many}; .* keeps {FEW}"):
            ours.merge(tmp_path / "other")
        assert held(ours) == before


@pytest.mark.parametrize("made", [None, 0])
def test_how_many_is_chosen_once(tmp_path, made):
    learner, _ = filled(tmp_path / "m", OBSERVED[:2], kept_touches=made)
    count = default_kept_touches(PAD, views=True) if made is None else made
    assert learner.settings.kept_touches == count
    learner.close()
    for mode in ("write", "read"):
        for asked in ({}, {"kept_touches": count}):
            with TactileLearner.open(tmp_path / "m", mode=mode, **asked) as again:
                assert again.settings.kept_touches == count
        with pytest.raises(MismatchError, match=rf"kept_touches {count} there, 7 here.*leave kept_touches out"):
            TactileLearner.open(tmp_path / "m", mode=mode, kept_touches=7)
    with Store.open(tmp_path / "m", mode="read") as store:
        identity = Identity.read(store)
    assert Identity.model_validate(identity.to_json()) == identity


def test_none_are_kept_where_they_are_of_no_use():
    assert default_kept_touches(BIOTAC, views=True) == 1000
    assert default_kept_touches(GELSIGHT, views=True) == 0
    large = BIOTAC.model_copy(update={"channels": 2000, "duration": 60.0})
    assert 1 <= default_kept_touches(large, views=True) < 20
    windowed = TactileLearner(sensor=PAD, embedding=Windowed(dimension=64))
    windowed.observe("a", stream((0, 60)))
    assert windowed.settings.kept_touches == 0
    assert kept_of(windowed) is None
    assert kept_of(fed(OBSERVED, kept_touches=0)) is None


@pytest.mark.parametrize("kept_touches", [-1, 2.5, "all", True])
def test_it_is_a_whole_number(kept_touches):
    with pytest.raises(InputError, match="kept_touches"):
        TactileLearner(sensor=PAD, embedding=Kernels(dimension=64), kept_touches=kept_touches)
