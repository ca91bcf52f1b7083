"""Messages out of the files of ROS, `.bag`, `.mcap` and `.db3`, in the order they were written.

Files are read from their beginning, a chunk at a time, and never by their index. So one that was cut off, by a power
cut or a full disk, gives its whole messages up to there, and a large one needs no more memory than its largest chunk.
"""

from __future__ import annotations

import bz2
import os
import re
import shutil
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from scroll_tactile.errors import InputError, RecordingError
from scroll_tactile.libraries import missing
from scroll_tactile.recordings.bounds import LARGEST, Budget

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

    wanted: whether messages of a topic are wanted; those of others are passed over. budget: what it may cost.
    cut_off: why the file ends before its end. damaged: how many chunks inside it could not be read.
    """

    def __init__(self, wanted: Callable[[str], bool], budget: Budget) -> None:
        self.wanted, self.budget = wanted, budget
        self.cut_off: str | None = None
        self.damaged = 0


class _CutOff(Exception):
    """The bytes end in the middle of something."""


_DAMAGE = (ValueError, RuntimeError, OSError, EOFError, KeyError, struct.error)  # what decompressors and parsers raise


def _take(file: BinaryIO, size: int, end: int, budget: Budget) -> bytes:
    """The next `size` bytes of `end`; raises _CutOff where there are fewer, before any memory is taken for them.

    Raises RecordingError where the budget has no room for as many: what is left of a file may be a hole.
    """
    left = end - file.tell()
    if size > min(left, LARGEST):
        raise _CutOff(f"a record of {size} bytes is claimed where {left} are left")
    budget.take(size)
    return file.read(size)


def _decompress(kind: str, data: bytes, size: int, budget: Budget, *, whole: bool) -> bytes:
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
        return _zstd().ZstdDecompressor()
    raise RecordingError(f"chunks are compressed as {kind!r}; expected lz4, zstd or bz2")


def _zstd() -> Any:
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
    with path.open("rb") as file, _zstd().open(file, "rb") as source, target.open("wb") as sink:
        while part := source.read(1 << 20):
            budget.take(len(part))
            sink.write(part)
    return target


# ROS 1: records of a header (fields name=value) and data; chunks hold records.

_BAG = b"#ROSBAG V2.0\n"
_A_RECORD = 4  # steps of work
_HEADER_A_STEP = 64  # bytes of a header; a field has five at least
_LONGEST_HEADER = 1 << 20  # bytes; a message's definition is in one of them, and those of MoveIt take 100 KB
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
                header, length = _record_head(file, size, scan.budget)
                left = size - file.tell()
                if length > left and header.get(b"op") == bytes([_CHUNK]):
                    yield from reader.chunk(header, _take(file, min(left, LARGEST), size, scan.budget), whole=False)
                    raise _CutOff("it ends in the middle of a chunk")
                yield from reader.record(header, _take(file, length, size, scan.budget))
        except _CutOff as error:
            scan.cut_off = str(error)


def _record_head(file: BinaryIO, size: int, budget: Budget) -> tuple[dict[bytes, bytes], int]:
    """A record's header, and how many bytes of data follow."""
    (length,) = struct.unpack("<I", _take(file, 4, size, budget))
    if length > _LONGEST_HEADER:
        raise _CutOff(f"a record's header of {length} bytes is claimed")
    header = _header(_take(file, length, size, budget), budget)
    (length,) = struct.unpack("<I", _take(file, 4, size, budget))
    return header, length


