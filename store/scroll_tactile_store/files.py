"""Files and folders made durable, read, measured, compared and removed; links are never followed."""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, BinaryIO

from scroll_tactile_store.exceptions import DamageError, NotAStoreError

try:
    import fcntl
except ImportError:  # Windows has none
    FULL_SYNC = None
else:
    FULL_SYNC = getattr(fcntl, "F_FULLFSYNC", None)

# Not through a link, nor waiting for whoever might write into a pipe. Windows has neither.
CAREFULLY = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)

SPARE, RATIO = 64 * 2**20, 16  # what a file may claim beyond its bytes on the disk


def sync_file(path: Path) -> None:
    """Return when the file's bytes are on the disk; raises OSError."""
    _sync(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)


def sync_folder(path: Path) -> None:
    """Return when the folder's entries are on the disk; does nothing on Windows, which has no such call."""
    if os.name != "nt":
        _sync(path, os.O_RDONLY)


def _sync(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        sync_open(descriptor)
    finally:
        os.close(descriptor)


def sync_open(descriptor: int, *, data_only: bool = False) -> None:
    """Return when an open file's bytes are on the disk, and where not `data_only` its times, too; raises OSError."""
    # On a Mac fsync stops at the drive's cache; some file systems there refuse the stronger call.
    if FULL_SYNC is not None:
        with suppress(OSError):
            fcntl.fcntl(descriptor, FULL_SYNC)
            return
    # Windows has no fdatasync.
    (getattr(os, "fdatasync", os.fsync) if data_only else os.fsync)(descriptor)


def sync_tree(path: Path) -> None:
    """Make every file below `path`, and every folder from the deepest up to `path`, durable."""
    for folder, _, files in os.walk(path, topdown=False):
        for name in files:
            sync_file(Path(folder, name))
        sync_folder(Path(folder))


def tree_size(path: Path) -> int:
    """Return the bytes of a file, or of all files below a folder, 0 when there is none; files may vanish meanwhile."""
    size, files = 0, [path] if path.is_file() else [Path(at, name) for at, _, names in os.walk(path) for name in names]
    for file in files:
        with suppress(FileNotFoundError):
            size += file.lstat().st_size
    return size


def remove_tree(path: Path) -> None:
    """Remove a file or a whole folder if it is there; what cannot be removed is left for the next open."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def new_file(path: Path, mode: str = "wb") -> IO[Any]:
    """Return a new file at `path`, open; what a writer that died left there is removed. Raises OSError."""
    remove_tree(path)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | CAREFULLY
    return os.fdopen(os.open(path, flags, 0o666), mode, encoding=None if "b" in mode else "utf-8")


@contextmanager
def replacing(path: Path, draft: Path) -> Iterator[None]:
    """In the block `draft`, a file or a folder, is written; then it takes the place of `path`, durably, or is removed.

    Raises OSError, where it may all the same be in its place, though not durably.
    """
    try:
        yield
        (sync_tree if draft.is_dir() else sync_file)(draft)
        draft.replace(path)
    except BaseException:
        remove_tree(draft)
        raise
    sync_folder(path.parent)


def read_regular(path: Path, limit: int, *, within: Path | None = None) -> bytes:
    """Return the bytes of a regular file of at most `limit` bytes; raises as `regular_file`."""
    with regular_file(path, limit, within=within) as (file, size):
        return file.read(size)


def copy_regular(path: Path, target: Path, limit: int, *, within: Path | None = None) -> None:
    """Copy a regular file of at most `limit` bytes, a part at a time; raises as `regular_file`."""
    with regular_file(path, limit, within=within) as (file, _), target.open("xb") as copy:
        shutil.copyfileobj(file, copy)


@contextmanager
def regular_file(path: Path, limit: int, *, within: Path | None = None) -> Iterator[tuple[BinaryIO, int]]:
    """In the block a regular file of at most `limit` bytes is open; gives it and its size.

    within: a folder above it; those between the two are no links either. Raises DamageError for a link, for anything
    that is no file, and for a larger one, without reading from it; and OSError.
    """
    for folder in path.parents if within is not None else ():
        if folder == within:
            break
        if folder.is_symlink():
            raise DamageError(f"{folder} is a symbolic link, where a store has a folder of its own", path=folder)
    with os.fdopen(open_regular(path, os.O_RDONLY), "rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise DamageError(f"{path} has {size} bytes; at most {limit} are read there", path=path)
        yield file, size


def open_regular(path: Path, flags: int) -> int:
    """Return the descriptor of a regular file. Raises DamageError for a link and for anything else, and OSError."""
    # Before it is opened: to open a device can already do something.
    if not stat.S_ISREG(path.lstat().st_mode):
        raise DamageError(f"{path} is no regular file", path=path)
    descriptor = os.open(path, flags | CAREFULLY)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise DamageError(f"{path} is no regular file", path=path)
    return descriptor


def dense_size(descriptor: int, path: Path) -> int:
    """Return the bytes of an open file. Raises DamageError where next to nothing of them is on the disk."""
    found = os.fstat(descriptor)
    stored = 512 * getattr(found, "st_blocks", 0)  # 0 also where the file system does not tell
    if stored and found.st_size > SPARE + RATIO * stored:
        raise DamageError(
            f"{path} says that it has {found.st_size} bytes, and {stored} are on the disk: nothing of it was read. In "
            "a folder that comes from elsewhere trust nothing",
            path=path,
        )
    return found.st_size


def store_folder(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path of a folder, `~` its home; raise NotAStoreError for what no file system calls so."""
    try:
        folder = Path(path).expanduser().absolute()
        if b"\0" not in os.fsencode(folder):
            return folder
    except (TypeError, UnicodeEncodeError, RuntimeError):  # the last where nobody has this home
        pass
    raise NotAStoreError(f"expected the path of a folder; came {path!r}, which is none")


def same_folder(first: Path, second: Path) -> bool:
    """Return whether two paths lead to one folder, also by links, by other mounts of it or in other letters."""
    try:
        return first.samefile(second)
    except OSError:
        return first.resolve() == second.resolve()
