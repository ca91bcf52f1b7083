"""A log: whole batches of frames read in order by one scan, single frames by where they are, and batches appended.

A batch is written once the one before it is durable. So behind a frame that does not verify there may be, after a power
cut, others of its own batch and nothing else; any other frame of the log there proves that a durable one was damaged.
"""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Self

from scroll_tactile_store.exceptions import FULL, DamageError, VersionError, reported
from scroll_tactile_store.files import dense_size, new_file, open_regular, replacing, sync_open
from scroll_tactile_store.framing import (
    COMMIT,
    FRAME_BYTES,
    HEADER,
    IDENTITY_BYTES,
    MARK,
    NO_CHECKSUM,
    VERSION,
    Frame,
    LogPlace,
    pack_frame,
    read_frame,
)
from scroll_tactile_store.records import payload_digest

logger = logging.getLogger(__name__)

# Is called with what is damaged and the frames before it in its batch, which verify. It raises, or the scan goes on
# behind the damage.
Damaged = Callable[[DamageError, list[Frame]], object]

NEWER = f"this release reads format {VERSION}: upgrade it; nothing was changed"
BEGIN = LogPlace(0, 0, 0, NO_CHECKSUM)
USUAL = 2**13  # bytes of a frame, which are read at once
PART = 2**18  # bytes of the file that are looked through at once
# What a writer is just writing and damage look alike the first time, and not the third.
ATTEMPTS = 3

# Zeros are written ahead: to write over them changes nothing but bytes, and fdatasync has no file system's journal to
# wait for. (Room that was only reserved costs as many bytes on the disk, and thrice the time.)
AHEAD = 2**20
LARGEST_STAGED = 2**22  # bytes that wait in memory for their commit
TOGETHER = 4096  # frames of a batch in a log that replaces another
NO_ROOM = FULL | {errno.EFBIG}


def refuse(damage: DamageError, _: list[Frame]) -> None:
    """Raise what is damaged: whoever uses a store goes on behind no damage."""
    raise damage


