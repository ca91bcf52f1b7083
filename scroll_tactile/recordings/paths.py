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
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import FieldError

__all__ = ["CLOCK_KEYS", "FieldPath", "fields_of", "matched", "nearest", "select"]

CLOCK_KEYS = ("timestamp", "timestamps", "time", "times")
"""What an array of times is called, seconds."""

_Collect = Callable[[Any, list[Any]], None]
_Step = str | int | slice | list["list[_Step]"]
_TOKEN = re.compile(r"\s*([A-Za-z_]\w*|-?\d+|[.{},*:\[\]])\s*")
_ARRAYS = (list, tuple, np.ndarray, array.array)  # rclpy has the last
_DEEPEST = 32  # no message is nested as deep; a path of a million brackets is no path


class FieldPath:
    """A path, compiled once and applied to many messages, or to dictionaries and lists as JSON has them.

    Raises FieldError, showing where, for a text that is no path.
    """

    def __init__(self, text: str) -> None:
        self.text = text.strip()
        self._collect = _compiled(_Parser(self.text).steps(0))

    def values(self, message: object) -> list[Any]:
        """What the path leads to, in order: numbers, arrays, texts, or messages.

        Raises FieldError for a field that a message does not have, naming those nearest, or an element beyond the end.
        """
        found: list[Any] = []
        try:
            self._collect(message, found)
        except FieldError as error:
            raise FieldError(f"field {self.text!r}: {error}") from None
        return found

    def reading(self, message: object) -> npt.NDArray[Any]:
        """The numbers that the path leads to, flat: one reading, shape (n,).

        Raises FieldError for a field that is not there, or one that holds text or whole messages.
        """
        found = self.values(message)
        if len(found) == 1:
            return self._numbers(found[0])
        if found and type(found[0]) in (float, int) and all(type(value) in (float, int) for value in found):
            return self._numbers(found)
        return np.concatenate([self._numbers(value) for value in found]) if found else np.empty(0)

    def _numbers(self, value: Any) -> npt.NDArray[Any]:
        if not isinstance(value, np.ndarray):
            if isinstance(value, str) or _messages(value):
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
        message = value[0] if isinstance(value, Sequence) and not isinstance(value, str) and len(value) else value
        names = fields_of(message)
        if names:
            inside = ", ".join(names)
            deeper = f"{self.text}[*]" if message is not value else self.text
            raise FieldError(
                f"field {self.text!r} leads to a message, not to numbers; inside it are {inside}: "
                f"write {deeper}.{names[-1]!s} or {deeper}.{{{','.join(names[-3:])}}}"
            )
        kind = "text" if isinstance(message, str | bytes | np.str_) else f"a {type(message).__name__}"
        raise FieldError(f"field {self.text!r} leads to {kind}, {str(value)!r:.40}; expected numbers")


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
    steps = _Parser(rest).steps(0)
    if len(steps) != 1 or isinstance(steps[0], str | list):
        raise FieldError(f"field {text!r}: expected one index such as [0:19] after the name; came {rest!r}")
    step = steps[0]
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


