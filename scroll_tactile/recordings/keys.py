"""Which of a file's arrays is meant by a field: by its name, or the end of it, with an index behind."""

from __future__ import annotations

import re
from collections.abc import Collection

from scroll_tactile.errors import FieldError
from scroll_tactile.recordings.paths import nearest

__all__ = ["CLOCK_KEYS", "matched", "split"]

CLOCK_KEYS = ("timestamp", "timestamps", "time", "times")
"""What an array of times is called, seconds."""


def split(field: str) -> tuple[str, str]:
    """A field's name and the index behind it: ("tactile", "[0:19]")."""
    match = re.fullmatch(r"\s*(.*?)\s*((?:\[[^\]]*\])?)\s*", field, re.DOTALL)
    return (match.group(1), match.group(2)) if match else (field, "")


def matched(field: str, keys: Collection[str], source: str) -> tuple[str, str]:
    """The key that a field names, and the index behind it.

    Raises FieldError where no key is called so, naming the nearest, or the end of several is.
    """
    if field in keys:
        return field, ""
    name, rest = split(field)
    if name in keys:
        return name, rest
    ends = [key for key in keys if re.split(r"[/.]", key)[-1] == name or key.endswith(f"/{name}")]
    if len(ends) == 1:
        return ends[0], rest
    if ends:
        raise FieldError(f"{source}: field {field!r} may be any of {', '.join(ends)}: name it in full")
    raise FieldError(f"{source} has no field {field!r}{nearest(name, list(keys))}")
