"""One writer at a time: a lock that the operating system frees when its holder dies."""

from __future__ import annotations

import json
import os
import socket
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from scroll_tactile_store.exceptions import DamageError, LockedError, NotAStoreError, StoreError, reported
from scroll_tactile_store.files import new_file, read_regular, sync_folder
from scroll_tactile_store.layout import (
    HOLDER_FILE,
    LOCK_FILE,
    Current,
    holds_store,
    log_path,
    require_safe,
    write_current,
)
from scroll_tactile_store.log import create_log

LARGEST_NOTE = 4096  # bytes


class WriterLock:
    """The writer's lock on a store's folder, held from construction until `release`.

    Raises LockedError when another Store object holds it, in this process or in any other, and
    ReadOnlyError when the folder may not be written.
    """

    def __init__(self, folder: Path) -> None:
        # Imported late: it brings asyncio, 60 ms that a reader need not spend.
        from filelock import FileLock, Timeout

        self._folder = folder
        # Not per thread: the thread that closes the store need not be the one that opened it.
        # Nor the lock of a file's mere presence, which filelock takes where there is no other: it outlives its holder.
        self._lock = FileLock(folder / LOCK_FILE, thread_local=False, fallback_to_soft=False)
        with reported(folder, "taking the writer's lock, without which two writers could spoil it"):
            try:
                self._lock.acquire(blocking=False)
            except Timeout:
                raise LockedError(self._refusal()) from None
            except NotImplementedError as error:
                raise StoreError(f"{folder} lies where there are no locks: keep it on another file system") from error
        try:
            with reported(folder, "noting who holds the lock"):
                self._note_holder()
        except BaseException:
            self.release()
            raise

    def _note_holder(self) -> None:
        since = datetime.now(UTC).isoformat(timespec="seconds")
        text = json.dumps({"pid": os.getpid(), "host": socket.gethostname(), "since": since})
        draft = self._folder / f"{HOLDER_FILE}.new"
        with new_file(draft, "w") as file:
            file.write(text + "\n")
        draft.replace(self._folder / HOLDER_FILE)

    def _refusal(self) -> str:
        try:
            holder = json.loads(read_regular(self._folder / HOLDER_FILE, LARGEST_NOTE))
            ours = "this process, " if (holder["pid"], holder["host"]) == (os.getpid(), socket.gethostname()) else ""
            who = f"{ours}process {holder['pid']} on {holder['host']} since {holder['since']}"
        except (OSError, ValueError, TypeError, KeyError, RecursionError, DamageError):
            # The holder writes the note just after it takes the lock and removes it just before it releases it.
            who = "a process that left no note of itself"
        shown = who if who.isprintable() else ascii(who)
        return (
            f"{self._folder} is being written by {shown}: close the store there (the lock frees itself when "
            'that process ends), or open it here with mode="read"'
        )

    def release(self) -> None:
        """Let the next writer in; a second call does nothing."""
        if self._lock.is_locked:
            # A note that cannot be removed, on a disk that became read-only, must not keep the lock.
            with suppress(OSError):
                (self._folder / HOLDER_FILE).unlink(missing_ok=True)
            self._lock.release()


def lock_to_write(folder: Path, identity: str | None) -> WriterLock:
    """Return the writer's lock on a folder that then holds a store, made with this identity where there was none.

    Raises LockedError, NotAStoreError where there is none and no identity, and what else `Store.open` raises.
    """
    with reported(folder, "making the folder"):
        if not folder.is_dir():
            folder.mkdir(parents=True, exist_ok=True)
            sync_folder(folder.parent)
    require_safe(folder, written=True)
    lock = WriterLock(folder)
    try:
        # Asked again, under the lock: another writer may have made the store, and left, since.
        if not holds_store(folder):
            if identity is None:
                raise NotAStoreError(f"{folder} holds no store; give an identity to make one")
            with reported(folder, "making the store"):
                write_current(folder, Current(1, create_log(log_path(folder, 1), identity.encode())))
                sync_folder(folder.parent)
    except BaseException:
        lock.release()
        raise
    return lock
