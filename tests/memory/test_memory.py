"""A memory: what a journal row holds, and what comes back from a store."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of
from scroll_tactile_store.encoding import encode_payload

from examples.paper.readers import biotac_slide
from scroll_tactile.errors import CapacityError, MismatchError
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import pack_codes, pack_readings, row_codes, unpack_codes, unpack_readings
from scroll_tactile.signals.windows import Scale, WindowPlan
from scroll_tactile.statistics.moments import MOST_ROWS
from scroll_tactile.statistics.sample import stage_rows

DIMENSION, SCALES = 4, (6, 20)
READING = WindowPlan(SCALES)
NARROW = Scale("window", 6)

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


def test_real_touches_take_less_than_ten_kilobytes_on_average(real_data):
    for sensor in ("biotac", "roboskin"):
        streams = biotac_slide.load(real_data, sensor).streams[::200]
        packed = [pack_readings(stream.readings) for stream in streams]
        for stream, arrays in zip(streams, packed, strict=True):
            assert unpack_readings(arrays).tobytes() == stream.readings.tobytes()
        assert np.mean([len(encode_payload(arrays)) for arrays in packed]) < 10_000


def test_codes_come_back():
    codes = {NARROW: np.arange(8, dtype=np.int32).reshape(2, 4), Scale("window", 300): np.zeros((1, 4), np.int32)}
    again = unpack_codes(pack_codes(codes))
    assert {scale: rows.tolist() for scale, rows in again.items()} == {
        scale: rows.tolist() for scale, rows in codes.items()
    }


def test_readings_alone_need_their_embedding():
    arrays = pack_readings(np.ones((20, 2), np.float32))
    with pytest.raises(MismatchError, match="by the embedding that made the memory"):
        row_codes(arrays, None)


def windows_of(seed):
    """The codes of all windows of `touch(seed)`."""
    rng = np.random.default_rng(seed)
    columns = int(rng.integers(3, 60))
    return {
        Scale("window", scale): rng.integers(0, 2**20, size=(len(begin), DIMENSION), dtype=np.int32)
        for scale, begin in WindowPlan(SCALES).extent(columns).items()
    }


def touch(seed):
    columns = int(np.random.default_rng(seed).integers(3, 60))
    codes = dict(stage_rows(READING.scored_stages(columns), windows_of(seed)))
    return "abcd"[seed % 4], np.random.default_rng([seed, 1]).bytes(32), columns, codes


def filled(seeds):
    made_with = SimpleNamespace(
        plan=READING, embedding=SimpleNamespace(dimension=DIMENSION), exemplars=0, kept_touches=0
    )
    memory = Memory(made_with)
    for i, seed in enumerate(seeds, start=1):
        memory.add(*touch(seed), i, None, None)
    return memory


def content(memory):
    pool = [(m, k, t.rows.tobytes(), t.pairs.tobytes()) for m, k, t in memory.sample]
    return memory.statistics.digest(), pool, memory.sequence


def test_a_full_memory_refuses_and_stays_as_it_was():
    memory = filled(range(5))
    moment = memory.statistics.second(NARROW)
    held, moment.rows = moment.rows, MOST_ROWS
    before = content(memory)
    with pytest.raises(CapacityError):
        memory.add(*touch(9), 6, None, None)
    assert content(memory) == before
    moment.rows = held
    assert content(memory) == content(filled(range(5)))
