"""Streams: readings in time order, made sound once at the door, so that nothing behind it looks again."""

import math
import numbers
import sys
from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import (
    ChannelCountError,
    EmptyStreamError,
    InputError,
    NotFiniteError,
    ReadingsTypeError,
    SensorMismatchError,
    StreamTooShortError,
)
from scroll_tactile.sensors import Sensor

if TYPE_CHECKING:
    import torch

__all__ = ["Stream", "as_rows", "fewest_readings", "validate"]

_Array = npt.NDArray[Any]
_BLOCK = 2**20  # missing values at once: a camera that drops a frame lacks a million


@dataclass(frozen=True, eq=False)
class Stream:
    """Readings in time order with the sensor they came from; made by `validate`, which guarantees this:

    sensor: the sensor.
    readings: float32 of shape (T, n), or (T, height, width, 3) for a camera, in the sensor's unit and within
        its range; C-contiguous, read-only, and nobody else's memory.
    clipped: how many values lay outside the sensor's range before they were clipped to it.
    mask: which values were missing (NaN or infinite), bool of the readings' shape, read-only; None where none were.
        `readings` has in their place the line between their neighbours in time.
    outside: how many readings of each channel lay outside the range, int64 of shape (n,); None of a camera, and where
        nobody counted.
    raw: the stream as the sensor gave it, where a memory that was adapted to a changed skin has corrected it since
        (`TactileLearner.adapt`): it is not corrected again. None where nobody has.

    Two streams are equal where their sensors and their readings are.
    """

    sensor: Sensor
    readings: npt.NDArray[np.float32]
    clipped: int = 0
    mask: npt.NDArray[np.bool_] | None = None
    raw: "Stream | None" = None
    outside: npt.NDArray[np.int64] | None = None

    @property
    def missing(self) -> int:
        """How many values were missing."""
        return 0 if self.mask is None else int(np.count_nonzero(self.mask))

    @property
    def seconds(self) -> float:
        """The stream's length in seconds: T readings last T / rate."""
        return len(self) / self.sensor.rate

    @cached_property
    def key(self) -> bytes:
        """32 bytes that name the content: a hash of the sensor's name, the shape and the readings.

        The same on every machine, and whatever type the readings had when they came in. Computed when first
        asked.
        """
        name = self.sensor.name.encode()
        sizes = [len(name), self.readings.ndim, *self.readings.shape]
        digest = blake2b(np.array(sizes, dtype="<i8").tobytes() + name, digest_size=32)
        digest.update(self.readings.astype("<f4", copy=False).data.cast("B"))
        return digest.digest()

    def first(self, seconds: float) -> "Stream":
        """The stream of the first `seconds`, or the whole stream if it is no longer; memory is shared.

        `clipped` stays an upper bound: which values were clipped is not kept. Missing values are interpolated anew,
        from what had been observed by then; what a correction guesses of a lost channel stays.

        Raises InputError if seconds is not a number, StreamTooShortError if it asks for less than two readings (or one
        frame of a camera), NotFiniteError if all values until then are missing.
        """
        if not isinstance(seconds, numbers.Real) or math.isnan(seconds):
            raise InputError(f"first() needs a number of seconds; came {seconds!r:.60}")
        # min() first: infinity and 1e300 s have no number of readings.
        count = round(min(max(seconds, 0.0), self.seconds) * self.sensor.rate)
        _require_length(count, self.sensor)
        if count >= len(self):
            return self
        part, raw = self.readings[:count], None if self.raw is None else self.raw.first(seconds)
        if self.mask is None or not self.mask[:count].any():
            return Stream(self.sensor, part, min(self.clipped, part.size), raw=raw)
        mask = self.mask[:count]
        _require_any(mask, self.sensor)
        unread = mask if raw is None else mask & ~self.mask.all(axis=0)  # not the lost channels: these are guessed
        part = part.copy()
        _interpolate(part, unread, self.sensor)
        part.setflags(write=False)
        return Stream(self.sensor, part, min(self.clipped, int(np.count_nonzero(~mask))), mask, raw)

    def __len__(self) -> int:
        return len(self.readings)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Stream):
            return NotImplemented
        if self is other:
            return True
        return self.sensor == other.sensor and np.array_equal(self.readings, other.readings)

    def __hash__(self) -> int:
        return hash(self.key)

    def __repr__(self) -> str:
        shape = self.readings.shape
        missing = "" if self.mask is None else f", missing={self.missing}"
        return f"Stream({self.sensor.name}, {shape}, {self.seconds:g} s, clipped={self.clipped}{missing})"

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Pickling and copying drop the read-only flag.
        self.__dict__.update(state)
        self.readings.setflags(write=False)
        if self.mask is not None:
            self.mask.setflags(write=False)


