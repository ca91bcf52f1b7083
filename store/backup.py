"""A copy of a store that is in use: whole, verified and durable when it appears, or not there at all."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from tempfile import mkdtemp

from store.exceptions import DamageError, NotAStoreError, reported
from store.files import copy_regular, is_real_folder, remove_tree, same_folder, sync_folder, sync_tree
from store.groups import PARTIAL, folder_name
from store.reader import JournalReader
from store.schema import GENERATIONS, JOURNAL_FILE
from store.survey import Progress, check_store

__all__ = ["back_up"]

LARGEST_FILE = 2**30  # of a generation


def back_up(source: Path, destination: Path, named: Callable[[], set[int]], progress: Progress | None) -> None:
    """Copy the store in folder `source` to the new folder `destination`, as `Store.backup`.

    named: the numbers of the generations that the journal names at that moment.
    """
    if os.path.lexists(destination):
        raise NotAStoreError(f"{destination} is there already; nothing was written: give the name of a new folder")
    if any(same_folder(source, above) for above in destination.resolve().parents if above.is_dir()):
        raise NotAStoreError(f"{destination} lies inside {source}; nothing was written: give a folder outside of it")
    with reported(destination, "backing up a store"):
        destination.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(mkdtemp(prefix=f"{destination.name}.", suffix=PARTIAL, dir=destination.parent))
        try:
            shutil.copymode(source, draft)
            with closing(JournalReader(source / JOURNAL_FILE)) as reader:
                while True:
                    _copy_generations(source, draft, reader.connection, named)
                    with closing(sqlite3.connect(draft / JOURNAL_FILE)) as copy:
                        reader.connection.backup(copy)
                    if not reader.renew():
                        break
                    remove_tree(draft / GENERATIONS)
            _verify(source, draft, progress)
            sync_tree(draft)
            draft.rename(destination)
            sync_folder(destination.parent)
        except BaseException:
            remove_tree(draft)
            raise


def _copy_generations(source: Path, draft: Path, connection: sqlite3.Connection, named: Callable[[], set[int]]) -> None:
    """Copy the generations that the journal names, and leave the connection in a transaction that sees it so."""
    while True:
        connection.execute("BEGIN")
        numbers = {number for (number,) in connection.execute("SELECT number FROM generation")}
        failure = None
        try:
            for number in numbers:
                _copy_tree(source / GENERATIONS / folder_name(number), draft / GENERATIONS / folder_name(number))
        except FileNotFoundError as error:
            failure = error
        # A writer removes a folder only after the journal has ceased to name it.
        if numbers <= named():
            if failure is not None:
                raise failure
            return
        connection.execute("ROLLBACK")
        remove_tree(draft / GENERATIONS)


def _copy_tree(source: Path, target: Path) -> None:
    target.mkdir(parents=True)
    if source.is_symlink():
        raise DamageError(f"{source} is a symbolic link, where a store has a folder of its own", path=source)
    for entry in source.iterdir():
        if is_real_folder(entry):
            _copy_tree(entry, target / entry.name)
        else:
            copy_regular(entry, target / entry.name, LARGEST_FILE)


def _verify(source: Path, draft: Path, progress: Progress | None) -> None:
    damaged = [problem for problem in check_store(draft, progress=progress) if problem.kind != "leftover"]
    if damaged:
        what = damaged[0].what.replace(str(draft), str(source))
        raise DamageError(
            f"a copy of {source} does not verify: {what}; no copy was kept. Check the store (check_store): it is "
            "damaged, or else the disk of the copy cannot be trusted",
            path=source,
        )
