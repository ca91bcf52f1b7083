"""Messages out of the files of ROS in the order they were written; here those of ROS 1, `.bag`.

Files are read from their beginning, a chunk at a time, and never by their index. So one that was cut off, by a power
cut or a full disk, gives its whole messages up to there, and a large one needs no more memory than its largest chunk.
"""

from __future__ import annotations

import bz2
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from scroll_tactile.errors import InputError, RecordingError
from scroll_tactile.libraries import missing
from scroll_tactile.recordings.bounds import LARGEST, Budget, on_disk

__all__ = [
    "DAMAGE",
    "Channel",
    "CutOff",
    "Message",
    "Scan",
    "decompress",
    "holes_of",
    "inflated",
    "scan_bag",
    "take",
    "zstd",
]


@dataclass(frozen=True)
class Channel:
    """A topic's messages of one type: encoding is "ros1", "cdr" or "json"; the definition is a .msg, or an IDL."""

    topic: str
    type: str
    encoding: str
    definition: str = ""
    idl: bool = False


class Message(NamedTuple):
    """A message as bytes, its times in ns; `others` counts the messages of other channels until then."""

    channel: Channel
    log: int
    publish: int | None
    sequence: int | None
    others: int
    data: bytes


class Scan:
    """What a scan is to give, and how it went.

    wanted: whether messages of a topic are wanted; those of others are passed over. budget: what it may cost.
    cut_off: why the file ends before its end. damaged: how many chunks inside it could not be read.
    """

    def __init__(self, wanted: Callable[[str], bool], budget: Budget) -> None:
        self.wanted, self.budget = wanted, budget
        self.cut_off: str | None = None
        self.damaged = 0


class CutOff(Exception):
    """The bytes end in the middle of something."""


DAMAGE = (ValueError, RuntimeError, OSError, EOFError, KeyError, struct.error)  # what decompressors and parsers raise


def holes_of(file: BinaryIO, budget: Budget) -> Budget | None:
    """What the bytes of a file are taken from: a budget where it has holes, which are read and are nowhere stored."""
    about = os.fstat(file.fileno())
    return budget if on_disk(about) < about.st_size else None


def take(file: BinaryIO, size: int, left: int, holes: Budget | None = None) -> bytes:
    """The next `size` bytes; raises CutOff where there are fewer, before any memory is taken for them.

    holes: as of `holes_of`; raises RecordingError where it has no room for as many.
    """
    if size > left:
        raise CutOff(f"a record of {size} bytes is claimed where {left} are left")
    if size > LARGEST:  # what is left may be a hole
        raise CutOff(f"a record of {size} bytes is claimed")
    if holes is not None:
        holes.take(size)
    data = file.read(size)
    if len(data) < size:
        raise CutOff("it ends in the middle of a record")
    return data


def decompress(kind: str, data: bytes, size: int, budget: Budget, *, whole: bool) -> bytes:
    """`data` decompressed, of `size` bytes; raises ValueError where they are not as many and it is `whole`.

    Raises RecordingError where the budget has no room for as many, MissingLibraryError.
    """
    if size > LARGEST:
        raise ValueError(f"a chunk of {size} bytes is claimed")
    budget.take(size)
    if kind in ("", "none"):
        result = data
    else:
        decompressor = _decompressor(kind)
        try:
            result = decompressor.decompress(data, max_length=size)
        except Exception as error:  # each library has errors of its own
            raise ValueError(str(error)) from error
    if whole and len(result) != size:
        raise ValueError(f"a chunk of {size} bytes is claimed; there are {len(result)}")
    return result


def _decompressor(kind: str) -> Any:
    if kind == "bz2":
        return bz2.BZ2Decompressor()
    if kind == "lz4":
        try:
            from lz4.frame import LZ4FrameDecompressor  # comes with rosbags
        except ImportError as error:
            raise missing("lz4", "ros", "a file compressed by lz4", cause=error) from error
        return LZ4FrameDecompressor()
    if kind == "zstd":
        return zstd().ZstdDecompressor()
    raise RecordingError(f"chunks are compressed as {kind!r}; expected lz4, zstd or bz2")


def zstd() -> Any:
    """The module that decompresses Zstandard."""
    try:
        from compression import zstd  # type: ignore[import-not-found]  # Python 3.14
    except ImportError:
        try:
            from backports import zstd
        except ImportError as error:
            raise missing("backports.zstd", "ros", "a file compressed by zstd", cause=error) from error
    return zstd


def inflated(path: Path, folder: Path, budget: Budget) -> Path:
    """A whole file that was compressed by zstd, as it was before, in `folder`."""
    target = folder / path.stem
    with path.open("rb") as file, zstd().open(file, "rb") as source, target.open("wb") as sink:
        while part := source.read(1 << 20):
            budget.take(len(part))
            sink.write(part)
    return target


# ROS 1: records of a header (fields name=value) and data; chunks hold records.

_BAG = b"#ROSBAG V2.0\n"
_A_RECORD = 4  # steps of work
_FIELDS_A_STEP = 4
_LONGEST_HEADER = 1 << 20  # bytes; a message's definition is in one of them, and those of MoveIt take 100 KB
_MESSAGE, _BAG_HEADER, _CHUNK, _CONNECTION = 2, 3, 5, 7


