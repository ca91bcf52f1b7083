"""The write-ahead log: whether a durable frame in it is damaged, and a copy that SQLite reads to its end.

SQLite reads a log up to the first frame that fails its checksum and takes that for the end, as after a power cut. So a
flipped bit would take all rows behind it, in silence. But each commit waits for the disk before the next one's frames
are written: sound frames behind a whole commit prove that the commit was durable.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from store.exceptions import DamageError, reported
from store.schema import JOURNAL_FILE, LOG, PAGE_BYTES

__all__ = ["damaged_frame", "describe_frame", "mend_log", "require_whole_log"]

HEADER_BYTES, FRAME_HEADER_BYTES = 32, 24
FRAME_BYTES = FRAME_HEADER_BYTES + PAGE_BYTES
# By the magic number: the order in which the checksums take bytes.
ORDERS = {0x377F0682: "<", 0x377F0683: ">"}
VERSION = 3007000
TOGETHER = 1024  # frames
ATTEMPTS = 3

Words = npt.NDArray[np.uint32]


def _weights(pairs: int) -> tuple[Words, Words]:
    """Return what each word of so many pairs, and the checksum before them, adds to the checksum (s, t), mod 2³².

    SQLite takes in a pair (a, b) by s += a + t, t += b + s. That is linear: behind a word come only steps
    (s, t) → (s + t, s + 2t).
    """
    words, (p, q, r, u) = [], (1, 0, 0, 1)
    for _ in range(pairs):
        words += [((p + q) % 2**32, (r + u) % 2**32), (q, u)]
        p, q, r, u = (p + q) % 2**32, (p + 2 * q) % 2**32, (r + u) % 2**32, (r + 2 * u) % 2**32
    # The last pair has the fewest steps behind it.
    ordered = np.array(words, np.uint32).reshape(pairs, 2, 2)[::-1].reshape(2 * pairs, 2)
    return np.ascontiguousarray(ordered), np.array([[p, r], [q, u]], np.uint32)


FRAME_WEIGHTS, FRAME_STEP = _weights((FRAME_BYTES - FRAME_HEADER_BYTES + 8) // 8)
HEADER_WEIGHTS, _ = _weights(3)


def _header_checksum(header: bytes, order: str) -> Words:
    return np.asarray(np.frombuffer(header[:24], f"{order}u4").astype(np.uint32) @ HEADER_WEIGHTS)


@dataclass(frozen=True)
class _Frames:
    """Of each frame: its page, whether a commit ends with it, its salts, its checksum, what its bytes add to that."""

    pages: Words
    commits: npt.NDArray[np.bool_]
    salts: Words
    stored: Words
    added: Words

    @classmethod
    def of(cls, data: bytes, order: str) -> _Frames:
        table = np.frombuffer(data[: len(data) // FRAME_BYTES * FRAME_BYTES], np.uint8).reshape(-1, FRAME_BYTES)
        heads = np.ascontiguousarray(table[:, :FRAME_HEADER_BYTES]).view(">u4").astype(np.uint32)
        covered = np.concatenate([table[:, :8], table[:, FRAME_HEADER_BYTES:]], axis=1).view(f"{order}u4")
        added = covered.astype(np.uint32) @ FRAME_WEIGHTS
        return cls(heads[:, 0], heads[:, 1] != 0, heads[:, 2:4], heads[:, 4:6], added)

    def follow(self, before: Words) -> npt.NDArray[np.bool_]:
        """Return whether each frame's checksum continues that of the frame before it; of the first, `before`."""
        earlier = np.concatenate([before[None], self.stored[:-1]])[: len(self.stored)]
        # A disk may have zeros where nothing was written yet, and zeros would continue zeros.
        return np.asarray((self.pages != 0) & (earlier @ FRAME_STEP + self.added == self.stored).all(axis=1))


