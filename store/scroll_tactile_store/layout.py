"""What a store's folder holds, by name, and `CURRENT`: the one file whose rename commits a log and its checkpoints."""

from __future__ import annotations

import json
import os
import stat
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from scroll_tactile_store.exceptions import DamageError, NotAStoreError, VersionError, reported
from scroll_tactile_store.files import new_file, read_regular, remove_tree, replacing
from scroll_tactile_store.framing import LogPlace
from scroll_tactile_store.log import Log
from scroll_tactile_store.records import LARGEST_NUMBER, from_json, json_digest

FORMAT_VERSION = 3
OLDER = {1: ("0.15 or before", "0.15"), 2: ("0.16 to 0.18", "0.18")}  # by which releases, and the last of them
CURRENT_FILE = "CURRENT"
LOG = "log-"
CHECKPOINTS = "checkpoints"
CHECKPOINT = f"{CHECKPOINTS}/"  # begins the paths of checkpoints, as LOG those of logs
PARTIAL, NEW, DAMAGED = ".partial", ".new", ".damaged"
LOCK_FILE, HOLDER_FILE = "lock", "holder.json"
LEGACY_FILE = "journal.sqlite"  # of releases 0.x
OURS = (LOG, CURRENT_FILE, HOLDER_FILE)  # how the names of files begin

LARGEST_CURRENT = 2**16  # bytes, of which it has some hundreds
MOST_DIGITS = 18  # of a number in a name, so that there is room for those after it


@dataclass(frozen=True)
class NamedCheckpoint:
    """A checkpoint as `CURRENT` names it.

    last_sequence: the last row that it contains. sha256: what its own description has, so that no other can take its
    place. place: in the log, behind all rows up to `last_sequence`, so that reading can go on from there.
    """

    number: int
    last_sequence: int
    sha256: str
    place: LogPlace

    @classmethod
    def read(cls, known: Any) -> Self | None:
        """Return what `CURRENT` says of one, if anything. Raises ValueError, TypeError or KeyError for what is none."""
        if known is None:
            return None
        offset, number, previous = known["place"]
        place = LogPlace(_count(offset), _count(number), _count(number), bytes.fromhex(previous))
        return cls(_count(known["number"]), _count(known["last_sequence"]), str(known["sha256"]), place)


@dataclass(frozen=True)
class Current:
    """What makes up a store at one moment.

    log: the number of the log, and log_identity what all frames of it carry. newest: the checkpoint to begin with.
    compaction: the one that stands for rows that gave up their arrays; it may be the same. None where there is none.
    last: a row that the log has had; one that ends before it was cut off. 0 where nothing is known.
    """

    log: int
    log_identity: bytes
    newest: NamedCheckpoint | None = None
    compaction: NamedCheckpoint | None = None
    last: int = 0

    @property
    def checkpoints(self) -> list[NamedCheckpoint]:
        """The newest and the compaction checkpoint, each once."""
        return list({each.number: each for each in (self.compaction, self.newest) if each is not None}.values())[::-1]

    @property
    def compacted(self) -> int:
        """The last row that gave up its arrays for the compaction checkpoint, 0 without one."""
        return 0 if self.compaction is None else self.compaction.last_sequence

    def to_bytes(self) -> bytes:
        """Return the bytes of the file."""
        log = [self.log, self.log_identity.hex()]
        known: dict[str, Any] = {"format": FORMAT_VERSION, "log": log, "newest": None, "compaction": None}
        for name, named in (("newest", self.newest), ("compaction", self.compaction)):
            if named is not None:
                place = [named.place.offset, named.place.number, named.place.previous.hex()]
                known[name] = vars(named) | {"place": place}
        known["last"] = self.last
        return (json.dumps(known | {"sha256": json_digest(known)}) + "\n").encode("ascii")

    @classmethod
    def from_bytes(cls, data: bytes, path: Path) -> Self:
        """Return what `to_bytes` wrote. Raises VersionError for another format; KeyError, TypeError, ValueError."""
        known: dict[str, Any] = dict(from_json(data.decode("ascii")))
        if known.pop("sha256", None) != json_digest(known):
            raise ValueError("its sha256 differs")
        if known["format"] != FORMAT_VERSION:
            raise VersionError(other_format(path, known["format"]))
        number, identity = known["log"]
        newest, compaction = NamedCheckpoint.read(known["newest"]), NamedCheckpoint.read(known["compaction"])
        return cls(_count(number), bytes.fromhex(identity), newest, compaction, _count(known.get("last", 0)))


def other_format(path: Path, version: int) -> str:
    """Return what is said of a file of another format."""
    what = f"{path} is written in format {version}"
    if version in OLDER:
        releases, last = OLDER[version]
        what += f", by scroll-tactile {releases}; this one reads format {FORMAT_VERSION}: learn it again from the"
        return f"{what} recordings, or open it with scroll-tactile {last}"
    what += f"; this release reads format {FORMAT_VERSION}: upgrade it, or open the store with the release"
    return f"{what} that wrote it; nothing was changed"


def _count(value: Any) -> int:
    if type(value) is not int or not 0 <= value <= LARGEST_NUMBER:
        raise ValueError(f"{str(value)[:80]!r} is no number")
    return value


def read_current(path: Path) -> Current:
    """Return what the `CURRENT` at `path` says. Raises DamageError, VersionError, and OSError where it is not there."""
    try:
        return Current.from_bytes(read_regular(path, LARGEST_CURRENT), path)
    except (DamageError, KeyError, TypeError, ValueError) as error:
        what = f"{path} is not as it was written ({error}): repair the store (repair_store), which finds"
        raise DamageError(f"{what} the log and the checkpoints by themselves", path=path) from error


