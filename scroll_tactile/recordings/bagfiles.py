"""Messages out of the files of ROS, in the order they were written: `.bag`, `.mcap` and `.db3`.

rosbags goes by an index at a file's end, and of a file that a power cut ended it has nothing. So `.bag` and `.mcap` are
read from their beginning, record by record, and give each whole message; SQLite reads `.db3`.
"""

from __future__ import annotations

import bz2
import os
import shutil
import struct
import sys
import tempfile
import zlib
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from scroll_tactile.errors import InputError, RecordingError
from scroll_tactile.libraries import optional
from scroll_tactile.recordings.bounds import RATIO, SPARE, on_disk, require_file

__all__ = ["ZSTD", "Channel", "Message", "Scan", "inflated"]

ZSTD, _LZ4, _BZIP2 = b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18", b"BZh"
"""What anything begins with that was compressed so."""


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
    """The messages of one file, and how reading it went.

    wanted: whether messages of a topic are wanted; those of others are passed over. room: how many bytes a chunk or a
    message may claim to be. cut_off: why the file ends before its end. damaged: how many chunks could not be read.

    Raises RecordingError for what is no file, and for one that is little but a hole.
    """

    def __init__(self, path: Path, wanted: Callable[[str], bool]) -> None:
        about = require_file(path)
        self.path, self.size, self.wanted = path, about.st_size, wanted
        self.cut_off: str | None = None
        self.damaged = 0
        self.room = SPARE + RATIO * on_disk(about)
        if self.size > self.room:
            raise RecordingError(f"{path} claims {self.size} bytes, of which {on_disk(about)} are there: copy it again")

    def messages(self) -> Iterator[Message]:
        """Raises RecordingError for a file that does not begin as its name says, or claims more than it can hold."""
        name = self.path.name.lower().removesuffix(".active")
        if name.endswith(".zstd"):
            with tempfile.TemporaryDirectory() as folder:
                inside = Scan(_unzipped(self, Path(folder)), self.wanted)
                yield from inside.messages()
            self.cut_off, self.damaged = inside.cut_off, inside.damaged
        elif name.endswith(".db3"):
            yield from _scan_db3(self)
        else:
            yield from _scan_bag(self) if name.endswith(".bag") else _scan_mcap(self)

    def opened(self, begin: bytes) -> BinaryIO:
        """The file behind these bytes, with which it has to begin."""
        file = self.path.open("rb")
        if (found := file.read(len(begin))) == begin:
            return file
        file.close()
        why = "it ends within that" if found and begin.startswith(found) else f"{found!r}" if found else "it is empty"
        raise RecordingError(f"{self.path} does not begin as a {self.path.suffix} file does, with {begin!r}: {why}")


def inflated(data: bytes, most: int, size: int | None = None) -> bytes:
    """`data` decompressed, if it begins as Zstandard, LZ4 or bzip2 does; of what was cut off, as much as is there.

    Raises RecordingError where it is more than `most` bytes, or claims a size beyond; MissingLibraryError.
    """
    found = data
    if size is None or size <= most:
        if data.startswith(ZSTD):
            found = _zstd().ZstdDecompressor().decompress(data, max_length=most + 1)
        elif data.startswith(_LZ4):
            with optional("lz4", "ros", "a file compressed by lz4"):  # comes with rosbags
                from lz4.frame import LZ4FrameDecompressor
            found = LZ4FrameDecompressor().decompress(data, max_length=most + 1)
        elif data.startswith(_BZIP2):
            found = bz2.BZ2Decompressor().decompress(data, max_length=most + 1)
        if len(found) <= most:
            return found
    raise RecordingError(
        f"a chunk or message claims to have more than {most} bytes, too many for a file of this size: it may be "
        "damaged. If it is not, write it with less compression, or in parts"
    )


def _zstd() -> Any:
    with optional("backports.zstd", "ros", "a file compressed by zstd"):  # comes with rosbags
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd
    return zstd


def _unzipped(scan: Scan, folder: Path) -> Path:
    """A file that was compressed whole, as it was before, in `folder`."""
    target = folder / scan.path.stem
    with scan.opened(ZSTD) as file, target.open("wb") as sink:
        file.seek(0)
        source = _zstd().open(file, "rb")
        with suppress(EOFError):  # of what was cut off
            while part := source.read(1 << 20):
                if sink.tell() > scan.room:
                    raise RecordingError(f"{scan.path} becomes more than {scan.room} bytes: decompress it yourself")
                sink.write(part)
    return target


# ROS 1: records have a header of fields and data; chunks hold records. rosbags knows what is in them.

_BAG = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7


