"""The log written: batches appended with one write and one sync each, and a new log put in the place of an old one."""

from __future__ import annotations

import errno
import logging
import os
import threading
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from shutil import disk_usage

from scroll_tactile_store.exceptions import FULL, RecordError, StoreClosedError, StoreError, reported
from scroll_tactile_store.files import new_file, replacing, sync_open
from scroll_tactile_store.framing import (
    COMMIT,
    FRAME_BYTES,
    HEADER,
    IDENTITY_BYTES,
    LARGEST_PAYLOAD,
    NO_CHECKSUM,
    Frame,
    pack_frame,
    read_frame,
)
from scroll_tactile_store.log import LogPlace, LogReader
from scroll_tactile_store.log_file import PART

__all__ = ["LogWriter", "create_log"]

logger = logging.getLogger(__name__)

# Zeros are written ahead: to write over them changes nothing but bytes, and fdatasync has no file system's journal to
# wait for. (Room that was only reserved costs as many bytes on the disk, and thrice the time.) Of a disk that is nearly
# full the rest is for others.
AHEAD = 2**20
SPARE_ROOM = 16 * AHEAD
LARGEST_STAGED = 2**22  # bytes that wait in memory for their commit
TOGETHER = 4096  # frames of a batch in a log that replaces another
NO_ROOM = FULL | {errno.EFBIG}


