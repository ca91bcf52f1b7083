"""What an annotation wrote is put in its place: renamed to be a new data set, or moved file by file into one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from scroll_tactile.clients.learning.annotating.rewriting import copied, own_files
from scroll_tactile.clients.learning.runfile import RunFile
from scroll_tactile.errors import InputError

__all__ = ["MADE", "RECORD", "clear", "free_name", "place", "require_own_folders"]

RECORD = "annotation.json"
MADE = "set"  # the folder of what is written, beside the record: a data set may have a file of any name


def require_own_folders(target: Path, names: Sequence[str]) -> None:
    """Raises InputError where files cannot be moved to these names in a data set, or would leave it by a link."""
    folders = {parent for name in names for parent in (target / name).parents if parent.is_relative_to(target)}
    for folder in sorted(folders):
        if folder.is_symlink():
            raise InputError(f"{folder} is a link: copy what it leads to in its place, or give output=")
        if not folder.exists():
            continue
        if not folder.is_dir():
            raise InputError(f"expected a folder in {folder}, which is a file: move it away, or give output=")
        if _device(folder) != _device(target.parent):
            raise InputError(
                f"{folder} lies on another file system than {target.parent}, where its new files are written before "
                "they are moved: give output="
            )


def _device(path: Path) -> int:
    return path.stat().st_dev


def place(target: Path, work: Path, record: RunFile) -> Path | None:
    """Put what was written in its place, and remove the work folder; where it was cut off, go on.

    Returns the folder that keeps `meta/` of a data set that is changed. Raises InputError where that cannot be, and
    RecordingError for metadata that lead out of the data set.
    """
    moving, made, kept = record.notes["moving"], work / MADE, None
    try:
        if moving:
            require_own_folders(target, moving)
            kept = target / _kept(target, made, record)
            for name in moving:  # info.json is the last
                (target / name).parent.mkdir(exist_ok=True)
                if (made / name).exists():
                    (made / name).replace(target / name)
        elif made.is_dir():
            made.rename(target)
        elif not target.is_dir():
            raise InputError(f"{target} is not there, though {work} says it was made: remove {work} to begin anew")
        clear(work)
    except OSError as error:
        raise InputError(
            f"{error.filename or target} cannot be put in its place: {error.strerror}. All is written in {work}: mend "
            "that, and start the same again"
        ) from error
    return kept


def free_name(target: Path) -> str:
    """The name in a data set by which `meta/` can be kept as it was. Raises InputError where all are taken."""
    names = ["meta.before", *(f"meta.before-{number}" for number in range(2, 1000))]
    for name in names:
        if not os.path.lexists(target / name):
            return name
    raise InputError(f"{target} has everything from {names[0]} to {names[-1]}: remove some, or give output=")


def _kept(target: Path, made: Path, record: RunFile) -> str:
    """The name of the folder that keeps `meta/` as it was; it is copied once."""
    if "kept" not in record.notes:
        name = free_name(target)
        draft = made / "meta.kept"
        shutil.rmtree(draft, ignore_errors=True)
        for own, path in own_files(target, "meta"):
            copied(path, draft / Path(own).relative_to("meta"))
        draft.replace(target / name)
        record.note("kept", name)
    return str(record.notes["kept"])


def clear(work: Path) -> None:
    """Remove the work folder, its record behind all else: without it, nobody could tell what the rest is of."""
    if (work / MADE).exists():
        shutil.rmtree(work / MADE)
    (work / RECORD).unlink(missing_ok=True)
    shutil.rmtree(work)
