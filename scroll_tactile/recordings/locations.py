"""Where a file is: on this machine, or at an address that fsspec knows (`s3://`, `memory://`, `https://` …)."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from scroll_tactile.errors import RecordingError
from scroll_tactile.recordings.blocks import missing

__all__ = ["file_system", "is_remote", "local"]


def is_remote(address: str) -> bool:
    """Whether an address names a file system, rather than a path."""
    scheme, mark, _ = address.partition("://")
    return bool(mark) and len(scheme) > 1 and scheme.replace("+", "").replace("-", "").isalnum()


@contextmanager
def local(address: str) -> Iterator[Path]:
    """The path of a file or folder; what is elsewhere is copied into a temporary folder while it is used.

    Raises RecordingError for an address where nothing is or that cannot be reached, and what `file_system` raises.
    """
    if not is_remote(address):
        path = Path(address)
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
    except (ImportError, ValueError) as error:
        s3 = address.partition("://")[0] in ("s3", "s3a")
        if isinstance(error, ImportError) and (s3 or error.name == "fsspec"):
            raise missing("s3fs" if s3 else "fsspec", "s3", address) from error
        raise RecordingError(f"{address} cannot be reached: {error}") from error
    return found


def _copied(address: str, folder: Path) -> Path:
    files, path = file_system(address)
    target = folder / (Path(path.rstrip("/")).name or "recording")
    try:
        if files.isdir(path):
            files.get(path.rstrip("/") + "/", f"{target}/", recursive=True)
        else:
            files.get_file(path, str(target))
    except FileNotFoundError as error:
        raise RecordingError(f"expected a recording in {address}; it is not there") from error
    except Exception as error:  # each file system has errors of its own
        raise RecordingError(f"{address} cannot be fetched: {type(error).__name__}: {error}") from error
    return target
