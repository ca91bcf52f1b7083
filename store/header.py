"""What a folder and the first bytes of its journal say, before SQLite sees them."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from store.exceptions import DamageError, NotAStoreError, VersionError, reported
from store.files import file_size, is_real_folder, sync_folder
from store.groups import PARTIAL
from store.lock import HOLDER_FILE, LOCK_FILE, WriterLock
from store.schema import (
    APPLICATION_ID,
    DAMAGED_FILE,
    DRAFT_FILE,
    FORMAT_VERSION,
    GENERATIONS,
    JOURNAL_FILE,
    LOG,
    PAGE_BYTES,
    REPAIRED_FILE,
    ROLLBACK,
    SIDES,
    create_journal,
    remove_drafts,
)

__all__ = ["header_fault", "holds_store", "lock_to_write", "new_first_page", "require_unshared", "strangers"]

# What a folder may hold in which no store was made yet, and what betrays that one was.
OURS = frozenset(
    {LOCK_FILE, HOLDER_FILE, HOLDER_FILE + ".new", GENERATIONS}
    | {DRAFT_FILE + suffix for suffix in ("", ROLLBACK, *SIDES)}
)
TRACES = (JOURNAL_FILE + LOG, REPAIRED_FILE, DAMAGED_FILE)

SQLITE_MAGIC = b"SQLite format 3\0"
HEADER_LENGTH = 100
# Offsets in the header: the file's change, its pages, its free pages, user_version, application_id, and
# the change for which the count of pages was made.
CHANGE_AT, PAGES_AT, FREE_AT, VERSION_AT, APPLICATION_AT, COUNTED_AT = 24, 28, 32, 60, 68, 92

# What every journal's header says at offsets 0 and 44; between these, and behind, are counts that change. `log`
# is 2 for a write-ahead log, and 1 without one, which another program may have made of it; `spare` are the bytes
# kept free at the end of a page, of which Apple's builds of SQLite want 12.
BEGINNINGS = tuple(
    SQLITE_MAGIC + struct.pack(">H6B", PAGE_BYTES, log, log, spare, 64, 32, 32) for log in (2, 1) for spare in (0, 12)
)
FORMAT = struct.pack(">7I", 4, 0, 0, 1, FORMAT_VERSION, 0, APPLICATION_ID) + bytes(20)


def holds_store(folder: Path) -> bool:
    """Return whether `folder` holds a store that this release reads; False when one may be made there.

    Only looks. Raises NotAStoreError for a file, for a folder with other things in it and for another
    program's database, VersionError for a newer format, and DamageError for a journal whose first
    bytes are damaged, or which is gone while its generations are still there.
    """
    with reported(folder, "looking for a store"):
        if not folder.exists():
            return False
        if not folder.is_dir():
            raise NotAStoreError(f"{folder} is a file; a store is a folder")
        journal = folder / JOURNAL_FILE
        if os.path.lexists(journal):
            for error in strangers(folder):
                raise error
            _refuse_rollback(journal.with_name(JOURNAL_FILE + ROLLBACK))
        # A repair may be moving it away just now.
        with suppress(FileNotFoundError):
            if journal.is_file():
                _require_ours(journal, _header(journal))
                # Before SQLite sees it: with a smaller page, or fewer of them, it would write over rows.
                if (fault := header_fault(journal)) is not None:
                    raise DamageError(f"{fault}: repair the store (repair_store)", path=journal)
                return True
        try:
            _refuse_foreign(folder)
        except (DamageError, NotAStoreError):
            if journal.is_file():  # another process has just made the store
                return holds_store(folder)
            raise
        for error in strangers(folder):
            raise error
        return False


def strangers(folder: Path) -> Iterator[DamageError]:
    """Yield an error for each thing in a store's folder that is there under a name of ours, and is not of its kind.

    A link would lead what is read, written or removed out of the folder; to read from a pipe or a device may never
    end. Raises OSError.
    """
    for path, is_ours in _named_as_ours(folder):
        if not is_ours and os.path.lexists(path):
            what = "a symbolic link" if path.is_symlink() else "no regular file or folder"
            yield DamageError(
                f"{path} is {what}, where a store has a file or folder of its own: nothing was read through it. Put "
                "what belongs there in its place; in a folder that comes from elsewhere trust nothing",
                path=path,
            )


def require_unshared(folder: Path) -> None:
    """Raise DamageError where a file of the journal, or the lock, has another name: writing would change that too."""
    with reported(folder, "looking for what may be written"):
        for path, is_ours in _named_as_ours(folder) if folder.is_dir() else ():
            if is_ours and path.parent == folder and path.is_file() and path.lstat().st_nlink > 1:
                raise DamageError(
                    f"{path} has another name somewhere (a hard link), and what is written here would change it there: "
                    'copy the folder (cp -r) and open the copy, or open this one with mode="read"',
                    path=path,
                )


def _refuse_rollback(rollback: Path) -> None:
    if file_size(rollback):
        raise DamageError(
            f"{rollback} is of another program, which was writing to the journal and did not end: repair the store "
            "(repair_store)",
            path=rollback,
        )


def _named_as_ours(folder: Path) -> Iterator[tuple[Path, bool]]:
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name == GENERATIONS:
                yield Path(entry.path), entry.is_dir(follow_symlinks=False)
            elif entry.name.startswith((JOURNAL_FILE, HOLDER_FILE)) or entry.name == LOCK_FILE:
                yield Path(entry.path), entry.is_file(follow_symlinks=False)
    if is_real_folder(folder / GENERATIONS):
        with os.scandir(folder / GENERATIONS) as entries:
            for entry in entries:
                if entry.name.removesuffix(PARTIAL).isdigit():
                    is_ours = entry.is_dir(follow_symlinks=False) or entry.is_file(follow_symlinks=False)
                    yield Path(entry.path), is_ours


def _header(journal: Path) -> bytes:
    with journal.open("rb") as file:
        return file.read(HEADER_LENGTH)


def _refuse_foreign(folder: Path) -> None:
    generations = folder / GENERATIONS
    traces = [name for name in TRACES if (folder / name).exists()]
    if generations.is_dir() and any(generations.iterdir()):
        traces.append(GENERATIONS)
    if traces:
        raise DamageError(
            f"{folder} has {' and '.join(traces)} but no {JOURNAL_FILE}: put the journal back from a copy, or "
            "repair the store (repair_store), which resumes from what verifies",
            path=folder / JOURNAL_FILE,
        )
    if foreign := sorted(entry.name for entry in folder.iterdir() if entry.name not in OURS):
        raise NotAStoreError(
            f"{folder} holds no {JOURNAL_FILE} but other things ({', '.join(foreign[:3])}"
            f"{', …' if len(foreign) > 3 else ''}): nothing was written; choose an empty or a new folder"
        )


def _require_ours(journal: Path, header: bytes) -> None:
    if len(header) < HEADER_LENGTH or not header.startswith(SQLITE_MAGIC):
        if (journal.parent / GENERATIONS).is_dir():
            raise DamageError(
                f"{journal} does not begin as a SQLite file: put it back from a copy of the folder, or repair "
                "the store (repair_store)",
                path=journal,
            )
        raise NotAStoreError(f"{journal} is not a SQLite file; nothing was written")
    (application,) = struct.unpack_from(">I", header, APPLICATION_AT)
    (version,) = struct.unpack_from(">I", header, VERSION_AT)
    if application != APPLICATION_ID:
        raise NotAStoreError(
            f"{journal} is another program's database (application id {application:#010x}, not "
            f"{APPLICATION_ID:#010x}); nothing was written"
        )
    if version > FORMAT_VERSION:
        raise VersionError(
            f"{journal} is written in format {version}; this release reads up to format {FORMAT_VERSION}: "
            "upgrade it, or open the store with the release that wrote it; nothing was changed"
        )


def header_fault(journal: Path) -> str | None:
    """Return in words what is wrong with the header of a journal, None for a sound one. A writer may be at work."""
    header = _header(journal)
    if len(header) < HEADER_LENGTH or not (header.startswith(BEGINNINGS) and header.startswith(FORMAT, 44)):
        return f"{journal} does not begin as a journal of format {FORMAT_VERSION}"
    (pages,) = struct.unpack_from(">I", header, PAGES_AT)
    size = file_size(journal)
    # The log knows it better; and what changed meanwhile is no damage.
    if size == pages * PAGE_BYTES or file_size(journal.with_name(journal.name + LOG)) or _header(journal) != header:
        return None
    return f"{journal} has {size} bytes, and says that it has {pages} pages of {PAGE_BYTES}"


def new_first_page(page: bytes) -> bytes:
    """Return the first page of a new journal, changed so that SQLite takes it for that of one of any size."""
    fresh = bytearray(page)
    struct.pack_into(">II", fresh, FREE_AT, 0, 0)
    # SQLite does not believe a count of pages made for another change: it goes by the size of the file.
    struct.pack_into(">I", fresh, CHANGE_AT, 1)
    struct.pack_into(">I", fresh, COUNTED_AT, 0)
    return bytes(fresh)


def lock_to_write(folder: Path, identity: str | None) -> WriterLock:
    """Return the writer's lock on a folder that then holds a store, made with this identity where there was none.

    Raises LockedError, NotAStoreError where there is none and no identity, and what else `Store.open` raises.
    """
    with reported(folder, "making the folder"):
        if not folder.is_dir():
            folder.mkdir(parents=True, exist_ok=True)
            sync_folder(folder.parent)
    require_unshared(folder)
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
