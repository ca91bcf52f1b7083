import copy
import pickle
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from scroll_tactile.errors import (
    ChannelCountError,
    EmptyStreamError,
    InputError,
    NotFiniteError,
    ReadingsTypeError,
    SensorMismatchError,
    StreamTooShortError,
)
from scroll_tactile.sensors import BIOTAC, Sensor
from scroll_tactile.signals.stream import fewest_readings, validate

SKIN = Sensor(name="skin", channels=3, rate=20.0, low=-8.0, high=100.0, unit="counts", duration=1.0)
CAMERA = Sensor(
    name="eye", channels=24, rate=30.0, low=0, high=255, unit="counts", duration=1,
    layout=(2, 4, 3), camera=True,
)  # fmt: skip
VALUES = np.arange(12).reshape(4, 3)


class Reader:
    """Something of another library that can be seen as an array."""

    def __array__(self, dtype=None, copy=None):
        return VALUES.astype(np.float64)


def test_a_stream_is_clean_float32_with_its_sensor():
    stream = validate(VALUES, SKIN)
    assert stream.sensor is SKIN
    assert stream.readings.dtype == np.float32
    assert stream.readings.flags.c_contiguous
    assert not stream.readings.flags.writeable
    assert np.array_equal(stream.readings, VALUES)
    assert (len(stream), stream.seconds, stream.clipped) == (4, 0.2, 0)
    assert repr(stream) == "Stream(skin, (4, 3), 0.2 s, clipped=0)"
    assert validate(np.full((4, 3), -0.0), SKIN).key == validate(np.zeros((4, 3), int), SKIN).key
    with pytest.raises(AttributeError):
        stream.clipped = 3


DTYPES = ["?", "i1", "u1", "i2", ">i2", "u2", "i4", "u4", "i8", ">i8", "u8", "f2", "f4", ">f4", "f8", ">f8", "g"]
TENSOR_DTYPES = ["bool", "uint8", "int64", "float16", "bfloat16", "float32", "float64", "float8_e4m3fn"]


@pytest.mark.parametrize("dtype", DTYPES + TENSOR_DTYPES)
def test_any_real_type_gives_the_same_stream(dtype):
    values = VALUES % 2
    if dtype in DTYPES:
        readings = values.astype(dtype)
    else:
        readings = torch.from_numpy(values).to(getattr(torch, dtype))
        readings.requires_grad_(dtype in ("float16", "bfloat16", "float32", "float64"))
    assert validate(readings, SKIN) == validate(values, SKIN)


@pytest.mark.parametrize(
    "readings",
    [
        VALUES.tolist(),
        tuple(map(tuple, VALUES)),
        list(VALUES),
        list(torch.from_numpy(VALUES)),
        [torch.tensor(row, dtype=torch.float32, requires_grad=True) for row in VALUES.tolist()],
        [[Fraction(int(value)) for value in row] for row in VALUES],
        np.array(VALUES, dtype=object),
        memoryview(VALUES),
        Reader(),
        np.ma.masked_array(VALUES, mask=False),
        np.asfortranarray(VALUES),
        np.repeat(VALUES, 2, axis=1)[:, ::2],
        VALUES[::-1][::-1],
        [range(start, start + 3) for start in (0, 3, 6, 9)],
    ],
)
def test_any_container_gives_the_same_stream(readings):
    stream = validate(readings, SKIN)
    assert stream == validate(VALUES, SKIN)
    assert type(stream.readings) is np.ndarray


def test_a_generator_is_read_to_its_end_and_its_own_error_passes():
    def broken():
        yield [0, 1, 2]
        raise OSError("cable out")

    assert validate((row for row in VALUES), SKIN) == validate(VALUES, SKIN)
    with pytest.raises(OSError, match=r"^cable out$"):
        validate(broken(), SKIN)


@given(st.data())
@settings(max_examples=40, deadline=None)
def test_type_and_memory_layout_leave_no_trace(data):
    shape = (data.draw(st.integers(2, 6)), 3)
    values = data.draw(hnp.arrays(np.int8, shape, elements=st.integers(-16, 120)))
    key, clipped = validate(values, SKIN).key, validate(values, SKIN).clipped
    dtype = data.draw(st.sampled_from(["i1", "<i2", ">i4", "<i8", "f2", ">f4", "f8", "g", "O"]))
    step = data.draw(st.sampled_from([1, 2, -1, -3]))
    order = data.draw(st.sampled_from("CF"))
    wide = np.zeros((abs(step) * shape[0], shape[1]), dtype=dtype, order=order)
    view = wide[::step][: shape[0]]
    view[...] = values
    wide.flags.writeable = data.draw(st.booleans())
    before = wide.copy()
    stream = validate(view, SKIN)
    assert (stream.key, stream.clipped) == (key, clipped)
    assert np.array_equal(wide, before)
    assert not np.shares_memory(stream.readings, wide)
    assert clipped == np.count_nonzero((values < -8) | (values > 100))