def validate(readings: npt.ArrayLike | Iterable[npt.ArrayLike] | Stream, sensor: Sensor) -> Stream:
    """Make a stream of whatever holds readings: the one way in.

    readings: of shape (T, n), or (T, height, width, 3) for a camera, in the sensor's unit. A numpy array or
        torch tensor of any real type, nested lists, anything with `__array__`, an iterable of readings, or a
        stream. It is neither changed nor kept. Values outside the sensor's range are clipped and counted.

    NaN and ±infinity are refused, or missing, as the sensor's `non_finite` says. A missing value is interpolated
    linearly in time between its channel's neighbours and held at the ends; a channel without any reads the low end of
    its range. What is masked in a masked array is NaN.

    Raises EmptyStreamError, StreamTooShortError (fewer than two readings; one frame is enough for a camera),
    ChannelCountError (shape), NotFiniteError (where such values are refused, or there are no others),
    ReadingsTypeError, all of them StreamErrors; SensorMismatchError for another sensor's stream; and whatever an
    iterable raises while it is read.
    """
    if isinstance(readings, Stream):
        if readings.sensor is not sensor and readings.sensor != sensor:
            same_name = readings.sensor.name == sensor.name
            raise SensorMismatchError(
                f"expected a stream of sensor {sensor.name!r}; came one of {readings.sensor.name!r}"
                + (", which has the same name but other fields" if same_name else "")
            )
        return readings
    array = _as_array(readings, "the readings", sensor)
    if array.size == 0:
        raise EmptyStreamError(
            f"expected readings of sensor {sensor.name!r}, shape {_expected(sensor)}; came none: an array of "
            f"shape {array.shape}. Is the sensor connected and recording?"
        )
    array = _real(array)
    _require_shape(array.shape, sensor)
    _require_length(len(array), sensor)
    return _sound(array, sensor)


def as_rows(readings: npt.ArrayLike | Iterable[npt.ArrayLike], sensor: Sensor) -> _Array:
    """One reading, or a block of k ≥ 0, as an array of real numbers of shape (k, n), or (k, height, width, 3).

    For readings that come a few at a time: nothing is copied without need, nor clipped.

    Raises ChannelCountError, ReadingsTypeError, and NotFiniteError where the sensor refuses such values.
    """
    array = _real(_as_array(readings, "readings", sensor))
    if array.shape == sensor.shape:
        array = array[None]
    elif array.size == 0 and (array.ndim == 1 or array.shape[1:] == sensor.shape):
        return np.empty((0, *sensor.shape))
    _require_shape(array.shape, sensor)
    if sensor.non_finite == "refused" and not np.isfinite(array).all():
        _refuse(array, ~np.isfinite(array), sensor)
    return array


def fewest_readings(sensor: Sensor) -> int:
    """The fewest readings that make a stream: two, between which something changes, or one frame of a camera."""
    return 1 if sensor.camera else 2


def _sound(array: _Array, sensor: Sensor) -> Stream:
    low, high = sensor.limits
    with np.errstate(all="ignore"):  # values beyond float32 become infinite here, and are clipped below
        values = np.array(array, dtype=np.float32, order="C", copy=True, subok=False)
        least, most = values.min(), values.max()  # NaN if any value is
    mask: npt.NDArray[np.bool_] | None = None
    if not (math.isfinite(least) and math.isfinite(most)) and not np.isfinite(array).all():
        mask = np.logical_not(np.isfinite(array), order="C")
        if sensor.non_finite == "refused":
            _refuse(array, mask, sensor)
        _require_any(mask, sensor)
        values[mask] = low.min()  # neither clipped nor compared
        mask.setflags(write=False)
    clipped, beyond = 0, None
    if mask is not None or least < low.max() or most > high.min():
        outside = (values < low) | (values > high)
        outside = outside if mask is None else outside & ~mask
        clipped = int(np.count_nonzero(outside))
        beyond = None if sensor.camera else np.count_nonzero(outside, axis=0)
        np.clip(values, low, high, out=values)
    if mask is not None:
        _interpolate(values, mask, sensor)
    values += np.float32(0)  # −0 becomes 0: equal readings must have equal keys
    values.setflags(write=False)
    return Stream(sensor, values, clipped, mask, outside=beyond)


