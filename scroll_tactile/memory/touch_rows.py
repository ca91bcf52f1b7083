"""What a journal row holds of a touch, and how it is packed: exactly, and small."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from scroll_tactile_store import Checkpoint, DamageError, Head

from scroll_tactile.errors import StreamError
from scroll_tactile.quantities import MOST_QUANTITIES, MOST_STEPS, Quantity
from scroll_tactile.settings import require_source
from scroll_tactile.signals.stream import Stream
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.annotations import MOST_AXES, Annotation
from scroll_tactile.statistics.fields import Arrays, Name, first_wrong
from scroll_tactile.statistics.statistics import LONGEST_TOUCH

__all__ = [
    "Arrays",
    "Changed",
    "Codes",
    "Encode",
    "Kind",
    "Readings",
    "RowFields",
    "active_rows",
    "annotated",
    "annotation_of",
    "declared_by",
    "pack_codes",
    "pack_readings",
    "refusing",
    "require_row",
    "retracted_by",
    "spans",
    "unpack_codes",
    "unpack_readings",
    "unspanned",
]


class Kind(StrEnum):
    """What a row of the journal says. Its attributes are those of `RowFields`, and what stands in quotes here."""

    OBSERVE = "observe"  # a stream was observed; "channels" are numbers of them, see `health.channel_numbers`
    RETRACT = "retract"  # observations were retracted
    MERGE = "merge"  # a compacted memory came in as a whole; the arrays are those of its compaction checkpoint
    MEMBER = "member"  # a stream that such a memory had observed: its name and hash alone
    DESCRIBE = "describe"  # what a material is made of, in "constituents"; null removes the description
    DECLARE = "declare"  # a quantity that touches can carry: "unit", "low", "high", "resolution"; the label names it
    SENSE = "sense"  # a touch of the material that is its label, or without one the sensor at rest: not learned
    ADAPT = "adapt"  # touches from now on are read through a "correction"; or the row that it "retracts" counts no more
    __repr__ = str.__repr__  # in messages it is what a row from the disk says


Codes = dict[Scale, npt.NDArray[np.int32]]
Readings = npt.NDArray[np.float32]
Encode = Callable[[Readings], Codes]
"""Embeds the readings of a touch: its rows of codes by scale."""


class Changed(NamedTuple):
    """A touch that came, or was retracted: its material, and its axes and labels."""

    material: str
    labels: tuple[tuple[str, str], ...] = ()


# What reading values of wrong types can raise; what is no error of the values, such as ctrl-C, is none of them.
WRONG = (ArithmeticError, AttributeError, LookupError, MemoryError, RecursionError, TypeError, ValueError)
MOST_BYTES = 2**28  # of the readings of a touch as float32: a row is read into memory whole
CODES = "codes-"  # and a scale
PACKED_WHOLE = "readings-2e"  # and a number: whole numbers, in units of two to that power
PACKED_SHAPE, PACKED_ZERO, PACKED_REST = "readings-shape", "readings-zero", "readings-rest"
MANTISSA, LARGEST_EXPONENT = 24, 128  # bits of a float32's mantissa, and its largest exponent


class RowFields(BaseModel):
    """What the attributes of a row must be, as far as somebody reads them before its arrays; see `Kind`.

    columns: of the touch. nbytes: of its readings, where the row has them. source: the file or place it comes from.
    values, labels: quantity → steps, and axis → label. sequences: what it retracts, as [first, last] pairs.
    """

    model_config = ConfigDict(strict=True)

    columns: Annotated[int, Field(ge=1, le=LONGEST_TOUCH)] | None = None
    nbytes: int | None = None
    source: Annotated[str, AfterValidator(require_source)] | None = None
    values: dict[Name, Annotated[int, Field(ge=0, le=MOST_STEPS)]] = Field({}, max_length=MOST_QUANTITIES)
    labels: dict[Name, Name] = Field({}, max_length=MOST_AXES)
    sequences: list[Annotated[list[int], Field(min_length=2, max_length=2)]] = []


@contextmanager
def refusing(path: Path, held: Head | Checkpoint | str) -> Iterator[None]:
    """Raise what is found wrong in a row, a checkpoint or something else of a memory as DamageError that names it."""
    what = held if isinstance(held, str) else f"row {held.sequence}" if isinstance(held, Head) else "checkpoint "
    what += str(held.number) if isinstance(held, Checkpoint) else ""
    try:
        yield
    except WRONG as error:
        came = first_wrong(error) if isinstance(error, ValidationError) else f"{type(error).__name__}: {error!s:.200}"
        raise DamageError(
            f"{what} of {path} is not what is written there: {came}. It is damaged, or was made by another program: "
            "use none of this memory before you know who made it (scroll-tactile memory check)",
            path=path,
            sequence=held.sequence if isinstance(held, Head) else None,
        ) from error


def require_row(stream: Stream) -> None:
    """Raise StreamError for a touch that is too long for a row of the journal."""
    if stream.readings.nbytes > MOST_BYTES:
        raise StreamError(
            f"expected a touch of at most {MOST_BYTES // (4 * stream.sensor.channels)} readings of sensor "
            f"{stream.sensor.name!r}, 256 MiB; came {len(stream)}. Cut it into touches"
        )


def pack_readings(readings: Readings) -> dict[str, npt.NDArray[Any]]:
    """Readings as the arrays of a journal row, which give the same bits back: float32 of shape (T, ...).

    Most sensors count: values that are multiples of one power of two are kept as small integers, channel by channel,
    for neighbours in time are alike (BioTac: 3.7 KB a touch in place of 9). Others are kept as they are but for zeros,
    which are half of what a skin reads (RoboSkin: 9.3 KB in place of 13).
    """
    if (counts := _counts(readings)) is None:
        zero = readings.view(np.uint32) == 0  # of the bits: −0 is none
        return {PACKED_SHAPE: np.array(readings.shape), PACKED_ZERO: np.packbits(zero), PACKED_REST: readings[~zero]}
    power, whole = counts
    return {f"{PACKED_WHOLE}{power}": np.ascontiguousarray(np.moveaxis(whole, 0, -1))}


def _counts(readings: Readings) -> tuple[int, npt.NDArray[np.integer]] | None:
    """A power, and the readings in units of two to it as integers of at most 16 bits; None where they are none."""
    some = readings[readings != 0]
    if not np.isfinite(some).all() or np.signbit(readings[readings == 0]).any():
        return None
    mantissas, exponents = np.frexp(some)
    digits = np.ldexp(mantissas, MANTISSA).astype(np.int32)
    trailing = np.frexp((digits & -digits).astype(np.float32))[1] - 1
    power = int((exponents - MANTISSA + trailing).min(initial=LARGEST_EXPONENT)) if len(some) else 0
    whole = np.ldexp(readings.astype(np.float64), -power)
    for kind in (np.uint8, np.int8, np.int16):
        if np.iinfo(kind).min <= whole.min(initial=0) and whole.max(initial=0) <= np.iinfo(kind).max:
            return power, whole.astype(kind)
    return None


def unpack_readings(arrays: Arrays) -> Readings | None:
    """The readings that `pack_readings` packed; None where there are none. They take no more than a multiple of it."""
    if PACKED_REST in arrays:
        shape, zero = arrays[PACKED_SHAPE].tolist(), np.unpackbits(arrays[PACKED_ZERO]) > 0
        size = math.prod(shape)
        readings: Readings = np.zeros(len(zero), np.float32)
        readings[:size][~zero[:size]] = arrays[PACKED_REST]
        return readings[:size].reshape(shape)
    for name, whole in arrays.items():
        if name.startswith(PACKED_WHOLE):
            power = int(name.removeprefix(PACKED_WHOLE))
            return np.ldexp(np.ascontiguousarray(np.moveaxis(whole, -1, 0)).astype(np.float32), power)
    return None


def declared_by(row: Head) -> Quantity:
    """The quantity that a row declares. Raises InputError for what is none."""
    return Quantity(name=row.label, **cast(dict[str, Any], row.attributes))


def annotated(annotation: Annotation) -> dict[str, Any]:
    """The attributes of a row with which an annotation is kept: none where there is nothing in it."""
    found = {"values": dict(annotation.values), "labels": dict(annotation.labels)}
    return {name: told for name, told in found.items() if told}


def annotation_of(attributes: Mapping[str, Any]) -> Annotation:
    """The annotation that `annotated` made attributes of."""
    values, labels = (tuple(sorted(attributes.get(name, {}).items())) for name in ("values", "labels"))
    return Annotation(values, labels)


def pack_codes(codes: Codes) -> dict[str, npt.NDArray[Any]]:
    """Codes by scale as the arrays of a journal row."""
    return {f"{CODES}{scale}": rows for scale, rows in codes.items()}


def unpack_codes(arrays: Arrays) -> Codes:
    """The codes that `pack_codes` packed; none where the row has readings alone."""
    named = [name for name in arrays if name.startswith(CODES)]
    return {Scale.numbered(int(name.removeprefix(CODES))): arrays[name] for name in named}


def retracted_by(rows: Iterable[Head]) -> set[int]:
    """The observations that these rows of a journal retracted."""
    return {row for head in rows if head.kind == Kind.RETRACT for row in unspanned(head.attributes["sequences"])}


def active_rows(rows: Iterable[Head]) -> list[Head]:
    """The rows that something was learned from, compacted ones too, without the retracted ones."""
    heads = list(rows)
    gone = retracted_by(heads)
    return [row for row in heads if row.kind in (Kind.OBSERVE, Kind.MERGE, Kind.MEMBER) and row.sequence not in gone]


def spans(sequences: Iterable[int]) -> list[list[int]]:
    """Whole numbers as [first, last] pairs of those that follow each other: 1, 2, 3, 7 → [[1, 3], [7, 7]]."""
    ordered = sorted(sequences)
    edges = [i for i in range(1, len(ordered)) if ordered[i] > ordered[i - 1] + 1]
    return [[ordered[first], ordered[last - 1]] for first, last in pairwise([0, *edges, len(ordered)]) if last]


def unspanned(pairs: Any) -> list[int]:
    """The numbers that `spans` made pairs of."""
    return [sequence for first, last in pairs for sequence in range(first, last + 1)]