def test_the_callers_array_stays_his():
    values = np.zeros((4, 3), dtype=np.float32)
    stream = validate(values, SKIN)
    values[:] = 7
    assert not stream.readings.any()
    tensor = torch.zeros(4, 3)
    stream = validate(tensor, SKIN)
    tensor += 7
    assert not stream.readings.any()
    assert values.flags.writeable


def test_a_stream_passes_unchanged_but_not_to_another_sensor():
    stream = validate(VALUES, SKIN)
    assert validate(stream, SKIN) is stream
    assert validate(stream, SKIN.model_copy()) is stream
    with pytest.raises(SensorMismatchError, match=r"expected a stream of sensor 'biotac'; came one of 'skin'$"):
        validate(stream, BIOTAC)
    with pytest.raises(SensorMismatchError, match="came one of 'skin', which has the same name but other fields"):
        validate(stream, SKIN.model_copy(update={"high": 5.0}))


@pytest.mark.parametrize(
    ("readings", "clipped"),
    [
        (np.full((4, 3), 1e300), 12),
        (np.full((4, 3), -(2**63)), 12),
        (np.full((4, 3), np.longdouble("1e400")), 12),
        ([[10**400, 0, -(10**400)]] * 4, 8),
        (torch.full((4, 3), 1e300, dtype=torch.float64), 12),
        ([[100.0, 100.1, -8.1]] * 4, 8),
    ],
)
def test_values_outside_the_range_are_clipped_and_counted(readings, clipped):
    stream = validate(readings, SKIN)
    assert stream.clipped == clipped
    assert stream.readings.min() >= -8
    assert stream.readings.max() <= 100


def test_the_ends_of_a_range_that_float32_cannot_write_are_inside_it():
    sensor = Sensor(name="s", channels=1, rate=1, low=0.1, high=0.7, unit="N", duration=1)
    assert validate(np.array([[0.1], [0.7]]), sensor).clipped == 0


def test_the_key_tells_sensor_shape_and_every_value_apart():
    base = validate(VALUES, SKIN)
    changed = VALUES.copy()
    changed[3, 2] += 1
    line = Sensor(name="skin", channels=6, rate=20.0, low=-8, high=100, unit="counts", duration=1)
    others = [
        validate(changed, SKIN),
        validate(VALUES[:3], SKIN),
        validate(VALUES, SKIN.model_copy(update={"name": "skin2"})),
        validate(VALUES.reshape(2, 6), line),
    ]
    assert len({stream.key for stream in [base, *others]}) == 5
    assert len({base, validate(VALUES, SKIN), *others}) == 5
    assert base != VALUES.tolist()
    assert len(base.key) == 32
    # Pinned: memories on disk name their exemplars by it.
    assert base.key.hex() == "7e8cc775984176ed5ee46af6c90fdf0eef32341d667b2bf3fb99470b6a40087a"


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda stream: pickle.loads(pickle.dumps(stream))])
def test_a_copy_is_equal_and_read_only(copied):
    stream = validate([[0, np.nan, 2], [3, 4, 5]], GAPPED)
    again = copied(stream)
    assert again == stream
    assert again.key == stream.key
    assert not again.readings.flags.writeable
    assert np.array_equal(again.mask, stream.mask)
    assert not again.mask.flags.writeable