def write_current(folder: Path, current: Current) -> None:
    """Commit: put `CURRENT` in the place of the one before, durably. Raises OSError; it may then be there all the same.

    Everything that it names has to be durable.
    """
    draft = folder / (CURRENT_FILE + NEW)
    with replacing(folder / CURRENT_FILE, draft), new_file(draft) as file:
        file.write(current.to_bytes())


def log_path(folder: Path, number: int) -> Path:
    """Return where the log of this number lies."""
    return folder / f"{LOG}{number:08d}"


def checkpoint_path(folder: Path, number: int) -> Path:
    """Return the folder of the checkpoint of this number: eight digits, or more when it needs them."""
    return folder / CHECKPOINTS / f"{number:08d}"


def is_number(stem: str) -> bool:
    """Return whether part of a name is a number that leaves room for those after it."""
    return stem.isascii() and stem.isdigit() and len(stem) <= MOST_DIGITS


def numbers(folder: Path, begin: str, end: str = "") -> list[int]:
    """Return the numbers of the logs (begin: LOG) or checkpoints (CHECKPOINT) in a store's folder, ascending.

    end: of drafts of them, which count, too.
    """
    return sorted(set(_numbered(folder, begin, end).values()))


def _numbered(folder: Path, begin: str, end: str) -> dict[Path, int]:
    names = {path: path.relative_to(folder).as_posix() for path in folder.glob(f"{begin}*")}
    stems = {path: name.removeprefix(begin).removesuffix(end) for path, name in names.items()}
    return {path: int(stem) for path, stem in stems.items() if is_number(stem)}


def holds_store(folder: Path) -> bool:
    """Return whether `folder` holds a store, or what is left of one; False when one may be made there.

    Only looks. Raises NotAStoreError for a file and for a folder with other things in it, VersionError for a store of
    releases 0.x or of another format, and DamageError as `require_safe`.
    """
    with reported(folder, "looking for a store"):
        if not folder.exists():
            return False
        if not folder.is_dir():
            raise NotAStoreError(f'{folder} is a file: a packed store is opened with mode="read", or merged')
        require_safe(folder)
        names = sorted(entry.name for entry in folder.iterdir())
        if os.path.lexists(folder / CURRENT_FILE):  # after the names: another process may have made it meanwhile
            with suppress(DamageError, FileNotFoundError):
                read_current(folder / CURRENT_FILE)  # refuses another format before anything is written
            return True
        if LEGACY_FILE in names:
            raise VersionError(
                f"{folder} was made by a release 0.x, whose memories this one does not read: learn it again from the "
                "recordings, or keep that release to read it"
            )
        # The first log is made before `CURRENT`: a writer may have died in between.
        logs, first = [log_path(folder, number) for number in numbers(folder, LOG)], log_path(folder, 1)
        if any(DAMAGED in name for name in names) or any(numbers(folder, CHECKPOINT)):
            return True
        if any(log != first or _has_batches(log) for log in logs):
            return True
        if foreign := [name for name in names if not name.startswith(OURS) and name not in (LOCK_FILE, CHECKPOINTS)]:
            raise NotAStoreError(
                f"{folder} holds no store but other things ({', '.join(foreign[:3])}…): nothing was written; choose an "
                "empty or a new folder"
            )
        return False


def _has_batches(path: Path) -> bool:
    """Whether more than its first frame was ever written to a log."""
    try:
        with Log(path) as log:
            return log.size() > log.place.offset
    except DamageError:
        return True


def require_safe(folder: Path, *, written: bool = False) -> None:
    """Raise DamageError for what is in a store's folder under a name of ours, and is not of its kind.

    A link would lead what is read, written or removed out of the folder; to read from a pipe or a device may never
    end. written: also for a file that is written in place and has another name, which that would change, too.
    """
    with reported(folder, "looking at what is there"):
        for path in (*folder.glob("*"), *folder.glob(f"{CHECKPOINT}*")):
            if path.parent == folder:
                is_folder, is_file = path.name == CHECKPOINTS, path.name.startswith(OURS) or path.name == LOCK_FILE
            else:
                is_folder, is_file = is_number(path.name.removesuffix(PARTIAL)), False
            try:
                status = path.lstat()
            except FileNotFoundError:  # another process may have written it and moved it
                continue
            if (is_folder and not stat.S_ISDIR(status.st_mode)) or (is_file and not stat.S_ISREG(status.st_mode)):
                what = "a symbolic link" if stat.S_ISLNK(status.st_mode) else "no regular file or folder"
                raise DamageError(
                    f"{path} is {what}, where a store has a file or folder of its own: nothing was read through it. "
                    "Put what belongs there in its place; in a folder that comes from elsewhere trust nothing",
                    path=path,
                )
            if written and is_file and status.st_nlink > 1:
                raise DamageError(
                    f"{path} has another name somewhere (a hard link), and what is written here would change it there: "
                    'copy the folder (cp -r) and open the copy, or open this one with mode="read"',
                    path=path,
                )


def unnamed(folder: Path, current: Current) -> list[Path]:
    """Return the logs, checkpoints and drafts of these, which `current` does not name."""
    kept = {log_path(folder, current.log), *(checkpoint_path(folder, named.number) for named in current.checkpoints)}
    found = {*_numbered(folder, LOG, NEW), *_numbered(folder, CHECKPOINT, PARTIAL)} - kept
    return [*found, *folder.glob(CURRENT_FILE + NEW)]


def remove_unnamed(folder: Path, current: Current) -> None:
    """Remove what is `unnamed`; what cannot be removed stays, and what does not carry a name of ours."""
    for path in unnamed(folder, current):
        remove_tree(path)
