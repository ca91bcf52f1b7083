"""Stores to be harmed, how to harm them, and what they must hold; shared by the tests of this folder."""

import hashlib
import json
import shutil
import struct
from dataclasses import replace

import numpy as np

from store import Store, check_store
from store.framing import COMMIT, HEADER, NO_CHECKSUM, pack_frame
from store.layout import checkpoint_path, log_path, read_current, write_current
from store.log import LogReader, Place
from store.row_encoding import ROW, encode_row
from store.rows import Rows

LAST = 20
IDENTITY = {"for": ["tests", 1]}


def values(number):
    """The array of a row: of two lengths, so that some heads are read with their arrays and some are not."""
    return np.random.default_rng(number).integers(0, 2**40, 900 if number % 5 == 0 else 200)


def state(last_sequence):
    """The arrays of a checkpoint."""
    rows = np.arange(400.0).reshape(100, 4) + last_sequence
    return {"sum": np.array(last_sequence), "rows": rows, "names": np.array([f"to {last_sequence}", "é"])}


def add(opened, number):
    return opened.append(
        "a", f"row {number}", bytes([number % 256]), arrays={"x": values(number)}, attributes={"n": number}
    )


def commit(call, last_sequence, **options):
    return call(state(last_sequence), last_sequence=last_sequence, attributes={"n": last_sequence}, **options)


def build(path, *, compacted=False, last=LAST):
    """Twenty rows, a checkpoint up to row 15, and, where compacted, a compaction checkpoint up to row 6 beside it."""
    with Store.open(path, identity=IDENTITY) as opened:
        for number in range(1, last + 1):
            add(opened, number)
            if number == 15:
                if compacted:
                    commit(opened.compact, 6, newest=(state(15), {"n": 15}))
                else:
                    commit(opened.commit, 15)
    return path


def as_after_a_crash(opened, copy):
    """Copy an open store as its process would leave it if it died now."""
    return shutil.copytree(opened.path, copy, ignore=shutil.ignore_patterns("lock", "holder.json"))


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def folders(path):
    return sorted(entry.name for entry in (path / "checkpoints").iterdir())


def log_of(path):
    return log_path(path, read_current(path / "CURRENT").log)


def newest(path):
    return checkpoint_path(path, read_current(path / "CURRENT").newest.number)


def compaction(path):
    return checkpoint_path(path, read_current(path / "CURRENT").compaction.number)


def flip(file, place=-9, bit=2):
    data = bytearray(file.read_bytes())
    data[place] ^= 1 << bit
    file.write_bytes(data)


def spoil(folder):
    """Damage a checkpoint's rows."""
    flip(folder / "rows" / "c" / "0" / "0")


def frames(path):
    """The frames of the rows that verify, by sequence."""
    with LogReader(log_of(path)) as log:
        found = Rows()
        for _ in found.take(log):
            pass
        places = zip(found.offsets, found.sizes, strict=True)
        return {number: log.read(*place)[0] for number, place in zip(found.sequences, places, strict=True)}


def rows(path):
    """The bytes of the rows, by sequence."""
    with LogReader(log_of(path)) as log:
        return {number: log.read(frame.offset, frame.size)[1] for number, frame in frames(path).items()}


def flip_row(path, number, *, arrays=False):
    """Damage a row's frame, or no more than its arrays."""
    frame = frames(path)[number]
    flip(log_of(path), frame.end - 9 if arrays else frame.payload_offset + 4)


def write_log(path, payloads, *, header=None, kind=ROW):
    """Write the log anew, each of these payloads in a batch of its own, with right checksums and right places."""
    file, current = log_of(path), read_current(path / "CURRENT")
    with LogReader(file) as log:
        identity, header = log.identity, log.header if header is None else header
    data, frame = pack_frame(identity, 0, 0, 0, HEADER, header, NO_CHECKSUM)
    places = [(0, Place.behind(frame))]
    for payload in payloads:
        number = frame.number + 1
        part, frame = pack_frame(identity, frame.end, number, number, kind, payload, frame.checksum)
        end, frame = pack_frame(identity, frame.end, number + 1, number, COMMIT, b"", frame.checksum)
        data += part + end
        places.append((struct.unpack_from("<Q", payload.ljust(8, b"\0"))[0], Place.behind(frame)))
    file.write_bytes(data)

    def placed(named):
        at = 0
        while named and at + 1 < len(places) and places[at + 1][0] <= named.last_sequence:
            at += 1
        return named and replace(named, place=places[at][1])

    write_current(path, replace(current, newest=placed(current.newest), compaction=placed(current.compaction)))


def change_rows(path, change):
    """Change the bytes of the rows, a dictionary by sequence; all checksums are right."""
    found = rows(path)
    change(found)
    write_log(path, found.values())


def lose_rows(path, *numbers):
    """Take rows out, as nothing that damages a disk does: what is left verifies."""
    change_rows(path, lambda found: [found.pop(number) for number in numbers])


def cut_rows(path, first):
    """Cut the log off before a row."""
    file = log_of(path)
    file.write_bytes(file.read_bytes()[: frames(path)[first].offset])


def put_row(path, *, sequence=None, payload=b"ARPL\x01\0\0", size=None, **changed):
    """Add a row with right checksums, of any fields; return its sequence."""
    found = rows(path)
    sequence = max(found, default=0) + 1 if sequence is None else sequence
    row = {"kind": "a", "label": "b", "key": b"", "time": 1.0, "attributes": "{}"} | changed
    data = encode_row(sequence, *row.values(), payload, len(payload) if size is None else size)
    write_log(path, [*found.values(), data])
    return sequence


def known_current(path):
    known = json.loads((path / "CURRENT").read_text())
    del known["sha256"]
    return known


def put_current(path, **changes):
    """Change what `CURRENT` says, with the right sha256."""
    known = known_current(path) | changes
    text = json.dumps(known, sort_keys=True, separators=(",", ":"))
    digest = hashlib.sha256(text.encode("ascii")).hexdigest()
    (path / "CURRENT").write_text(json.dumps(known | {"sha256": digest}))


def torn(path, cut):
    """Cut the log off at a byte, as a power cut may."""
    file = log_of(path)
    file.write_bytes(file.read_bytes()[:cut])


def damage(path):
    return [problem for problem in check_store(path) if problem.kind != "leftover"]


def same_arrays(found, given):
    return {name: (array.dtype, array.shape, array.tobytes()) for name, array in found.items()} == {
        name: (array.dtype, array.shape, array.tobytes()) for name, array in given.items()
    }
