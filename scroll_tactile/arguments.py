"""What the public calls take: for each argument, by its name, what fits and how a message says it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from numbers import Real
from typing import Any

from scroll_tactile.errors import InputError
from scroll_tactile.sensors import Sensor, known

__all__ = ["require_arguments", "silent"]


def require_arguments(needed: Mapping[str, Any], optional: Mapping[str, Any] | None = None) -> None:
    """Raise InputError for the first argument that is not what its name expects; an optional one may be None."""
    given = {name: value for name, value in (optional or {}).items() if value is not None}
    for name, value in {**needed, **given}.items():
        expected, fits = _EXPECTED[name]
        if not fits(value):
            came = f"{type(value).__name__} {value!r:.60}"
            raise InputError(f"expected {name} as {expected}; came {came}{_advice(name, value)}")


def _is_path(value: Any) -> bool:
    try:
        text = os.fspath(value)
        return isinstance(text, str) and bool(text) and b"\0" not in os.fsencode(text)
    except (TypeError, UnicodeEncodeError):
        return False


def _is_embedding(value: Any) -> bool:
    return not isinstance(value, type) and callable(getattr(value, "embed", None))


def _is_probability(value: float) -> bool:
    return isinstance(value, Real) and bool(0 <= value <= 1)


def _is_share(value: float) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and bool(0 < value < 1)


def _is_row(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


_ROW = "a row of the journal, a whole number of 0 or more", _is_row
_PATH = "a path: a string, or what os.PathLike is, that the file system can have", _is_path

_EXPECTED: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "path": _PATH,
    "destination": _PATH,
    "other": ("a TactileLearner with a path, or its path", _is_path),
    "mode": ("'write' or 'read'", lambda value: value in ("write", "read")),
    "descriptions": ("'same', 'ours' or 'theirs'", lambda value: value in ("same", "ours", "theirs")),
    "sensor": ("a Sensor", lambda value: isinstance(value, Sensor)),
    "embedding": ("an embedding, such as Kernels()", _is_embedding),
    "unfamiliar": ("a probability from 0 to 1", _is_probability),
    "after": _ROW,
    "until": _ROW,
    "bound": ("a probability between 0 and 1", _is_share),
    "risk": ("a share between 0 and 1", _is_share),
    "known": ("True, False, or None for what the prediction says", lambda value: isinstance(value, bool)),
    "progress": ("a function of (what is being done, steps done, steps in all)", callable),
}


def silent(what: str, done: int, of: int) -> None:
    """The progress of calls that are given none: shows nothing."""


def _advice(name: str, value: Any) -> str:
    """What was probably meant."""
    if name == "sensor" and isinstance(value, str) and value in known():
        return f". Use sensors.{value.upper().replace('-', '_')}"
    if name in ("sensor", "embedding") and isinstance(value, type):
        return f". Call it: {value.__name__}(...)"
    if name == "embedding" and isinstance(value, str) and value.lower() in ("kernels", "frames", "vision"):
        return f". Use {value.capitalize()}(...)"
    return ""
