"""What a journal row holds, packed and unpacked."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of
from scroll_tactile_store import Record
from scroll_tactile_store.encoding import encode_payload
from touches import PAD, SMALL

from examples.paper.readers import biotac_slide
from scroll_tactile.errors import MismatchError
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import pack_codes, pack_readings, unpack_codes, unpack_readings
from scroll_tactile.recipe import Recipe
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


def test_real_touches_take_less_than_ten_kilobytes_on_average(real_data):
    for sensor in ("biotac", "roboskin"):
        streams = biotac_slide.load(real_data, sensor).streams[::200]
        packed = [pack_readings(stream.readings) for stream in streams]
        for stream, arrays in zip(streams, packed, strict=True):
            assert unpack_readings(arrays).tobytes() == stream.readings.tobytes()
        assert np.mean([len(encode_payload(arrays)) for arrays in packed]) < 10_000


def test_codes_come_back():
    codes = {
        Scale("window", 6): np.arange(8, dtype=np.int32).reshape(2, 4),
        Scale("window", 300): np.zeros((1, 4), np.int32),
    }
    again = unpack_codes(pack_codes(codes))
    assert {scale: rows.tolist() for scale, rows in again.items()} == {
        scale: rows.tolist() for scale, rows in codes.items()
    }


def test_readings_alone_need_their_embedding():
    row = Record(1, "observe", "a", b"", 0.0, {"columns": 20}, 0, pack_readings(np.ones((20, 2), np.float32)))
    with pytest.raises(MismatchError, match="by the embedding that made the memory"):
        Memory(Recipe.of(PAD, SMALL)).codes(row)
