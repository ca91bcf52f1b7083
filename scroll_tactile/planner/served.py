"""The recordings that a planner may name: those in one folder, whose place on the machine it is not told."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path

from scroll_tactile.errors import InputError
from scroll_tactile.recordings import read
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream

__all__ = ["Served"]

LARGEST = 2**28  # bytes of a recording
CALL = re.compile(r"^read\((.*)\)$", re.MULTILINE)  # the line to copy of a recording's contents, as Python has it


class Served:
    """A folder of recordings, or None where none is served. Raises InputError for what is no folder."""

    def __init__(self, folder: Path | None) -> None:
        if folder is not None and not folder.is_dir():
            raise InputError(f"expected a folder of recordings as files={str(folder)!r}; there is none")
        self._folder = None if folder is None else folder.resolve()

    def touch(self, file: str, sensor: Sensor, topic: str | None, field: str | None, columns: str | None) -> Stream:
        """A recording as one touch of a sensor. Raises what `read` and `Recording.stream` raise."""
        return read(self._place(file), topic=topic, field=field, columns=columns).stream(sensor)

    def told(self, text: str) -> str:
        """An error's text as a planner is to read it: the folder is not named, and lines to copy are its own."""
        text = text if self._folder is None else text.replace(f"{self._folder}{os.sep}", "")
        return CALL.sub(r"such as file=\1", text)

    def _place(self, file: str) -> Path:
        """A recording in the folder, wherever its links lead. Raises InputError for any other."""
        if self._folder is None:
            raise InputError("no folder of recordings is served: start with --files FOLDER, or give readings")
        place = self._folder if "\0" in file else (self._folder / file).resolve()
        if self._folder not in place.parents or _bytes(place) > LARGEST:
            raise InputError(
                f"expected a recording in the served folder, a file or the folder of one without links in it, of at "
                f"most {LARGEST >> 20} MB; came {file!r:.80}"
            )
        return place


def _bytes(place: Path) -> float:
    """Of a file, or of what a folder has; infinite for anything else, and where a link in it could lead elsewhere."""
    if place.is_file():
        return place.stat().st_size
    total = 0.0 if place.is_dir() else math.inf
    for folder, folders, files in os.walk(place):
        for name in (*folders, *files):
            inside = Path(folder, name)
            total += math.inf if inside.is_symlink() else inside.stat().st_size
        if total > LARGEST:
            break
    return total
