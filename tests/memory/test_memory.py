"""What a row and a checkpoint hold of touches, packed and unpacked, also by zarr alone; and how many are kept."""

import numpy as np
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of
from scroll_tactile_store import Record
from touches import OBSERVED, PAD, SMALL, Windowed, fed, filled, held, kept_of, require_same, stream

from scroll_tactile import Kernels, TactileLearner
from scroll_tactile.errors import InputError, MismatchError
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import pack_codes, pack_readings, unpack_codes, unpack_readings
from scroll_tactile.recipe import Recipe, default_kept_touches
from scroll_tactile.sensors import BIOTAC, GELSIGHT
from scroll_tactile.signals.levels import levels_of
from scroll_tactile.signals.windows import Scale

SHAPES = st.one_of(
    st.tuples(st.integers(1, 9), st.integers(1, 5)), st.tuples(st.integers(1, 3), st.just(2), st.just(3), st.just(3))
)
any_bits = arrays_of.arrays(np.uint32, SHAPES).map(lambda bits: bits.view(np.float32))
counted = st.builds(
    lambda counts, power: np.ldexp(counts.astype(np.float32), power),
    arrays_of.arrays(np.int32, SHAPES, elements=st.integers(-(2**16), 2**16)),
    st.integers(-140, 100),
)
mixed = arrays_of.arrays(np.float32, SHAPES, elements=st.sampled_from([0.0, -0.0, 1.0, 0.5, 1e-45, 3e38, 0.1, np.inf]))


@settings(deadline=None)
@given(st.one_of(any_bits, counted, mixed))
def test_packed_readings_unpack_to_the_same_bits(readings):
    again = unpack_readings(pack_readings(readings))
    assert (again.dtype, again.shape) == (np.float32, readings.shape)
    assert again.tobytes() == readings.tobytes()
    assert again.flags.c_contiguous


@pytest.mark.parametrize(
    ("readings", "kind"),
    [
        (np.arange(256), np.uint8),
        (np.arange(-128, 128), np.int8),
        (np.arange(256) / 64, np.uint8),
        (np.arange(4096) * 8, np.int16),
        (np.arange(300) - 9.25, np.int16),
        (np.zeros(5), np.uint8),
    ],
)
def test_what_a_sensor_counts_takes_a_byte_or_two_a_value(readings, kind):
    packed = pack_readings(readings.astype(np.float32)[:, None])
    assert [array.dtype for array in packed.values()] == [kind]


def test_codes_come_back_and_readings_alone_need_their_embedding():
    codes = {Scale("window", 6): np.arange(8).reshape(2, 4), Scale("window", 300): np.zeros((1, 4))}
    again = unpack_codes(pack_codes(codes))
    assert {scale: rows.tolist() for scale, rows in again.items()} == {
        one: rows.tolist() for one, rows in codes.items()
    }
    row = Record(1, "observe", "a", b"", 0.0, {"columns": 20}, 0, pack_readings(np.ones((20, 2), np.float32)))
    with pytest.raises(MismatchError, match="by the embedding that made the memory"):
        Memory(Recipe.of(PAD, SMALL)).codes(row)