def _scan_bag(scan: Scan) -> Iterator[Message]:
    with optional("rosbags", "ros", "a ROS recording"):
        from rosbags.rosbag1.reader import Header, Reader, ReaderError, read_uint32
    bag, channels = Reader(scan.path), dict[int, Channel]()
    with scan.opened(_BAG) as bag.bio:
        file = bag.bio
        try:
            header, length = Header.read(file), read_uint32(file)
            begin, index = file.tell() + length, header.get_uint64("index_pos")
            scan.cut_off = None if index else "its recorder did not close it"
            with suppress(Exception):  # of an index that is not there: what is in it is in the chunks, too
                file.seek(index or scan.size)
                for _ in range(header.get_uint32("conn_count")):
                    _connect(bag, channels)
            file.seek(begin)
            while file.tell() < scan.size:
                header, length = Header.read(file), read_uint32(file)
                left = scan.size - file.tell()
                if header.get_uint8("op") == _CHUNK:
                    yield from _in_chunk(bag, channels, file.read(length), scan, whole=length <= left)
                else:
                    file.seek(length, os.SEEK_CUR)
                if length > left:
                    raise ReaderError("it ends in the middle of a record")
        except ReaderError as error:
            scan.cut_off = str(error)


def _connect(bag: Any, channels: dict[int, Channel]) -> None:
    each = bag.read_connection()
    channels[each.id] = Channel(each.topic, each.msgtype, "ros1", each.msgdef.data)


def _in_chunk(bag: Any, channels: dict[int, Channel], data: bytes, scan: Scan, *, whole: bool) -> Iterator[Message]:
    """The messages of a chunk; of one that was cut off, those before the cut."""
    from rosbags.rosbag1.reader import Header, read_bytes, read_uint32

    file = bag.bio
    try:
        bag.bio = chunk = BytesIO(inside := inflated(data, scan.room))
        while (begin := chunk.tell()) < len(inside):
            header, length = Header.read(chunk), read_uint32(chunk)
            kind, end = header.get_uint8("op"), chunk.tell() + length
            if kind == _CONNECTION:
                chunk.seek(begin)
                _connect(bag, channels)
            elif kind == _MESSAGE:
                channel = channels.get(header.get_uint32("conn"))
                if channel is not None and scan.wanted(channel.topic):
                    yield Message(channel, header.get_time("time"), None, None, 0, read_bytes(chunk, length))
            chunk.seek(end)
    except InputError:  # a library is missing, or the chunk claims too much
        raise
    except Exception:  # whatever damage does to decompressors and parsers
        scan.damaged += whole
    finally:
        bag.bio = file


# MCAP: records have a kind, a length and data; chunks hold records.

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK, _DATA_END = 2, 3, 4, 5, 6, 15
_HEAD, _MCAP_HEAD, _CHUNK_HEAD = struct.Struct("<BQ"), struct.Struct("<HIQQ"), struct.Struct("<QQQI")


def _scan_mcap(scan: Scan) -> Iterator[Message]:
    reader = _Mcap(scan)
    with scan.opened(_MAGIC) as file:
        # Schemas and channels stand at a whole file's end again: those in a damaged chunk are needed by later ones.
        file.seek(max(scan.size - 37, 0))
        if (footer := file.read()).endswith(_MAGIC) and footer[0] == _FOOTER:
            file.seek(int.from_bytes(footer[9:17], "little") or scan.size)
            for _ in reader.records(file):
                pass
        file.seek(len(_MAGIC))
        if not (yield from reader.records(file)):
            scan.cut_off = "it ends before its end, or in the middle of a record"


