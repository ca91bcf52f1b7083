"""The file of a log: read and written at offsets from any thread, a part at a time, and never through a link."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from scroll_tactile_store.encoding import RATIO, SPARE
from scroll_tactile_store.exceptions import DamageError, StoreClosedError, reported
from scroll_tactile_store.files import open_regular
from scroll_tactile_store.framing import FRAME_BYTES, MARK, Frame, read_frame

__all__ = ["PART", "LogFile", "Window", "find_identity", "frames_behind"]

PART = 2**18  # bytes that are read at once
BLOCK = 512  # bytes, of st_blocks


class LogFile:
    """A regular file, read and written at offsets from any thread; raises OSError, DamageError for anything else.

    window: offset and size of the part of the file that is all there is, for one that is only read.
    """

    def __init__(self, path: Path, *, write: bool, window: tuple[int, int] | None = None) -> None:
        self.path = path
        self._begin = 0 if window is None else window[0]
        self._end = None if window is None else window[1]
        self._guard = threading.Lock()
        self._descriptor = open_regular(path, os.O_RDWR if write else os.O_RDONLY)

    @property
    def descriptor(self) -> int:
        """The open file's number. Raises StoreClosedError."""
        if self._descriptor < 0:
            raise StoreClosedError(f"the log {self.path} is closed")
        return self._descriptor

    def read(self, offset: int, size: int) -> bytes:
        """Return so many bytes at an offset, fewer where the file ends."""
        if self._end is not None:
            size = max(0, min(size, self._end - offset))
        with self._guard:
            os.lseek(self.descriptor, self._begin + offset, os.SEEK_SET)
            data = part = os.read(self.descriptor, size)
            while part and len(data) < size:
                part = os.read(self.descriptor, size - len(data))
                data += part
            return data

    def read_whole(self, limit: int) -> bytes:
        """Return all bytes, of which there are at most `limit`. Raises DamageError where there are more."""
        if (size := self.size()) > limit:
            raise DamageError(f"{self.path} has {size} bytes; at most {limit} are read there", path=self.path)
        return self.read(0, size)

    def write(self, offset: int, data: bytes | bytearray) -> None:
        """Write all bytes at an offset, in one call unless the system takes fewer."""
        with self._guard, memoryview(data) as rest:
            os.lseek(self.descriptor, self._begin + offset, os.SEEK_SET)
            done = 0
            while done < len(rest):
                done += os.write(self.descriptor, rest[done:])

    def size(self) -> int:
        """Return the size in bytes. Raises DamageError where next to nothing of it is on the disk."""
        found = os.fstat(self.descriptor)
        stored = getattr(found, "st_blocks", 0) * BLOCK  # 0 also where the file system does not tell
        if stored and found.st_size > SPARE + RATIO * stored:
            # No log is ever so: its end is filled with zeros that are written.
            raise DamageError(
                f"{self.path} says that it has {found.st_size} bytes, and {stored} are on the disk: nothing of it was "
                "read. In a folder that comes from elsewhere trust nothing",
                path=self.path,
            )
        return found.st_size if self._end is None else self._end

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        with self._guard:
            descriptor, self._descriptor = self._descriptor, -1
            if descriptor >= 0:
                os.close(descriptor)


class Window:
    """The part of a file that is being read, so that small frames need no call each."""

    def __init__(self, file: LogFile) -> None:
        self._file = file
        self.drop()

    def drop(self) -> None:
        """Forget what was read: the file may have changed since."""
        self._start, self._data = 0, b""

    def read(self, offset: int, size: int) -> bytes:
        """Return at most PART bytes at an offset, fewer where the file ends."""
        begin = offset - self._start
        if not 0 <= begin <= begin + size <= len(self._data):
            self._start, begin = offset, 0
            self._data = self._file.read(offset, PART)
        return self._data[begin : begin + size]

    def digest(self, offset: int, size: int) -> bytes:
        """Return the digest of so many bytes at an offset, or of those up to the end of the file."""
        digest = hashlib.blake2b(digest_size=16)
        while size > 0 and (part := self.read(offset, min(size, PART))):
            digest.update(part)
            offset, size = offset + len(part), size - len(part)
        return digest.digest()


def frames_behind(file: LogFile, offset: int, mark: bytes = MARK) -> Iterator[Frame]:
    """Yield the frames whose first bytes verify, found by what they begin with, wherever they are."""
    size = file.size()
    for start in range(offset, size, PART):
        data = file.read(start, PART + FRAME_BYTES - 1)
        found = data.find(mark)
        while 0 <= found < PART:
            if (frame := read_frame(data[found : found + FRAME_BYTES], start + found)) is not None:
                yield frame
            found = data.find(mark, found + 1)


def find_identity(file: LogFile) -> bytes | None:
    """Return the identity that the frames of a log carry, by the first of them that can be found; None without one.

    The file is closed.
    """
    with closing(file), reported(file.path, "looking for frames"):
        return next((frame.identity for frame in frames_behind(file, 0)), None)
