"""Messages out of ROS bags, in the order they were written: `.bag`, `.mcap`, `.db3`.

Files are read from their beginning, a chunk at a time, and never by their index. So one that was cut off, by a power
cut or a full disk, gives its whole messages up to there, and a large one needs no more memory than its largest chunk.
"""

from __future__ import annotations

import bz2
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from scroll_tactile.errors import RecordingError
from scroll_tactile.recordings.blocks import LARGEST, missing

__all__ = ["Channel", "Message", "Scan", "inflated", "scan_bag", "scan_db3", "scan_mcap"]


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

    wanted: whether messages of a topic are wanted; those of others are passed over.
    cut_off: why the file ends before its end. damaged: how many chunks inside it could not be read.
    """

    def __init__(self, wanted: Callable[[str], bool]) -> None:
        self.wanted = wanted
        self.cut_off: str | None = None
        self.damaged = 0


class _CutOff(Exception):
    """The bytes end in the middle of something."""


_DAMAGE = (ValueError, RuntimeError, OSError, EOFError, KeyError, struct.error)  # what decompressors and parsers raise


def _take(file: BinaryIO, size: int, left: int) -> bytes:
    if size > left:
        raise _CutOff(f"a record of {size} bytes is claimed where {left} are left")
    data = file.read(size)
    if len(data) < size:
        raise _CutOff("it ends in the middle of a record")
    return data


def _decompress(kind: str, data: bytes, size: int, *, whole: bool) -> bytes:
    """`data` decompressed, of `size` bytes; raises ValueError where they are not as many and it is `whole`."""
    if size > LARGEST:
        raise ValueError(f"a chunk of {size} bytes is claimed")
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
            raise missing("lz4", "ros", "a file compressed by lz4") from error
        return LZ4FrameDecompressor()
    if kind == "zstd":
        return _zstd().ZstdDecompressor()
    raise RecordingError(f"chunks are compressed as {kind!r}; expected lz4, zstd or bz2")


def _zstd() -> Any:
    try:
        from compression import zstd  # type: ignore[import-not-found]  # Python 3.14
    except ImportError:
        try:
            from backports import zstd
        except ImportError as error:
            raise missing("backports.zstd", "ros", "a file compressed by zstd") from error
    return zstd


# ROS 1: records of a header (fields name=value) and data; chunks hold records.

_BAG = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG_HEADER, _CHUNK, _CONNECTION = 2, 3, 5, 7


def scan_bag(path: Path, scan: Scan) -> Iterator[Message]:
    """The messages of a ROS 1 bag, indexed or not."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(len(_BAG)) != _BAG:
            raise RecordingError(f"{path} does not begin as a ROS 1 bag does, with {_BAG.decode().strip()!r}")
        reader = _Bag(scan)
        try:
            _index(file, size, reader)
            while file.tell() < size:
                header, length = _record_head(file, size)
                left = size - file.tell()
                if length > left and header.get(b"op") == bytes([_CHUNK]):
                    yield from reader.chunk(header, file.read(left), whole=False)
                    raise _CutOff("it ends in the middle of a chunk")
                yield from reader.record(header, _take(file, length, size - file.tell()))
        except _CutOff as error:
            scan.cut_off = str(error)


def _record_head(file: BinaryIO, size: int) -> tuple[dict[bytes, bytes], int]:
    """A record's header, and how many bytes of data follow."""
    (length,) = struct.unpack("<I", _take(file, 4, size - file.tell()))
    header = _header(_take(file, length, size - file.tell()))
    (length,) = struct.unpack("<I", _take(file, 4, size - file.tell()))
    return header, length


def _header(data: bytes) -> dict[bytes, bytes]:
    fields: dict[bytes, bytes] = {}
    i = 0
    while i < len(data):
        (length,) = struct.unpack_from("<I", data, i)
        name, _, value = data[i + 4 : i + 4 + length].partition(b"=")
        fields[name] = value
        i += 4 + length
    return fields