def _as_array(readings: Any, what: str, sensor: Sensor) -> _Array:
    """`readings` as an array, sharing memory where it can; `what` names them in messages."""
    if type(readings) is np.ndarray:  # first: to ask for numpy.ma is to import it, a fiftieth of a second
        return readings
    if isinstance(readings, np.ma.MaskedArray):
        # numpy would show the values under the mask as if they were readings.
        masked = np.ma.is_masked(readings)
        return np.ma.filled(readings.astype(np.float64), np.nan) if masked else readings.data
    if isinstance(readings, np.ndarray):
        return np.asarray(readings)  # a matrix would stay one, and multiply as one
    torch = sys.modules.get("torch")  # whoever passes a tensor has imported torch
    if torch is not None and isinstance(readings, torch.Tensor):
        return _from_torch(readings)
    if isinstance(readings, numbers.Number | memoryview) or hasattr(readings, "__array__"):
        return _converted(readings, what, sensor)
    if isinstance(readings, str | bytes | bytearray | Mapping | Set) or not isinstance(readings, Iterable):
        raise ReadingsTypeError(
            f"expected {what} of sensor {sensor.name!r} as numbers in an array, tensor, list or iterable; "
            f"came {_article(type(readings).__name__)}"
        )
    return _stack(list(readings), sensor)


def _converted(readings: Any, what: str, sensor: Sensor) -> _Array:
    try:
        return np.asarray(readings)
    except MemoryError:
        raise
    except Exception as error:  # whatever the object's own code raises
        raise ReadingsTypeError(
            f"expected {what} of sensor {sensor.name!r} as numbers; {_article(type(readings).__name__)} cannot be made "
            f"into an array: {error!r:.100}"
        ) from error


def _from_torch(tensor: "torch.Tensor") -> _Array:
    if tensor.is_floating_point() and tensor.element_size() < 4:
        tensor = tensor.float()  # numpy knows no bfloat16 and no 8-bit floats
    try:
        array: _Array = tensor.numpy(force=True)
    except (TypeError, RuntimeError, NotImplementedError) as error:
        raise ReadingsTypeError(
            f"expected a dense tensor of real numbers; came one of {tensor.dtype}, layout {tensor.layout}, "
            f"on {tensor.device}, which cannot be turned into an array: {error}"
        ) from error
    return array


def _stack(items: list[Any], sensor: Sensor) -> _Array:
    plain = (list, tuple, numbers.Number)  # np.asarray reads nested lists fastest when it gets them whole
    rows = [
        item if isinstance(item, plain) else _as_array(item, f"reading {i}", sensor) for i, item in enumerate(items)
    ]
    try:
        return np.asarray(rows)
    except ValueError:
        _raise_ragged(rows, sensor)
        raise


def _raise_ragged(rows: list[Any], sensor: Sensor) -> None:
    for i, row in enumerate(rows):
        try:
            shape = np.shape(row)
        except ValueError:  # ragged within one reading
            raise ChannelCountError(
                f"expected {sensor.channels} numbers in each reading of sensor {sensor.name!r}; reading {i} "
                f"of {len(rows)} holds sequences of different lengths"
            ) from None
        if shape != sensor.shape:
            raise ChannelCountError(
                f"expected each reading of sensor {sensor.name!r} to have shape {sensor.shape}; reading {i} "
                f"of {len(rows)} has {shape}. Were values lost on the way from the sensor?"
            ) from None


def _real(array: _Array) -> _Array:
    if array.dtype.kind in "fiub":
        return array
    if array.dtype.kind != "O":
        raise ReadingsTypeError(
            f"expected real numbers; came an array of {array.dtype} of shape {array.shape}. "
            + ("Take .real or np.abs() of it" if array.dtype.kind == "c" else "Convert it to numbers")
        )
    flat = array.reshape(-1)
    values = np.empty(flat.shape)
    for i, item in enumerate(flat):
        real = isinstance(item, numbers.Real | np.bool)
        if not real:
            index = np.unravel_index(i, array.shape)
            raise ReadingsTypeError(
                f"expected real numbers; {_place(index)} is {item!r:.60}, {_article(type(item).__name__)}"
            )
        try:
            values[i] = float(item)
        except OverflowError:  # an int beyond float64: as far outside the range as can be said
            values[i] = sys.float_info.max if item > 0 else -sys.float_info.max
    return values.reshape(array.shape)


def _require_shape(shape: tuple[int, ...], sensor: Sensor) -> None:
    if len(shape) > 1 and shape[1:] == sensor.shape:
        return
    came = f"came {shape}" if shape else "came a single number"
    raise ChannelCountError(
        f"expected readings of sensor {sensor.name!r} of shape {_expected(sensor)}; {came}{_advice(shape, sensor)}"
    )