@dataclass(frozen=True)
class _LogHeader:
    """Whether the header is as it was written, the order of bytes, its salts and its checksum."""

    whole: bool
    order: str
    salts: Words
    stored: Words

    @classmethod
    def of(cls, header: bytes, frames: bytes) -> _LogHeader:
        words = np.frombuffer(header, ">u4").astype(np.uint32)
        for magic, order in ORDERS.items():
            known = words[:3].tolist() == [magic, VERSION, PAGE_BYTES]
            if known and (_header_checksum(header, order) == words[6:8]).all():
                return cls(True, order, words[4:6], words[6:8])
        # Then the frames tell the order: all but the first continue another one.
        orders = [order for order in ORDERS.values() if _Frames.of(frames, order).follow(words[6:8]).any()]
        salts = np.frombuffer(frames[8:16].ljust(8, b"\0"), ">u4").astype(np.uint32)
        return cls(False, (orders or ["<"])[0], salts, words[6:8])


def damaged_frame(path: Path) -> int | None:
    """Return the number of the first frame of a log that was durable and is damaged; 0 is its header.

    None for a sound log, for one that a power cut cut off, and where there is none. A writer may be at work.
    """
    found = None
    for _ in range(ATTEMPTS):
        # A frame that is just being written looks damaged once, and not again.
        if (found := _first_damaged(path)) is None:
            return None
    return found


def _first_damaged(path: Path) -> int | None:
    with suppress(FileNotFoundError), path.open("rb") as file:
        header, block = file.read(HEADER_BYTES), file.read(TOGETHER * FRAME_BYTES)
        if len(header) == HEADER_BYTES:
            return _search(_LogHeader.of(header, block), block, lambda: file.read(TOGETHER * FRAME_BYTES))
    return None


def _search(header: _LogHeader, block: bytes, read: Callable[[], bytes]) -> int | None:
    before, number = header.stored, 0
    first, committed = (None, False) if header.whole else (0, True)
    while len(block) >= FRAME_BYTES:
        frames = _Frames.of(block, header.order)
        salted = (frames.salts == header.salts).all(axis=1)
        sound = frames.follow(before) & salted
        for i in range(len(sound)):
            number += 1
            if first is not None and committed and sound[i]:
                return first
            if first is None and not sound[i]:
                first = number
            # Frames left from before the log was begun anew prove nothing.
            committed = first is not None and (committed or bool(frames.commits[i] & (salted[i] | (first == number))))
        if not sound.any():
            return None
        before, block = frames.stored[-1], read()
    return None


def describe_frame(log: Path, frame: int) -> str:
    """Return in words what `damaged_frame` found."""
    where = f"frame {frame} of {log}" if frame else f"the header of {log}"
    return f"{where} was changed after it had been made durable, and SQLite would pass over the rows in and behind it"


def require_whole_log(folder: Path) -> None:
    """Raise DamageError where SQLite would take a damaged frame of the log for its end, and write over what follows."""
    log = folder / (JOURNAL_FILE + LOG)
    with reported(log, "reading the write-ahead log"):
        frame = damaged_frame(log)
    if frame is not None:
        raise DamageError(f"{describe_frame(log, frame)}: repair the store (repair_store)", path=log)


def mend_log(path: Path, target: Path) -> None:
    """Write a copy of a damaged log in which SQLite reads all frames, up to the last commit, as they are now."""
    data = bytearray(path.read_bytes())
    body = bytes(data[HEADER_BYTES:])
    header = _LogHeader.of(bytes(data[:HEADER_BYTES]), body)
    frames, salts = _Frames.of(body, header.order), header.salts
    sound = frames.follow(header.stored) & (frames.salts == salts).all(axis=1)
    ends = np.flatnonzero(frames.commits & (np.cumsum(sound[::-1])[::-1] > 0))
    count = int(ends[-1]) + 1 if len(ends) else 0
    (magic,) = (magic for magic, order in ORDERS.items() if order == header.order)
    struct.pack_into(">6I", data, 0, magic, VERSION, PAGE_BYTES, 0, *map(int, salts))
    stored = _header_checksum(bytes(data[:24]), header.order)
    struct.pack_into(">2I", data, 24, *map(int, stored))
    for i in range(count):
        stored = stored @ FRAME_STEP + frames.added[i]
        struct.pack_into(">4I", data, HEADER_BYTES + i * FRAME_BYTES + 8, *map(int, salts), *map(int, stored))
    target.write_bytes(data[: HEADER_BYTES + count * FRAME_BYTES])
