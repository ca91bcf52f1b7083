"""What a journal row holds of a touch, and how it is packed: exactly, and small."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BaseModel, Field, ValidationError
from scroll_tactile_store import Checkpoint, DamageError, Head

from scroll_tactile.errors import InputError, MismatchError, StreamError
from scroll_tactile.quantities import MOST_QUANTITIES, MOST_STEPS, Quantity
from scroll_tactile.settings import require_source
from scroll_tactile.signals.stream import Stream
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.annotations import MOST_AXES, NO_ANNOTATION, Annotation
from scroll_tactile.statistics.fields import Arrays, Name, Unexpected, first_wrong
from scroll_tactile.statistics.statistics import LONGEST_TOUCH

__all__ = [
    "ADAPT",
    "CHANNELS",
    "CODES",
    "CORRECTION",
    "DECLARE",
    "DESCRIBE",
    "KINDS",
    "LABELS",
    "MEMBER",
    "MERGE",
    "MOST_BYTES",
    "OBSERVE",
    "PACKED_SHAPE",
    "PACKED_ZERO",
    "RETRACT",
    "RETRACTS",
    "SENSE",
    "SOURCE",
    "VALUES",
    "Arrays",
    "Changed",
    "Codes",
    "Encode",
    "Readings",
    "RowFields",
    "active_rows",
    "annotated",
    "annotation_of",
    "declaration",
    "declared_by",
    "only_readings",
    "pack_codes",
    "pack_readings",
    "place_of",
    "refusing",
    "require_row",
    "retracted_by",
    "row_codes",
    "spans",
    "unpack_codes",
    "unpack_readings",
    "unspanned",
]

OBSERVE = "observe"  # a stream was observed; see below
RETRACT = "retract"  # observations were retracted; the attribute "sequences" holds [first, last] pairs
MERGE = "merge"  # a compacted memory came in as a whole; the arrays are those of its compaction checkpoint
MEMBER = "member"  # a stream that such a memory had observed: its name and hash alone
DESCRIBE = "describe"  # what a material is made of, in the attribute "constituents"; null removes the description
DECLARE = "declare"  # a quantity that touches can carry: its unit, low, high and resolution; the label is its name
SENSE = "sense"  # a touch of the material that is its label, or without one the sensor at rest: read, and not learned
ADAPT = "adapt"  # touches from now on are read through a correction; or an earlier such row counts no more
SOURCE = "source"  # an attribute of an observation: the file or place it comes from, where `observe` was given one
VALUES, LABELS = "values", "labels"  # of an observation or a member: quantity → steps, and axis → label, if any
CHANNELS = "channels"  # of an observation or a sense: numbers of the channels, see `health.channel_numbers`
CORRECTION, RETRACTS = "correction", "retracts"  # of an adapt: `Correction.to_text`, or the row that is taken back
KINDS = [OBSERVE, RETRACT, MERGE, MEMBER, DESCRIBE, DECLARE, SENSE, ADAPT]

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


Whole = Annotated[int, Field(strict=True)]


class RowFields(BaseModel):
    """What the attributes of a row must be, where they are there; see the kinds above.

    columns: of the touch. nbytes: of its readings, where the row has them.
    """

    columns: Annotated[Whole, Field(ge=1, le=LONGEST_TOUCH)] | None = None
    nbytes: Annotated[Whole, Field(ge=1, le=MOST_BYTES)] | None = None
    source: Annotated[str, AfterValidator(require_source)] | None = None
    values: dict[Name, Annotated[Whole, Field(ge=0, le=MOST_STEPS)]] = Field({}, max_length=MOST_QUANTITIES)
    labels: dict[Name, Name] = Field({}, max_length=MOST_AXES)
    sequences: list[tuple[Whole, Whole]] | None = None
    retracts: Whole | None = None
    correction: str | None = None
    constituents: dict[str, Any] | None = None


def place_of(held: Head | Checkpoint) -> tuple[str, int | None]:
    """What `refusing` calls a row or a checkpoint, and the sequence of a row."""
    return (f"row {held.sequence}", held.sequence) if isinstance(held, Head) else (f"checkpoint {held.number}", None)


@contextmanager
def refusing(path: Path, what: str, sequence: int | None = None) -> Iterator[None]:
    """Name the place of what is found wrong there: as MismatchError what this version does not know, else DamageError.

    what: such as "row 3". sequence: of a row.
    """
    try:
        yield
    except MismatchError as error:
        advice = "Open the memory with the version that wrote it, or a newer one"
        raise MismatchError(f"{what} of {path} {error}. {advice}") from None
    except WRONG as error:
        came = str(error) if isinstance(error, Unexpected | InputError) else f"{type(error).__name__}: {error!s:.200}"
        came = first_wrong(error) if isinstance(error, ValidationError) else came
        raise DamageError(
            f"{what} of {path} is not what is written there: {came}. It is damaged, or was made by another program: "
            "use none of this memory before you know who made it (scroll-tactile memory check)",
            path=path,
            sequence=sequence,
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
    """The readings that `pack_readings` packed, or that a compaction checkpoint has as they are; None without any."""
    if "readings" in arrays:
        return arrays["readings"]
    if PACKED_REST in arrays:
        readings: Readings = np.zeros(arrays[PACKED_SHAPE], np.float32)
        readings.reshape(-1)[np.unpackbits(arrays[PACKED_ZERO], count=readings.size) == 0] = arrays[PACKED_REST]
        return readings
    for name, whole in arrays.items():
        if name.startswith(PACKED_WHOLE):
            power = int(name.removeprefix(PACKED_WHOLE))
            return np.ldexp(np.ascontiguousarray(np.moveaxis(whole, -1, 0)).astype(np.float32), power)
    return None


def only_readings(arrays: Arrays) -> dict[str, npt.NDArray[Any]]:
    """Of the arrays of a row, those that hold its readings."""
    return {name: array for name, array in arrays.items() if name.startswith("readings")}


def declaration(quantity: Quantity) -> dict[str, Any]:
    """The attributes of the row that declares a quantity; its label is the name."""
    return quantity.model_dump(exclude={"name"})


def declared_by(row: Head) -> Quantity:
    """The quantity that a row declares. Raises InputError for what is none."""
    fields: dict[str, Any] = {name: row.attributes.get(name) for name in ("unit", "low", "high", "resolution")}
    return Quantity(name=row.label, **fields)


def annotated(annotation: Annotation) -> dict[str, Any]:
    """The attributes of a row with which an annotation is kept: none where there is nothing in it."""
    found = {VALUES: dict(annotation.values), LABELS: dict(annotation.labels)}
    return {name: told for name, told in found.items() if told}


def annotation_of(attributes: Mapping[str, Any]) -> Annotation:
    """The annotation that `annotated` made attributes of."""
    values, labels = (attributes.get(name, {}) for name in (VALUES, LABELS))
    return (
        Annotation(tuple(sorted(values.items())), tuple(sorted(labels.items()))) if values or labels else NO_ANNOTATION
    )


def pack_codes(codes: Codes) -> dict[str, npt.NDArray[Any]]:
    """Codes by scale as the arrays of a journal row."""
    return {f"{CODES}{scale}": rows for scale, rows in codes.items()}


def unpack_codes(arrays: Arrays) -> Codes:
    """The codes that `pack_codes` packed; none where the row has readings alone."""
    numbers = {name: int(name.removeprefix(CODES)) for name in arrays if name.startswith(CODES)}
    return {Scale.numbered(number): arrays[name] for name, number in numbers.items()}


def row_codes(arrays: Arrays, encode: Encode | None) -> Codes:
    """The rows of codes that a touch added, by scale, from the arrays of its journal row.

    encode: embeds readings where the row has nothing else; None raises MismatchError there.
    """
    if codes := unpack_codes(arrays):
        return codes
    readings = unpack_readings(arrays)
    if readings is None or encode is None:
        raise MismatchError(
            "a row of the journal holds readings alone, and they can be embedded only by the embedding that made the "
            "memory: open it with TactileLearner.open(path, embedding=...)"
        )
    return encode(readings)


def retracted_by(rows: Iterable[Head]) -> set[int]:
    """The observations that these rows of a journal retracted."""
    return {row for head in rows if head.kind == RETRACT for row in unspanned(head.attributes["sequences"])}


def active_rows(rows: Iterable[Head]) -> list[Head]:
    """The rows that something was learned from, compacted ones too, without the retracted ones."""
    heads = list(rows)
    retracted = retracted_by(heads)
    return [head for head in heads if head.kind in (OBSERVE, MERGE, MEMBER) and head.sequence not in retracted]


def spans(sequences: Iterable[int]) -> list[list[int]]:
    """Whole numbers as [first, last] pairs of those that follow each other: 1, 2, 3, 7 → [[1, 3], [7, 7]]."""
    pairs: list[list[int]] = []
    for sequence in sorted(sequences):
        if pairs and pairs[-1][1] == sequence - 1:
            pairs[-1][1] = sequence
        else:
            pairs.append([sequence, sequence])
    return pairs


def unspanned(pairs: Any) -> list[int]:
    """The numbers that `spans` made pairs of."""
    return [sequence for first, last in pairs for sequence in range(first, last + 1)]
