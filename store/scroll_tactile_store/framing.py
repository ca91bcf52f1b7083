"""The frames of a log: their bytes, where the next one belongs, whether they are as written (see FORMAT.md)."""

from __future__ import annotations

import struct
from typing import NamedTuple

from scroll_tactile_store.records import payload_digest

# As PNG's: not text, and changed by whatever changes the ends of lines.
MAGIC, VERSION = b"\x89ARLOG", 1
MARK = MAGIC + bytes([VERSION]) + b"\n"
IDENTITY_BYTES = 8

# mark, the log's identity, number, number of the batch's first frame, kind, size of the payload, checksum of the frame
# before, digest of the payload; behind them the checksum of all these.
FIELDS = struct.Struct("<8s8sQQII16s16s")
CHECKSUM_BYTES = 16
FRAME_BYTES = FIELDS.size + CHECKSUM_BYTES
NO_CHECKSUM = bytes(CHECKSUM_BYTES)  # of the frame before the first

HEADER, COMMIT = 0, 1

# A row's arrays, 256 MiB and their descriptions, and 64 Mi characters of attributes fit.
LARGEST_PAYLOAD = 2**28 + 2**27


class Frame(NamedTuple):
    """A frame as its own first bytes describe it, and the offset in the file at which it was found.

    `batch` is the number of the first frame of its batch, `size` that of its payload in bytes.
    """

    offset: int
    version: int
    identity: bytes
    number: int
    batch: int
    kind: int
    size: int
    previous: bytes
    digest: bytes
    checksum: bytes

    @property
    def end(self) -> int:
        """Where the next frame begins."""
        return self.offset + FRAME_BYTES + self.size


class LogPlace(NamedTuple):
    """Where a log's next frame belongs: its offset and number, its batch's first number, the checksum before it."""

    offset: int
    number: int
    batch: int
    previous: bytes

    @classmethod
    def behind(cls, frame: Frame) -> LogPlace:
        """Return the place of the frame behind this one, in a batch of its own where this one ends a batch."""
        number = frame.number + 1
        batch = number if frame.kind in (HEADER, COMMIT) else frame.batch
        return cls(frame.offset + FRAME_BYTES + frame.size, number, batch, frame.checksum)

    def holds(self, frame: Frame) -> bool:
        """Return whether the frame is the one that belongs here."""
        belongs = (frame.offset, frame.number, frame.batch, frame.previous) == self
        largest = 0 if frame.kind == COMMIT else LARGEST_PAYLOAD
        return belongs and frame.kind != HEADER and frame.size <= largest

    def is_before(self, frame: Frame) -> bool:
        """Return whether reading can go on with the frame, where none belongs here."""
        return frame.number > self.number or (frame.number == self.number and frame.offset > self.offset)

    def can_be_torn_before(self, frame: Frame) -> bool:
        """Return whether a power cut while the batch of this place was written can have left the frame."""
        if frame.number <= self.number:
            return (frame.offset, frame.number, frame.batch, frame.previous) == self
        return frame.batch == self.batch and frame.offset - self.offset >= FRAME_BYTES * (frame.number - self.number)


def pack_frame(identity: bytes, place: LogPlace, kind: int, payload: bytes) -> tuple[bytes, Frame]:
    """Return the bytes of the frame that belongs at a place of the log of this identity, and the frame."""
    offset, number, batch, previous = place
    digest = payload_digest(payload)
    fields = FIELDS.pack(MARK, identity, number, batch, kind, len(payload), previous, digest)
    checksum = payload_digest(fields)
    frame = Frame(offset, VERSION, identity, number, batch, kind, len(payload), previous, digest, checksum)
    return b"".join((fields, checksum, payload)), frame


def read_frame(data: bytes, offset: int) -> Frame | None:
    """Return the frame that `data`, found at `offset` of a file, begins with; None where its checksum fails.

    The payload is not looked at, and may be of any size. A later version keeps these bytes in the first frame.
    """
    if len(data) < FRAME_BYTES or not data.startswith(MAGIC):
        return None
    mark, identity, number, batch, kind, size, previous, digest = FIELDS.unpack_from(data)
    checksum = data[FIELDS.size : FRAME_BYTES]
    if payload_digest(data[: FIELDS.size]) != checksum or mark[-1:] != b"\n":
        return None
    return Frame(offset, mark[-2], identity, number, batch, kind, size, previous, digest, checksum)