def _index(file: BinaryIO, size: int, reader: _Bag) -> None:
    """Take the connections at the end of a whole bag: those in a damaged chunk are needed by later ones."""
    begin = file.tell()
    header, _ = _record_head(file, size)
    with suppress(*_DAMAGE, _CutOff):
        (start,) = struct.unpack("<Q", header[b"index_pos"])
        file.seek(start if 0 < start < size else size)
        while file.tell() < size:
            header, length = _record_head(file, size)
            if header[b"op"] != bytes([_CONNECTION]):
                break
            for _ in reader.record(header, _take(file, length, size - file.tell())):
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
            inside = _decompress(header[b"compression"].decode(), data, size, whole=whole)
            chunk = BytesIO(inside)
            while chunk.tell() < len(inside):
                inner, length = _record_head(chunk, len(inside))
                if inner.get(b"op") == bytes([_CHUNK]):
                    raise ValueError("a chunk is claimed inside a chunk")
                yield from self.record(inner, _take(chunk, length, len(inside) - chunk.tell()))
        except (*_DAMAGE, _CutOff):
            self.scan.damaged += whole

    def _connect(self, header: dict[bytes, bytes], data: bytes) -> None:
        fields = _header(data)
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


# MCAP: records of a kind, a length and data; chunks hold records.

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK, _DATA_END = 2, 3, 4, 5, 6, 15
_HEAD = struct.Struct("<BQ")
_MCAP_HEAD = struct.Struct("<HIQQ")


