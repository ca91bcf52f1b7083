"""A record as the payload of a frame, and back (FORMAT.md describes it); and which rows a log holds, and where."""

from __future__ import annotations

import math
import struct
from array import array
from bisect import bisect_left, bisect_right

import numpy as np

from scroll_tactile_store.exceptions import DamageError, RecordError
from scroll_tactile_store.framing import LARGEST_PAYLOAD, Frame, LogPlace
from scroll_tactile_store.log import Log, refuse
from scroll_tactile_store.records import LARGEST_NUMBER, Head, from_json, payload_digest, to_json

ROW = 2  # the kind of a frame that holds a record

# sequence, time, bytes of the arrays' payload, whether that follows; lengths of key, kind, label and attributes.
FIELDS = struct.Struct("<QdQBBIII")
DIGEST_BYTES = 16
HEAD_BYTES = FIELDS.size + DIGEST_BYTES
USUAL_HEAD = 512  # bytes that are read at once of a row's head


def encode_row(
    sequence: int, kind: str, label: str, key: bytes, time: float, attributes: str, payload: bytes | None, size: int
) -> bytes:
    """Return the bytes of a row: `attributes` as JSON, and of arrays that were given up their `size` alone.

    Raises RecordError for values that cannot be kept.
    """
    try:
        texts = (key, kind.encode(), label.encode(), attributes.encode())
        if not math.isfinite(time):
            raise ValueError("the time is no finite number of seconds since 1970")
        fields = FIELDS.pack(sequence, time, size, payload is not None, *map(len, texts))
        data = b"".join((fields, payload_digest(fields, *texts), *texts, payload or b""))
        if len(data) > LARGEST_PAYLOAD:
            raise ValueError(f"it has {len(data)} bytes, and at most {LARGEST_PAYLOAD} are kept")
    except (AttributeError, TypeError, ValueError, struct.error) as error:
        what = f"a row of kind {kind!r:.80}, label {label!r:.80}, key {key!r:.80} and time {time!r:.80}"
        raise RecordError(f"{what} cannot be kept: {error}") from error
    return data


def head_without_arrays(head: Head) -> bytes:
    """Return the bytes of a row that has given up its arrays."""
    text = to_json("attributes", head.attributes)
    return encode_row(head.sequence, head.kind, head.label, head.key, head.time, text, None, head.size)


def row_sequence(data: bytes) -> int:
    """Return the sequence of a row, of which these are the first HEAD_BYTES or more; raise ValueError for none."""
    sequence = int.from_bytes(data[:8], "little")
    if len(data) < HEAD_BYTES or not 1 <= sequence <= LARGEST_NUMBER:
        raise ValueError(f"a row of {len(data)} bytes has the sequence {sequence}")
    return sequence


def key_prefix(key: bytes) -> int:
    """Return the first eight bytes of a key as a number, by which a row is looked for; equal keys have equal ones."""
    return int.from_bytes(key[:8], "little")


def decode_head(data: bytes, whole: int) -> Head:
    """Return the head of a row of `whole` bytes, of which `data` has the head, verified by its own digest.

    Raises ValueError for what `encode_row` never made.
    """
    sequence = row_sequence(data)
    _, time, size, kept, *lengths = FIELDS.unpack_from(data)
    parts, end = [], HEAD_BYTES
    for length in lengths:
        parts.append(data[end : end + length])
        end += length
    if payload_digest(data[: FIELDS.size], *parts) != data[FIELDS.size : HEAD_BYTES] or end + kept * size != whole:
        raise ValueError("a row's head is not as it was written")
    key, kind, label, attributes = parts
    return Head(sequence, kind.decode(), label.decode(), key, time, from_json(attributes.decode()), size)


def decode_row(data: bytes) -> tuple[Head, bytes | None]:
    """Return a row's head and payload, None where it gave that up; raise ValueError for what was never made."""
    head = decode_head(data, len(data))
    _, _, size, kept, *_ = FIELDS.unpack_from(data)
    return head, data[len(data) - size :] if kept else None


