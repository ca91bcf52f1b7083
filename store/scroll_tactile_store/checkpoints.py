"""The checkpoints of an open store: which one is read, how one is committed, and how one takes the place of rows."""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from scroll_tactile_store.archive import Files
from scroll_tactile_store.checkpoint_files import (
    INDEX,
    CheckpointDraft,
    CheckpointReader,
    index_name,
    write_checkpoint,
)
from scroll_tactile_store.encoding import check_arrays
from scroll_tactile_store.exceptions import DamageError, RecordError, StoreError, reported
from scroll_tactile_store.files import remove_tree
from scroll_tactile_store.journal import Journal
from scroll_tactile_store.layout import (
    MOST_DIGITS,
    Current,
    NamedCheckpoint,
    checkpoint_path,
    log_numbers,
    log_path,
    numbers,
    remove_unnamed,
    write_current,
)
from scroll_tactile_store.log import LogPlace, LogReader
from scroll_tactile_store.log_writer import create_log
from scroll_tactile_store.records import Arrays, Attributes, Checkpoint, to_json
from scroll_tactile_store.row_encoding import ROW
from scroll_tactile_store.rows import Rows

__all__ = ["Checkpoints", "read_back"]

logger = logging.getLogger(__name__)


class Checkpoints:
    """The checkpoints that a store's `CURRENT` names. `Store` has methods of the same names."""

    def __init__(self, files: Files, journal: Journal) -> None:
        self._files, self._folder = files, files.folder
        self._journal = journal
        self._committing = threading.Lock()
        self._worker = ThreadPoolExecutor(1, f"store commit {files.folder.name}")
        self._queue = threading.Lock()
        self._waiting: CheckpointDraft | None = None
        self._submitted: Future[None] | None = None
        self._failure: Exception | None = None

    def latest(self) -> Checkpoint | None:
        """Return the newest checkpoint that verifies, None when there is none."""
        passed: set[int] = set()
        while left := [named for named in self._journal.current().checkpoints if named.number not in passed]:
            passed.add(left[0].number)
            try:
                return self._load(left[0])
            except DamageError as damage:
                if self._is_named(left[0]):
                    logger.warning("%s; replaying the journal behind an older checkpoint, or all of it", damage)
        return None

    def compaction(self) -> Checkpoint | None:
        """Return the checkpoint that stands for the compacted rows, None when there are none."""
        while (named := self._journal.current().compaction) is not None:
            try:
                return self._load(named)
            except DamageError:
                if self._is_named(named):
                    raise
        return None

    def _is_named(self, named: NamedCheckpoint) -> bool:
        """Whether it still counts: a writer replaces checkpoints and removes them."""
        return named in self._journal.current().checkpoints

    def _load(self, named: NamedCheckpoint) -> Checkpoint:
        reader = self._verified(named)
        return Checkpoint(named.number, named.last_sequence, reader.attributes, reader.arrays())

    def _verified(self, named: NamedCheckpoint) -> CheckpointReader:
        path = checkpoint_path(self._folder, named.number)
        reader = CheckpointReader(path, self._files)
        known = (reader.number, reader.last_sequence, reader.sha256, dict(reader.identity))
        if known != (named.number, named.last_sequence, named.sha256, self._journal.identity):
            raise DamageError(
                f"{path} is another checkpoint, or another store's, than the one that is named", path=path
            )
        return reader

    def commit(self, draft: CheckpointDraft) -> int:
        """Write a draft as a checkpoint, have `CURRENT` name it, and return its number."""
        with self._committing:
            current = self._journal.current()
            place, table = self._journal.place(draft.last_sequence), self._journal.table(draft.last_sequence)
            named = self._write(draft, place, current.log_identity, table)
            if current.newest is None or named.last_sequence >= current.newest.last_sequence:
                # When this fails all folders stay, for the next commit or open to remove: what could not be synced may
                # be on the disk all the same, and count after a crash.
                self._journal.commit(replace(current, newest=named, last=self._journal.last()))
            self.remove_unnamed()
            return named.number

    def draft(self, arrays: Arrays, last_sequence: int, attributes: Attributes) -> CheckpointDraft:
        """Return what is to become a checkpoint, once all of it can be kept. Raises RecordError, StoreError."""
        # The rows of a batch may yet be rolled back.
        self._journal.refuse_in_batch("committing a checkpoint")
        first, last = self._journal.current().compacted, self._journal.last()
        if type(last_sequence) is not int or not first <= last_sequence <= last:
            # Recovery could not resume among the compacted rows, which have given up their arrays.
            raise RecordError(
                f"last_sequence must be a sequence from {first}, the last that was compacted, to {last}, the last that "
                f"there is, not {last_sequence!r}"
            )
        if reserved := [name for name in arrays if name.startswith(INDEX)]:
            raise RecordError(f"no array may be called {reserved[0]!r}: {INDEX!r} begins the names of the store's own")
        return CheckpointDraft(check_arrays(arrays), last_sequence, to_json("attributes", attributes))

    def _write(self, draft: CheckpointDraft, place: LogPlace, log: bytes, table: np.ndarray | None) -> NamedCheckpoint:
        """Write a draft, with which rows are where in a log if that is known."""
        number = self._next(numbers(self._folder, unfinished=True))
        if table is not None:
            draft = replace(draft, arrays={**draft.arrays, index_name(log): table})
        sha256 = write_checkpoint(self._folder, number, draft, self._journal.identity)
        return NamedCheckpoint(number, draft.last_sequence, sha256, place)

    def _next(self, numbers: list[int]) -> int:
        number = 1 + max(numbers, default=0)
        if number >= 10**MOST_DIGITS:
            raise DamageError(f"{self._folder} has a log or a checkpoint of number {number - 1}", path=self._folder)
        return number

    def compact(self, draft: CheckpointDraft, newest: CheckpointDraft | None) -> None:
        """Commit a compaction checkpoint and a log in which its rows have no arrays; all is read back before."""
        with self._committing:
            with self._journal.switching():
                number = self._next(log_numbers(self._folder, unfinished=True))
                path = log_path(self._folder, number)
                header = to_json("identity", self._journal.identity).encode()
                rows_without = ((ROW, data) for data in self._journal.payloads(draft.last_sequence))
                try:
                    identity = create_log(path, header, rows_without)
                    drafts = [draft] if newest is None else [draft, newest]
                    places, rows = read_back(path, [each.last_sequence for each in drafts])
                    named = [
                        self._write(each, place, identity, rows.table(each.last_sequence))
                        for each, place in zip(drafts, places, strict=True)
                    ]
                    for one in named:
                        self._load(one)
                except BaseException:
                    remove_tree(path)
                    raise
                with reported(self._folder, "committing"):
                    write_current(self._folder, Current(number, identity, named[-1], named[0], self._journal.last()))
            self.remove_unnamed()

    def commit_later(self, draft: CheckpointDraft) -> None:
        """Do `commit` in a background thread; a newer one takes the place of one that still waits.

        Logs a failure and keeps it until `raise_failure`. While the interpreter ends nothing is written, and nothing
        said: the journal holds the rows.
        """
        with self._queue:
            self._waiting = draft
        with suppress(RuntimeError):  # it starts no job any more
            self._submitted = self._worker.submit(self._commit_newest)

    def _commit_newest(self) -> None:
        with self._queue:
            draft, self._waiting = self._waiting, None
        if draft is None:
            return
        try:
            self.commit(draft)
        except Exception as error:
            if isinstance(error, RuntimeError) and "interpreter shutdown" in str(error):
                return  # no thread starts a job any more, without which zarr writes nothing
            logger.exception("%s: a background commit failed; the journal still holds its rows", self._folder)
            self._failure = error

    def wait(self) -> None:
        """Return when no background commit runs or waits."""
        if self._submitted is not None:
            wait_for([self._submitted])

    def raise_failure(self) -> None:
        """Raise the failure of an earlier background commit, once, as a StoreError."""
        with self._queue:
            failure, self._failure = self._failure, None
        if isinstance(failure, StoreError):
            raise failure
        if failure is not None:
            raise StoreError(f"a background commit failed: {failure!r}") from failure

    def close(self) -> None:
        """Wait for the background commit and end its thread."""
        self._worker.shutdown()

    def remove_unnamed(self) -> None:
        """Remove what `CURRENT` does not name: what was replaced, and what a writer that died left."""
        try:
            with reported(self._folder, "removing checkpoints"):
                remove_unnamed(self._folder, self._journal.current())
        except StoreError as error:
            # The commit itself stands; the next one, or the next open, removes what is left.
            logger.warning("%s: what was replaced could not be removed: %s", self._folder, error)


def read_back(path: Path, last_sequences: Sequence[int]) -> tuple[list[LogPlace], Rows]:
    """Read a log that was just written; return for each of these rows a place, and which rows are where.

    All rows behind that row are behind the place. Raises DamageError where the log does not read back whole.
    """
    with LogReader(path) as log:
        rows, places = Rows(), [log.place] * len(last_sequences)
        for behind in rows.take(log):
            places = [
                behind if rows.sequences[-1] <= last_sequence else place
                for last_sequence, place in zip(last_sequences, places, strict=True)
            ]
        for damage in rows.damage.values():
            raise damage[0]
        if log.place.offset != path.stat().st_size:
            raise DamageError(
                f"{path} does not read back as it was just written: its disk cannot be trusted", path=path
            )
        return places, rows