def _header(data: bytes, budget: Budget) -> dict[bytes, bytes]:
    """The fields of a header; raises _CutOff for what is none, RecordingError where the budget has no time for it."""
    budget.work(len(data) // _HEADER_A_STEP)
    fields: dict[bytes, bytes] = {}
    i = 0
    while i < len(data):
        (length,) = struct.unpack_from("<I", data, i)
        name, mark, value = data[i + 4 : i + 4 + length].partition(b"=")
        if not mark:
            raise _CutOff(f"a field of a record's header is {name!r:.60}; expected name=value")
        fields[name] = value
        i += 4 + length
    return fields


def _index(file: BinaryIO, size: int, reader: _Bag) -> None:
    """Take the connections at the end of a whole bag: those in a damaged chunk are needed by later ones."""
    begin, budget = file.tell(), reader.scan.budget
    header, _ = _record_head(file, size, budget)
    with suppress(*_DAMAGE, _CutOff):
        (start,) = struct.unpack("<Q", header[b"index_pos"])
        file.seek(start if 0 < start < size else size)
        while file.tell() < size:
            header, length = _record_head(file, size, budget)
            if header[b"op"] != bytes([_CONNECTION]):
                break
            reader.connect(header, _take(file, length, size, budget))
    file.seek(begin)


class _Bag:
    """Follows the connections of a ROS 1 bag from record to record."""

    def __init__(self, scan: Scan) -> None:
        self.scan = scan
        self.channels: dict[bytes, Channel] = {}
        self.total = 0

    def record(self, header: dict[bytes, bytes], data: bytes) -> Iterator[Message]:
        self.scan.budget.work(_A_RECORD)
        kind = header.get(b"op", b"\0")[0]
        if kind == _CHUNK:
            yield from self.chunk(header, data, whole=True)
        elif kind == _CONNECTION:
            self.connect(header, data)
        elif kind == _MESSAGE:
            channel = self.channels.get(header[b"conn"])
            self.total += 1
            if channel is not None and self.scan.wanted(channel.topic):
                seconds, nanoseconds = struct.unpack("<II", header[b"time"])
                yield Message(channel, seconds * 10**9 + nanoseconds, None, None, self.total, data)

    def chunk(self, header: dict[bytes, bytes], data: bytes, *, whole: bool) -> Iterator[Message]:
        """The messages of a chunk; of one that was cut off, those before the cut."""
        try:
            (size,) = struct.unpack("<I", header[b"size"])
            inside = _decompress(header[b"compression"].decode(), data, size, self.scan.budget, whole=whole)
            chunk = BytesIO(inside)
            while chunk.tell() < len(inside):
                inner, length = _record_head(chunk, len(inside), self.scan.budget)
                yield from self.record(inner, _take(chunk, length, len(inside), self.scan.budget))
        except InputError:  # a library is missing, or there is more than such a file can hold
            raise
        except (*_DAMAGE, _CutOff):
            self.scan.damaged += whole

    def connect(self, header: dict[bytes, bytes], data: bytes) -> None:
        fields = _header(data, self.scan.budget)
        topic = header.get(b"topic", fields.get(b"topic", b"")).decode()
        name = fields[b"type"].decode()
        name = name if "/msg/" in name else name.replace("/", "/msg/", 1)
        self.channels[header[b"conn"]] = Channel(topic, name, "ros1", fields[b"message_definition"].decode())


# MCAP: records have a kind, a length and data; chunks hold records.

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
                scan.budget.work()
                kind, length = _HEAD.unpack(_take(file, _HEAD.size, size, scan.budget))
                left = size - file.tell()
                if kind in (_FOOTER, _DATA_END):
                    return
                if kind not in (_SCHEMA, _CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK):
                    if length > left:
                        raise _CutOff("it ends in the middle of a record")
                    file.seek(length, 1)
                    continue
                if kind == _MCAP_CHUNK and length > left:
                    yield from reader.chunk(_take(file, min(left, LARGEST), size, scan.budget), whole=False)
                    raise _CutOff("it ends in the middle of a chunk")
                data = _take(file, length, size, scan.budget)
                yield from reader.chunk(data, whole=True) if kind == _MCAP_CHUNK else reader.record(kind, data)
        except _CutOff as error:
            scan.cut_off = str(error)


def _summary(file: BinaryIO, size: int, reader: _Mcap) -> None:
    """Take the schemas and channels at the end of a whole file: those in a damaged chunk are needed by later ones."""
    budget = reader.scan.budget
    begin, tail = file.tell(), 9 + 20 + len(_MAGIC)  # a footer and the magic
    file.seek(max(size - tail, begin))
    footer = file.read(tail)
    if len(footer) == tail and footer.endswith(_MAGIC) and footer[0] == _FOOTER:
        (start,) = struct.unpack_from("<Q", footer, 9)
        with suppress(*_DAMAGE, _CutOff):
            file.seek(start if 0 < start < size else size)
            while file.tell() < size - tail:
                budget.work()
                kind, length = _HEAD.unpack(_take(file, _HEAD.size, size, budget))
                data = _take(file, length, size, budget)
                if kind in (_SCHEMA, _CHANNEL):
                    list(reader.record(kind, data))
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
            inside = _decompress(form, data[i + 8 : i + 8 + length], size, self.scan.budget, whole=whole)
            if whole and checksum and zlib.crc32(inside) != checksum:
                raise ValueError("its checksum does not verify")
            i = 0
            while i + _HEAD.size <= len(inside):
                kind, length = _HEAD.unpack_from(inside, i)
                i += _HEAD.size
                self.scan.budget.work()
                if i + length > len(inside):
                    raise _CutOff("a record ends beyond its chunk")
                yield from self.record(kind, inside[i : i + length])
                i += length
        except InputError:  # a library is missing, or there is more than such a file can hold
            raise
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
    return data[i + 4 : i + 4 + length].decode(errors="replace"), i + 4 + length


# SQLite, as ROS 2 had it before MCAP.

_INSTRUCTIONS, _A_STEP = 20_000, 100  # of SQLite between two looks at their number; and in the time of a step of Python
_TABLES = ("topics", "messages", "message_definitions")
_TABLE = re.compile(r"CREATE TABLE\b", re.IGNORECASE)


def scan_db3(path: Path, scan: Scan, *, compressed: bool = False) -> Iterator[Message]:
    """The messages of a ROS 2 SQLite file, in the order they were written; `compressed`: each by itself, by zstd."""
    import sqlite3

    with ExitStack() as stack:
        budget = scan.budget
        base = stack.enter_context(closing(_connect(_whole_pages(path, scan, stack))))
        _bound(base, budget)
        try:
            channels = _channels(base)
        except sqlite3.DatabaseError as error:
            budget.work(0)
            raise RecordingError(f"{path} cannot be read as a ROS 2 bag, and may be damaged: {error}") from error
        wanted = [number for number, channel in channels.items() if scan.wanted(channel.topic)]
        marks = ",".join("?" * len(wanted))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY id"
        try:
            for number, log, stored in base.execute(query, wanted):
                if not isinstance(stored, bytes) or not isinstance(log, int):
                    scan.damaged += 1
                    continue
                budget.work()
                most = budget.room() + 1
                data = _zstd().ZstdDecompressor().decompress(stored, max_length=most) if compressed else stored
                budget.take(len(data))
                yield Message(channels[number], log, None, None, 0, data)
        except sqlite3.DatabaseError as error:
            budget.work(0)
            scan.cut_off = str(error)


def _bound(base: Any, budget: Budget) -> None:
    """SQLite stops where a query costs more than a file of this size can ask for: a forged one can ask for ever."""
    import sqlite3

    def count() -> bool:
        try:
            budget.work(_INSTRUCTIONS // _A_STEP)
        except RecordingError:
            return True
        return False

    base.set_progress_handler(count, _INSTRUCTIONS)
    base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(LARGEST, budget.room()))
    base.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)


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
    scan.budget.take(size)
    target = Path(stack.enter_context(tempfile.TemporaryDirectory())) / path.name
    shutil.copyfile(path, target)
    os.truncate(target, size - size % page)
    return target