def _advice(shape: tuple[int, ...], sensor: Sensor) -> str:
    each = sensor.shape
    if shape == each:
        noun = "frame" if sensor.camera else "reading"
        return f": one {noun}. A stream of it alone is .reshape{(1, *each)}"
    if each == (1,) and len(shape) == 1:
        return f". With one channel use .reshape({shape[0]}, 1)"
    if len(shape) == 2 and shape[0] == sensor.channels:
        return ", which looks like (channels, time): use .T"
    if len(shape) > 1 and math.prod(shape[1:]) == sensor.channels:
        return f". Its values fit: use .reshape{(shape[0], *each)}"
    return ". Is it this sensor, and time the first axis?"


def _require_length(count: int, sensor: Sensor) -> None:
    needed = fewest_readings(sensor)
    if count < needed:
        raise StreamTooShortError(
            f"expected at least {needed} {'frame' if sensor.camera else 'readings'} of sensor {sensor.name!r} at "
            f"{sensor.rate:g} Hz; came {count}, which is {count / sensor.rate:.3g} s. Touch for longer"
        )


def _refuse(array: _Array, bad: npt.NDArray[np.bool_], sensor: Sensor) -> NoReturn:
    index = np.unravel_index(int(np.argmax(bad)), bad.shape)
    raise NotFiniteError(
        f"expected finite readings of sensor {sensor.name!r}; {_place(index)} is {float(array[index])}, the "
        f"first of {np.count_nonzero(bad)} not finite among {array.size} values. Leave this touch out, repair the "
        'readings, or make the sensor with non_finite="missing"'
    )


def _require_any(mask: npt.NDArray[np.bool_], sensor: Sensor) -> None:
    if mask.all():
        raise NotFiniteError(
            f"expected readings of sensor {sensor.name!r}, of which some may be missing; all {mask.size} values of "
            f"{len(mask)} readings are NaN or infinite. Is the sensor connected?"
        )


def _place(index: tuple[Any, ...]) -> str:
    if not index:
        return "the only item"
    channel = ", ".join(str(int(axis)) for axis in index[1:])
    return f"reading {int(index[0])}, channel {channel}" if len(index) > 1 else f"item {int(index[0])}"


def _expected(sensor: Sensor) -> str:
    return f"(T, {', '.join(map(str, sensor.shape))})"


def _article(noun: str) -> str:
    return f"{'an' if noun[0] in 'aeiouAEIOU' else 'a'} {noun}"


def _interpolate(values: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], sensor: Sensor) -> None:
    """Write into each missing value, in place, the line between its channel's neighbours in time.

    values: contiguous, (T, n) or (T, height, width, 3), within the sensor's range except where missing. mask: which are
    missing, of the same shape. At a channel's ends its nearest value is held; a channel without any reads the low end.
    """
    flat, flags = values.reshape(len(values), -1), mask.reshape(len(mask), -1)
    low = np.broadcast_to(sensor.limits[0], sensor.shape).reshape(-1)
    channels = np.flatnonzero(flags.any(axis=0))
    size = max(1, _BLOCK // len(values))
    for block in (channels[first : first + size] for first in range(0, len(channels), size)):
        flat[:, block] = _lines(flat[:, block].astype(np.float64), flags[:, block], low[block])
    np.clip(values, *sensor.limits, out=values)  # rounding may pass a neighbour by a unit in the last place


def _lines(
    values: npt.NDArray[np.float64], gap: npt.NDArray[np.bool_], low: npt.NDArray[np.float32]
) -> npt.NDArray[np.float64]:
    """Values (T, n) whose gaps are interpolated, held at the ends, `low` in a channel (n,) that is all gap."""
    dead = gap.all(axis=0)
    values[:, dead], gap = low[dead], gap & ~dead
    last = len(values)
    time = np.arange(last)[:, None]
    before = np.maximum.accumulate(np.where(gap, -1, time), axis=0)
    after = np.minimum.accumulate(np.where(gap, last, time)[::-1], axis=0)[::-1]
    before, after = np.where(before < 0, after, before), np.where(after == last, before, after)  # held at the ends
    begin, end = np.take_along_axis(values, before, axis=0), np.take_along_axis(values, after, axis=0)
    # Step by step in float64, not np.interp: a fused multiply-add would round otherwise on another machine.
    slope = (end - begin) / np.maximum(after - before, 1)
    return np.where(gap, begin + slope * (time - before), values)
