"""One writer at a time: a lock that the operating system frees when its holder dies."""

from __future__ import annotations

import json
import os
import socket
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from store.exceptions import LockedError, StoreError, reported

if TYPE_CHECKING:
    from filelock import BaseFileLock

__all__ = ["HOLDER_FILE", "LOCK_FILE", "WriterLock"]

LOCK_FILE = "lock"
HOLDER_FILE = "holder.json"


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
        self._lock: BaseFileLock = FileLock(folder / LOCK_FILE, timeout=0, thread_local=False)
        with reported(folder, "taking the writer's lock"):
            try:
                self._lock.acquire()
            except Timeout:
                raise LockedError(self._refusal()) from None
            except NotImplementedError as error:
                raise StoreError(f"{folder}: its file system has no locks ({error})") from error
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
        draft.write_text(text + "\n", encoding="utf-8")
        draft.replace(self._folder / HOLDER_FILE)

    def _refusal(self) -> str:
        try:
            holder = json.loads((self._folder / HOLDER_FILE).read_text(encoding="utf-8"))
            who = f"process {holder['pid']} on {holder['host']} since {holder['since']}"
        except (OSError, ValueError, TypeError, KeyError):
            # The holder writes the note just after it takes the lock and removes it just before it releases it.
            who = "a process that left no note of itself"
        return (
            f"{self._folder} is being written by {who}: close the store there (the lock frees itself when "
            'that process ends), or open it here with mode="read"'
        )

    def release(self) -> None:
        """Let the next writer in; a second call does nothing."""
        if self._lock.is_locked:
            # A note that cannot be removed, on a disk that became read-only, must not keep the lock.
            with suppress(OSError):
                (self._folder / HOLDER_FILE).unlink(missing_ok=True)
            self._lock.release()