def _connect(path: Path) -> Any:
    import sqlite3

    address = path.resolve().as_uri()
    for mode in ("mode=ro", "mode=ro&immutable=1"):  # a write-ahead log cannot be read where nothing may be written
        base = sqlite3.connect(f"{address}?{mode}", uri=True)
        base.text_factory = lambda data: data.decode(errors="replace")
        try:
            base.execute("PRAGMA trusted_schema=OFF")
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
    tables: set[str] = set()
    for kind, name, sql in base.execute("SELECT type, name, sql FROM sqlite_master"):
        # A view may pose as a table, and a column may be computed or hidden when it is read.
        if str(name).lower() in _TABLES:
            columns = base.execute("SELECT * FROM pragma_table_xinfo(?)", (name,))
            if kind != "table" or not _TABLE.match(str(sql)) or any(hidden for *_, hidden in columns):
                raise RecordingError(f"{name} is no table as a ROS 2 bag has it: {str(sql)!r:.100}")
        tables |= {str(name)} if kind == "table" else set()
    if not {"topics", "messages"} <= tables:
        raise RecordingError(f"expected the tables topics and messages of a ROS 2 bag; there are {sorted(tables)[:20]}")
    definitions = {}
    if "message_definitions" in tables:  # since ROS 2 Iron
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        definitions = {name: (str(text), form == "ros2idl") for name, form, text in base.execute(query)}
    return {
        number: Channel(str(topic), str(name), str(form), *definitions.get(name, ("", False)))
        for number, topic, name, form in base.execute("SELECT id, name, type, serialization_format FROM topics")
    }
