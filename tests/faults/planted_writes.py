"""Bugs in what is written: in its order, in what is synced, and in what belongs together."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

from faults.planting import Patches, nothing
from scroll_tactile.persistence import ledger
from store import backup, checkpoint_files, checkpoints, layout, log_writer
from store.exceptions import reported
from store.files import sync_file, sync_folder, sync_tree
from store.layout import Current


def unsynced(_: Any) -> Any:
    """As `replacing`, without a sync of the draft."""

    @contextmanager
    def replacing(path: Path, draft: Path) -> Iterator[None]:
        yield
        draft.replace(path)
        sync_folder(path.parent)

    return replacing


def unsynced_name(_: Any) -> Any:
    """As `replacing`, without a sync of the folder."""

    @contextmanager
    def replacing(path: Path, draft: Path) -> Iterator[None]:
        yield
        (sync_tree if draft.is_dir() else sync_file)(draft)
        draft.replace(path)

    return replacing


def _no_sync_of_the_log(patch: Patches) -> None:
    def make(sync: Any) -> Any:
        return lambda descriptor, *, data_only=False: None if data_only else sync(descriptor)

    patch(log_writer, "sync_open", make)


def _unsynced(call: Any) -> Any:
    """The same, and nothing of the log is synced meanwhile."""

    def done(*given: Any, **named: Any) -> Any:
        before = log_writer.sync_open, log_writer.replacing
        log_writer.sync_open, log_writer.replacing = nothing(None), unsynced(None)
        try:
            return call(*given, **named)
        finally:
            log_writer.sync_open, log_writer.replacing = before

    return done


def _no_sync_of_a_new_log(patch: Patches) -> None:
    patch.everywhere(log_writer, "create_log", _unsynced)


def _no_sync_of_current(patch: Patches) -> None:
    patch(layout, "replacing", unsynced)


def _no_sync_of_a_checkpoint(patch: Patches) -> None:
    patch(checkpoint_files, "replacing", unsynced)


def _no_sync_of_a_folder(patch: Patches) -> None:
    patch(layout, "replacing", unsynced_name)


def _no_sync_of_checkpoints(patch: Patches) -> None:
    patch(checkpoint_files, "replacing", unsynced_name)


def _no_sync_of_a_backup(patch: Patches) -> None:
    patch(backup, "replacing", unsynced)


def _no_sync_at_opening(patch: Patches) -> None:
    patch(log_writer.LogWriter, "__init__", _unsynced)


def _rename_before_sync(patch: Patches) -> None:
    def make(_: Any) -> Any:
        def write(folder: Path, current: Current) -> None:
            draft = folder / "CURRENT.new"
            draft.write_bytes(current.to_bytes())
            draft.replace(folder / "CURRENT")
            sync_folder(folder)
            sync_file(folder / "CURRENT")

        return write

    patch.everywhere(layout, "write_current", make)


def _current_before_checkpoint(patch: Patches) -> None:
    late: list[Path] = []

    def make_replacing(_: Any) -> Any:
        @contextmanager
        def replacing(path: Path, draft: Path) -> Iterator[None]:
            with unsynced(None)(path, draft):
                yield
            late.append(path)

        return replacing

    def make_write(write: Any) -> Any:
        def written(folder: Path, current: Current) -> None:
            write(folder, current)
            while late:
                if (path := late.pop()).exists():
                    sync_tree(path)

        return written

    patch(checkpoint_files, "replacing", make_replacing)
    patch.everywhere(layout, "write_current", make_write)


def _removed_too_early(patch: Patches) -> None:
    def make(write: Any) -> Any:
        def written(folder: Path, current: Current) -> None:
            layout.remove_unnamed(folder, current)
            write(folder, current)

        return written

    patch(checkpoints, "write_current", make)


def _commit_frame_first(patch: Patches) -> None:
    def make(whole: Any) -> Any:
        def commit(self: Any) -> None:
            if self._next == self.place:
                return
            try:
                last = self._pack(1, b"")
                begin, staged = self._written, bytes(self._staged)
                self._file.write(begin + len(staged) - 88, staged[-88:])
                log_writer.sync_open(self._file.descriptor, data_only=True)
                self._write()
            except BaseException:
                self.rollback()
                raise
            self._last, self.place, self._settled = last, self._next, True

        def told(self: Any) -> None:
            with reported(self.path, "making a batch durable"):
                commit(self)

        return told

    patch(log_writer.LogWriter, "commit", make)


def _rollback_without_cut(patch: Patches) -> None:
    def make(_: Any) -> Any:
        def settle(self: Any) -> None:
            self._settled = True

        return settle

    patch(log_writer.LogWriter, "_settle", make)


def _without_batch(change: Any) -> Any:
    """The same change of a ledger, and each of its rows is durable by itself."""

    def done(self: Any, *given: Any, **named: Any) -> Any:
        before, self.store.batch = self.store.batch, nullcontext
        try:
            return change(self, *given, **named)
        finally:
            self.store.batch = before

    return done


def _relabel_in_two(patch: Patches) -> None:
    patch(ledger.Ledger, "relabel", _without_batch)


def _merge_in_parts(patch: Patches) -> None:
    patch(ledger.Ledger, "merge", _without_batch)


WRITES: dict[str, Callable[[Patches], None]] = {
    "the log is not synced": _no_sync_of_the_log,
    "a new log is not synced": _no_sync_of_a_new_log,
    "CURRENT is not synced": _no_sync_of_current,
    "a checkpoint's files are not synced": _no_sync_of_a_checkpoint,
    "the folder is not synced": _no_sync_of_a_folder,
    "the folder of checkpoints is not synced": _no_sync_of_checkpoints,
    "a backup is not synced": _no_sync_of_a_backup,
    "what a killed writer left is not synced": _no_sync_at_opening,
    "CURRENT is renamed before it is synced": _rename_before_sync,
    "CURRENT comes before its checkpoint is durable": _current_before_checkpoint,
    "what is replaced is removed before CURRENT": _removed_too_early,
    "the commit frame is written first": _commit_frame_first,
    "a rollback does not cut the log": _rollback_without_cut,
    "relabel is not atomic": _relabel_in_two,
    "a merge is not atomic": _merge_in_parts,
}
