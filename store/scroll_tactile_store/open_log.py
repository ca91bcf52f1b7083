"""The log that `CURRENT` names, opened to read or to write, and which rows are in it."""

from __future__ import annotations

import logging
from bisect import bisect_right

import numpy as np

from scroll_tactile_store.archive import Files
from scroll_tactile_store.checkpoint_files import CheckpointReader, index_name
from scroll_tactile_store.encoding import decode_payload
from scroll_tactile_store.exceptions import CompactedError, DamageError, StoreError
from scroll_tactile_store.files import sync_folder
from scroll_tactile_store.layout import Current, checkpoint_path, log_path
from scroll_tactile_store.log import LogPlace, LogReader
from scroll_tactile_store.log_writer import LogWriter
from scroll_tactile_store.records import JSON, Head, Record, from_json
from scroll_tactile_store.row_encoding import decode_head, decode_row
from scroll_tactile_store.rows import Rows, head_bytes

__all__ = ["OpenLog"]

logger = logging.getLogger(__name__)

MOST_PLACES = 4096


class OpenLog:
    """The log that `CURRENT` names, opened, and what is known of its rows.

    first: the last row before those that are known; read_all: whether there are none before these. places: rows, and
    where in the log all behind them follow.
    """

    def __init__(self, files: Files, current: Current, *, write: bool) -> None:
        self._files, self.current, self.path = files, current, log_path(files.folder, current.log)
        self.rows, self.first, self._warned = Rows(), 0, 0
        named = current.newest
        self.log = self._reader(None if named is None else named.place, write=write)
        try:
            if self.log.identity != current.log_identity:
                raise DamageError(f"{self.path} is the log of another store, or of another time", path=self.path)
            self.identity = self._read_identity()
            if named is not None and self.log.place == named.place:
                self.first = named.last_sequence
            self.read_all = self.first == 0
            self.places = [(self.first, self.log.place)]
            self.catch_up()
            self._note_lost_end()
            if write:
                self._begin_writing()
        except BaseException:
            self.log.close()
            raise

    def _reader(self, place: LogPlace | None, *, write: bool) -> LogReader:
        """Return the log from a place on; where that is not in it a reader begins at the beginning."""
        try:
            return self._files.read_log(self.path, place=place)
        except DamageError as damage:
            if place is None:
                raise
            if write:
                raise DamageError(f"{damage}: repair the store (repair_store)", path=self.path) from damage
            logger.warning("%s; reading all of it", damage)
            return self._files.read_log(self.path)

    def _read_identity(self) -> dict[str, JSON]:
        try:
            return from_json(self.log.header.decode())
        except ValueError as error:
            raise DamageError(f"the identity in {self.path} was never written so: {error}", path=self.path) from error

    def _begin_writing(self) -> None:
        for damage in self.rows.damage.values():
            raise DamageError(
                f"{damage[0]}: repair the store (repair_store) before anything is appended behind it", path=self.path
            )
        self.log.close()
        self.log = LogWriter(self.path, place=self.log.place)
        # `CURRENT` may name this log in the system's memory alone: a power cut would take what follows.
        sync_folder(self.path.parent)

    def catch_up(self) -> None:
        """Take in what was committed since."""
        for behind in self.rows.take(self.log):
            self.note_place(behind)

    def _note_lost_end(self) -> None:
        """Take rows that `CURRENT` knows of, and that are no longer there, as damage behind the last one."""
        if max(self.last_row, self.current.compacted) < self.current.last:
            what = f"{self.path} ends with row {self.last_row}, and had row {self.current.last}: its end is damaged or "
            self.rows.damage.setdefault(len(self.rows), []).append(DamageError(f"{what}was cut off", path=self.path))

    def note_place(self, place: LogPlace) -> None:
        """Note the place behind all rows that are known."""
        self.places.append((self.last_row, place))
        if len(self.places) > MOST_PLACES:
            del self.places[1:-1:2]

    @property
    def last_row(self) -> int:
        """The sequence of the last row that is known."""
        return self.rows.sequences[-1] if self.rows.sequences else self.first

    @property
    def last(self) -> int:
        """The last row, or the last that a checkpoint contains or `CURRENT` names, if later."""
        # These count only when rows were lost: then their numbers must not be given out again.
        return max([self.last_row, self.current.last, *(named.last_sequence for named in self.current.checkpoints)])

    def find(self, after: int) -> int:
        """Return the index of the first row behind `after`, once all rows from there on are known."""
        if after < self.first and not self.read_all:
            self._read_before()
        return bisect_right(self.rows.sequences, after)

    def _read_before(self) -> None:
        until = self.places[0][1].offset
        earlier = self._indexed(until)
        if earlier is None:
            earlier = Rows()
            for _ in earlier.take(self.log.reader_of_heads(), until):
                pass
        earlier.extend(self.rows)
        self.rows, self.read_all = earlier, True

    def _indexed(self, until: int) -> Rows | None:
        """Return the rows before an offset as the newest checkpoint has them; None where it has none of this log."""
        named, name = self.current.newest, index_name(self.current.log_identity)
        try:
            if named is not None and self.log.has_place(named.place):
                reader = CheckpointReader(checkpoint_path(self._files.folder, named.number), self._files)
                if reader.sha256 == named.sha256 and (found := reader.arrays([name])):
                    return Rows.of_table(found[name], until)
        except (StoreError, ValueError) as error:
            logger.warning("%s: rows are looked for in the log itself: %s", self.path, error)
        return None

    def table(self, last_sequence: int) -> np.ndarray | None:
        """Return which rows up to a sequence are where; None where any is damaged."""
        self.find(0)
        return None if self.rows.damage else self.rows.table(last_sequence)

    def warn_of_damage(self) -> None:
        """Log a warning, once, for all that is damaged among the rows that are known."""
        for damage in () if self._warned == len(self.rows.damage) else self.rows.damage.values():
            logger.warning(
                "%s; what was there is passed over where rows of one kind, name or key are asked for", damage[0]
            )
        self._warned = len(self.rows.damage)

    def data(self, index: int) -> bytes:
        """Return the bytes of a row, verified. Raises DamageError."""
        try:
            return self.log.read(self.rows.offsets[index], self.rows.sizes[index])[1]
        except DamageError as error:
            raise self._not_as_written(index, error) from error

    def row(self, index: int, *, arrays: bool) -> Head:
        """Return a row, verified; arrays: as a record. Raises DamageError, and CompactedError for compacted arrays."""
        sequence, size = self.rows.sequences[index], self.rows.sizes[index]
        try:
            if arrays:
                head, payload = decode_row(self.log.read(self.rows.offsets[index], size)[1])
            else:
                self.log.frame(self.rows.offsets[index], size)
                head, payload = decode_head(head_bytes(self.log, self.rows.offsets[index], size), size), None
            if head.sequence != sequence:
                raise ValueError(f"it has the number {head.sequence}")
            if not arrays:
                return head
            if payload is None and sequence <= self.current.compacted:
                raise self.given_up(sequence)
            if payload is None:
                raise ValueError("its arrays are missing")
            return Record(**vars(head), arrays=decode_payload(payload))
        except (DamageError, ValueError) as error:
            raise self._not_as_written(index, error) from error

    def require_no_gap(self, after: int, through: int, index: int) -> None:
        """Raise DamageError where rows behind `after` are missing, up to `through`, before that of an index."""
        why = self.rows.damage.get(index)
        # Of compacted ones a repair may have left some out.
        first = 1 + (after if why is not None else max(after, self.current.compacted))
        if first <= through:
            missing = f"row {through} is missing" if first == through else f"rows {first} to {through} are missing"
            raise self._damage(f"{missing}{'' if why is None else f' ({why[0]})'} from", through)

    def given_up(self, sequence: int) -> CompactedError:
        """Return the error for a row whose arrays a compaction checkpoint stands for."""
        return CompactedError(
            f"records 1 to {self.current.compacted} of {self._files.folder} gave up their arrays when it was compacted "
            f"(row {sequence}, too): begin with compaction(), and continue behind its last_sequence"
        )

    def _not_as_written(self, index: int, error: Exception) -> DamageError:
        sequence = self.rows.sequences[index]
        return self._damage(f"row {sequence} is not as it was written ({error}) in", sequence)

    def _damage(self, what: str, sequence: int) -> DamageError:
        named = next((named for named in self.current.checkpoints if named.last_sequence >= sequence), None)
        still = "no checkpoint contains it"
        if named is not None:
            still = f"checkpoint {named.number} (up to row {named.last_sequence}) still contains it"
        return DamageError(
            f"{what} {self.path}; {still}; records(after={sequence}) continues behind it",
            path=self.path,
            sequence=sequence,
        )