def test_a_checkpoint_opened_with_zarr_alone_has_what_the_learner_has(tmp_path):
    learner, _ = filled(tmp_path / "m")
    with learner:
        learner.compact(keep=3)
        groups = [zarr.open(folder, mode="r") for folder in (learner.path / "checkpoints").iterdir()]
        before, group = sorted(groups, key=lambda one: one.attrs["last_sequence"])
        memory, told = learner.memory, group.attrs["attributes"]
        for name, array in (*group.arrays(), *before.arrays()):
            assert array.dtype.kind in "iuf", name
            assert np.asarray(array[...]).shape == array.shape
            assert [codec["name"] for codec in array.metadata.to_dict()["codecs"]] == ["bytes", "zstd"]

        def read(name, of=group):
            return of[name][...]

        names = told["statistics"]["materials"]
        assert dict(zip(names, read("statistics-observations").tolist(), strict=True)) == learner.materials
        for scale in memory.statistics.scales:
            assert read(f"statistics-rows-{scale}").tolist() == memory.statistics.counts(scale, names).tolist()
            assert read(f"statistics-sums-{scale}").tolist() == memory.statistics.sums(scale, names).tolist()
            if f"statistics-second-{scale}" in group:
                packed = read(f"statistics-second-{scale}")
            else:
                rows = read(f"statistics-codes-{scale}").astype(np.int64)
                packed = (rows @ rows.T)[np.tril_indices(len(rows))]
            assert packed.tolist() == memory.statistics.second(scale).packed().tolist()
        own = list(memory.sample)
        assert told["sample"]["materials"] == [material for material, *_ in own]
        assert [row.tobytes() for row in read("sample-keys")] == [key for _, key, _ in own]
        assert read("sample-pairs").tolist() == np.concatenate([touch.pairs for *_, touch in own]).tolist()
        assert read("sample-rows").T.tolist() == np.concatenate([touch.rows for *_, touch in own]).tolist()
        levels = np.split(read("kept-levels"), np.cumsum(read("kept-columns") * PAD.channels)[:-1])
        assert [row.tobytes() for row in read("kept-keys")] == [touch.key for touch in memory.kept.touches()]
        for touch, found in zip(memory.kept.touches(), levels, strict=True):
            assert found.reshape(PAD.channels, -1).tolist() == touch.levels.tolist()
        readings = read("exemplars-held-readings", before)
        touches = np.split(readings, np.cumsum(read("exemplars-held-lengths", before))[:-1])
        materials = before.attrs["attributes"]["exemplars"]["materials"]
        compacted = {(name, np.clip(stream(touch), 0, 1).astype(np.float32).tobytes()) for name, touch in OBSERVED[:-3]}
        assert {(name, found.tobytes()) for name, found in zip(materials, touches, strict=True)} == compacted


def test_levels_are_those_of_the_readings_and_at_most_twice_as_long_as_is_usual():
    for readings in (2, 50, 100, 101, 5000):
        levels = Memory(Recipe.of(PAD, SMALL)).levels(stream((0, readings)))
        assert levels.dtype == np.uint8
        assert np.array_equal(levels, levels_of(stream((0, readings))[:100], PAD))
    short = PAD.model_copy(update={"duration": 0.02})
    assert Memory(Recipe.of(short, SMALL)).levels(stream((0, 60))).shape == (2, 2)


@pytest.mark.parametrize("theirs", [0, None])
def test_a_compacted_one_that_kept_others_is_refused_and_as_it_is_taken_in(tmp_path, theirs):
    spare = [("d", (40 + i, 60)) for i in range(3)]
    ours, _ = filled(tmp_path / "m", kept_touches=5)
    other, _ = filled(tmp_path / "other", spare, kept_touches=theirs)
    with ours:
        ours.merge(other)
        require_same(ours, [*OBSERVED, *spare], kept_touches=5)
        ours.forget("d")
        other.compact()
        many = other.settings.kept_touches
        other.close()
        before = held(ours)
        with pytest.raises(MismatchError, match=rf"compacted and keeps kept_touches {many}; .* keeps 5"):
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


def test_none_are_kept_where_they_are_of_no_use():
    assert default_kept_touches(BIOTAC, views=True) == 1000
    assert default_kept_touches(GELSIGHT, views=True) == 0
    large = BIOTAC.model_copy(update={"channels": 2000, "duration": 60.0})
    assert 1 <= default_kept_touches(large, views=True) < 20
    for settings_ in ({"embedding": Windowed(dimension=64)}, {"kept_touches": 0}):
        learner = fed(OBSERVED[:1], **settings_)
        assert learner.settings.kept_touches == 0
        assert kept_of(learner) is None


@pytest.mark.parametrize("kept_touches", [-1, 2.5, "all", True])
def test_it_is_a_whole_number(kept_touches):
    with pytest.raises(InputError, match="kept_touches"):
        TactileLearner(sensor=PAD, embedding=Kernels(dimension=64), kept_touches=kept_touches)
