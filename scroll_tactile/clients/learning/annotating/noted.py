"""What the notes of an annotation may say: a work folder can come with a data set of others, and be made to harm."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scroll_tactile.errors import InputError

__all__ = ["COUNTS", "LOGS", "require_movable", "require_no_links", "require_notes"]

LOGS = "mcap"  # the folder of the episodes' logs
COUNTS = ("frames", "answered", "touches", "events", "left_out")  # what is noted of each file, and of all together
_KEPT = re.compile(r"meta\.before(-([2-9]|[1-9][0-9]{1,2}))?")
_METADATA = ("meta/info.json", "meta/stats.json")


def require_no_links(work: Path) -> None:
    """Raises InputError where the work folder is a link, or has one in it: what is written would follow it."""
    inside = (Path(place) / name for place, *names in os.walk(work) for name in [*names[0], *names[1]])
    if link := work if work.is_symlink() else next((path for path in inside if path.is_symlink()), None):
        raise InputError(f"{link} is a link, and no annotation makes one there: remove {work} to begin anew")


def require_notes(notes: Mapping[str, Any], work: Path, *, in_place: bool) -> None:
    """Raises InputError for notes that no annotation wrote: files would be moved where none of it belongs.

    in_place: whether the data set itself is changed, into which files are moved.
    """
    wrong = _wrong(notes)
    if not wrong and "moving" in notes and bool(notes["moving"]) != in_place:
        wrong = "files are moved, though a new folder is made" if notes["moving"] else "there is no file to be moved"
    if wrong:
        raise InputError(
            f"expected the notes of an annotation in {work}; no annotation wrote these: {wrong}. Remove {work} to "
            "begin anew"
        )


def require_movable(names: Sequence[str]) -> None:
    """Raises InputError for names that no annotation moves into a data set."""
    for name in names:
        if wrong := _unmovable(name):
            raise InputError(f"{wrong}: give output=, or name the data set's files as LeRobot does")


def _wrong(notes: Mapping[str, Any]) -> str:
    """What is wrong with notes, in words; empty where nothing is."""
    done = notes.get("done", {})
    if not isinstance(done, dict) or not all(_is_counted(of, COUNTS) for of in done.values()):
        return "'done' is not what each file has"
    if ("done" in notes or "moving" in notes) and not isinstance(notes.get("asked"), dict):
        return "'asked' is not what is asked for"
    return _wrongly_moved(notes, notes["moving"]) if "moving" in notes else ""


def _wrongly_moved(notes: Mapping[str, Any], moving: Any) -> str:
    """As `_wrong`, of what is noted once all is written."""
    if "done" not in notes or not _is_counted(notes.get("summary"), ("episodes", *COUNTS)):
        return "'summary' is not what all files have"
    if not isinstance(moving, list):
        return f"'moving' is a {type(moving).__name__}"
    if not _KEPT.fullmatch(kept if isinstance(kept := notes.get("kept", "meta.before"), str) else ""):
        return f"'kept' is {kept!r:.100}"
    return next(filter(None, map(_unmovable, moving)), "")


def _is_counted(of: Any, names: Sequence[str]) -> bool:
    """Whether something is a whole number by each of these names, and no more."""
    return isinstance(of, dict) and {*of} == {*names} and all(type(each) is int for each in of.values())


def _unmovable(name: Any) -> str:
    """Why a name is none that an annotation moves into a data set, in words; empty where it is one.

    These are files of frames, tables of episodes, logs, and two of the metadata.
    """
    if not isinstance(name, str):
        return f"{name!r:.100} is no file's name"
    path = Path(name)
    if not _is_plain(name) or path.is_absolute() or path.drive or os.pardir in path.parts:
        return f"{name!r:.100} leads out of the data set"
    is_log = path.parent == Path(LOGS) and path.suffix == ".mcap"
    if not (is_log or path.suffix == ".parquet" or path.as_posix() in _METADATA):
        return f"{name!r:.100} is no file that an annotation writes"
    return ""


def _is_plain(name: str) -> bool:
    """Whether a name is the shortest for its file, and one that a file can have."""
    try:
        return os.path.normpath(name) == name.replace("/", os.sep) and b"\0" not in os.fsencode(name)
    except ValueError:  # letters that the file system cannot write
        return False
