"""Some of a recording's columns, by their places: `25:44`, `0,3,5:9`."""

from __future__ import annotations

import re
from dataclasses import replace

from scroll_tactile.errors import FieldError
from scroll_tactile.recordings.recording import Recording

__all__ = ["only_columns", "places", "require_columns"]

_PART = re.compile(r"(\d{1,9})|(\d{1,9})?:(\d{1,9})?", re.ASCII)


def require_columns(columns: str) -> list[re.Match[str]]:
    """The parts of a text that names columns. Raises FieldError for one that does not."""
    parts = [_PART.fullmatch(part.strip()) for part in columns.split(",")]
    found = [part for part in parts if part is not None]
    if len(found) < len(parts):
        raise FieldError(f"expected columns such as 25:44 or 0,3,5:9, counted from 0; came {columns!r:.80}")
    return found


def places(columns: str, width: int) -> list[int]:
    """The columns that a text names, of `width`: counted from 0, a range without its end, as Python has it.

    Raises FieldError for a text that is none, and for columns that are not there.

    >>> places("0,3,5:9", 10)
    [0, 3, 5, 6, 7, 8]
    """
    found: list[int] = []
    for part in require_columns(columns):
        one, low, high = part.groups()
        begin, end = (int(one), int(one) + 1) if one else (int(low or 0), width if high is None else int(high))
        if begin >= end or end > width:
            raise FieldError(
                f"columns {part[0]} are not there: expected places from 0 to {width - 1}, a range without its end; "
                f"0:{width} are all"
            )
        found += range(begin, end)
    return found


def only_columns(recording: Recording, columns: str) -> Recording:
    """A recording of these of its columns, those of times, labels and an index not counted.

    Raises FieldError for a recording of pictures, and as `places` does.
    """
    if recording.readings.ndim != 2:
        raise FieldError(f"{recording.source} has pictures, which have no columns; came columns={columns!r:.80}")
    try:
        chosen = places(columns, recording.readings.shape[1])
    except FieldError as error:
        raise FieldError(f"{recording.source}: {error}") from None
    return replace(recording, readings=recording.readings[:, chosen])