class _Mcap:
    """Follows the schemas and channels of an MCAP file from record to record."""

    def __init__(self, scan: Scan) -> None:
        self.scan = scan
        self.schemas: dict[int, tuple[str, str, str]] = {}
        self.channels: dict[int, Channel] = {}
        self.others: dict[int, int] = {}
        self.total = 0

    def records(self, file: BinaryIO) -> Generator[Message, None, bool]:
        """The messages from here on; returns whether they end with an end."""
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            kind, length = _HEAD.unpack(head)
            if kind in (_FOOTER, _DATA_END):
                return True
            most = min(length, self.scan.room)
            if kind not in (_SCHEMA, _CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK):
                file.seek(most, os.SEEK_CUR)
                continue
            data = file.read(most)
            if kind == _MCAP_CHUNK:
                yield from self._chunk(data, whole=len(data) == length)
            elif len(data) == length and (message := self._record(kind, data)) is not None:
                yield message
        return False

    def _chunk(self, data: bytes, *, whole: bool) -> Iterator[Message]:
        """The messages of a chunk; of one that was cut off, those before the cut, which no checksum verifies."""
        try:
            _, _, size, checksum = _CHUNK_HEAD.unpack_from(data)
            form, i = _text(data, _CHUNK_HEAD.size)
            if form not in ("", "zstd", "lz4"):
                raise RecordingError(f"chunks are compressed as {form!r}; expected lz4 or zstd")
            inside = inflated(data[i + 8 :], self.scan.room, size)
            if whole and (len(inside) != size or (checksum and zlib.crc32(inside) != checksum)):
                raise ValueError("its length or checksum is another")
            yield from self.records(BytesIO(inside))
        except InputError:  # a library is missing, or the chunk claims too much
            raise
        except Exception:  # whatever damage does to decompressors and parsers
            self.scan.damaged += whole

    def _record(self, kind: int, data: bytes) -> Message | None:
        if kind == _MCAP_MESSAGE:
            number, sequence, log, publish = _MCAP_HEAD.unpack_from(data)
            channel = self.channels.get(number)
            self.total += 1
            if channel is not None and self.scan.wanted(channel.topic):
                seen = self.others[number] = self.others.get(number, 0) + 1
                return Message(channel, log, publish, sequence, self.total - seen, data[_MCAP_HEAD.size :])
        elif kind == _SCHEMA:
            name, i = _text(data, 2)
            form, i = _text(data, i)
            self.schemas[int.from_bytes(data[:2], "little")] = (name, form, _text(data, i)[0])
        else:
            number, schema = struct.unpack_from("<HH", data)
            name, form, definition = self.schemas.get(schema, ("", "", ""))
            topic, i = _text(data, 4)
            encoding, _ = _text(data, i)
            name = name if encoding != "ros1" or "/msg/" in name else name.replace("/", "/msg/", 1)
            self.channels[number] = Channel(topic, name, encoding, definition, form in ("ros2idl", "omgidl"))
        return None


def _text(data: bytes, i: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", data, i)
    return data[i + 4 : i + 4 + length].decode(errors="replace"), i + 4 + length


# SQLite, as ROS 2 had it before MCAP.

_SQLITE = b"SQLite format 3\0"


def _scan_db3(scan: Scan) -> Iterator[Message]:
    import sqlite3

    with tempfile.TemporaryDirectory() as folder, closing(_database(_whole_pages(scan, Path(folder)))) as base:
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(scan.room, 2**31 - 1))
        try:
            channels = _channels(base)
        except sqlite3.DatabaseError as error:
            raise RecordingError(f"{scan.path} cannot be read as a ROS 2 bag, and may be damaged: {error}") from error
        wanted = ",".join(str(number) for number, channel in channels.items() if scan.wanted(channel.topic))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({wanted}) ORDER BY id"
        try:
            for number, log, data in base.execute(query):
                if isinstance(data, bytes) and isinstance(log, int):
                    yield Message(channels[number], log, None, None, 0, data)
                else:
                    scan.damaged += 1
        except sqlite3.DatabaseError as error:
            scan.cut_off = str(error)


def _whole_pages(scan: Scan, folder: Path) -> Path:
    """A file that ends inside a page without that page, as a copy: SQLite would read zeros for what is missing."""
    with scan.opened(_SQLITE) as file:
        page = int.from_bytes(file.read(2), "big")
    rest = scan.size % (65536 if page == 1 else max(page, 1))
    if not rest:
        return scan.path
    scan.cut_off = "it ends in the middle of a page"
    shutil.copyfile(scan.path, folder / scan.path.name)
    os.truncate(folder / scan.path.name, scan.size - rest)
    return folder / scan.path.name


def _database(path: Path) -> Any:
    import sqlite3

    why: Exception | None = None
    for mode in ("mode=ro", "mode=ro&immutable=1"):  # a write-ahead log cannot be read where nothing may be written
        base = sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True)
        base.text_factory = lambda data: data.decode(errors="replace")
        try:
            base.execute("PRAGMA trusted_schema=OFF")
            base.execute("PRAGMA writable_schema=ON")  # otherwise SQLite gives nothing of a file that was cut off
            base.execute("SELECT 1 FROM sqlite_master").fetchone()
            return base
        except sqlite3.DatabaseError as error:
            base.close()
            why = error
    raise RecordingError(f"{path} cannot be read as a ROS 2 bag: is it being written, or damaged? ({why})") from why


def _channels(base: Any) -> dict[int, Channel]:
    tables = {name for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if not {"topics", "messages"} <= tables:
        there = sorted(map(str, tables))[:20]
        raise RecordingError(f"expected the tables topics and messages of a ROS 2 bag; there are {there}")
    definitions = {}
    if "message_definitions" in tables:  # since ROS 2 Iron
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        definitions = {name: (str(text), form == "ros2idl") for name, form, text in base.execute(query)}
    return {
        int(number): Channel(str(topic), str(name), str(form), *definitions.get(name, ("", False)))
        for number, topic, name, form in base.execute("SELECT id, name, type, serialization_format FROM topics")
    }
