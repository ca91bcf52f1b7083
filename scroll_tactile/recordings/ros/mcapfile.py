"""Messages out of MCAP files, whole or cut off, in the order they were written."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from scroll_tactile.errors import InputError, RecordingError
from scroll_tactile.recordings.bounds import LARGEST, Budget
from scroll_tactile.recordings.ros.bagfiles import DAMAGE, Channel, CutOff, Message, Scan, decompress, holes_of, take

__all__ = ["scan_mcap"]

# Records have a kind, a length and data; chunks hold records.

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
        reader, holes = _Mcap(scan), holes_of(file, scan.budget)
        _summary(file, size, reader, holes)
        try:
            while True:
                scan.budget.work()
                kind, length = _HEAD.unpack(take(file, _HEAD.size, size - file.tell()))
                if kind in (_FOOTER, _DATA_END):
                    return
                if kind not in (_SCHEMA, _CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK):
                    if length > size - file.tell():
                        raise CutOff("it ends in the middle of a record")
                    file.seek(length, 1)
                    continue
                left = size - file.tell()
                if kind == _MCAP_CHUNK and length > left:
                    left = min(left, LARGEST)
                    yield from reader.chunk(take(file, left, left, holes), whole=False)
                    raise CutOff("it ends in the middle of a chunk")
                data = take(file, length, left, holes)
                yield from reader.chunk(data, whole=True) if kind == _MCAP_CHUNK else reader.record(kind, data)
        except CutOff as error:
            scan.cut_off = str(error)


def _summary(file: BinaryIO, size: int, reader: _Mcap, holes: Budget | None) -> None:
    """Take the schemas and channels at the end of a whole file: those in a damaged chunk are needed by later ones."""
    begin, tail = file.tell(), 9 + 20 + len(_MAGIC)  # a footer and the magic
    file.seek(max(size - tail, begin))
    footer = file.read(tail)
    if len(footer) == tail and footer.endswith(_MAGIC) and footer[0] == _FOOTER:
        (start,) = struct.unpack_from("<Q", footer, 9)
        with suppress(*DAMAGE, CutOff):
            file.seek(start if 0 < start < size else size)
            while file.tell() < size - tail:
                reader.scan.budget.work()
                kind, length = _HEAD.unpack(take(file, _HEAD.size, size - file.tell()))
                data = take(file, length, size - file.tell(), holes)
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
            inside = decompress(form, data[i + 8 : i + 8 + length], size, self.scan.budget, whole=whole)
            if whole and checksum and zlib.crc32(inside) != checksum:
                raise ValueError("its checksum does not verify")
            i = 0
            while i + _HEAD.size <= len(inside):
                kind, length = _HEAD.unpack_from(inside, i)
                i += _HEAD.size
                self.scan.budget.work()
                if i + length > len(inside):
                    raise CutOff("a record ends beyond its chunk")
                yield from self.record(kind, inside[i : i + length])
                i += length
        except InputError:  # a library is missing, or there is more than such a file can hold
            raise
        except (*DAMAGE, CutOff):
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
