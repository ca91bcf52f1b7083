"""Bugs in what is written: in its order, in what is synced, and in what belongs together."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

from scroll_tactile_store import backup, checkpoint_files, layout, log, store
from scroll_tactile_store.exceptions import reported
from scroll_tactile_store.files import sync_file, sync_folder, sync_tree
from scroll_tactile_store.layout import Current

from faults.planting import bug, nothing
from scroll_tactile.persistence import ledger


@bug("CURRENT is not synced", layout, "replacing")
@bug("a checkpoint's files are not synced", checkpoint_files, "replacing")
@bug("a backup is not synced", backup, "replacing")
@contextmanager
def unsynced(_: Any, path: Path, draft: Path) -> Iterator[None]:
    """As `replacing`, without a sync of the draft."""
    yield
    draft.replace(path)
    sync_folder(path.parent)


@bug("the folder is not synced", layout, "replacing")
@bug("the folder of checkpoints is not synced", checkpoint_files, "replacing")
@contextmanager
def unsynced_name(_: Any, path: Path, draft: Path) -> Iterator[None]:
    """As `replacing`, without a sync of the folder."""
    yield
    (sync_tree if draft.is_dir() else sync_file)(draft)
    draft.replace(path)


@bug("the log is not synced", log, "sync_open")
def _no_sync_of_the_log(sync: Any, descriptor: int, *, data_only: bool = False) -> None:
    if not data_only:
        sync(descriptor)


@bug("a new log is not synced", log, "create_log", everywhere=True)
@bug("what a killed writer left is not synced", log.Log, "prepare")
def _without_syncs(call: Any, *given: Any, **named: Any) -> Any:
    with (
        mock.patch.object(log, "sync_open", nothing),
        mock.patch.object(log, "replacing", lambda path, draft: unsynced(None, path, draft)),
    ):
        return call(*given, **named)


@bug("CURRENT is renamed before it is synced", layout, "write_current", everywhere=True)
def _rename_before_sync(_: Any, folder: Path, current: Current) -> None:
    draft = folder / "CURRENT.new"
    draft.write_bytes(current.to_bytes())
    draft.replace(folder / "CURRENT")
    sync_folder(folder)
    sync_file(folder / "CURRENT")


LATE: list[Path] = []  # checkpoints that are synced behind `CURRENT`


@bug("CURRENT comes before its checkpoint is durable", checkpoint_files, "replacing")
@contextmanager
def _noted_as_late(_: Any, path: Path, draft: Path) -> Iterator[None]:
    with unsynced(None, path, draft):
        yield
    LATE.append(path)


@bug("CURRENT comes before its checkpoint is durable", layout, "write_current", everywhere=True)
def _late_synced_behind(write: Any, folder: Path, current: Current) -> None:
    write(folder, current)
    while LATE:
        if (path := LATE.pop()).exists():
            sync_tree(path)


@bug("what is replaced is removed before CURRENT", store, "write_current")
def _removed_too_early(write: Any, folder: Path, current: Current) -> None:
    layout.remove_unnamed(folder, current)
    write(folder, current)


@bug("the commit frame is written first", log.Log, "commit")
def _commit_frame_first(_: Any, self: Any, *, seal: bool = False) -> None:
    if self._next == self.place and not seal:
        return
    with reported(self.path, "making a batch durable"):
        try:
            self._pack(1, b"")
            begin, staged = self._written, bytearray(self._staged)
            self._put(begin + len(staged) - 88, staged[-88:])
            log.sync_open(self._descriptor, data_only=True)
            self._write()
        except BaseException:
            self.rollback()
            raise
        self.place, self._settled = self._next, True


@bug("a rollback does not cut the log", log.Log, "_settle")
def _rollback_without_cut(_: Any, self: Any) -> None:
    self._settled = True


@bug("relabel is not atomic", ledger.Ledger, "relabel")
@bug("a merge is not atomic", ledger.Ledger, "merge")
def _without_batch(change: Any, self: Any, *given: Any, **named: Any) -> Any:
    """Each row of the change is durable by itself."""
    with mock.patch.object(self.store, "batch", nullcontext):
        return change(self, *given, **named)