def scan_bag(path: Path, scan: Scan) -> Iterator[Message]:
    """The messages of a ROS 1 bag, indexed or not."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(len(_BAG)) != _BAG:
            raise RecordingError(f"{path} does not begin as a ROS 1 bag does, with {_BAG.decode().strip()!r}")
        reader, holes = _Bag(scan), holes_of(file, scan.budget)
        try:
            _index(file, size, reader, holes)
            while file.tell() < size:
                header, length = _record_head(file, size, scan.budget, holes)
                left = size - file.tell()
                if length > left and header.get(b"op") == bytes([_CHUNK]):
                    left = min(left, LARGEST)
                    yield from reader.chunk(header, take(file, left, left, holes), whole=False)
                    raise CutOff("it ends in the middle of a chunk")
                yield from reader.record(header, take(file, length, left, holes))
        except CutOff as error:
            scan.cut_off = str(error)


def _record_head(
    file: BinaryIO, size: int, budget: Budget, holes: Budget | None = None
) -> tuple[dict[bytes, bytes], int]:
    """A record's header, and how many bytes of data follow."""
    (length,) = struct.unpack("<I", take(file, 4, size - file.tell()))
    if length > _LONGEST_HEADER:
        raise CutOff(f"a record's header of {length} bytes is claimed")
    header = _header(take(file, length, size - file.tell(), holes), budget)
    (length,) = struct.unpack("<I", take(file, 4, size - file.tell()))
    return header, length


def _header(data: bytes, budget: Budget) -> dict[bytes, bytes]:
    """The fields of a header; raises CutOff for what is none, RecordingError where the budget has no time for it."""
    if len(data) > _LONGEST_HEADER:
        raise CutOff(f"a record's header has {len(data)} bytes")
    fields: dict[bytes, bytes] = {}
    i = count = 0
    while i < len(data):
        (length,) = struct.unpack_from("<I", data, i)
        name, mark, value = data[i + 4 : i + 4 + length].partition(b"=")
        if not mark:
            raise CutOff(f"a field of a record's header is {name!r:.60}; expected name=value")
        fields[name] = value
        i += 4 + length
        count += 1
    budget.work(count // _FIELDS_A_STEP)
    return fields


def _index(file: BinaryIO, size: int, reader: _Bag, holes: Budget | None) -> None:
    """Take the connections at the end of a whole bag: those in a damaged chunk are needed by later ones."""
    begin, budget = file.tell(), reader.scan.budget
    header, _ = _record_head(file, size, budget, holes)
    with suppress(*DAMAGE, CutOff):
        (start,) = struct.unpack("<Q", header[b"index_pos"])
        file.seek(start if 0 < start < size else size)
        while file.tell() < size:
            header, length = _record_head(file, size, budget, holes)
            if header[b"op"] != bytes([_CONNECTION]):
                break
            for _ in reader.record(header, take(file, length, size - file.tell(), holes)):
                pass
    file.seek(begin)


class _Bag:
    """Follows the connections of a ROS 1 bag from record to record."""

    def __init__(self, scan: Scan) -> None:
        self.scan = scan
        self.channels: dict[bytes, Channel] = {}
        self.count: dict[bytes, int] = {}
        self.total = 0

    def record(self, header: dict[bytes, bytes], data: bytes) -> Iterator[Message]:
        self.scan.budget.work(_A_RECORD)
        kind = header.get(b"op", b"\0")[0]
        if kind == _CHUNK:
            yield from self.chunk(header, data, whole=True)
        elif kind == _CONNECTION:
            self._connect(header, data)
        elif kind == _MESSAGE:
            yield from self._message(header, data)

    def chunk(self, header: dict[bytes, bytes], data: bytes, *, whole: bool) -> Iterator[Message]:
        """The messages of a chunk; of one that was cut off, those before the cut."""
        try:
            (size,) = struct.unpack("<I", header[b"size"])
            inside = decompress(header[b"compression"].decode(), data, size, self.scan.budget, whole=whole)
            chunk = BytesIO(inside)
            while chunk.tell() < len(inside):
                inner, length = _record_head(chunk, len(inside), self.scan.budget)
                if inner.get(b"op") == bytes([_CHUNK]):
                    raise ValueError("a chunk is claimed inside a chunk")
                yield from self.record(inner, take(chunk, length, len(inside) - chunk.tell()))
        except InputError:  # a library is missing, or there is more than such a file can hold
            raise
        except (*DAMAGE, CutOff):
            self.scan.damaged += whole

    def _connect(self, header: dict[bytes, bytes], data: bytes) -> None:
        fields = _header(data, self.scan.budget)
        topic = header.get(b"topic", fields.get(b"topic", b"")).decode()
        name = fields[b"type"].decode()
        name = name if "/msg/" in name else name.replace("/", "/msg/", 1)
        self.channels[header[b"conn"]] = Channel(topic, name, "ros1", fields[b"message_definition"].decode())

    def _message(self, header: dict[bytes, bytes], data: bytes) -> Iterator[Message]:
        channel = self.channels.get(header[b"conn"])
        self.total += 1
        if channel is None or not self.scan.wanted(channel.topic):
            return
        seconds, nanoseconds = struct.unpack("<II", header[b"time"])
        yield Message(channel, seconds * 10**9 + nanoseconds, None, None, self.total, data)
