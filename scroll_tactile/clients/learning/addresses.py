"""Where a fleet's sources lie: recordings and memories in files, folders and buckets, each found once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from queue import Empty, Queue
from typing import TypeVar

from scroll_tactile_store.archive import ARCHIVE_BYTES, is_archive
from scroll_tactile_store.layout import CURRENT_FILE, holds_store

from scroll_tactile.clients.learning.sources import Refused, find_sources
from scroll_tactile.errors import RecordingError
from scroll_tactile.recordings.locations import file_system, is_remote, local

__all__ = ["expand", "fetched", "is_memory"]

RECORDINGS = (".bag", ".db3", ".mcap", ".npy", ".csv", ".h5", ".hdf5", ".parquet")
PACKED = (".part",)  # what is looked for in a remote folder: the names that packed memories have
WHOLE = ("metadata.yaml", "meta/info.json", ".zgroup", "zarr.json")  # in a folder that is one recording

T = TypeVar("T")


def is_memory(address: str, patience: float | None = None) -> bool:
    """Whether an address is that of a memory, in a folder or packed; what cannot be looked at is none.

    patience: seconds in which a remote one must answer; raises TimeoutError where it does not.
    """
    remote = is_remote(address)
    try:
        return _answered(partial(_is_remote_memory, address), patience) if remote else _is_local_memory(Path(address))
    except Exception as error:  # each file system has errors of its own; reading it raises what is wrong
        if remote and isinstance(error, TimeoutError):
            raise
        return False


def _is_local_memory(path: Path) -> bool:
    if path.is_dir():
        return holds_store(path)
    if not path.is_file():  # a pipe would be waited for
        return False
    with path.open("rb") as file:
        return is_archive(file.read(ARCHIVE_BYTES))


def _is_remote_memory(address: str) -> bool:
    if address.lower().endswith(RECORDINGS):
        return False
    files, path = file_system(address)
    if files.isdir(path):
        return bool(files.exists(f"{path.rstrip('/')}/{CURRENT_FILE}"))
    with files.open(path, "rb", cache_type="none") as file:
        return is_archive(file.read(ARCHIVE_BYTES))


def expand(paths: Sequence[str], patience: float | None = None) -> tuple[list[str], list[Refused]]:
    """The recordings and memories at some paths and addresses, each once, in order; and where there is none.

    patience: seconds in which an address must answer.
    """
    found: dict[str, None] = {}
    refused: list[Refused] = []
    for path in paths:
        inside: Sequence[str]
        if is_remote(path):
            try:
                inside = _answered(partial(_listed, path), patience)
            except Exception as error:  # each file system has errors of its own
                refused.append(Refused(path, f"it cannot be listed: {type(error).__name__}: {error!s:.300}"))
                continue
            if not inside:
                refused.append(Refused(path, "expected recordings or memories; nothing is there"))
        elif is_memory(path):
            inside = [path]
        else:
            inside, missing = find_sources([path])
            refused += missing
        found |= dict.fromkeys(inside)
    return list(found), refused


@contextmanager
def fetched(address: str, patience: float | None = None) -> Iterator[Path]:
    """The path of a memory, as `local` gives it; patience: seconds in which a remote one must be there.

    Raises what `local` raises, and RecordingError where it takes longer.
    """
    fetch = local(address)
    try:
        place = _answered(fetch.__enter__, patience) if is_remote(address) else fetch.__enter__()
    except TimeoutError as error:
        raise RecordingError(
            f"{address} cannot be fetched: {error}. Give it more time, or look at its server"
        ) from error
    try:
        yield place
    finally:
        fetch.__exit__(None, None, None)


def _answered(ask: Callable[[], T], patience: float | None) -> T:
    """The answer of a call. Raises what it raises, and TimeoutError where it takes longer; it is left alone then."""
    answers: Queue[T | Exception] = Queue()

    def call() -> None:
        try:
            answers.put(ask())
        except Exception as error:  # raised below
            answers.put(error)

    threading.Thread(target=call, daemon=True).start()
    try:
        answer = answers.get(timeout=patience)
    except Empty:
        raise TimeoutError(f"no answer in {patience:g} s") from None
    if isinstance(answer, Exception):
        raise answer
    return answer


def _listed(address: str) -> list[str]:
    """What a remote folder holds; the address itself where it is a file, or a folder that is one recording."""
    files, path = file_system(address)
    files.invalidate_cache()
    if not files.isdir(path):
        return [address]
    scheme, place = address.partition("://")[0], path.rstrip("/")
    names = sorted(str(name) for name in files.find(place))
    inside = {name[len(place) + 1 :] for name in names}
    if inside & {*WHOLE, CURRENT_FILE}:
        return [address]
    folders = {name.rpartition("/")[0] for name in names if name.endswith((f"/{CURRENT_FILE}", "/metadata.yaml"))}
    alone = [
        name for name in names if name.lower().endswith(RECORDINGS + PACKED) and not name.startswith(tuple(folders))
    ]
    return [f"{scheme}://{name}" for name in sorted({*folders, *alone})]