@pytest.mark.parametrize(
    ("readings", "error", "message"),
    [
        (
            [],
            EmptyStreamError,
            r"shape \(T, 3\); came none: an array of shape \(0,\). Is the sensor connected",
        ),
        (iter([]), EmptyStreamError, "came none"),
        (np.zeros((0, 3)), EmptyStreamError, r"an array of shape \(0, 3\)"),
        (
            np.zeros((1, 3)),
            StreamTooShortError,
            r"at least 2 readings .* at 20 Hz; came 1, which is 0.05 s",
        ),
        (5.0, ChannelCountError, "came a single number"),
        (np.zeros(3), ChannelCountError, r"\(T, 3\); came \(3,\): one reading. .* .reshape\(1, 3\)"),
        (np.zeros(9), ChannelCountError, r"came \(9,\). Is it this sensor"),
        (
            np.zeros((3, 40)),
            ChannelCountError,
            r"came \(3, 40\), which looks like \(channels, time\): use .T",
        ),
        (np.zeros((40, 4)), ChannelCountError, r"of sensor 'skin' of shape \(T, 3\); came \(40, 4\)"),
        (np.zeros((4, 3, 1)), ChannelCountError, r"Its values fit: use .reshape\(4, 3\)"),
        ([[1e300, 0, np.nan], [0, 0, 0]], NotFiniteError, "reading 0, channel 2 is nan, the first of 1"),
        ([[0, 1, 2], [0, 1], [0, 1, 2]], ChannelCountError, r"shape \(3,\); reading 1 of 3 has \(2,\)"),
        ([np.zeros(3), np.zeros(4)], ChannelCountError, r"reading 1 of 2 has \(4,\)"),
        ([[0, 1, 2], [0, [1], 2]], ChannelCountError, "reading 1 of 2 holds sequences of different lengths"),
        (None, ReadingsTypeError, "the readings of sensor 'skin' as numbers .* came a NoneType"),
        ("1 2 3", ReadingsTypeError, "came a str"),
        ({"a": [1, 2, 3]}, ReadingsTypeError, "came a dict"),
        ([[1, 2, 3], None], ReadingsTypeError, "expected reading 1 of sensor 'skin'.* came a NoneType"),
        ([[1, 2, 3], [1, None, 3]], ReadingsTypeError, "reading 1, channel 1 is None, a NoneType"),
        ([[1, 2, "3"]] * 4, ReadingsTypeError, r"came an array of <U\d+ of shape \(4, 3\). Convert"),
        (np.ones((4, 3), complex), ReadingsTypeError, "came an array of complex128 .* Take .real"),
        (torch.ones(4, 3, dtype=torch.complex64), ReadingsTypeError, "complex64"),
        (np.zeros((4, 3), "M8[s]"), ReadingsTypeError, r"datetime64\[s\]"),
        (torch.eye(3).to_sparse(), ReadingsTypeError, "dense tensor .* layout torch.sparse_coo"),
        (torch.zeros(4, 3, device="meta"), ReadingsTypeError, "on meta"),
    ],
)
def test_what_is_no_stream_is_refused_with_the_reason(readings, error, message):
    with pytest.raises(error, match=message):
        validate(readings, SKIN)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64, np.longdouble, list, torch.tensor, object])
def test_the_first_value_that_is_not_finite_is_named(value, kind):
    values = VALUES.astype(np.float64)
    values[2, 1] = values[3, 0] = value
    readings = kind(values.tolist()) if kind in (list, torch.tensor) else values.astype(kind)
    with pytest.raises(NotFiniteError, match=f"reading 2, channel 1 is {value}, the first of 2 .* among 12"):
        validate(readings, SKIN)


def test_a_masked_value_is_not_read_from_under_its_mask_and_one_channel_gets_its_own_advice():
    masked = np.ma.masked_array(VALUES, mask=VALUES == 7)
    with pytest.raises(NotFiniteError, match="reading 2, channel 1"):
        validate(masked, SKIN)
    sensor = Sensor(name="mic", channels=1, rate=20, low=0, high=1, unit="V", duration=1)
    with pytest.raises(ChannelCountError, match=r"With one channel use .reshape\(40, 1\)"):
        validate(np.zeros(40), sensor)


def test_camera_frames_keep_their_shape_and_one_is_enough():
    frames = np.arange(48, dtype=np.uint8).reshape(2, 2, 4, 3)
    stream = validate(frames, CAMERA)
    assert np.array_equal(stream.readings, frames)
    assert len(validate(frames[:1], CAMERA)) == fewest_readings(CAMERA) == 1
    assert validate(list(frames), CAMERA) == stream
    with pytest.raises(ChannelCountError, match=r"\(T, 2, 4, 3\); came \(2, 4, 3\): one frame.*reshape\(1, 2, 4, 3\)"):
        validate(frames[0], CAMERA)
    with pytest.raises(ChannelCountError, match=r"use .reshape\(2, 2, 4, 3\)"):
        validate(frames.reshape(2, 24), CAMERA)
    bad = frames.astype(float)
    bad[1, 0, 3, 2] = np.nan
    with pytest.raises(NotFiniteError, match="reading 1, channel 0, 3, 2 is nan"):
        validate(bad, CAMERA)


@pytest.mark.parametrize("rate", [0.5, 100.0, 44_100.0])
def test_two_readings_are_a_stream_at_any_rate_and_one_is_none(rate):
    sensor = SKIN.model_copy(update={"rate": rate})
    assert len(validate(VALUES[:2], sensor)) == 2 == fewest_readings(sensor)
    with pytest.raises(StreamTooShortError, match="at least 2 readings"):
        validate(VALUES[:1], sensor)