def scan_mcap(path: Path, scan: Scan) -> Iterator[Message]:
    """The messages of an MCAP file, whole or cut off."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise RecordingError(f"{path} does not begin as an MCAP file does")
        reader = _Mcap(scan)
        _summary(file, size, reader)
        try:
            while True:
                kind, length = _HEAD.unpack(_take(file, _HEAD.size, size - file.tell()))
                if kind in (_FOOTER, _DATA_END):
                    return
                if kind not in (_SCHEMA, _CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK):
                    if length > size - file.tell():
                        raise _CutOff("it ends in the middle of a record")
                    file.seek(length, 1)
                    continue
                left = size - file.tell()
                if kind == _MCAP_CHUNK and length > left:
                    yield from reader.chunk(file.read(left), whole=False)
                    raise _CutOff("it ends in the middle of a chunk")
                data = _take(file, length, size - file.tell())
                yield from reader.chunk(data, whole=True) if kind == _MCAP_CHUNK else reader.record(kind, data)
        except _CutOff as error:
            scan.cut_off = str(error)


def _summary(file: BinaryIO, size: int, reader: _Mcap) -> None:
    """Take the schemas and channels at the end of a whole file: those in a damaged chunk are needed by later ones."""
    begin, tail = file.tell(), 9 + 20 + len(_MAGIC)  # a footer and the magic
    file.seek(max(size - tail, begin))
    footer = file.read(tail)
    if len(footer) == tail and footer.endswith(_MAGIC) and footer[0] == _FOOTER:
        (start,) = struct.unpack_from("<Q", footer, 9)
        with suppress(*_DAMAGE, _CutOff):
            file.seek(start if 0 < start < size else size)
            while file.tell() < size - tail:
                kind, length = _HEAD.unpack(_take(file, _HEAD.size, size - file.tell()))
                data = _take(file, length, size - file.tell())
                if kind in (_SCHEMA, _CHANNEL):
                    for _ in reader.record(kind, data):
                        pass
    file.seek(begin)


class _Mcap:
    """Follows the schemas and channels of an MCAP file from record to record."""

    def __init__(self, scan: Scan) -> None:
        self.scan = scan
        self.schemas: dict[int, tuple[str, str, str]] = {}
        self.channels: dict[int, Channel] = {}
        self.others: dict[int, int] = {}
        self.total = 0

    def chunk(self, data: bytes, *, whole: bool) -> Iterator[Message]:
        """The messages of a chunk; of one that was cut off, those before the cut, which no checksum verifies."""
        try:
            size, checksum = struct.unpack_from("<QI", data, 16)
            form, i = _text(data, 28)
            (length,) = struct.unpack_from("<Q", data, i)
            inside = _decompress(form, data[i + 8 : i + 8 + length], size, whole=whole)
            if whole and checksum and zlib.crc32(inside) != checksum:
                raise ValueError("its checksum does not verify")
            i = 0
            while i + _HEAD.size <= len(inside):
                kind, length = _HEAD.unpack_from(inside, i)
                i += _HEAD.size
                if i + length > len(inside):
                    raise _CutOff("a record ends beyond its chunk")
                yield from self.record(kind, inside[i : i + length])
                i += length
        except (*_DAMAGE, _CutOff):
            self.scan.damaged += whole

    def record(self, kind: int, data: bytes) -> Iterator[Message]:
        if kind == _MCAP_MESSAGE:
            number, sequence, log, publish = _MCAP_HEAD.unpack_from(data)
            channel = self.channels.get(number)
            self.total += 1
            if channel is not None and self.scan.wanted(channel.topic):
                self.others[number] = self.others.get(number, 0) + 1
                foreign = self.total - self.others[number]
                yield Message(channel, log, publish, sequence, foreign, data[_MCAP_HEAD.size :])
        elif kind == _SCHEMA:
            name, i = _text(data, 2)
            form, i = _text(data, i)
            self.schemas[struct.unpack_from("<H", data)[0]] = (name, form, _text(data, i)[0])
        elif kind == _CHANNEL:
            number, schema = struct.unpack_from("<HH", data)
            topic, i = _text(data, 4)
            encoding, _ = _text(data, i)
            name, form, definition = self.schemas.get(schema, ("", "", ""))
            name = name if "/msg/" in name else name.replace("/", "/msg/", 1)
            self.channels[number] = Channel(topic, name, encoding, definition, form == "ros2idl")


def _text(data: bytes, i: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", data, i)
    if i + 4 + length > len(data):
        raise struct.error("a text ends beyond its record")
    return data[i + 4 : i + 4 + length].decode(errors="replace"), i + 4 + length


def scan_db3(path: Path, scan: Scan, *, compressed: bool = False) -> Iterator[Message]:
    """The messages of a ROS 2 SQLite file, in the order they were written; `compressed`: each by itself, by zstd."""
    import sqlite3

    with ExitStack() as stack:
        base = stack.enter_context(closing(_connect(_whole_pages(path, scan, stack))))
        try:
            channels = _channels(base)
        except sqlite3.DatabaseError as error:
            raise RecordingError(f"{path} cannot be read as a ROS 2 bag, and may be damaged: {error}") from error
        wanted = [number for number, channel in channels.items() if scan.wanted(channel.topic)]
        marks = ",".join("?" * len(wanted))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY id"
        try:
            for number, log, data in base.execute(query, wanted):
                whole = _zstd().decompress(data) if compressed else data
                yield Message(channels[number], log, None, None, 0, whole)
        except sqlite3.DatabaseError as error:
            scan.cut_off = str(error)


def _whole_pages(path: Path, scan: Scan, stack: ExitStack) -> Path:
    """A file that ends inside a page without that page, as a copy: SQLite would read zeros for what is missing."""
    with path.open("rb") as file:
        head = file.read(100)
        if head[:16] != b"SQLite format 3\0" or len(head) < 100:
            raise RecordingError(f"{path} does not begin as an SQLite file does")
        page = int.from_bytes(head[16:18], "big")
        page = 65536 if page == 1 else page
        size = path.stat().st_size
        if page < 512 or size % page == 0:
            return path
        scan.cut_off = "it ends in the middle of a page"
        target = Path(stack.enter_context(tempfile.TemporaryDirectory())) / path.name
        file.seek(0)
        with target.open("wb") as copy:
            for _ in range(size // page):
                copy.write(file.read(page))
    return target


def _connect(path: Path) -> Any:
    import sqlite3

    address = path.resolve().as_uri()
    for mode in ("mode=ro", "mode=ro&immutable=1"):  # a write-ahead log cannot be read where nothing may be written
        base = sqlite3.connect(f"{address}?{mode}", uri=True)
        base.text_factory = lambda data: data.decode(errors="replace")
        try:
            base.execute("PRAGMA writable_schema=ON")  # otherwise SQLite gives nothing of a file that was cut off
            base.execute("SELECT 1 FROM sqlite_master").fetchone()
            return base
        except sqlite3.OperationalError:
            base.close()
        except sqlite3.DatabaseError as error:
            base.close()
            raise RecordingError(f"{path} cannot be read as a ROS 2 bag, and may be damaged: {error}") from error
    raise RecordingError(f"{path} cannot be opened as an SQLite file: is it being written, or readable at all?")


def _channels(base: Any) -> dict[int, Channel]:
    tables = {name for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if not {"topics", "messages"} <= tables:
        raise RecordingError(f"expected the tables topics and messages of a ROS 2 bag; there are {sorted(tables)}")
    definitions = {}
    if "message_definitions" in tables:  # since ROS 2 Iron
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        definitions = {name: (text, form == "ros2idl") for name, form, text in base.execute(query)}
    return {
        number: Channel(topic, name, form, *definitions.get(name, ("", False)))
        for number, topic, name, form in base.execute("SELECT id, name, type, serialization_format FROM topics")
    }


def inflated(path: Path, folder: Path) -> Path:
    """A whole file that was compressed by zstd, as it was before, in `folder`."""
    import shutil

    target = folder / path.stem
    with path.open("rb") as file, _zstd().open(file, "rb") as source, target.open("wb") as sink:
        shutil.copyfileobj(source, sink, 1 << 20)
    return target
