"""Files and folders made durable, measured and removed."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows has none
    FULL_SYNC = None
else:
    FULL_SYNC = getattr(fcntl, "F_FULLFSYNC", None)

__all__ = ["file_size", "remove_tree", "sync_file", "sync_folder", "sync_tree", "tree_size"]


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
        # On a Mac fsync stops at the drive's cache; some file systems there refuse the stronger call.
        if FULL_SYNC is not None:
            with suppress(OSError):
                fcntl.fcntl(descriptor, FULL_SYNC)
                return
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(path: Path) -> None:
    """Make every file below `path`, and every folder from the deepest up to `path`, durable."""
    for folder, _, files in os.walk(path, topdown=False):
        for name in files:
            sync_file(Path(folder, name))
        sync_folder(Path(folder))


def file_size(path: Path) -> int:
    """Return the size in bytes, 0 for a file that is not, or no longer, there."""
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def tree_size(path: Path) -> int:
    """Return the bytes of all files below `path`, 0 when there is none; files may vanish meanwhile."""
    return sum(file_size(Path(folder, name)) for folder, _, files in os.walk(path) for name in files)


def remove_tree(path: Path) -> None:
    """Remove a file or a whole folder if it is there; what cannot be removed is left for the next open."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)
