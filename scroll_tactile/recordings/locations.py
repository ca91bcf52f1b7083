"""Where a file is: on this machine, or at an address that fsspec knows (`s3://`, `memory://`, `https://` …)."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from scroll_tactile.errors import RecordingError
from scroll_tactile.libraries import missing

__all__ = ["file_system", "is_remote", "local"]


def is_remote(address: str) -> bool:
    """Whether an address names a file system, rather than a path."""
    scheme, mark, _ = address.partition("://")
    return bool(mark) and len(scheme) > 1 and scheme.replace("+", "").replace("-", "").isalnum()


@contextmanager
def local(address: str) -> Iterator[Path]:
    """The path of a file or folder; what is elsewhere is copied into a temporary folder while it is used.

    Raises RecordingError for an address where nothing is, that cannot be reached, that names files outside its folder,
    or that holds more than the temporary folder has room for, and what `file_system` raises.
    """
    scheme, _, rest = address.partition("://")
    if not is_remote(address) or scheme in ("file", "local"):
        path = Path(rest if is_remote(address) else address)
        if not path.exists():
            raise RecordingError(f"expected a recording in {address}; it is not there")
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="scroll-tactile-") as folder:
        yield _copied(address, Path(folder))


def file_system(address: str) -> tuple[Any, str]:
    """The file system of an address, as fsspec has it, and the path there.

    Raises MissingLibraryError where the library for it is not installed, RecordingError for an address that is none.
    """
    try:
        import fsspec

        found: tuple[Any, str] = fsspec.core.url_to_fs(address)
    except Exception as error:  # each file system has errors of its own
        s3 = address.partition("://")[0] in ("s3", "s3a")
        if isinstance(error, ImportError) and (s3 or error.name == "fsspec"):
            raise missing("s3fs" if s3 else "fsspec", "s3", address) from error
        raise RecordingError(f"{address} cannot be reached: {type(error).__name__}: {error}") from error
    return found


def _copied(address: str, folder: Path) -> Path:
    files, path = file_system(address)
    root = path.rstrip("/")
    target = folder / (root.rpartition("/")[2] or "recording")
    try:
        about = {root: files.info(path)} if not files.isdir(path) else files.find(root, maxdepth=16, detail=True)
        if any(entry.get("type", "file") != "file" for entry in about.values()):
            raise RecordingError(f"{address} is of type {about[root]['type']!r:.40}; expected a file or a folder")
        places = {name: target.joinpath(*_inside(name, root, address)) for name in about if not name.endswith("/")}
        size, free = sum(entry.get("size") or 0 for entry in about.values()), shutil.disk_usage(folder).free
        if size > free:
            raise RecordingError(
                f"{address} holds {size} bytes, and {free} are free where it would be copied to, {folder.parent}: set "
                "TMPDIR to a folder with more room, or fetch it in parts"
            )
        for place in places.values():
            place.parent.mkdir(parents=True, exist_ok=True)
        files.get(list(places), [str(place) for place in places.values()])  # many at once, where it can
    except RecordingError:
        raise
    except FileNotFoundError as error:
        raise RecordingError(f"expected a recording in {address}; it is not there") from error
    except Exception as error:
        raise RecordingError(f"{address} cannot be fetched: {type(error).__name__}: {error}") from error
    return target


def _inside(name: str, root: str, address: str) -> list[str]:
    """The parts of a file's name below a folder. Whoever may write there names it: no name leads out of the folder."""
    parts = name.removeprefix(root).strip("/").split("/") if name != root else []
    for part in parts:
        if not name.startswith(root) or part in ("", ".", "..") or "\\" in part or "\0" in part:
            raise RecordingError(
                f"{address} names a file by {part!r:.100}, which leads out of its folder: it was not fetched"
            )
    return parts
