"""The path from a message to its numbers: `tactiles[0].electrodes`, `pillars[*].{fX,fY,fZ}`.

A path is names joined by dots. `[2]` takes an element, `[*]` all of them, `[4:23]` some; `{x,y,z}` takes several fields
of one message, in this order. Values come out message by message: x, y, z of the first taxel, then of the second. Names
are compared as written, then without regard to case, since ROS 2 writes in lower case what ROS 1 does not.

A file of arrays has no messages: there a field is an array's name, or the end of it, with an index behind (`matched`).
"""

from __future__ import annotations

import array
import difflib
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import FieldError

__all__ = ["FieldPath", "fields_of", "matched", "nearest", "select"]

_Step = Callable[[list[Any]], list[Any]]
_NAME, _SPACE = re.compile(r"[A-Za-z_]\w*"), re.compile(r"\s*")
_INDEX = re.compile(r"\[\s*(?:(\*)|(-?\d{1,9})|(-?\d{1,9})?\s*:\s*(-?\d{1,9})?)\s*\]")
_ARRAYS = (list, tuple, np.ndarray, array.array)  # rclpy has the last
_DEEPEST = 32  # no message is nested as deep; a path of a million braces is no path


class FieldPath:
    """A path, compiled once and applied to many messages, or to dictionaries and lists as JSON has them.

    Raises FieldError, showing where, for a text that is no path.
    """

    def __init__(self, text: str) -> None:
        self.text = text.strip()
        self._steps, _ = _compiled(self.text)

    def values(self, message: object) -> list[Any]:
        """What the path leads to, in order: numbers, arrays, texts, or messages. An empty array leads to nothing.

        Raises FieldError for a field that a message does not have, naming those nearest, or an element beyond the end.
        """
        found = [message]
        try:
            for step in self._steps:
                found = step(found)
            return found
        except FieldError as error:
            raise FieldError(f"field {self.text!r}: {error}") from None

    def reading(self, message: object) -> npt.NDArray[Any]:
        """The numbers that the path leads to, flat: one reading, shape (n,), of n = 0 where its array is empty.

        Raises FieldError for a field that is not there, or one that holds text or whole messages.
        """
        found = self.values(message)
        if len(found) == 1:
            return self._numbers(found[0])
        if set(map(type, found)) <= {float, int}:
            return np.asarray(found)
        return np.concatenate([self._numbers(value) for value in found])

    def _numbers(self, value: Any) -> npt.NDArray[Any]:
        if not isinstance(value, np.ndarray):
            if isinstance(value, str) or fields_of(_first(value)):
                self._refuse(value)
            try:
                value = np.asarray(value)
            except ValueError as error:
                raise FieldError(f"field {self.text!r} leads to ragged arrays, whose rows differ in length") from error
        if value.dtype.kind not in "biuf":
            self._refuse(value)
        flat: npt.NDArray[Any] = value.reshape(-1)
        return flat

    def _refuse(self, value: Any) -> NoReturn:
        message = _first(value)
        if names := fields_of(message):
            deeper = f"{self.text}[*]" if message is not value else self.text
            raise FieldError(
                f"field {self.text!r} leads to a message, not to numbers; inside it are {', '.join(names)}: "
                f"write {deeper}.{names[-1]!s} or {deeper}.{{{','.join(names[-3:])}}}"
            )
        kind = "text" if isinstance(message, str | bytes | np.str_) else f"a {type(message).__name__}"
        raise FieldError(f"field {self.text!r} leads to {kind}, {str(value)!r:.40}; expected numbers")


def _first(value: Any) -> Any:
    """The first element of a list; anything else itself."""
    return value[0] if isinstance(value, list | tuple) and value else value


def matched(field: str, keys: Collection[str], source: str) -> tuple[str, str]:
    """The key that a field names, and the index behind it.

    Raises FieldError where no key is called so, naming the nearest, or the end of several is.
    """
    if field in keys:
        return field, ""
    name, rest = field.strip(), ""
    if name.endswith("]") and (begin := name.find("[", name.rfind("]", 0, -1) + 1)) >= 0:
        name, rest = name[:begin].rstrip(), name[begin:]
    if name in keys:
        return name, rest
    ends = [key for key in keys if re.split(r"[/.]", key)[-1] == name or key.endswith(f"/{name}")]
    if len(ends) == 1:
        return ends[0], rest
    if ends:
        raise FieldError(f"{source}: field {field!r} may be any of {', '.join(ends)}: name it in full")
    raise FieldError(f"{source} has no field {field!r}{nearest(name, list(keys))}")


def select(array: npt.NDArray[Any], rest: str, text: str) -> npt.NDArray[Any]:
    """The columns of (T, …) that `rest`, such as "", "[3]" or "[0:19]", takes of each reading.

    Raises FieldError for a rest that is not one index, or lies beyond the columns.
    """
    if not rest:
        return array
    if not (found := _INDEX.fullmatch(rest.strip())):
        raise FieldError(f"field {text!r}: expected one index such as [0:19] after the name; came {rest!r}")
    step = _index(found)
    try:
        return array[:, [step]] if isinstance(step, int) else array[:, step]
    except IndexError as error:
        raise FieldError(f"field {text!r}: index {step} lies beyond its {array.shape[1]} columns") from error