class Log:
    """An open log. To read it needs no lock and leaves every byte as it is; a writer may be at work.

    `header` is the payload of its first frame, the caller's; `identity` is what all its frames carry. `place` is where
    reading, or the one writer, goes on: behind the first frame, until something is scanned. One thread at a time may
    use it.

    write: for whoever holds the writer's lock. identity: of a log whose first frame may be damaged; then
    `header_damage` names that damage, and a scan begins with the first frame that can be found.

    Raises VersionError for a newer format, DamageError for what is no log, StoreError, and OSError when it is opened.
    """

    def __init__(self, path: Path, *, write: bool = False, identity: bytes | None = None) -> None:
        self.path, self.header = path, b""
        self.header_damage: DamageError | None = None
        self._proved: Frame | None = None
        self._staged, self._written = bytearray(), 0
        self._descriptor = open_regular(path, os.O_RDWR if write else os.O_RDONLY)
        try:
            self._read_header(identity)
            self._begin_batch()
        except BaseException:
            self.close()
            raise

    def _read_header(self, identity: bytes | None) -> None:
        self.place = BEGIN
        try:
            frame = read_frame(self.at(0, FRAME_BYTES), 0)
            if frame is not None and frame.version > VERSION:
                raise VersionError(f"{self.path} is written in format {frame.version}; {NEWER}")
            if frame is None or frame[3:6] != (0, 0, HEADER):
                raise self._damage("does not begin as a log, or its first frame is not as it was written", BEGIN)
            if identity not in (None, frame.identity):
                raise self._damage("is the log of another store, or of another time", BEGIN)
            self.identity = frame.identity
            self.header = self._payload(frame, b"")
            self.place = LogPlace.behind(frame)
        except DamageError as damage:
            if identity is None:
                raise
            self.header_damage, self.identity = damage, identity
        self.first, self._mark = self.place, MARK + self.identity

    def _damage(self, what: str, at: LogPlace | Frame) -> DamageError:
        return DamageError(f"{self.path} {what} (byte {at.offset})", path=self.path, offset=at.offset, frame=at.number)

    # Reading.

    def at(self, offset: int, size: int) -> bytes:
        """Return so many bytes of the log at an offset, staged ones, too; fewer where it ends."""
        begin = offset - self._written
        if 0 <= begin < len(self._staged):
            return bytes(self._staged[begin : begin + size])
        if (size := min(size, self.size() - offset)) <= 0 or offset < 0:
            return b""
        os.lseek(self._descriptor, offset, os.SEEK_SET)
        data = part = os.read(self._descriptor, size)
        while part and len(data) < size:
            part = os.read(self._descriptor, size - len(data))
            data += part
        return data

    def size(self) -> int:
        """Return the bytes of the file. Raises DamageError where they are holes, which no log has."""
        return dense_size(self._descriptor, self.path)

    def _is_ours(self, frame: Frame) -> bool:
        return frame.version == VERSION and frame.identity == self.identity

    def scan(self, damaged: Damaged, durable: LogPlace | None = None) -> Iterator[list[Frame]]:
        """Yield the frames of each batch that was committed behind `place`, verified and in order; move that behind it.

        A batch without its commit frame is not there yet. durable: a place that was noted elsewhere; what is before it
        is no torn batch.
        """
        if self.place == BEGIN:
            self._resume(BEGIN)
        while True:
            for _ in range(ATTEMPTS):
                frames, torn = self._batch()
                if torn is None or (proof := self._proof(torn, durable)) is None:
                    break
            if torn is None:
                self.place = LogPlace.behind(frames.pop())
                if frames:
                    yield frames
            elif proof is None:
                return
            else:
                what = f"is damaged: frame {torn.number} is not as it was written, and was durable, as {proof} proves"
                damaged(self._damage(f"{what}: repair the store (repair_store)", torn), frames)
                if not self._resume(torn):
                    return

    def _batch(self) -> tuple[list[Frame], LogPlace | None]:
        """Return the frames from the place on that verify, up to a commit frame, or the place where one does not."""
        place, size, frames = self.place, self.size(), list[Frame]()
        while True:
            data = self.at(place.offset, USUAL)
            frame = read_frame(data, place.offset)
            if frame is None or not self._is_ours(frame) or not place.holds(frame) or frame.end > size:
                return frames, place
            try:
                self._payload(frame, data[FRAME_BYTES:])
            except DamageError:
                return frames, place
            frames.append(frame)
            if frame.kind == COMMIT:
                return frames, None
            place = LogPlace.behind(frame)

    def _payload(self, frame: Frame, begin: bytes) -> bytes:
        """Return the payload of a frame, verified; begin: what was read of it, and maybe of what is behind it."""
        payload = begin[: frame.size]
        if len(payload) < frame.size:
            payload += self.at(frame.offset + FRAME_BYTES + len(payload), frame.size - len(payload))
        if len(payload) != frame.size or payload_digest(payload) != frame.digest:
            raise self._damage(f"is damaged: the payload of frame {frame.number} is not as it was written", frame)
        return payload

    def _proof(self, torn: LogPlace, durable: LogPlace | None) -> str | None:
        """Return what no power cut can have left behind a torn frame, in words; None where there is nothing."""
        if durable is not None and torn.offset < durable.offset:
            return "the place of the newest checkpoint"
        known = self._proved  # or each of many damaged frames would be a search of all that is behind it
        if known is None or known.offset <= torn.offset or torn.can_be_torn_before(known):
            behind = self._frames_behind(torn.offset)
            self._proved = known = next((frame for frame in behind if not torn.can_be_torn_before(frame)), None)
        return None if known is None else f"frame {known.number} at byte {known.offset}"

    def _resume(self, torn: LogPlace) -> bool:
        """Go on behind a damaged frame, at the next that can be found, if any."""
        found = next(filter(torn.is_before, self._frames_behind(torn.offset)), None)
        if found is not None:
            self.place = LogPlace(found.offset, found.number, found.batch, found.previous)
        return found is not None

    def _frames_behind(self, offset: int) -> Iterator[Frame]:
        """Yield the frames whose first bytes verify, found by what they begin with, wherever they are."""
        for start in range(offset, self.size(), PART):
            data = self.at(start, PART + FRAME_BYTES - 1)
            found = data.find(self._mark)
            while 0 <= found < PART:
                if (frame := read_frame(data[found : found + FRAME_BYTES], start + found)) is not None:
                    yield frame
                found = data.find(self._mark, found + 1)

    def has_place(self, place: LogPlace) -> bool:
        """Return whether a place is behind the first frame or a batch of this log."""
        if place == self.first:
            return True
        offset = place.offset - FRAME_BYTES
        frame = self.frame_at(offset) if 0 < offset < 2**63 else None
        return frame is not None and frame.kind == COMMIT and LogPlace.behind(frame) == place

    def read(self, offset: int, size: int, *, first: int | None = None) -> bytes:
        """Return the payload, of `size` bytes, of the frame at an offset, verified. Raises DamageError.

        first: so many of its first bytes, or all; only that the frame is there is verified.
        """
        wanted = size if first is None else min(first, size)
        data = self.at(offset, FRAME_BYTES + wanted)
        frame = read_frame(data, offset)
        if frame is None or not self._is_ours(frame) or frame.size != size or len(data) < FRAME_BYTES + wanted:
            raise self._damage(f"holds no frame with a payload of {size} bytes there", BEGIN._replace(offset=offset))
        return self._payload(frame, data[FRAME_BYTES:]) if first is None else data[FRAME_BYTES:]

    def frame_at(self, offset: int) -> Frame | None:
        """Return the frame at an offset, whose payload is not looked at; None where there is none of this log."""
        frame = read_frame(self.at(offset, FRAME_BYTES), offset)
        return frame if frame is not None and self._is_ours(frame) else None

    # Writing, by whoever holds the writer's lock.

    def prepare(self) -> None:
        """Make ready to append at `place`, behind all that was committed; cut off what a kill or a power cut left."""
        self._begin_batch()
        self._allocated = self.size()
        parts = (self.at(at, PART) for at in range(self.place.offset, self._allocated, PART))
        self._settled = not any(part.count(0) < len(part) for part in parts)
        self._settle()
        # The last commit may be in the system's memory alone, if its writer was killed before its sync.
        sync_open(self._descriptor)

    def _begin_batch(self) -> None:
        """Nothing is staged, and what is written next belongs behind the last commit."""
        self._staged = bytearray()
        self._written = self.place.offset
        self._next = self.place

    def _settle(self) -> None:
        """Cut off what is behind the last commit, where something may be; raises OSError."""
        if not self._settled:
            os.ftruncate(self._descriptor, self.place.offset)
            self._allocated = self.place.offset
            sync_open(self._descriptor)
            self._settled = True

    def stage(self, kind: int, payload: bytes) -> Frame:
        """Add a frame to the batch that the next `commit` makes durable; `kind` is 2 or more, the caller's.

        Raises OSError; then, and when `commit` fails, `rollback` is the caller's to call.
        """
        if self._next == self.place:
            self._settle()  # a batch that could not be taken back
        frame = self._pack(kind, payload)
        if len(self._staged) > LARGEST_STAGED:
            self._write()
        return frame

    def _pack(self, kind: int, payload: bytes) -> Frame:
        data, frame = pack_frame(self.identity, self._next, kind, payload)
        self._staged += data
        self._next = LogPlace.behind(frame)
        return frame

    def _write(self) -> None:
        """Write what is staged, with one call, and zeros behind it where the file ends."""
        begin, end = self._written, self._written + len(self._staged)
        self._settled = False  # until it is committed
        zeros = bytes(-end % AHEAD) if end > self._allocated else b""
        try:
            self._put(begin, self._staged + zeros if zeros else self._staged)
        except OSError as error:
            if not zeros or error.errno not in NO_ROOM:
                raise
            zeros = b""
            self._put(begin, self._staged)
        self._allocated = max(self._allocated, end + len(zeros))
        self._written, self._staged = end, bytearray()

    def _put(self, offset: int, data: bytearray) -> None:
        """Write all bytes at an offset, in one call unless the system takes fewer."""
        os.lseek(self._descriptor, offset, os.SEEK_SET)
        done = os.write(self._descriptor, data)
        while done < len(data):
            done += os.write(self._descriptor, data[done:])

    def commit(self, *, seal: bool = False) -> None:
        """Make the staged frames durable, all of them or none; without any it does nothing.

        seal: also where there are none. Such a batch proves damage of the one before it; what befalls the last batch
        cannot be told from what a power cut leaves. Raises OSError.
        """
        if self._next == self.place and not seal:
            return
        self._pack(COMMIT, b"")
        self._write()
        sync_open(self._descriptor, data_only=True)
        self.place, self._settled = self._next, True

    def rollback(self) -> None:
        """Forget the staged frames.

        Where some may be on the disk they are cut off. If that fails, a warning says so, and nothing can be staged
        before it succeeds.
        """
        self._begin_batch()
        try:
            self._settle()
        except OSError as error:
            # The caller has to learn what ended the batch; the next one settles it, or is refused.
            logger.warning("%s: a batch could not be taken back yet: %s", self.path, error)

    def close(self, *, trim: bool = False) -> None:
        """Close the file; a second call does nothing. trim: give back the room ahead, of a log that was written."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            with suppress(OSError):
                if trim:
                    os.ftruncate(descriptor, self.place.offset)
            os.close(descriptor)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def create_log(path: Path, header: bytes, frames: Iterable[tuple[int, bytes]] = ()) -> bytes:
    """Put a new log, with these kinds and payloads, at `path`, whole and durable or not at all; return its identity.

    header: of the caller, for good. A log that is there is replaced; readers keep it open as it was. Raises
    StoreFullError, ReadOnlyError or another StoreError.
    """
    draft = path.with_name(f"{path.name}.new")
    identity = os.urandom(IDENTITY_BYTES)
    with reported(path, "making a log"), replacing(path, draft):
        with new_file(draft) as file:
            file.write(pack_frame(identity, BEGIN, HEADER, header)[0])
        with Log(draft, write=True) as log:
            log.prepare()
            count = 0
            for count, (kind, payload) in enumerate(frames, 1):
                log.stage(kind, payload)
                if count % TOGETHER == 0:
                    log.commit()
            log.commit()
            if count:
                log.commit(seal=True)  # all of them were durable, and may be all that the log ever holds
            log.close(trim=True)
    return identity
