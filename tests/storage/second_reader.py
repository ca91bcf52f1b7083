"""A second reader of a store, written from store/FORMAT.md alone: `python tests/storage/second_reader.py LOG`.

It reads a whole file into memory, imports nothing of the store, and prints the rows.
"""

import json
import math
import struct
import sys
from collections import namedtuple
from hashlib import blake2b, sha256
from pathlib import Path

import numpy as np
import zarr
from numcodecs import zstd

HEAD = struct.Struct("<8s8sQQII16s16s16s")
ROW = struct.Struct("<QdQBBIII")
MARK = b"\x89ARLOG\x01\n"
COMMIT, ROW_KIND = 1, 2


class Damaged(Exception):
    """`number` is that of the first damaged frame, at byte `offset`."""

    def __init__(self, number, offset):
        super().__init__(f"frame {number} at byte {offset} is damaged")
        self.number, self.offset = number, offset


class Frame(namedtuple("Frame", "offset mark identity number batch kind size previous digest checksum")):
    @property
    def end(self):
        return self.offset + HEAD.size + self.size


Row = namedtuple("Row", "sequence time key kind label attributes arrays size")


def digest(data):
    return blake2b(data, digest_size=16).digest()


def frame_at(data, offset):
    """The frame whose first 88 bytes are right, or None."""
    if len(data) < offset + HEAD.size:
        return None
    frame = Frame(offset, *HEAD.unpack_from(data, offset))
    return frame if digest(data[offset : offset + 72]) == frame.checksum else None


def header(data):
    frame = frame_at(data, 0)
    if frame is None or frame.mark[:6] != MARK[:6]:
        raise Damaged(0, 0)
    if frame.mark[6] > MARK[6]:
        raise ValueError(f"format {frame.mark[6]} is newer")
    payload = data[HEAD.size : frame.end]
    if (frame.number, frame.batch, frame.kind) != (0, 0, 0) or digest(payload) != frame.digest:
        raise Damaged(0, 0)
    return frame, payload


def can_be_torn(frame, offset, number, batch, previous):
    if frame.batch != batch:
        return False
    if frame.number == number:
        return frame.offset == offset and frame.previous == previous
    return frame.number > number and frame.offset >= offset + HEAD.size * (frame.number - number)


def frames(data):
    """The header's payload, the frames of whole batches, or those before damage, and the damage."""
    before, about = header(data)
    mark = MARK + before.identity
    whole, batch, first = [], [], 1
    while True:
        offset, number = before.end, before.number + 1
        frame = frame_at(data, offset)
        holds = (
            frame is not None
            and frame.mark + frame.identity == mark
            and (frame.number, frame.batch, frame.previous) == (number, first, before.checksum)
            and frame.end <= len(data)
            and digest(data[frame.offset + HEAD.size : frame.end]) == frame.digest
        )
        if not holds:
            break
        batch.append(frame)
        if frame.kind == COMMIT:
            whole, batch, first = whole + batch, [], number + 1
        before = frame
    at = data.find(mark, offset)
    while at >= 0:
        found = frame_at(data, at)
        if found is not None and not can_be_torn(found, offset, number, first, before.checksum):
            return about, whole + batch, Damaged(number, offset)
        at = data.find(mark, at + 1)
    return about, whole, None


def row(payload):
    sequence, time, size, kept, *lengths = ROW.unpack_from(payload)
    parts, at = [], ROW.size + 16
    for length in lengths:
        parts.append(payload[at : at + length])
        at += length
    key, kind, label, attributes = parts
    assert sequence >= 1 and math.isfinite(time) and len(key) <= 64
    assert len(payload) == at + (size if kept else 0)
    assert digest(payload[: ROW.size] + b"".join(parts)) == payload[ROW.size : ROW.size + 16]
    arrays = payload[at:] if kept else None
    return Row(sequence, time, key, kind.decode(), label.decode(), json.loads(attributes), arrays, size)


def rows(data):
    """What the header says, the rows, and the damage behind them or None."""
    about, whole, damage = frames(data)
    payloads = (data[frame.offset + HEAD.size : frame.end] for frame in whole if frame.kind == ROW_KIND)
    return about, [row(payload) for payload in payloads], damage


def arrays(payload):
    """The arrays of a row, by name."""
    at = 4 + int.from_bytes(payload[:4], "little")
    found = {}
    for name, (dtype, shape, stored) in json.loads(payload[4:at]).items():
        data = payload[at : at + stored]
        at += stored
        if stored != math.prod(shape) * np.dtype(dtype).itemsize:
            data = zstd.decompress(data)
        found[name] = np.frombuffer(data, dtype).reshape(shape)
    assert at == len(payload)
    return found


def checkpoint(folder):
    """What a checkpoint says of itself, verified, and its arrays, by name."""
    group = zarr.open_group(folder, mode="r")
    known = dict(group.attrs)
    right = known.pop("sha256")
    text = json.dumps(known, sort_keys=True, separators=(",", ":"))
    assert sha256(text.encode()).hexdigest() == right
    assert all(sha256(Path(folder, file).read_bytes()).hexdigest() == one for file, one in known["files"].items())
    return known, {name: np.asarray(array[...]) for name, array in group.arrays()}


if __name__ == "__main__":
    said, found, wrong = rows(Path(sys.argv[1]).read_bytes())
    print(said.decode())
    for each in found:
        print(each.sequence, each.kind, each.label, each.key.hex(), each.time, each.attributes, each.size)
    sys.exit(str(wrong) if wrong else 0)