def read_head(log: Log, offset: int, size: int) -> Head:
    """Return the head of the row in the frame at an offset. Raises DamageError, and ValueError for no row."""
    data = log.read(offset, size, first=USUAL_HEAD)
    row_sequence(data)
    needed = HEAD_BYTES + sum(FIELDS.unpack_from(data)[4:])
    return decode_head(data if needed <= len(data) else log.read(offset, size, first=needed), size)


class Rows:
    """Which rows a log holds, in order: of each its sequence, offset, size and the first bytes of its key.

    first: the number that a checkpoint has reached, of which the log may have lost rows. table: of those known already,
    as `table` gives it.
    """

    def __init__(self, first: int = 0, table: np.ndarray | None = None) -> None:
        self.sequences, self.offsets, self.sizes, self.keys = self.columns = tuple(array("Q") for _ in range(4))
        self.first = first
        for column, values in zip(self.columns, () if table is None else table, strict=False):
            column.frombytes(values.tobytes())

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def last(self) -> int:
        """The sequence of the last row that is known."""
        return max(self.first, self.sequences[-1]) if self.sequences else self.first

    def append(self, sequence: int, offset: int, size: int, key: bytes) -> None:
        """Add a row."""
        self.sequences.append(sequence)
        self.offsets.append(offset)
        self.sizes.append(size)
        self.keys.append(key_prefix(key))

    def catch_up(self, log: Log, last: int = 0) -> None:
        """Take in what was committed since; `last`: a row that the log has had. Raises DamageError."""
        for frames in log.scan(refuse):
            for frame in frames:
                if frame.kind == ROW:
                    self._take(log, frame)
        if self.last < last:
            what = f"{log.path} ends with row {self.last}, and had row {last}: its end is damaged or was cut off"
            raise DamageError(f"{what}: repair the store (repair_store)", path=log.path)

    def _take(self, log: Log, frame: Frame) -> None:
        data = log.read(frame.offset, frame.size, first=HEAD_BYTES + 8)
        try:
            sequence = row_sequence(data)
            if self.sequences and sequence <= self.sequences[-1]:
                raise ValueError(f"row {sequence} follows row {self.sequences[-1]}")
        except ValueError as error:
            what = f"{log.path} has a frame that is no row (byte {frame.offset}): {error}: repair the store"
            raise DamageError(f"{what} (repair_store)", path=log.path, offset=frame.offset) from error
        self.append(
            sequence, frame.offset, frame.size, data[HEAD_BYTES : HEAD_BYTES + min(8, FIELDS.unpack_from(data)[4])]
        )

    def cut(self, place: LogPlace) -> None:
        """Forget the rows behind a place, behind which nothing is left."""
        count = bisect_left(self.offsets, place.offset)
        for column in self.columns:
            del column[count:]

    def find(self, after: int) -> int:
        """Return the index of the first row behind `after`."""
        return bisect_right(self.sequences, after)

    def with_key(self, key: bytes) -> list[int]:
        """Return the sequences of the rows whose keys begin as this one does."""
        found = np.flatnonzero(np.frombuffer(self.keys, np.uint64) == key_prefix(key)).tolist()
        return [self.sequences[index] for index in found]

    def place(self, log: Log, last_sequence: int) -> LogPlace:
        """Return a place in the log that all rows behind `last_sequence` are behind: that of a batch."""
        index = self.find(last_sequence)
        if index == len(self):
            return log.place
        for offset in reversed(self.offsets[: index + 1]):
            frame = log.frame_at(offset)
            if frame is not None and frame.number == frame.batch:
                return LogPlace(frame.offset, frame.number, frame.batch, frame.previous)
        return log.first

    def table(self, last_sequence: int) -> np.ndarray:
        """Return those up to a sequence as an array: the columns, shape (4, rows)."""
        count = self.find(last_sequence)
        return np.stack([np.frombuffer(column, np.uint64)[:count] for column in self.columns])


def read_back(log: Log) -> Rows:
    """Return the rows of a log that was just written. Raises DamageError where it does not read back whole."""
    rows = Rows()
    rows.catch_up(log)
    if log.place.offset != log.size():
        raise DamageError(
            f"{log.path} does not read back as it was just written: its disk cannot be trusted", path=log.path
        )
    return rows
