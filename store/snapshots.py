"""The generations of an open store: which is current, which others are kept, and how one is made."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from store.errors import DamageError, StoreError
from store.generations import folder_name, highest_number, remove_others, write_generation
from store.journal import Journal
from store.reading import read_generation, read_rows
from store.records import Generation, from_json
from store.reporting import reported
from store.rows import GenerationRow

__all__ = ["KEPT_GENERATIONS", "Snapshots"]

logger = logging.getLogger(__name__)

# The current one, and the one before it in case a disk error spoils the current: then only the
# journal's rows since then have to be gone through again. More would only cost space. A base is
# kept beside them, for the rows that it stands for have no arrays of their own any more.
KEPT_GENERATIONS = 2


class Snapshots:
    """The generations in folder `parent` that the journal names."""

    def __init__(self, parent: Path, journal: Journal) -> None:
        self._parent = parent
        self._journal = journal
        self._committing = threading.Lock()
        # Numbers of generations that failed to verify: they do not count as a fallback.
        self._spoilt: set[int] = set()

    def latest(self) -> Generation | None:
        """As `Store.latest`."""
        passed: set[int] = set()
        while True:
            row = next((row for row in self._journal.generations() if row.number not in passed), None)
            if row is None:
                return None
            passed.add(row.number)
            try:
                return self._load(row)
            except DamageError as damage:
                # A writer may have replaced and removed it while it was read: no damage.
                if row.number in {row.number for row in self._journal.generations()}:
                    self._spoilt.add(row.number)
                    logger.warning("%s; falling back to an older generation", damage)

    def base(self) -> Generation | None:
        """As `Store.base`."""
        while True:
            row = next((row for row in self._journal.generations() if row.base), None)
            if row is None:
                return None
            try:
                return self._load(row)
            except DamageError:
                if row.number in {row.number for row in self._journal.generations()}:
                    raise

    def _load(self, row: GenerationRow) -> Generation:
        attributes, content = row.verified(self._journal.path)
        folder = self._parent / folder_name(row.number)
        return Generation(row.number, row.upto, attributes, read_generation(folder, row.number, content))

    def read_rows(self, name: str, first: int, last: int, generation: int | None) -> np.ndarray:
        """As `Store.read_rows`."""
        while True:
            row = next((row for row in self._journal.generations() if generation in (None, row.number)), None)
            if row is None:
                wanted = "no generation" if generation is None else f"generation {generation} no longer"
                raise StoreError(f"{self._parent.parent} has {wanted}: look at the newest again, with latest()")
            folder = self._parent / folder_name(row.number)
            try:
                return read_rows(folder, row.number, row.verified(self._journal.path)[1], name, first, last)
            except DamageError:
                # A writer may have replaced and removed it while it was read: no damage.
                if row.number in {row.number for row in self._journal.generations()}:
                    raise

    def commit(
        self,
        arrays: Mapping[str, np.ndarray],
        upto: int,
        attributes: str,
        chunks: Mapping[str, int],
        *,
        base: bool = False,
    ) -> int:
        """Write checked arrays as a generation, make the journal name it, and return its number."""
        with self._committing:
            earlier = self._journal.generations()
            number = 1 + max([highest_number(self._parent), *(row.number for row in earlier)])
            content = write_generation(
                self._parent, number, upto, arrays, from_json(attributes), chunks, self._journal.identity
            )
            row = GenerationRow.of(number, upto, int(base), time.time(), attributes, content)
            kept = {row.number for row in self._kept(earlier, base=base)}
            # When this fails the folder stays, for the next commit or open to remove: what could not be
            # synced may be on the disk all the same, and name it after a crash.
            self._journal.make_current(row, forget={row.number for row in earlier} - kept)
            self._remove_unnamed()
            return number

    def _kept(self, earlier: list[GenerationRow], *, base: bool) -> list[GenerationRow]:
        """Those of the earlier generations, the newest first, that stay beside a new one."""
        sound = [row for row in earlier if row.sound and row.number not in self._spoilt]
        if base:
            # Only the newest: one older may need arrays, to take a row back, that go with this commit.
            return sound[:1]
        # Of a row that fails its checksum nobody knows whether it is that of the base.
        bases = [row for row in earlier if row.sound and row.base]
        return sound[: KEPT_GENERATIONS - 1] + bases[:1] + [row for row in earlier if not row.sound]

    def remove_unfinished(self) -> None:
        """Remove what a writer that died left behind: folders that the journal does not name."""
        with reported(self._parent, "removing unfinished generations"):
            remove_others(self._parent, [row.number for row in self._journal.generations()])

    def _remove_unnamed(self) -> None:
        try:
            self.remove_unfinished()
        except StoreError as error:
            # The commit itself stands; the next one, or the next open, removes what is left.
            logger.warning("%s: old generations could not be removed: %s", self._parent, error)
