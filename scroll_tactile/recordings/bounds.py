"""What a recording may cost: it comes from elsewhere, and may claim to hold more than anybody has room or time for.

The bounds are ratios to the bytes that a recording has on the disk, so that they fit a touch and a day of touching.
Numbers of sensors are compressed 2 to 20 times, those of a sensor at rest and pictures of a gel 100 times, and LZ4
makes at most 255 bytes of one; deflate can make 1032, and zstd a million. What is small is believed: a second's work is
nobody's harm.
"""

from __future__ import annotations

import json
import os
import stat
import zlib
from pathlib import Path

from scroll_tactile.errors import RecordingError

__all__ = [
    "RATIO",
    "SPARE",
    "on_disk",
    "read_text",
    "require_bounded",
    "require_file",
    "require_inflated",
    "require_inside",
    "stored_bytes",
]

SPARE, RATIO = 1 << 28, 256
"""Bytes that any recording may become in memory, and how many more for each byte on the disk."""

_PIECE = 1 << 14  # bytes, of which deflate makes 17 million at most
_POINTER, _LONGEST_POINTER = b"version https://git-lfs.github.com/spec/", 1024


def require_bounded(claimed: int, stored: int, what: str) -> None:
    """Raises RecordingError where `stored` bytes of a file claim to become more than files of their size can.

    It is asked wherever a buffer is made for what a file says of itself.
    """
    if claimed > SPARE + RATIO * stored:
        raise RecordingError(
            f"{what} claims to hold {claimed} bytes in {stored} bytes on the disk; expected at most {RATIO} times as "
            f"many, and {SPARE >> 20} MiB. It may be damaged or made to harm. If it is neither, write it with less "
            "compression, or in parts"
        )


def require_inflated(data: bytes, most: int, what: str) -> None:
    """Raises RecordingError where zlib or gzip make more than `most` bytes of `data`; a few are believed unseen."""
    inflating, count = zlib.decompressobj(47), 0
    for begin in range(0, len(data), _PIECE) if len(data) > SPARE >> 10 else ():
        count += len(inflating.decompress(data[begin : begin + _PIECE]))
        if inflating.eof:  # gzip may have several parts
            rest, inflating = inflating.unused_data, zlib.decompressobj(47)
            count += len(inflating.decompress(rest))
        if count > most:
            raise RecordingError(f"{what} becomes more than the {most} bytes that it claims, and may be made to harm")


def stored_bytes(path: Path) -> int:
    """The bytes that a file has on the disk, holes left out; raises RecordingError for what is no file."""
    return on_disk(require_file(path))


def on_disk(about: os.stat_result) -> int:
    """The bytes of a file without its holes; its length on a file system that counts no blocks."""
    return min(about.st_size, 512 * getattr(about, "st_blocks", 0) or about.st_size)


def require_file(path: Path) -> os.stat_result:
    """Raises RecordingError for what is no file: opening a FIFO or a device waits for ever, or changes something.

    And for a pointer of Git LFS, which stands in a file's place in a clone that was made without it.
    """
    about = path.stat()
    if not stat.S_ISREG(about.st_mode):
        kinds = {"FIFO": stat.S_ISFIFO, "socket": stat.S_ISSOCK, "folder": stat.S_ISDIR}
        kind = next((kind for kind, of in kinds.items() if of(about.st_mode)), "device")
        raise RecordingError(f"{path} is a {kind}; expected a file. It was passed over")
    if about.st_size < _LONGEST_POINTER:
        with path.open("rb") as file:
            if file.read(len(_POINTER)) == _POINTER:
                raise RecordingError(
                    f"{path} is a pointer of Git LFS, and the file itself was not fetched: run git lfs pull where it is"
                )
    return about


def require_inside(folder: Path, path: Path) -> None:
    """Raises RecordingError for a file that lies, by a link or by its name, outside of the recording's folder."""
    if not path.resolve().is_relative_to(folder.resolve()):
        raise RecordingError(f"{path} leads out of its recording, {folder}: copy what it leads to in its place")


def read_text(folder: Path, path: Path, most: int) -> str:
    """What is written in a file of a recording's folder; raises RecordingError where that is more than `most` bytes."""
    require_inside(folder, path)
    require_file(path)
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise RecordingError(f"{path} has more than {most} bytes; expected less of what describes a recording")
    return data.decode(json.detect_encoding(data))