def fields_of(message: object) -> tuple[str, ...]:
    """The names of a message's fields, or a dictionary's keys; none for anything else."""
    if isinstance(message, Mapping):
        return tuple(str(key) for key in message)
    names = getattr(message, "__dataclass_fields__", None)
    if names is None:
        described = getattr(message, "get_fields_and_field_types", None)  # rclpy's messages
        names = () if described is None else described()
    return tuple(name for name in names if name != "__msgtype__")


def nearest(name: str, names: Sequence[str]) -> str:
    """Which of `names` are nearest to `name`, as the end of a message: "; nearest is 'a' (of a, b, c)"."""
    if not names:
        return "; there are none"
    close = difflib.get_close_matches(name.lower(), [other.lower() for other in names], n=1, cutoff=0.5)
    found = next((other for other in names if close and other.lower() == close[0]), None)
    listed = ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")
    return f"; there are {listed}" if found is None else f"; nearest is {found!r} (of {listed})"


# A path's text, compiled: each step makes of a list of values the list of what it leads to.


def _compiled(text: str, i: int = 0, depth: int = 0) -> tuple[list[_Step], int]:
    """The steps of the path that begins at letter i, and where it ends; raises FieldError for a text that is none."""
    if depth > _DEEPEST:
        _fail(text, i, f"at most {_DEEPEST} braces within each other")
    steps: list[_Step] = []
    fresh = True  # a name comes next: at the beginning, and behind a dot
    while True:
        i = _SPACE.match(text, i).end()  # type: ignore[union-attr]  # it always matches
        letter = text[i : i + 1]
        if letter == "[":
            if (found := _INDEX.match(text, i)) is None:
                _fail(text, i, "an index: [0], [*] or [0:19]")
            steps.append(partial(_element, _index(found)))
            fresh, i = False, found.end()
        elif letter == "{" and fresh:
            paths = []
            while letter in ("{", ","):
                path, i = _compiled(text, i + 1, depth + 1)
                paths.append(path)
                letter = text[i]
            plain = all(isinstance(step, _Attribute) for path in paths for step in path)  # each leads to one value
            steps.append(partial(_columns if plain else _several, paths))
            fresh, i = False, i + 1
        elif fresh and (found := _NAME.match(text, i)):
            steps.append(_Attribute(found[0]))
            fresh, i = False, found.end()
        elif letter == "." and not fresh:
            fresh, i = True, i + 1
        elif not fresh and letter in ((",", "}") if depth else ("",)):
            return steps, i
        else:
            _fail(text, i, "a field's name" if fresh else "a dot or an index")


def _fail(text: str, i: int, expected: str) -> NoReturn:
    raise FieldError(
        f"field {text!r:.80}: expected {expected} at character {i + 1}; came {text[i:][:10]!r}. "
        "A path looks like tactiles[0].electrodes or pillars[*].{fX,fY,fZ}"
    )


def _index(found: re.Match[str]) -> int | slice:
    every, one, low, high = found.groups()
    return (
        int(one) if one else slice(int(low) if low else None, int(high) if high else None) if not every else slice(None)
    )


def _through(steps: list[_Step], values: list[Any]) -> list[Any]:
    for step in steps:
        values = step(values)
    return values


class _Attribute:
    """A step to a field by its name."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.actual: dict[type, str] = {}  # of each type of message, what it calls this field

    def __call__(self, values: list[Any]) -> list[Any]:
        try:
            name = self.actual[type(values[0])]
            return [getattr(values[0], name)] if len(values) == 1 else [getattr(value, name) for value in values]
        except (KeyError, IndexError, AttributeError):  # of the first message, of none, and where they differ in type
            return [self.of(value) for value in values]

    def of(self, value: Any) -> Any:
        """The field of one message."""
        name, names = self.name, fields_of(value)
        if name not in names:
            alike = [other for other in names if other.lower() == name.lower()]
            if len(alike) != 1:
                if isinstance(value, _ARRAYS):
                    raise FieldError(f"an array of {len(value)} stands before {name!r}: write [0] or [*] between them")
                if not names:
                    raise FieldError(f"{name!r} is wanted of a {type(value).__name__}, which has no fields")
                raise FieldError(f"the message has no {name!r}{nearest(name, names)}")
            name = alike[0]
        if isinstance(value, Mapping):
            return value[name]
        self.actual[type(value)] = name
        return getattr(value, name)


def _columns(paths: list[list[_Step]], values: list[Any]) -> list[Any]:
    return [value for row in zip(*(_through(path, values) for path in paths), strict=True) for value in row]


def _several(paths: list[list[_Step]], values: list[Any]) -> list[Any]:
    return [found for value in values for path in paths for found in _through(path, [value])]


def _element(step: int | slice, values: list[Any]) -> list[Any]:
    found: list[Any] = []
    for value in values:
        if not isinstance(value, _ARRAYS):
            shown = "[*]" if step == slice(None) else str(step) if isinstance(step, slice) else f"[{step}]"
            raise FieldError(f"{shown} is wanted of a {type(value).__name__}, which is no array")
        if isinstance(step, slice):
            found += value[step] if isinstance(value, list | tuple) else [value[step]]
        elif len(value):
            try:
                found.append(value[step])
            except IndexError:
                raise FieldError(f"[{step}] is wanted of an array of {len(value)}") from None
    return found
