"""Fields: a part of a memory as arrays and JSON values, and back. What each must be is written beside it, once.

A part is a dataclass. A field of it is

- an array, `Annotated[Ints, Must("int64", "C 2", 0, 9)]`, or a mapping from scales or names to such arrays;
- another part, or a list of parts;
- a value of JSON, as its type says.

An array is named by its field, behind the fields that its part lies in: `statistics-sums-30` is the array of scale 30
of the field `sums` of the part `statistics`. What is None, or empty and has a default, is left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from reprlib import repr as shortened
from typing import Annotated, Any, TypeVar, cast, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, TypeAdapter, ValidationError

from scroll_tactile.settings import require_name
from scroll_tactile.signals.windows import Scale

__all__ = [
    "KEY_BYTES",
    "Arrays",
    "Bytes",
    "Ints",
    "Must",
    "Name",
    "Unexpected",
    "decode",
    "encode",
    "expect",
    "first_wrong",
    "key_rows",
]

Arrays = Mapping[str, npt.NDArray[Any]]
Ints = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]
Name = Annotated[str, AfterValidator(require_name)]
"""A name of a material, a label, an axis or a quantity."""

KEY_BYTES = 32  # of a touch's content hash, see `Stream.key`
P = TypeVar("P")


class Unexpected(ValueError):
    """What was read is not what is written there; the message names the field, what was expected and what came."""


def expect(holds: bool | np.bool, field: str, expected: str, came: object) -> None:
    """Raise Unexpected unless it holds."""
    if not holds:
        raise Unexpected(f"{field}: expected {expected}; came {shortened(came)}")


@dataclass(frozen=True)
class Must:
    """What an array must be.

    shape: a word for each axis: its size; the name of a size, which is one in all of a part; "*" for any; or at the end
    "..." for any axes. least, most: bounds of the values, where the code could not work beyond them; `most` of all, or
    of each place along the last axis. A list of JSON has the dtype "", and the name of its length for a shape.
    """

    dtype: str
    shape: str
    least: float = -math.inf
    most: float | tuple[int, ...] = math.inf

    def check(self, field: str, array: Any, sizes: dict[str, int]) -> None:
        """Raise Unexpected where an array is anything else; sizes: those that are known, to which its own are added."""
        axes, shape = self.shape.split(), getattr(array, "shape", None) or np.shape(array or ())[:1]
        if axes[-1] == "...":
            axes = axes[:-1] + ["*"] * (len(shape) - len(axes) + 1)
        known = {axis: int(axis) if axis.isdigit() else sizes.get(axis) for axis in axes}
        fits = len(shape) == len(axes) and all(
            known[axis] in (None, own) for axis, own in zip(axes, shape, strict=True)
        )
        came = "none" if array is None else f"{getattr(array, 'dtype', type(array).__name__)} {shape}"
        shown = f"{self.dtype or 'a list'} of shape ({', '.join(str(known[axis] or 'any') for axis in axes)})"
        expect(fits and str(getattr(array, "dtype", "")) == self.dtype, field, shown, came)
        sizes |= {axis: own for axis, own in zip(axes, shape, strict=True) if axis.isalpha()}
        if self.least > -math.inf and array.size:
            low, high = array.min(), array.max(axis=0)
            inside = bool(low >= self.least and np.all(high <= self.most))
            expect(inside, field, f"values from {self.least} to {self.most}", (low, high.max()))


def key_rows(keys: Sequence[bytes]) -> Bytes:
    """Content hashes as an array, uint8 (n, 32)."""
    return np.frombuffer(b"".join(keys), np.uint8).reshape(len(keys), len(keys[0]) if keys else KEY_BYTES)


@dataclass(frozen=True)
class _Field:
    """A field of a part: an array, several arrays by `keys`, another `part`, `several` parts, or what `json` reads."""

    name: str
    needed: bool
    must: Must | None
    keys: Any
    part: Any
    several: bool
    json: TypeAdapter[Any] | None


@cache
def _fields_of(part: Any) -> list[_Field]:
    found, hints = list[_Field](), get_type_hints(part, include_extras=True)
    for field in fields(part):
        options, needed = get_args(hints[field.name]), field.default is MISSING and field.default_factory is MISSING
        hint = options[0] if type(None) in options else hints[field.name]
        must = next((each for each in getattr(hint, "__metadata__", ()) if isinstance(each, Must)), None)
        own = hint if must is None else get_args(hint)[0]
        several = get_origin(own) is list and is_dataclass(get_args(own)[0])
        inner = get_args(own)[0] if several else own
        array, part_of = must is not None and bool(must.dtype), inner if is_dataclass(inner) else None
        keys = get_args(own)[0] if array and get_origin(own) is dict else None
        json = None if array or part_of else TypeAdapter(own)
        found.append(_Field(field.name, needed, must, keys, part_of, several, json))
    return found


def encode(part: Any, at: str = "") -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """The arrays of a part by name, and its values of JSON. at: the fields that the part lies in."""
    arrays, told = dict[str, npt.NDArray[Any]](), dict[str, Any]()
    kind: Any = type(part)
    for field in _fields_of(kind):
        value, name = getattr(part, field.name), at + field.name
        if value is None or (field.json and not value and not field.needed):
            continue
        if field.json:
            told[field.name] = value
        elif field.keys:
            arrays |= {f"{name}-{key}": array for key, array in value.items()}
        elif not field.part:
            arrays[name] = value
        else:
            parts = [(f"{name}-{i}-", one) for i, one in enumerate(value)] if field.several else [(f"{name}-", value)]
            encoded = [encode(one, place) for place, one in parts]
            for own, _ in encoded:
                arrays |= own
            told[field.name] = [each for _, each in encoded] if field.several else encoded[0][1]
    return arrays, told


def decode(part: type[P], arrays: Arrays, told: Any, sizes: Mapping[str, int], at: str = "") -> P:
    """The part that `encode` took apart; the arrays are its own from now on.

    sizes: those that are known before. at: the fields that the part lies in. Raises Unexpected for what is not what its
    field says, ValueError for an array of no scale.
    """
    expect(isinstance(told, dict), at.removesuffix("-") or "attributes", "a mapping", told)
    found, known, kind = dict[str, Any](), dict(sizes), cast(Any, part)
    for field in _fields_of(kind):
        name, value = at + field.name, told.get(field.name)
        if field.keys:
            of = (lambda key: Scale.numbered(int(key))) if field.keys is Scale else field.keys
            own = [each for each in arrays if each.startswith(f"{name}-")]
            value = {of(each.removeprefix(f"{name}-")): _checked(field, each, arrays[each], known) for each in own}
        elif not field.part and not field.json:
            value = arrays.get(name)
        if value is None and not field.needed:
            continue  # it has its default
        if field.json:
            try:
                value = field.json.validate_python(value)
            except ValidationError as error:
                raise Unexpected(f"{name}.{first_wrong(error)}") from None
        elif field.several:
            expect(isinstance(value, list), name, "a list", value)
            value = [decode(field.part, arrays, one, sizes, f"{name}-{i}-") for i, one in enumerate(value)]
        elif field.part:
            value = decode(field.part, arrays, value, sizes, f"{name}-")
        found[field.name] = value if field.keys else _checked(field, name, value, known)
    return part(**found)


def _checked(field: _Field, name: str, value: Any, known: dict[str, int]) -> Any:
    if field.must is not None:
        field.must.check(name, value, known)
    return value


def first_wrong(error: ValidationError) -> str:
    """The first thing that is wrong: the field, what was expected, and what came."""
    first = error.errors(include_url=False)[0]
    return f"{'.'.join(map(str, first['loc']))}: {first['msg']}; came {shortened(first['input'])}"
