"""What is expected of values that come from a disk, and how what came instead is told."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from reprlib import repr as shortened
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.settings import require_name, require_source
from scroll_tactile.statistics.grid import BITS
from store.records import LateArray

__all__ = [
    "KEY_BYTES",
    "MOST_COLUMNS",
    "Unexpected",
    "array",
    "check_values",
    "codes",
    "counts",
    "expect",
    "keys",
    "name",
    "source",
    "whole",
]

KEY_BYTES = 32  # of a stream's content hash, see `Stream.key`
MOST_COLUMNS = 2**28  # of a touch: 256 MiB of the smallest readings


class Unexpected(ValueError):
    """A value from a disk is not what is written there; the message names its field."""


def expect(holds: bool | np.bool, field: str, expected: str, came: object) -> None:
    """Raise Unexpected unless it holds."""
    if not holds:
        raise Unexpected(f"{field}: expected {expected}; came {shortened(came)}")


def whole(field: str, value: Any, least: int, most: int) -> int:
    """A whole number within bounds; Unexpected for anything else."""
    expect(type(value) is int and least <= value <= most, field, f"a whole number from {least} to {most}", value)
    return int(value)


def name(field: str, value: Any) -> str:
    """What can name a material, by the rule that `observe` has; Unexpected for anything else."""
    return _text(field, value, require_name)


def source(field: str, value: Any) -> str:
    """What can say where a touch comes from, by the rule that `observe` has; Unexpected for anything else."""
    return _text(field, value, require_source)


def _text(field: str, value: Any, rule: Callable[[str], str]) -> str:
    try:
        return rule(value)
    except InputError as error:
        raise Unexpected(f"{field}: {error}") from None


def array(
    arrays: Mapping[str, Any], field: str, kinds: Collection[str], shape: tuple[int | None, ...]
) -> npt.NDArray[Any]:
    """The array of that name; Unexpected where there is none, or it is of another type or shape.

    kinds: dtypes as NumPy writes them, such as "int64". shape: None for an axis of any length.
    """
    found: Any = arrays.get(field)
    expected = f"{' or '.join(kinds)} of shape {shape}".replace("None", "any")
    if found is None:
        raise Unexpected(f"{field}: expected {expected}; there is none")
    fits = len(found.shape) == len(shape) and all(
        own in (None, axis) for own, axis in zip(shape, found.shape, strict=True)
    )
    expect(found.dtype.name in kinds and fits, field, expected, f"{found.dtype} {found.shape}")
    return cast("npt.NDArray[Any]", found)


def check_values(values: npt.NDArray[Any] | LateArray, check: Callable[[npt.NDArray[Any]], None]) -> None:
    """Check values; those that are read later, then."""
    if isinstance(values, LateArray):
        values.check = check
    else:
        check(values)


def codes(field: str, values: npt.NDArray[Any], most: int | npt.NDArray[np.int64] = 1) -> None:
    """Raise Unexpected for codes, or sums of so many of them, beyond the grid; most: against the values' shape."""
    limit = np.asarray(most, dtype=np.int64) << BITS
    if limit.ndim == 0 and values.size:
        outside = values.min() < -limit or values.max() > limit
    else:
        outside = bool(((values < -limit) | (values > limit)).any())
    expect(not outside, field, f"codes of magnitude at most 2**{BITS} a row", "larger ones")


def counts(field: str, values: npt.NDArray[np.int64], least: int, most: int) -> npt.NDArray[np.int64]:
    """These numbers; Unexpected where any is not within bounds."""
    if values.size:
        low, high = int(values.min()), int(values.max())
        expect(least <= low and high <= most, field, f"numbers from {least} to {most}", (low, high))
    return values


def keys(arrays: Mapping[str, npt.NDArray[Any]], field: str, materials: list[str]) -> None:
    """Raise Unexpected for anything but one content hash for each material's stream, all different."""
    count = len(materials)
    found = array(arrays, field, ("uint8",), (count, KEY_BYTES if count else None))
    pairs = {(material, key.tobytes()) for material, key in zip(materials, found, strict=True)}
    expect(len(pairs) == count, field, "different streams", f"{count} of which {len(pairs)} differ")
