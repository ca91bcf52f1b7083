"""Kept touches are a function of the set observed, whatever happened on the way, and of how many are kept."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scroll_tactile_store import Store
from touches import OBSERVED, PAD, Windowed, fed, filled, held, kept_of, require_same, stream

from scroll_tactile import Kernels, TactileLearner
from scroll_tactile.errors import InputError, MismatchError
from scroll_tactile.matching.kept_arrays import KeptTouch
from scroll_tactile.memory.identity import Identity
from scroll_tactile.memory.state import KeptFields, KeptTouches
from scroll_tactile.recipe import default_kept_touches
from scroll_tactile.sensors import BIOTAC, GELSIGHT
from scroll_tactile.signals.levels import levels_of
from scroll_tactile.statistics.fields import decode, encode

FEW = 5
SPARE = [("d", (40 + i, 60)) for i in range(3)]


def test_levels_are_those_of_the_readings_and_at_most_twice_as_long_as_is_usual():
    for readings in (2, 50, 100, 101, 5000):
        levels = KeptTouches(PAD, 3).levels(stream((0, readings)))
        assert levels.dtype == np.uint8
        assert np.array_equal(levels, levels_of(stream((0, readings))[:100], PAD))
    short = PAD.model_copy(update={"duration": 0.02})
    assert KeptTouches(short, 3).levels(stream((0, 60))).shape == (2, 2)


@given(
    st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 12), st.sampled_from([2, 30, 150])), max_size=30),
    st.integers(1, 12),
    st.randoms(use_true_random=False),
)
@settings(max_examples=60, deadline=None)
def test_they_are_a_function_of_the_set_and_come_back_from_their_arrays(touches, capacity, rng):
    def kept(order):
        chosen = KeptTouches(PAD, capacity)
        for material, seed, readings in order:
            key, levels = bytes([seed, readings]) * 16, chosen.levels(stream((seed, readings)))
            chosen.add(material, key, KeptTouch(material, key, levels))
        return chosen

    first = kept(touches)
    shuffled = [*touches, *touches[:3]]
    rng.shuffle(shuffled)
    arrays, told = encode(first.to_fields())
    materials = told["materials"]
    for other in (kept(shuffled), KeptTouches(PAD, capacity)):
        if not len(other):
            other.fill(decode(KeptFields, arrays, told, {}))
        again, names = encode(other.to_fields())
        assert names == told
        assert {name: array.tobytes() for name, array in again.items()} == {
            name: array.tobytes() for name, array in arrays.items()
        }
    assert len(first) == min(capacity, len(set(touches)))
    # Of as many materials as fit there is one at least.
    assert len(set(materials)) == min(capacity, len({material for material, *_ in touches}))


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
