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
from typing import Annotated, Any, Literal, TypeVar, cast, get_args, get_origin, get_type_hints

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
        axes, shape = self.shape.split(), getattr(array, "shape", (len(array),) if isinstance(array, list) else ())
        if axes[-1] == "...":
            axes = axes[:-1] + ["*"] * (len(shape) - len(axes) + 1)
        known = [None if axis == "*" else int(axis) if axis.isdigit() else sizes.get(axis) for axis in axes]
        fits = len(shape) == len(axes) and all(own in (None, size) for own, size in zip(known, shape, strict=True))
        if self.dtype:
            came = "none" if array is None else f"{array.dtype} {array.shape}"
            shown = ", ".join("any" if size is None else str(size) for size in known)
            expect(fits and array.dtype.name == self.dtype, field, f"{self.dtype} of shape ({shown})", came)
        else:
            expect(fits, field, f"{known[0]} values", shape)
        sizes |= {axis: size for axis, size in zip(axes, shape, strict=True) if not (axis == "*" or axis.isdigit())}
        if self.least > -math.inf and array.size:
            low, high = array.min(), array.max(axis=0)
            inside = bool(low >= self.least and np.all(high <= self.most))
            expect(inside, field, f"values from {self.least} to {self.most}", (low, high.max()))


def key_rows(keys: Sequence[bytes]) -> Bytes:
    """Content hashes as an array, uint8 (n, 32)."""
    return np.frombuffer(b"".join(keys), np.uint8).reshape(len(keys), len(keys[0]) if keys else KEY_BYTES)


Kind = Literal["array", "arrays", "part", "parts", "json"]


@dataclass(frozen=True)
class _Field:
    """A field of a part. inner: the type of its arrays' keys, or of its part, or what reads its JSON."""

    name: str
    kind: Kind
    inner: Any
    must: Must | None
    needed: bool


@cache
def _fields_of(part: Any) -> list[_Field]:
    found, hints = list[_Field](), get_type_hints(part, include_extras=True)
    for field in fields(part):
        options, needed = get_args(hints[field.name]), field.default is MISSING and field.default_factory is MISSING
        hint = options[0] if type(None) in options else hints[field.name]
        must = next((each for each in getattr(hint, "__metadata__", ()) if isinstance(each, Must)), None)
        own = get_args(hint)[0] if must is not None else hint
        origin, inside = get_origin(own), get_args(own)
        kind: Kind = "json"
        inner: Any = None
        if must is not None and must.dtype:
            kind, inner = ("arrays", inside[0]) if origin is dict else ("array", None)
        elif is_dataclass(own):
            kind, inner = "part", own
        elif origin is list and is_dataclass(inside[0]):
            kind, inner = "parts", inside[0]
        found.append(_Field(field.name, kind, TypeAdapter(own) if kind == "json" else inner, must, needed))
    return found


def encode(part: Any) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """The arrays of a part by name, and its values of JSON."""
    arrays: dict[str, npt.NDArray[Any]] = {}
    return arrays, _encoded(part, "", arrays)


def _encoded(part: Any, at: str, arrays: dict[str, npt.NDArray[Any]]) -> dict[str, Any]:
    """The JSON of a part that lies in these fields; its arrays are added."""
    told: dict[str, Any] = {}
    kind: Any = type(part)
    for field in _fields_of(kind):
        value, name = getattr(part, field.name), at + field.name
        if value is None:
            continue
        if field.kind == "array":
            arrays[name] = value
        elif field.kind == "arrays":
            arrays |= {f"{name}-{key}": array for key, array in value.items()}
        elif field.kind == "part":
            told[field.name] = _encoded(value, f"{name}-", arrays)
        elif field.kind == "parts":
            told[field.name] = [_encoded(one, f"{name}-{i}-", arrays) for i, one in enumerate(value)]
        elif value or field.needed:
            told[field.name] = value
    return told


def decode(part: type[P], arrays: Arrays, told: Any, sizes: Mapping[str, int], at: str = "") -> P:
    """The part that `encode` took apart; the arrays are its own from now on.

    sizes: those that are known before. at: the fields that the part lies in. Raises Unexpected for what is not what its
    field says, ValueError for an array of no scale.
    """
    expect(isinstance(told, dict), at.removesuffix("-") or "attributes", "a mapping", told)
    found, known, kind = dict[str, Any](), dict(sizes), cast(Any, part)
    for field in _fields_of(kind):
        name, value = at + field.name, told.get(field.name)
        if field.kind == "arrays":
            own = {each: each.removeprefix(f"{name}-") for each in arrays if each.startswith(f"{name}-")}
            of = (lambda key: Scale.numbered(int(key))) if field.inner is Scale else field.inner
            found[field.name] = {of(key): _checked(field, each, arrays[each], known) for each, key in own.items()}
        elif not field.needed and (name not in arrays if field.kind == "array" else value is None):
            continue  # it has its default
        elif field.kind == "array":
            found[field.name] = _checked(field, name, arrays.get(name), known)
        elif field.kind == "part":
            found[field.name] = decode(field.inner, arrays, value, sizes, f"{name}-")
        elif field.kind == "parts":
            expect(isinstance(value, list), name, "a list", value)
            found[field.name] = [decode(field.inner, arrays, one, sizes, f"{name}-{i}-") for i, one in enumerate(value)]
        else:
            try:
                found[field.name] = _checked(field, name, field.inner.validate_python(value), known)
            except ValidationError as error:
                raise Unexpected(f"{name}.{first_wrong(error)}") from None
    return part(**found)


def _checked(field: _Field, name: str, value: Any, known: dict[str, int]) -> Any:
    if field.must is not None:
        field.must.check(name, value, known)
    return value


def first_wrong(error: ValidationError) -> str:
    """The first thing that is wrong: the field, what was expected, and what came."""
    first = error.errors(include_url=False)[0]
    return f"{'.'.join(map(str, first['loc']))}: {first['msg']}; came {shortened(first['input'])}"
