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
            yield from (_Bag if name.endswith(".bag") else _Mcap)(self).scanned()

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


# MCAP and ROS 1: records after records; chunks hold records.

_HEAD, _MESSAGE, _CHUNK = struct.Struct("<BQ"), struct.Struct("<HIQQ"), struct.Struct("<QQQI")


class _Mcap:
    """Walks from record to record, in a file and in its chunks: a kind, a length, and data. `_Bag` does so in ROS 1's.

    closed: whether the file was closed by its recorder.
    """

    begin, chunk = b"\x89MCAP0\r\n", 6
    kinds: tuple[int, ...] = (3, 4, 5)  # schemas, channels and messages

    def __init__(self, scan: Scan) -> None:
        self.scan, self.closed, self.total = scan, False, 0
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, tuple[str, str, str]] = {}
        self.seen: dict[int, int] = {}

    def scanned(self) -> Iterator[Message]:
        """The messages of the file."""
        with self.scan.opened(self.begin) as file:
            if index := self.index(file):  # a damaged chunk may hold channels that are needed by later ones
                file.seek(index)
                for _ in self.messages(file):
                    pass
            file.seek(len(self.begin))
            whole = yield from self.messages(file)
            if not (whole and self.closed):
                self.scan.cut_off = "its recorder did not close it" if whole else "it ends in the middle of a record"

    def messages(self, file: BinaryIO) -> Generator[Message, None, bool]:
        """Those from here on; returns whether the last record is whole."""
        while (found := self.head(file)) is not None:
            kind, header, length = found
            if kind != self.chunk and kind not in self.kinds:
                file.seek(min(length, self.scan.room), os.SEEK_CUR)
                continue
            data = file.read(min(length, self.scan.room))
            whole = len(data) == length
            if kind == self.chunk:
                try:
                    yield from self.messages(BytesIO(self.inside(data, whole=whole)))
                except InputError:  # a library is missing, or the chunk claims too much
                    raise
                except Exception:  # whatever damage does to decompressors and parsers
                    self.scan.damaged += whole
            elif whole and (message := self.record(kind, header, data)) is not None:
                yield message
            if not whole:
                return False
        return True

    def index(self, file: BinaryIO) -> int:
        """Where channels are told once more, at the end of a file that was closed; 0 where they are not."""
        file.seek(max(self.scan.size - 37, 0))  # a footer, and the letters of the beginning
        footer = file.read()
        return int.from_bytes(footer[9:17], "little") if footer[:1] == b"\2" and footer.endswith(self.begin) else 0

    def head(self, file: BinaryIO) -> tuple[int, Any, int] | None:
        """A record's kind, its header, and how many bytes follow; None where there is no further one."""
        if len(head := file.read(_HEAD.size)) < _HEAD.size:
            return None
        kind, length = _HEAD.unpack(head)
        if kind in (2, 15):  # a footer, or the end of data
            self.closed = True
            return None
        return kind, None, length

    def inside(self, data: bytes, *, whole: bool) -> bytes:
        """The records in a chunk; of one that was cut off, those before the cut, which no checksum verifies."""
        _, _, size, checksum = _CHUNK.unpack_from(data)
        form, i = _text(data, _CHUNK.size)
        if form not in ("", "zstd", "lz4"):
            raise RecordingError(f"chunks are compressed as {form!r}; expected lz4 or zstd")
        found = inflated(data[i + 8 :], self.scan.room, size)
        if whole and (len(found) != size or (checksum and zlib.crc32(found) != checksum)):
            raise ValueError("its length or checksum is another")
        return found

    def record(self, kind: int, _: Any, data: bytes) -> Message | None:
        """The message in a record, if there is one and it is wanted."""
        if kind == 5:
            number, sequence, log, publish = _MESSAGE.unpack_from(data)
            channel = self.channels.get(number)
            self.total += 1
            if channel is not None and self.scan.wanted(channel.topic):
                seen = self.seen[number] = self.seen.get(number, 0) + 1
                return Message(channel, log, publish, sequence, self.total - seen, data[_MESSAGE.size :])
        elif kind == 3:
            name, i = _text(data, 2)
            form, i = _text(data, i)
            self.schemas[int.from_bytes(data[:2], "little")] = (name, form, _text(data, i)[0])
        else:
            number, schema = struct.unpack_from("<HH", data)
            name, form, definition = self.schemas.get(schema, ("", "", ""))
            topic, i = _text(data, 4)
            encoding, _ = _text(data, i)
            self.channels[number] = Channel(topic, _ros2(name), encoding, definition, form in ("ros2idl", "omgidl"))
        return None


class _Bag(_Mcap):
    """The same of ROS 1: a record has a header of fields, which rosbags reads."""

    begin, chunk = b"#ROSBAG V2.0\n", 5
    kinds = (2, 7)  # messages and connections

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        with optional("rosbags", "ros", "a ROS recording"):
            from rosbags.rosbag1 import reader
        self.ros: Any = reader

    def index(self, file: BinaryIO) -> int:
        with suppress(self.ros.ReaderError):
            found: int = self.ros.Header.read(file).get_uint64("index_pos")
            self.closed = 0 < found < self.scan.size
        return found if self.closed else 0

    def head(self, file: BinaryIO) -> tuple[int, Any, int] | None:
        try:
            header = self.ros.Header.read(file)
            return header.get_uint8("op"), header, self.ros.read_uint32(file)
        except self.ros.ReaderError:  # of the end, and of what is none
            return None

    def inside(self, data: bytes, *, whole: bool) -> bytes:
        return inflated(data, self.scan.room)

    def record(self, kind: int, header: Any, data: bytes) -> Message | None:
        number = header.get_uint32("conn")
        if kind == 7:
            about = self.ros.Header.read(BytesIO(struct.pack("<I", len(data)) + data))
            kinds = _ros2(about.get_string("type")), "ros1", about.get_string("message_definition")
            self.channels[number] = Channel(header.get_string("topic"), *kinds)
        elif (channel := self.channels.get(number)) is not None and self.scan.wanted(channel.topic):
            return Message(channel, header.get_time("time"), None, None, 0, data)
        return None


def _ros2(name: str) -> str:
    """The name of a type of ROS 1, as ROS 2 has them."""
    return name.replace("/", "/msg/", 1) if name.count("/") == 1 else name


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
        base = sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True, timeout=1)
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