GAPPED = SKIN.model_copy(update={"non_finite": "missing"})


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64, np.longdouble, list, torch.tensor, object])
def test_what_is_missing_is_interpolated_between_its_neighbours_and_held_at_the_ends(value, kind):
    values = np.array([[value, 0, 5], [10, value, value], [value, value, value], [40, 6, value]])
    readings = kind(values.tolist()) if kind in (list, torch.tensor) else values.astype(kind)
    stream = validate(readings, GAPPED)
    assert stream.readings.tolist() == [[10, 0, 5], [10, 2, 5], [25, 4, 5], [40, 6, 5]]
    assert stream.mask.tolist() == (~np.isfinite(values)).tolist()
    assert (stream.missing, stream.clipped) == (7, 0)
    assert not stream.mask.flags.writeable
    assert repr(stream) == "Stream(skin, (4, 3), 0.2 s, clipped=0, missing=7)"


def test_neighbours_are_clipped_first_and_what_is_missing_is_not_counted_as_clipped():
    stream = validate([[1e300, np.inf, 3], [np.nan, 200, 3], [60, np.nan, 3]], GAPPED)
    assert stream.readings.tolist() == [[100, 100, 3], [80, 100, 3], [60, 100, 3]]
    assert (stream.missing, stream.clipped) == (3, 2)


def test_a_channel_without_a_value_reads_the_low_end_of_its_range():
    low, high = (-8.0, 2.0, 3.0), (9.0, 9.0, 9.0)
    stream = validate([[5, np.nan, np.nan], [6, np.nan, 7]], GAPPED.model_copy(update={"low": low, "high": high}))
    assert stream.readings.tolist() == [[5, 2, 7], [6, 2, 7]]
    assert stream.missing == 3


def test_masked_values_are_missing_and_without_any_nothing_differs():
    masked = np.ma.masked_array(VALUES, mask=VALUES == 7)
    stream = validate(masked, GAPPED)
    assert np.array_equal(stream.mask, VALUES == 7)
    assert stream == validate(VALUES, GAPPED)  # 7 lies on the line between 4 and 10
    assert stream.key == validate(VALUES, SKIN).key
    assert (validate(VALUES, GAPPED).mask, validate(VALUES, GAPPED).missing) == (None, 0)


def test_a_touch_with_nothing_finite_is_refused():
    with pytest.raises(NotFiniteError, match=r"some may be missing; all 12 values of 4 readings .* Is the sensor"):
        validate(np.full((4, 3), np.nan), GAPPED)
    late = validate(np.vstack([np.full((3, 3), np.nan), VALUES]), GAPPED)
    with pytest.raises(NotFiniteError, match="all 6 values of 2 readings"):
        late.first(0.1)


@given(st.data())
@settings(max_examples=50, deadline=None)
def test_missing_values_by_a_plain_model_and_a_prefix_knows_nothing_of_what_comes_later(data):
    count = data.draw(st.integers(2, 9))
    values = data.draw(hnp.arrays(np.float64, (count, 3), elements=st.integers(-8, 100)))
    values[data.draw(hnp.arrays(np.bool_, (count, 3)))] = np.nan
    assume(np.isfinite(values[:2]).any())
    stream = validate(values, GAPPED)
    for channel in range(3):
        there = np.flatnonzero(np.isfinite(values[:, channel]))
        expected = np.interp(range(count), there, values[there, channel]) if len(there) else -8
        np.testing.assert_allclose(stream.readings[:, channel], expected, atol=1e-4)
        assert np.array_equal(stream.readings[there, channel], values[there, channel])
    for length in range(2, count + 1):
        part, alone = stream.first(length / 20), validate(values[:length], GAPPED)
        assert part == alone
        assert part.missing == alone.missing
        assert not part.readings.flags.writeable


def test_a_camera_may_miss_pixels():
    frames = np.zeros((3, 2, 4, 3))
    frames[2] = 8
    frames[1, 1, 2, 0] = np.nan
    stream = validate(frames, CAMERA.model_copy(update={"non_finite": "missing"}))
    assert stream.readings[1, 1, 2, 0] == 4
    assert (stream.missing, stream.mask.shape) == (1, frames.shape)


def test_first_takes_a_prefix():
    stream = validate(np.vstack([VALUES, np.full((6, 3), 200)]), SKIN)
    part = stream.first(0.2)
    assert part == validate(VALUES, SKIN)
    assert not part.readings.flags.writeable
    assert part.clipped == 12  # an upper bound
    for seconds in (0.5, 10, np.inf, 1e300):
        assert stream.first(seconds) is stream
    for seconds in (0.07, 0, -1, -np.inf):
        with pytest.raises(StreamTooShortError, match="at least 2 readings"):
            stream.first(seconds)
    with pytest.raises(InputError, match="came nan"):
        stream.first(np.nan)