class LogWriter(LogReader):
    """The one writer of a log: whoever makes it holds the writer's lock.

    Methods may be called from any thread, but a batch is one thread's at a time; and not in a forked child.
    place: as of a reader. What is behind the last commit, left by a power cut or a kill, is removed, and what is
    before it is made durable. Raises as LogReader does, DamageError also for damage behind `place`.
    """

    WRITES = True

    def __init__(self, path: Path, *, place: LogPlace | None = None) -> None:
        super().__init__(path, place=place)
        self._writing, self._process = threading.RLock(), os.getpid()
        try:
            for _ in self.refresh():
                pass
            with reported(path, "preparing the log"):
                self._begin_batch()
                self._allocated = self._file.size()
                self._settled = not self._has_tail()
                self._settle()
                # The last commit may be in the system's memory alone, if its writer was killed before its sync.
                sync_open(self._file.descriptor)
        except BaseException:
            super().close()
            raise

    def _begin_batch(self) -> None:
        """Nothing is staged, and what is written next belongs behind the last commit."""
        self._staged = bytearray()
        self._written = self.place.offset
        self._next = self.place

    def _has_tail(self) -> bool:
        """Whether anything but zeros is behind the last commit."""
        parts = (self._file.read(at, PART) for at in range(self.place.offset, self._allocated, PART))
        return any(part.count(0) < len(part) for part in parts)

    def _settle(self) -> None:
        """Cut off what is behind the last commit, where something may be; raises OSError."""
        if not self._settled:
            os.ftruncate(self._file.descriptor, self.place.offset)
            self._allocated = self.place.offset
            sync_open(self._file.descriptor)
            self._settled = True

    def stage(self, kind: int, payload: bytes) -> Frame:
        """Add a frame to the batch that the next `commit` makes durable; `kind` is 2 or more, the caller's.

        After an error the whole batch is not there.
        """
        if not COMMIT < kind < 2**32 or len(payload) > LARGEST_PAYLOAD:
            raise RecordError(f"a frame of kind {kind} and {len(payload)} bytes cannot be kept")
        with self._writing, reported(self.path, "appending to the log"):
            if os.getpid() != self._process:
                raise StoreClosedError(f"{self.path} was opened by process {self._process}, of which this is a fork")
            if self._next == self.place:
                self._settle()  # a batch that could not be taken back
            try:
                frame = self._pack(kind, payload)
                if len(self._staged) > LARGEST_STAGED:
                    self._write()
            except BaseException:
                self.rollback()
                raise
            return frame

    def _pack(self, kind: int, payload: bytes) -> Frame:
        at = self._next
        data, frame = pack_frame(self.identity, at.offset, at.number, at.batch, kind, payload, at.previous)
        self._staged += data
        self._next = LogPlace.behind(frame)
        return frame

    def _write(self) -> None:
        """Write what is staged, with one call, and zeros behind it where the file ends."""
        begin, end = self._written, self._written + len(self._staged)
        self._settled = False  # until it is committed
        ahead = end
        # Asked of the open file, whose folder may have been moved; Windows takes a path alone.
        where = self.path.parent if os.name == "nt" else self._file.descriptor
        if end > self._allocated and disk_usage(where).free > SPARE_ROOM:
            ahead = -(-end // AHEAD) * AHEAD
        try:
            self._file.write(begin, self._staged + bytes(ahead - end))
        except OSError as error:
            if ahead == end or error.errno not in NO_ROOM:
                raise
            self._file.write(begin, self._staged)
            ahead = end
        self._allocated = max(self._allocated, ahead)
        self._written, self._staged = end, bytearray()

    def commit(self) -> None:
        """Make the staged frames durable, all of them or none; without any it does nothing.

        Raises StoreFullError or another StoreError, and then the log is as it was at the last commit.
        """
        with self._writing:
            if self._next != self.place:
                self.seal()

    def seal(self) -> None:
        """As `commit`, also where nothing is staged: behind a batch without frames damage of the one before is proven.

        What befalls the last batch cannot be told from what a power cut leaves.
        """
        with self._writing, reported(self.path, "making a batch durable"):
            try:
                last = self._pack(COMMIT, b"")
                self._write()
                sync_open(self._file.descriptor, data_only=True)
            except BaseException:
                self.rollback()
                raise
            self._last, self.place, self._settled = last, self._next, True

    def append(self, kind: int, payload: bytes) -> Frame:
        """Add a frame, in a batch of its own, and return it when it is durable. Raises as `commit` does."""
        with self._writing:
            frame = self.stage(kind, payload)
            self.commit()
            return frame

    def rollback(self) -> None:
        """Forget the staged frames.

        Where some may be on the disk they are cut off. If that fails, a warning says so, and nothing can be staged
        before it succeeds.
        """
        with self._writing:
            self._begin_batch()
            try:
                self._settle()
            except OSError as error:
                # The caller has to learn what ended the batch; the next one settles it, or is refused.
                logger.warning("%s: a batch could not be taken back yet: %s", self.path, error)

    def frame(self, offset: int, size: int) -> Frame:
        """As a reader's; a staged frame can be read, too."""
        with self._writing:
            is_staged = 0 <= offset - self._written < len(self._staged)
            return self.read(offset, size)[0] if is_staged else super().frame(offset, size)

    def read(self, offset: int, size: int) -> tuple[Frame, bytes]:
        """As a reader's; a staged frame can be read, too."""
        with self._writing:
            begin = offset - self._written
            if not 0 <= begin < len(self._staged):
                return super().read(offset, size)
            data = bytes(self._staged[begin : begin + FRAME_BYTES + size])
            if (frame := read_frame(data, offset)) is None or frame.size != size:
                raise self._damage(f"has no frame with a payload of {size} bytes staged there", offset, 0)
            return frame, data[FRAME_BYTES:]

    def peek(self, offset: int, size: int) -> bytes:
        """As a reader's; of a staged frame, too."""
        with self._writing:
            begin = offset - self._written
            if 0 <= begin < len(self._staged):
                return bytes(self._staged[begin + FRAME_BYTES : begin + FRAME_BYTES + size])
            return super().peek(offset, size)

    def close(self) -> None:
        """Forget what is staged, give the room ahead back and close the file; a second call does nothing."""
        with self._writing, suppress(StoreError, OSError):
            # A fork knows nothing of what its parent has written since.
            if os.getpid() == self._process:
                self._begin_batch()
                os.ftruncate(self._file.descriptor, self.place.offset)
        super().close()


def create_log(path: Path, header: bytes, frames: Iterable[tuple[int, bytes]] = ()) -> bytes:
    """Put a new log, with these kinds and payloads, at `path`, whole and durable or not at all; return its identity.

    header: of the caller, for good. A log that is there is replaced; readers keep it open as it was. Raises
    StoreFullError, ReadOnlyError or another StoreError.
    """
    if len(header) > LARGEST_PAYLOAD:
        raise RecordError(f"a log's first frame of {len(header)} bytes cannot be kept")
    draft = path.with_name(f"{path.name}.new")
    identity = os.urandom(IDENTITY_BYTES)
    with reported(path, "making a log"), replacing(path, draft):
        with new_file(draft) as file:
            file.write(pack_frame(identity, 0, 0, 0, HEADER, header, NO_CHECKSUM)[0])
        with LogWriter(draft) as log:
            count = 0
            for count, (kind, payload) in enumerate(frames, 1):
                log.stage(kind, payload)
                if count % TOGETHER == 0:
                    log.commit()
            log.commit()
            if count:
                log.seal()  # all of them were durable, and may be all that the log ever holds
    return identity
