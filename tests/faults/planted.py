"""Bugs to be put in, by name, so that it shows that the simulation finds such ones.

Each is a function that patches what it spoils, for as long as `planted` lasts.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import Any

from scroll_tactile.memory import ledger, merge, packing
from scroll_tactile.memory.rows import MEMBER, MERGE, OBSERVE
from scroll_tactile.memory.state import Memory
from store import backup, checkpoint_files, checkpoints, chunks, journal, layout, log, log_writer, repair, rows
from store.files import sync_file, sync_folder, sync_tree
from store.layout import Current


class Patches:
    """What was replaced, to be put back."""

    def __init__(self) -> None:
        self._before: list[tuple[Any, str, Any]] = []

    def __call__(self, where: Any, name: str, make: Callable[[Any], Any]) -> None:
        """Replace something by what `make` makes of it."""
        raw = vars(where)[name]
        before = (
            raw.__func__
            if isinstance(raw, classmethod | staticmethod)
            else raw.fget
            if isinstance(raw, property)
            else raw
        )
        made = make(before)
        kind = type(raw) if isinstance(raw, classmethod | staticmethod | property) else None
        self._before.append((where, name, raw))
        setattr(where, name, kind(made) if kind else made)

    def everywhere(self, where: Any, name: str, make: Callable[[Any], Any]) -> None:
        """Replace a function in each module that imported it, too."""
        before = vars(where)[name]
        made = make(before)
        for module in [one for key, one in sys.modules.items() if key.startswith(("store", "scroll_tactile"))]:
            if vars(module).get(name) is before:
                self(module, name, lambda _: made)

    def undo(self) -> None:
        """Put all back."""
        for where, name, before in reversed(self._before):
            setattr(where, name, before)
        self._before = []


def nothing(_: Any) -> Any:
    """What does nothing, in the place of a call."""
    return lambda *given, **named: None


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


# What is left out of the order of writes.


def _no_sync_of_the_log(patch: Patches) -> None:
    def make(sync: Any) -> Any:
        return lambda descriptor, *, data_only=False: None if data_only else sync(descriptor)

    patch(log_writer, "sync_open", make)


def _no_sync_of_a_new_log(patch: Patches) -> None:
    def make(create: Any) -> Any:
        def created(*given: Any, **named: Any) -> Any:
            before = log_writer.sync_open, log_writer.replacing
            log_writer.sync_open, log_writer.replacing = nothing(None), unsynced(None)
            try:
                return create(*given, **named)
            finally:
                log_writer.sync_open, log_writer.replacing = before

        return created

    patch.everywhere(log_writer, "create_log", make)


def _no_sync_of_current(patch: Patches) -> None:
    patch(layout, "replacing", unsynced)


def _no_sync_of_a_checkpoint(patch: Patches) -> None:
    patch(checkpoint_files, "replacing", unsynced)


def _no_sync_of_a_folder(patch: Patches) -> None:
    patch(layout, "replacing", unsynced_name)


def _no_sync_of_checkpoints(patch: Patches) -> None:
    patch(checkpoint_files, "sync_folder", nothing)
    patch(checkpoint_files, "replacing", unsynced_name)


def _no_sync_of_a_backup(patch: Patches) -> None:
    patch(backup, "replacing", unsynced)


def _no_sync_at_opening(patch: Patches) -> None:
    def make(init: Any) -> Any:
        def begun(self: Any, path: Any, *, place: Any = None) -> None:
            before, log_writer.sync_open = log_writer.sync_open, nothing(None)
            try:
                init(self, path, place=place)
            finally:
                log_writer.sync_open = before

        return begun

    patch(log_writer.LogWriter, "__init__", make)


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

        return lambda self: _reported(self.path, commit, self)

    patch(log_writer.LogWriter, "commit", make)


def _reported(path: Path, call: Any, *given: Any) -> Any:
    with log_writer.reported(path, "making a batch durable"):
        return call(*given)


def _rollback_without_cut(patch: Patches) -> None:
    def make(_: Any) -> Any:
        def settle(self: Any) -> None:
            self._settled = True

        return settle

    patch(log_writer.LogWriter, "_settle", make)


def _relabel_in_two(patch: Patches) -> None:
    def make(relabel: Any) -> Any:
        def relabelled(self: Any, receipt: Any, material: str) -> Any:
            before, self.store.batch = self.store.batch, nullcontext
            try:
                return relabel(self, receipt, material)
            finally:
                self.store.batch = before

        return relabelled

    patch(ledger.Ledger, "relabel", make)


def _merge_in_parts(patch: Patches) -> None:
    def make(merging: Any) -> Any:
        def merged(self: Any, *given: Any, **named: Any) -> Any:
            before, self.store.batch = self.store.batch, nullcontext
            try:
                return merging(self, *given, **named)
            finally:
                self.store.batch = before

        return merged

    patch(ledger.Ledger, "_merge", make)


# What is not looked at.


def _payload_not_looked_at(patch: Patches) -> None:
    def make(_: Any) -> Any:
        return lambda self, frame: self._file.read(frame.payload_offset, frame.size)

    def make_init(init: Any) -> Any:
        def begun(self: Any, path: Any, **named: Any) -> None:
            init(self, path, **named)
            self.payloads = False

        return begun

    patch(log.LogReader, "_payload", make)
    patch(log.LogReader, "__init__", make_init)


def _current_not_looked_at(patch: Patches) -> None:
    def make(read: Any) -> Any:
        def found(cls: Any, data: bytes, path: Path) -> Any:
            known = None
            try:
                known = json.loads(data)
                known.pop("sha256")
                text = json.dumps(known | {"sha256": layout._digest(known)}).encode()
            except (ValueError, KeyError, AttributeError, TypeError):
                text = data
            return read(cls, text, path)

        return found

    patch(layout.Current, "from_bytes", make)


def _chunk_not_looked_at(patch: Patches) -> None:
    def make(_: Any) -> Any:
        def read(self: Any, name: str) -> Any:
            content = self._described[name]
            folder = self._path / name
            places = [folder.joinpath("c", *map(str, place)) for place in content.places(content.chunk)]
            try:
                sums = [chunks.hashlib.sha256(self._files.read(one, 2**28)).hexdigest() for one in places]
                content = dataclasses.replace(content, files=tuple(sums))
                return chunks.ArrayFiles(self._path, name, content, self._files.read).read()
            except Exception as error:
                raise checkpoint_files._unreadable(error, name, folder) from error

        return read

    patch(checkpoint_files.CheckpointReader, "_array", make)


class _Same(str):
    """A text that is the same as any other."""

    __slots__ = ()
    __hash__ = str.__hash__

    def __eq__(self, _: object) -> bool:
        return True


def _description_not_looked_at(patch: Patches) -> None:
    patch(checkpoint_files, "_own_digest", lambda digest: lambda known: _Same(digest(known)))


def _torn_taken_for_committed(patch: Patches) -> None:
    def make(scan: Any) -> Any:
        def scanned(self: Any) -> Any:
            batch, torn = scan(self)
            return ([*batch, batch[-1]], None) if torn is not None and batch else (batch, torn)

        return scanned

    patch(log.LogReader, "_scan", make)


def _other_log_not_noticed(patch: Patches) -> None:
    def make(_: Any) -> Any:
        def renewed(self: Any, at: Any) -> Any:
            at.catch_up()
            return at

        return renewed

    patch(journal.Journal, "_renewed", make)


def _index_of_another_log(patch: Patches) -> None:
    def make(decoded: Any) -> Any:
        def believed(self: Any, path: Path, data: bytes) -> Any:
            self._identity = rows.HEADER.unpack_from(data)[1]
            segment, found = decoded(self, path, data)
            return dataclasses.replace(segment, begin=self.end), found

        return believed

    patch(rows.Index, "_decoded", make)


def _backup_looks_once(patch: Patches) -> None:
    def make(_: Any) -> Any:
        def copy(source: Path, draft: Path) -> None:
            current = layout.read_current(source / "CURRENT")
            with suppress(FileNotFoundError):
                backup._copy_named(source, draft, current)
            layout.write_current(draft, layout.read_current(source / "CURRENT"))

        return copy

    patch(backup, "_copy", make)
    patch(backup, "_verify", nothing)


# What is counted wrongly.


def _place_too_late(patch: Patches) -> None:
    def make(_: Any) -> Any:
        def place(self: Any, upto: int) -> Any:
            with self._using("looking for a place") as at:
                found = [place for row, place in at.places if row > upto]
                return found[0] if found else at.places[-1][1]

        return place

    patch(journal.Journal, "place", make)


def _one_row_too_many(patch: Patches) -> None:
    def make(commit: Any) -> Any:
        def committed(self: Any, draft: Any) -> Any:
            return commit(self, dataclasses.replace(draft, upto=min(draft.upto + 1, self._journal.last())))

        return committed

    patch(checkpoints.Checkpoints, "commit", make)


def _numbers_given_out_again(patch: Patches) -> None:
    patch(journal.OpenLog, "last", lambda _: lambda self: self.last_row)


def _compaction_drops_a_row(patch: Patches) -> None:
    def make(payloads: Any) -> Any:
        def fewer(self: Any, upto: int) -> Iterator[bytes]:
            found = list(payloads(self, upto))
            return iter(found[:-1])

        return fewer

    patch(journal.Journal, "payloads", make)


def _base_with_a_retracted_touch(patch: Patches) -> None:
    def make(until: Any) -> Any:
        def spoilt(self: Any, given: Any, upto: int) -> Any:
            base = until(self, given, upto)
            for sequence in sorted(self.retracted):
                if self.base < sequence <= upto:
                    record = given.record(sequence)
                    columns, codes = self.codes(record)
                    base.statistics.add(record.label, codes, columns)
                    break
            return base

        return spoilt

    patch(Memory, "until", make)


def _excluded_forgotten(patch: Patches) -> None:
    def make(to_arrays: Any) -> Any:
        def spoilt(self: Any, *given: Any, **named: Any) -> Any:
            arrays, attributes = to_arrays(self, *given, **named)
            return arrays | {"excluded": arrays["excluded"][:0]}, attributes

        return spoilt

    patch(Memory, "to_arrays", make)


def _kept_not_retracted(patch: Patches) -> None:
    def make(refill: Any) -> Any:
        def spoilt(self: Any, given: Any) -> None:
            kept = self.kept
            refill(self, given)
            self.kept = kept

        return spoilt

    patch(Memory, "refill", make)


def _all(heads: Any) -> Any:
    return [head for head in heads if head.kind in (OBSERVE, MERGE, MEMBER)]


def _retraction_lost_in_a_merge(patch: Patches) -> None:
    patch(merge, "active_rows", lambda _: _all)


def _retraction_lost_in_packing(patch: Patches) -> None:
    patch(packing, "active_rows", lambda _: _all)


def _shared_twice(patch: Patches) -> None:
    patch(merge, "_row", nothing)


def _packed_twice(patch: Patches) -> None:
    def make(sums: Any) -> Any:
        return lambda source, memory, left_out: sums(source, memory, set())

    patch(merge, "sums_without", make)


def _description_lost(patch: Patches) -> None:
    def make(described: Any) -> Any:
        return lambda *given: dict(list(described(*given).items())[1:])

    patch(merge, "_descriptions", make)


def _repair_keeps_too_much(patch: Patches) -> None:
    def make(of: Any) -> Any:
        return lambda cls, survey: dataclasses.replace(of(cls, survey), kept=survey.last)

    patch(repair._Plan, "of", make)


def _rows_of_a_failed_batch(patch: Patches) -> None:
    def make(_: Any) -> Any:
        def undo(at: Any, writer: Any) -> None:
            writer.rollback()

        return undo

    patch(journal.Journal, "_undo", make)


BUGS: dict[str, Callable[[Patches], None]] = {
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
    "rows of a failed batch stay known": _rows_of_a_failed_batch,
    "relabel is not atomic": _relabel_in_two,
    "a merge is not atomic": _merge_in_parts,
    "a frame's payload is not verified": _payload_not_looked_at,
    "CURRENT is not verified": _current_not_looked_at,
    "a chunk is not verified": _chunk_not_looked_at,
    "what a checkpoint says of itself is not verified": _description_not_looked_at,
    "a torn batch is taken": _torn_taken_for_committed,
    "a reader does not notice another log": _other_log_not_noticed,
    "an index of another log is believed": _index_of_another_log,
    "a backup does not look at CURRENT again": _backup_looks_once,
    "a place is one batch too late": _place_too_late,
    "a checkpoint says one row too many": _one_row_too_many,
    "numbers of rows are given out again": _numbers_given_out_again,
    "compaction drops the last row": _compaction_drops_a_row,
    "a base has a retracted touch": _base_with_a_retracted_touch,
    "excluded rows are forgotten": _excluded_forgotten,
    "kept touches are not retracted": _kept_not_retracted,
    "a retraction is lost in a merge": _retraction_lost_in_a_merge,
    "a retraction is lost in packing": _retraction_lost_in_packing,
    "a shared touch is counted twice": _shared_twice,
    "a packed memory is counted twice": _packed_twice,
    "a description is lost in a merge": _description_lost,
    "a repair keeps rows behind damage": _repair_keeps_too_much,
}


@contextmanager
def _planted(name: str) -> Iterator[None]:
    patches = Patches()
    BUGS[name](patches)
    try:
        yield
    finally:
        patches.undo()


PLANTS = {name: partial(_planted, name) for name in BUGS}
