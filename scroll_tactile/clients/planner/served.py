"""What a planner gives of a touch: readings, or a recording in one folder, whose place here it is not told."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from typing import Annotated

from pydantic import Field

from scroll_tactile.errors import InputError
from scroll_tactile.recordings import read
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream

__all__ = ["Columns", "File", "Place", "Readings", "Served", "Topic"]

MOST_VALUES = 2**20  # numbers in the readings of one call: a minute of 100 channels at 170 Hz
LARGEST = 2**28  # bytes of a recording
CALL = re.compile(r"^read\((.*)\)$", re.MULTILINE)  # the line to copy of a recording's contents, as Python has it

Readings = Annotated[
    list[list[float]] | None, Field(description="Rows of one touch in time, each with the sensor's channels.")
]
Text = Annotated[str, Field(max_length=1000)]
File = Annotated[Text | None, Field(description="In place of readings: a recording in the served folder, by its path.")]
Topic = Annotated[Text | None, Field(description="Of a file with several topics: the one to read.")]
Place = Annotated[Text | None, Field(description="Of a file with several fields: the one to read.")]
Columns = Annotated[Text | None, Field(description="Of a file with more channels: those to take, such as 0:2.")]


class Served:
    """A folder of recordings, or None where none is served. Raises InputError for what is no folder."""

    def __init__(self, folder: Path | None) -> None:
        if folder is not None and not folder.is_dir():
            raise InputError(f"expected a folder of recordings as files={str(folder)!r}; there is none")
        self._folder = None if folder is None else folder.resolve()

    def touch(
        self, sensor: Sensor, readings: Readings, file: File, topic: Topic, field: Place, columns: Columns
    ) -> Stream | list[list[float]]:
        """One touch, by its readings or by a recording in the folder. Raises InputError for both, for neither and for
        too many readings, and what `read` and `Recording.stream` raise."""
        if (readings is None) == (file is None) or (file is None and any((topic, field, columns))):
            raise InputError("expected readings or a file, one of them; topic, field and columns are of a file")
        if readings is None:
            return read(self._place(str(file)), topic=topic, field=field, columns=columns).stream(sensor)
        if sum(map(len, readings)) > MOST_VALUES:
            raise InputError(f"expected at most {MOST_VALUES} numbers in a touch; cut it, or name a file")
        return readings

    def without_paths(self, text: str) -> str:
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
