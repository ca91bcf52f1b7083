"""Where a file is: on this machine, or at an address that fsspec knows (`s3://`, `memory://`, `https://` …)."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import Any

from scroll_tactile.errors import RecordingError
from scroll_tactile.libraries import missing

__all__ = ["file_system", "is_remote", "local"]

_DEEPEST = 16  # folders within each other


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
    except ImportError as error:
        s3 = address.partition("://")[0] in ("s3", "s3a")
        if s3 or error.name == "fsspec":
            raise missing("s3fs" if s3 else "fsspec", "s3", address) from error
        raise RecordingError(f"{address} cannot be reached: {error}") from error
    except Exception as error:  # each file system has errors of its own
        raise RecordingError(f"{address} cannot be reached: {type(error).__name__}: {error}") from error
    return found


def _copied(address: str, folder: Path) -> Path:
    files, path = file_system(address)
    root = path.rstrip("/")
    target = folder / _named(root.rpartition("/")[2] or "recording", address)
    try:
        if files.isdir(path):
            return _copied_folder(files, root, target, address)
        about = files.info(path)
        if about.get("type", "file") != "file":
            raise RecordingError(f"{address} is of type {about['type']!r:.40}; expected a file or a folder")
        _require_room(about.get("size") or 0, folder, address)
        files.get_file(path, str(target))
    except RecordingError:
        raise
    except FileNotFoundError as error:
        raise RecordingError(f"expected a recording in {address}; it is not there") from error
    except Exception as error:
        raise RecordingError(f"{address} cannot be fetched: {type(error).__name__}: {error}") from error
    return target


def _copied_folder(files: Any, root: str, target: Path, address: str) -> Path:
    """The files of a folder below `target`. Whoever may write there names them: no name of theirs leads out of it."""
    there = files.find(root, maxdepth=_DEEPEST, detail=True)
    places: dict[str, Path] = {}
    for name in there:
        inside = str(name).removeprefix(f"{root}/")
        if inside == name:
            raise RecordingError(f"{address} lists {name!r:.200}, which does not lie in it")
        if inside and not inside.endswith("/"):  # as some programs mark a folder
            places[name] = target.joinpath(*(_named(part, address) for part in inside.split("/")))
    _require_room(sum(there[name].get("size") or 0 for name in places), target.parent, address)
    for place in places.values():
        place.parent.mkdir(parents=True, exist_ok=True)
    files.get(list(places), [str(place) for place in places.values()])  # many at once, where it can
    return target


def _named(part: str, address: str) -> str:
    """A part of a name as it may stand in a path; raises RecordingError for one that leads elsewhere."""
    if part in ("", ".", "..") or "\\" in part or "\0" in part or PurePath(part).name != part:
        raise RecordingError(
            f"{address} names a file by {part!r:.100}, which leads out of its folder: it was not fetched"
        )
    return part


def _require_room(size: int, folder: Path, address: str) -> None:
    free = shutil.disk_usage(folder).free
    if size > free:
        raise RecordingError(
            f"{address} holds {size} bytes, and {free} are free where it would be copied to, {folder.parent}: set "
            "TMPDIR to a folder with more room, or fetch it in parts"
        )
