"""What comes before SQLite opens a journal: a folder, the lock, a store in it, and no leftovers that could mislead."""

from __future__ import annotations

from pathlib import Path

from store.errors import DamageError, NotAStoreError
from store.files import sync_folder
from store.header import holds_store
from store.lock import WriterLock
from store.log import damaged_frame, log_text
from store.reporting import reported
from store.schema import JOURNAL_FILE, LOG, create_journal, remove_drafts

__all__ = ["lock_to_write", "require_whole_log"]


def lock_to_write(folder: Path, identity: str | None) -> WriterLock:
    """Return the writer's lock on a folder that then holds a store, made with this identity where there was none.

    Raises LockedError, NotAStoreError where there is none and no identity, and what else `Store.open` raises.
    """
    with reported(folder, "making the folder"):
        if not folder.is_dir():
            folder.mkdir(parents=True, exist_ok=True)
            sync_folder(folder.parent)
    lock = WriterLock(folder)
    try:
        # Asked again, under the lock: another writer may have made the store, and left, since.
        if not holds_store(folder):
            if identity is None:
                raise NotAStoreError(f"{folder} holds no store; give an identity to make one")
            with reported(folder, "making the store"):
                create_journal(folder, identity)
        with reported(folder, "removing what an interrupted repair left"):
            # Or, were the journal lost later, the rows appended from now on would be lost with it.
            remove_drafts(folder)
    except BaseException:
        lock.release()
        raise
    return lock


def require_whole_log(folder: Path) -> None:
    """Raise DamageError where SQLite would take a damaged frame of the log for its end, and write over what follows."""
    log = folder / (JOURNAL_FILE + LOG)
    with reported(log, "reading the write-ahead log"):
        frame = damaged_frame(log)
    if frame is not None:
        raise DamageError(f"{log_text(log, frame)}: repair the store (repair_store)", path=log)