class _Parser:
    """Turns a path's text into steps: a name, an index, a slice (`[*]` is the whole), or a list of paths (`{…}`)."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.tokens: list[tuple[str, int]] = []
        i = 0
        while i < len(text):
            match = _TOKEN.match(text, i)
            if match is None:
                self._fail("a name, a dot, brackets or braces", i)
            self.tokens.append((match.group(1), match.start(1)))
            i = match.end()
        self.i = 0

    def steps(self, depth: int) -> list[_Step]:
        if depth > _DEEPEST:
            self._fail(f"at most {_DEEPEST} braces within each other", self._where())
        steps: list[_Step] = []
        while True:
            token = self._peek()
            if token == "[":
                steps.append(self._index())
            elif token == "{" and (not steps or self._before() == "."):
                steps.append(self._alternatives(depth))
            elif token[:1].isidentifier() and (not steps or self._before() == "."):
                steps.append(self._next())
            elif token == "." and steps and self._before() != ".":
                self._next()
                continue
            elif steps and self._before() != "." and (token == "" if depth == 0 else token in (",", "}")):
                return steps
            else:
                self._fail("a field's name" if not steps or self._before() == "." else "a dot or an index")

    def _alternatives(self, depth: int) -> list[list[_Step]]:
        self._next()
        paths = [self.steps(depth + 1)]
        while self._next() == ",":
            paths.append(self.steps(depth + 1))
        return paths

    def _index(self) -> int | slice:
        self._next()
        inside = []
        while self._peek() not in ("]", ""):
            inside.append(self._next())
        if self._next() != "]":
            self._fail("]")
        text = "".join(inside)
        if text == "*":
            return slice(None)
        if re.fullmatch(r"-?\d{1,9}", text):
            return int(text)
        match = re.fullmatch(r"(-?\d{1,9})?:(-?\d{1,9})?", text)
        if match is None:
            self._fail("an index: [0], [*] or [0:19]", self._where() - 1)
        low, high = match.groups()
        return slice(int(low) if low else None, int(high) if high else None)

    def _peek(self) -> str:
        return self.tokens[self.i][0] if self.i < len(self.tokens) else ""

    def _before(self) -> str:
        return self.tokens[self.i - 1][0] if self.i else ""

    def _next(self) -> str:
        token = self._peek()
        self.i += 1
        return token

    def _where(self) -> int:
        return self.tokens[self.i][1] if self.i < len(self.tokens) else len(self.text)

    def _fail(self, expected: str, where: int | None = None) -> NoReturn:
        where = self._where() if where is None else where
        raise FieldError(
            f"field {self.text!r:.80}: expected {expected} at character {where + 1}; came {self.text[where:][:10]!r}. "
            "A path looks like tactiles[0].electrodes or pillars[*].{fX,fY,fZ}"
        )


def _compiled(steps: list[_Step]) -> _Collect:
    collect: _Collect = _append
    for step in reversed(steps):
        if isinstance(step, str):
            collect = _attribute(step, collect)
        elif isinstance(step, list):
            collect = _several([_compiled(path) for path in step], collect)
        else:
            collect = _element(step, collect)
    return collect


def _append(value: Any, found: list[Any]) -> None:
    found.append(value)


def _attribute(name: str, rest: _Collect) -> _Collect:
    actual: dict[type, str] = {}  # of each type of message, what it calls this field

    def collect(message: Any, found: list[Any]) -> None:
        kind = type(message)
        key = actual.get(kind)
        if key is None:
            key = _actual(message, name)
            if isinstance(message, Mapping):
                rest(message[key], found)
                return
            actual[kind] = key
        rest(getattr(message, key), found)

    return collect


def _actual(message: Any, name: str) -> str:
    names = fields_of(message)
    if name in names:
        return name
    alike = [other for other in names if other.lower() == name.lower()]
    if len(alike) == 1:
        return alike[0]
    if isinstance(message, _ARRAYS):
        raise FieldError(f"an array of {len(message)} stands before {name!r}: write [0] or [*] between them")
    if not names:
        raise FieldError(f"{name!r} is wanted of a {type(message).__name__}, which has no fields")
    raise FieldError(f"the message has no {name!r}{nearest(name, names)}")


def _several(paths: list[_Collect], rest: _Collect) -> _Collect:
    def collect(message: Any, found: list[Any]) -> None:
        for path in paths:
            if rest is _append:
                path(message, found)
                continue
            inner: list[Any] = []
            path(message, inner)
            for value in inner:
                rest(value, found)

    return collect


def _element(step: int | slice, rest: _Collect) -> _Collect:
    def collect(message: Any, found: list[Any]) -> None:
        if not isinstance(message, _ARRAYS):
            raise FieldError(f"{_shown(step)} is wanted of a {type(message).__name__}, which is no array")
        if isinstance(step, slice) and (rest is not _append or _messages(message)):
            for value in message[step]:
                rest(value, found)
            return
        try:
            value = message[step]
        except IndexError:
            raise FieldError(f"{_shown(step)} is wanted of an array of {len(message)}") from None
        rest(value, found)

    return collect


def _shown(step: int | slice) -> str:
    if isinstance(step, int):
        return f"[{step}]"
    return "[*]" if step == slice(None) else f"[{step.start or ''}:{step.stop or ''}]"


def _messages(value: Any) -> bool:
    """Whether this is a message, or a list of messages."""
    if isinstance(value, list | tuple):
        return bool(value) and bool(fields_of(value[0]))
    return bool(fields_of(value))
