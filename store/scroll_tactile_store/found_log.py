"""A log as it is found, damaged or whole: each of its rows, and what is wrong with it."""

from __future__ import annotations

import enum
from collections.abc import Callable
from pathlib import Path

from scroll_tactile_store.archive import Files
from scroll_tactile_store.encoding import decode_payload
from scroll_tactile_store.exceptions import DamageError, VersionError
from scroll_tactile_store.framing import FRAME_BYTES, read_frame
from scroll_tactile_store.layout import NamedCheckpoint
from scroll_tactile_store.log import LogPlace, LogReader
from scroll_tactile_store.log_file import find_identity
from scroll_tactile_store.records import JSON, Head, from_json
from scroll_tactile_store.row_encoding import ROW, decode_head, decode_row, row_sequence
from scroll_tactile_store.rows import Rows, head_bytes

__all__ = ["Fault", "FoundLog", "Progress"]

# Called with what is being done, how many of it are done, and how many there are.
Progress = Callable[[str, int, int], object]
REPORT_EVERY = 256  # rows


class Fault(enum.Enum):
    """A fault of a row; its value: the words for one row, and for several."""

    MISSING = ("is missing", "are missing")
    DAMAGED = ("fails its checksum", "fail their checksums")
    NO_ARRAYS = ("has lost its arrays", "have lost their arrays")
    DAMAGED_ARRAYS = ("has arrays that fail their checksum", "have arrays that fail their checksums")
    FOREIGN_ARRAYS = ("has arrays that were never written so", "have arrays that were never written so")

    def describe(self, first: int, last: int) -> str:
        """Return in words that rows `first` to `last` have this fault."""
        return f"row {first} {self.value[0]}" if first == last else f"rows {first} to {last} {self.value[1]}"


class FoundLog:
    """A log as it was found: the sequences of its rows, each with what is wrong with it, and other damage.

    path: the log, or what an interrupted repair left of it. identity: the store's, None where that is lost.
    compacted: the last row without arrays. damage: what is wrong with it but for rows. durable: as of `LogReader`.
    """

    def __init__(
        self, files: Files, path: Path, identity: bytes | None, progress: Progress, durable: LogPlace | None = None
    ) -> None:
        self.path, self.damage = path, list[str]()
        self.identity: dict[str, JSON] | None = None
        self.rows: list[tuple[int, Fault | None]] = []
        self.torn, self.without_arrays = set[int](), set[int]()
        self.compacted = 0
        self._offsets: dict[int, tuple[int, int]] = {}
        self._reader: LogReader | None = None
        try:
            known = find_identity(files.open_log(path)) if identity is None else identity
            self._reader = files.read_log(path, identity=known)
            self._reader.durable = durable
        except FileNotFoundError:
            self.damage.append(f"{path} is gone")
            return
        except DamageError as error:
            self.damage.append(str(error))
            return
        if identity is not None and self._reader.identity != identity:
            self.damage.append(f"{path} is the log of another store, or of another time: nothing of it was read")
            self._reader.close()
            self._reader = None
            return
        try:
            self._read(self._reader, progress)
        except DamageError as error:  # nothing more of the file can be read
            self.damage.append(str(error))
        except BaseException:
            self.close()
            raise

    def _read(self, log: LogReader, progress: Progress) -> None:
        if log.header_damage is not None:
            self.damage.append(str(log.header_damage))
        else:
            try:
                self.identity = from_json(log.header.decode())
            except ValueError as error:
                self.damage.append(f"the identity in {self.path} was never written so: {error}")
        rows = Rows()
        for done, _ in enumerate(rows.take(log)):
            if done % REPORT_EVERY == 0:
                progress("batches", done, done)
        for index in range(len(rows) + 1):
            for damage in rows.damage.get(index, ()):
                self._note_damage(log, damage)
            if index < len(rows):
                if index % REPORT_EVERY == 0:
                    progress("rows", index, len(rows))
                self._note_row(log, rows.sequences[index], rows.offsets[index], rows.sizes[index])

    def _note_damage(self, log: LogReader, damage: DamageError) -> None:
        """Note a damaged frame: as a row with a fault where its first bytes still say which."""
        before = self.rows[-1][0] if self.rows else 0
        try:
            offset = -1 if damage.offset is None else damage.offset
            frame = read_frame(log.bytes_at(offset, FRAME_BYTES), offset) if offset >= 0 else None
            if frame is not None and frame.identity == log.identity and frame.kind == ROW:
                data = head_bytes(log, offset, frame.size)
                sequence = row_sequence(data)
                if sequence > before:
                    decode_head(data, frame.size)
                    self._offsets[sequence] = offset, frame.size
                    self.rows.append((sequence, Fault.DAMAGED_ARRAYS))
                    return
        except ValueError:
            pass
        self.damage.append(str(damage))
        is_commit = log.durable is not None and log.durable[:2] == (offset + FRAME_BYTES, (damage.frame or 0) + 1)
        if not is_commit:  # which is no row
            self.torn.add(before)

    def _note_row(self, log: LogReader, sequence: int, offset: int, size: int) -> None:
        if self.rows and sequence <= self.rows[-1][0]:
            self.damage.append(f"row {sequence} follows row {self.rows[-1][0]} in {self.path}")
            return
        fault = None
        try:
            row = decode_row(log.read(offset, size)[1])
            if row.head.sequence != sequence:
                fault = Fault.DAMAGED
            elif row.payload is None:
                self.without_arrays.add(sequence)
                self.compacted = sequence
            elif not _is_readable(row.payload):
                fault = Fault.FOREIGN_ARRAYS
        except (DamageError, ValueError):
            fault = Fault.DAMAGED
        self._offsets[sequence] = offset, size
        self.rows.append((sequence, fault))

    @property
    def last(self) -> int:
        """The sequence of its last row, 0 without any."""
        return self.rows[-1][0] if self.rows else 0

    @property
    def is_read(self) -> bool:
        """Whether anything of it was read."""
        return self._reader is not None

    def has_place(self, named: NamedCheckpoint) -> bool:
        """Whether a checkpoint's place is in the log, and no row that it does not contain is before it."""
        assert self._reader is not None
        if any(at < named.place.offset for row, (at, _) in self._offsets.items() if row > named.last_sequence):
            return False
        return self._reader.has_place(named.place)

    def data(self, sequence: int) -> bytes:
        """Return the bytes of a row, verified once more. Raises DamageError."""
        assert self._reader is not None
        return self._reader.read(*self._offsets[sequence])[1]

    def head(self, sequence: int) -> Head:
        """Return the head of a row. Raises DamageError where that does not verify."""
        assert self._reader is not None
        offset, size = self._offsets[sequence]
        try:
            return decode_head(head_bytes(self._reader, offset, size), size)
        except ValueError as error:
            what = f"the head of row {sequence} is not as it was written ({error})"
            raise DamageError(f"{what} in {self.path}", path=self.path, sequence=sequence) from error

    def close(self) -> None:
        """Close the file."""
        if self._reader is not None:
            self._reader.close()


def _is_readable(payload: bytes) -> bool:
    """Whether a payload is what `encode_payload` makes: anyone can make its digest; one of a newer release counts."""
    try:
        decode_payload(payload)
    except VersionError:
        return True
    except ValueError:
        return False
    return True
