"""The generations of an open store: which one is current, which others stay, and how a new one is committed."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from pathlib import Path

from store.exceptions import DamageError, RecordError, StoreError, reported
from store.files import is_real_folder, remove_tree
from store.groups import PARTIAL, Draft, GroupReader, folder_name, require_known, write_group
from store.journal import Journal
from store.records import Generation, GenerationRow
from store.schema import GENERATIONS

__all__ = ["Generations", "highest_number", "numbers", "remove_others"]

logger = logging.getLogger(__name__)

MOST_DIGITS = 18  # of the numbers that SQLite keeps, 2^63 is the end of those with 19


class Generations:
    """The generations of the store in `folder` that the journal names. `Store` has methods of the same names."""

    def __init__(self, folder: Path, journal: Journal) -> None:
        self._folder = folder
        self._parent = folder / GENERATIONS
        self._journal = journal
        self._committing = threading.Lock()
        self._worker = ThreadPoolExecutor(1, f"store commit {folder.name}")
        self._queue = threading.Lock()
        self._waiting: Draft | None = None
        self._submitted: Future[None] | None = None
        self._failure: Exception | None = None
        for row in journal.generations():
            if not row.sound:
                # It may be the base's: nothing else would show that until a generation behind it is damaged, too.
                logger.warning(
                    "%s: the row of generation %s fails its checksum and does not count: check_store tells what it is "
                    "needed for",
                    folder,
                    row.number,
                )

    def latest(self, only: Collection[str] | None = None) -> Generation | None:
        """Return the newest generation that verifies, None when there is none; only: the arrays to read, or all."""
        passed: set[int] = set()
        while (row := self._find(lambda row: row.number not in passed)) is not None:
            passed.add(row.number)
            try:
                return self._load(row, only)
            except DamageError as damage:
                if row.number in self.named():
                    logger.warning("%s; replaying the journal behind an older generation, or all of it", damage)
        return None

    def base(self) -> Generation | None:
        """Return the generation that stands for the compacted rows, None when there are none."""
        while (row := self._find(lambda row: bool(row.base))) is not None:
            try:
                return self._load(row)
            except DamageError:
                if row.number in self.named():
                    raise
        return None

    def _find(self, wanted: Callable[[GenerationRow], bool]) -> GenerationRow | None:
        return next((row for row in self._journal.generations() if wanted(row)), None)

    def named(self) -> set[int]:
        """Return the numbers of the generations that the journal names just now: a writer replaces and removes them."""
        return {row.number for row in self._journal.generations()}

    def _load(self, row: GenerationRow, only: Collection[str] | None = None) -> Generation:
        attributes, content = row.verified(self._journal.path)
        folder = self._parent / folder_name(row.number)
        if only is None:
            arrays = GroupReader(folder, row.number, content).arrays()
        elif names := sorted(set(only).intersection(content["arrays"])):
            arrays = GroupReader(folder, row.number, content).arrays(names)
        else:
            require_known(folder, content["format"])
            arrays = {}
        return Generation(row.number, row.upto, attributes, arrays)

    def commit(self, draft: Draft, *, base: bool = False) -> int:
        """Write a draft as a generation, make the journal name it, and return its number."""
        with self._committing:
            earlier = self._journal.generations()
            number = 1 + max([highest_number(self._parent), *(row.number for row in earlier)])
            if number >= 10**MOST_DIGITS:
                raise DamageError(f"{self._folder} has a generation of number {number - 1}", path=self._parent)
            content = write_group(self._parent, number, draft, self._journal.identity)
            row = GenerationRow.of(number, draft.upto, int(base), time.time(), draft.attributes, content)
            kept = {row.number for row in self._kept(earlier, draft, base=base)}
            # When this fails the folder stays, for the next commit or open to remove: what could not be
            # synced may be on the disk all the same, and name it after a crash.
            self._journal.make_current(row, forget={row.number for row in earlier} - kept)
            self.remove_unnamed()
            return number

    @staticmethod
    def _kept(earlier: list[GenerationRow], draft: Draft, *, base: bool) -> list[GenerationRow]:
        """Return which of the earlier generations, the newest first, stay beside a new one."""
        if base:
            # `compact` has just read the newest. Recovery from an older one would need arrays that go with this commit.
            return earlier[:1]
        # Not the one before, as the journal has its rows; but the rows of a base have no arrays of their own any more,
        # and nobody knows whether a row that fails its checksum is that of a base.
        sound = [row for row in earlier if row.sound]
        current = [row for row in sound[:1] if row.upto > draft.upto]
        return [*current, *[row for row in sound if row.base][:1], *(row for row in earlier if not row.sound)]

    def compact(self, draft: Draft) -> None:
        """Commit a base; raise DamageError or RecordError where no sound generation with all rows is beside it."""
        newest, named = self.latest(), self._journal.newest()
        if named is not None and (newest is None or newest.number != named):
            raise DamageError(
                f"{self._folder} cannot be compacted: generation {named}, which has to be whole beside the base, could "
                "not be read back; nothing was given up. Commit another, and compact again",
                path=self._parent / folder_name(named),
            )
        if newest is None or newest.upto != self._journal.last():
            there = "there is none" if newest is None else f"the newest has those up to {newest.upto}"
            raise RecordError(
                f"{self._folder} can be compacted only beside a generation with all {self._journal.last()} records; "
                f"{there}: commit one first"
            )
        self.commit(draft, base=True)
        try:
            self._journal.shrink()
        except StoreError as error:
            logger.warning("%s: the space was not given back yet: %s", self._folder, error)

    def commit_later(self, draft: Draft) -> None:
        """Do `commit` in a background thread; a newer one takes the place of one that still waits.

        Logs a failure and keeps it until `raise_failure`.
        """
        with self._queue:
            self._waiting = draft
        try:
            self._submitted = self._worker.submit(self._commit_newest)
        except RuntimeError:  # the interpreter is shutting down, and starts no job any more
            self._commit_newest()

    def _commit_newest(self) -> None:
        with self._queue:
            draft, self._waiting = self._waiting, None
        if draft is None:
            return
        try:
            self.commit(draft)
        except Exception as error:
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
        """Remove the folders that the journal does not name: what was replaced, and what a writer that died left."""
        try:
            with reported(self._parent, "removing generations"):
                remove_others(self._parent, self.named())
        except StoreError as error:
            # The commit itself stands; the next one, or the next open, removes what is left.
            logger.warning("%s: old generations could not be removed: %s", self._parent, error)


def numbers(parent: Path, *, unfinished: bool = False) -> list[int]:
    """Return the numbers of the generations' folders in `parent`, ascending; finished ones unless told otherwise."""
    if not is_real_folder(parent):
        return []
    names = (entry.name for entry in parent.iterdir())
    stems = {name.removesuffix(PARTIAL) if unfinished else name for name in names}
    return sorted(int(stem) for stem in stems if is_number(stem))


def is_number(stem: str) -> bool:
    """Return whether a folder's name is a generation's number, and one that leaves room for those after it."""
    return stem.isascii() and stem.isdigit() and len(stem) <= MOST_DIGITS


def highest_number(parent: Path) -> int:
    """Return the highest number of a generation's folder in `parent`, finished or not; 0 for none."""
    return max(numbers(parent, unfinished=True), default=0)


def remove_others(parent: Path, kept: Collection[int]) -> None:
    """Remove every generation's folder, finished or not, that is not numbered in `kept`.

    What does not carry a generation's name is left alone; what cannot be removed stays for the next open.
    """
    if not is_real_folder(parent):
        return
    names = {folder_name(number) for number in kept}
    for entry in sorted(parent.iterdir()):
        stem = entry.name.removesuffix(PARTIAL)
        if entry.name not in names and is_number(stem):
            remove_tree(entry)
            logger.debug("removed %s", entry)
