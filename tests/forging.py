"""Rows, identities and checkpoints with right checksums, such as anyone can make: nothing in a checksum is secret."""

from __future__ import annotations

import hashlib
import json
import shutil
import struct
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from quick_checkpoints import array_about
from scroll_tactile_store import Store
from scroll_tactile_store.encoding import check_arrays, encode_payload
from scroll_tactile_store.framing import COMMIT, HEADER, Frame, LogPlace, pack_frame
from scroll_tactile_store.layout import CURRENT_FILE, checkpoint_path, log_path
from scroll_tactile_store.log import BEGIN, Log, refuse
from scroll_tactile_store.records import payload_digest
from scroll_tactile_store.rows import FIELDS, HEAD_BYTES, ROW, decode_row, row_sequence

LENGTH = struct.Struct("<I")


def as_text(value: Any) -> str:
    """JSON as the store writes it; a text is taken to be JSON, or meant to be none."""
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True, separators=(",", ":"))


def sealed(known: Mapping[str, Any]) -> dict[str, Any]:
    """What `CURRENT`, or a checkpoint's group, says, with the sha256 of it."""
    known = {name: value for name, value in known.items() if name != "sha256"}
    return {**known, "sha256": hashlib.sha256(as_text(known).encode("ascii")).hexdigest()}


def get_current(path: Path) -> dict[str, Any]:
    """What `CURRENT` says."""
    return dict(json.loads((path / CURRENT_FILE).read_text(encoding="ascii")))


def set_current(path: Path, **changes: Any) -> None:
    """Have `CURRENT` say other things, with the right sha256."""
    (path / CURRENT_FILE).write_text(as_text(sealed(get_current(path) | changes)) + "\n", encoding="ascii")


def log_of(path: Path) -> Path:
    """The log that `CURRENT` names."""
    return log_path(path, get_current(path)["log"][0])


def read_log(path: Path) -> tuple[bytes, list[bytes]]:
    """The payload of a store's first frame, and the bytes of each of its rows."""
    with Log(log_of(path)) as log:
        frames = [frame for batch in log.scan(refuse) for frame in batch if frame.kind == ROW]
        return log.header, [log.read(frame.offset, frame.size) for frame in frames]


def log_bytes(
    identity: bytes, header: bytes, batches: Iterable[Sequence[tuple[int, bytes]]]
) -> tuple[bytes, list[LogPlace]]:
    """The bytes of a log, and the place behind its first frame and behind each batch of kinds and payloads."""
    data, frame = pack_frame(identity, BEGIN, HEADER, header)
    parts, places, at = [data], [LogPlace.behind(frame)], LogPlace.behind(frame)
    for batch in batches:
        for kind, payload in [*batch, (COMMIT, b"")]:
            data, frame = pack_frame(identity, at, kind, payload)
            parts.append(data)
            at = LogPlace.behind(frame)
        places.append(at)
    return b"".join(parts), places


def write_log(path: Path, rows: Sequence[bytes], header: bytes | None = None) -> None:
    """Put a log of these rows, each in a batch of its own, in the place of the one there is.

    `CURRENT` then names the checkpoints' places in it.
    """
    current = get_current(path)
    header = read_log(path)[0] if header is None else header
    data, places = log_bytes(bytes.fromhex(current["log"][1]), header, [[(ROW, row)] for row in rows])
    log_of(path).write_bytes(data)
    sequences = [int.from_bytes(row[:8], "little") for row in rows]
    for named in filter(None, (current["newest"], current["compaction"])):
        behind = [i for i, sequence in enumerate(sequences) if sequence > named["last_sequence"]]
        named["place"] = as_place(places[min(behind, default=len(rows))])
    set_current(path, **current)


def as_place(place: LogPlace) -> list[Any]:
    """A place as `CURRENT` has it."""
    return [place.offset, place.number, place.previous.hex()]


def as_row(
    sequence: int,
    kind: str,
    label: str,
    key: bytes,
    time: float,
    attributes: str,
    payload: bytes | None,
    size: int,
    kept: int | None = None,
) -> bytes:
    """The bytes of a row of which anything may be said."""
    texts = (key[:255], *(text.encode("utf-8", "surrogatepass") for text in (kind, label, attributes)))
    kept = payload is not None if kept is None else kept
    fields = FIELDS.pack(sequence % 2**64, time, size % 2**64, kept, *map(len, texts))
    return b"".join((fields, payload_digest(b"".join((fields, *texts))), *texts, payload or b""))


def observation(path: Path) -> tuple[dict[str, Any], bytes]:
    """The attributes and the payload of the first observation of a memory whose arrays are there."""
    for row in map(decode_row, read_log(path)[1]):
        if row.head.kind == "observe" and row.payload is not None:
            return dict(row.head.attributes), row.payload
    raise ValueError(f"{path} has no observation with its arrays")


def put_row(
    path: Path,
    *,
    kind: str = "observe",
    label: str = "silk",
    key: bytes = b"k" * 32,
    attributes: Any = None,
    payload: bytes | Mapping[str, np.ndarray] | None = None,
    time: float = 0.0,
    sequence: int | None = None,
    size: int | None = None,
    kept: int | None = None,
) -> int:
    """Put a row into a log, in place of any that has its sequence, and return that: by default the next one.

    payload: bytes, or arrays by name. size, kept: where they are to be others than the right ones.
    """
    body = payload if isinstance(payload, bytes) else encode_payload(check_arrays(payload or {}))
    rows = {row_sequence(row): row for row in read_log(path)[1]}
    if sequence is None:
        sequence = 1 + max([*rows, *(named["last_sequence"] for named in named_in(path))], default=0)
    text = as_text({} if attributes is None else attributes)
    size = len(body) if size is None else size
    rows[sequence % 2**64] = as_row(sequence, kind, label, key, time, text, body, size, kept)
    write_log(path, [rows[number] for number in sorted(rows)])
    return sequence


def get_identity(path: Path) -> dict[str, Any]:
    """The identity of a memory."""
    return dict(json.loads(read_log(path)[0]))


def set_identity(path: Path, identity: Any) -> None:
    """Give a memory another identity, a JSON value or a text, and its checkpoints, too, where it is JSON."""
    write_log(path, read_log(path)[1], as_text(identity).encode("utf-8", "surrogatepass"))
    with suppress(ValueError, RecursionError):
        known = json.loads(as_text(identity))
        for named in named_in(path):
            seal(path, named["number"], described(path, named["number"]) | {"identity": known})


@dataclass(frozen=True)
class Packed:
    """An array in a payload: what is said of it, and its buffer; stored: the length that the buffer is said to have."""

    name: str
    dtype: Any
    shape: Any
    buffer: bytes
    stored: Any = None

    @property
    def said(self) -> list[Any]:
        """What the payload says of it."""
        return [self.dtype, self.shape, len(self.buffer) if self.stored is None else self.stored]


def pack(arrays: Sequence[Packed], text: str | None = None) -> bytes:
    """A payload as FORMAT.md says it is, of arrays of which anything may be said; text: in place of what is said."""
    said = (as_text({one.name: one.said for one in arrays}) if text is None else text).encode("utf-8", "surrogatepass")
    return b"".join([LENGTH.pack(len(said)), said, *(array.buffer for array in arrays)])


def unpack(payload: bytes) -> list[Packed]:
    """The arrays of a sound payload."""
    start, arrays = LENGTH.size + LENGTH.unpack_from(payload)[0], []
    for name, (dtype, shape, stored) in json.loads(payload[LENGTH.size : start]).items():
        arrays.append(Packed(name, dtype, shape, payload[start : start + stored]))
        start += stored
    return arrays


def raw(name: str, array: np.ndarray) -> Packed:
    """An array as it is, not compressed."""
    return Packed(name, array.dtype.str, list(array.shape), array.tobytes())


def named_in(path: Path) -> list[dict[str, Any]]:
    """The newest checkpoint and the compaction checkpoint, as `CURRENT` names them, each once."""
    current = get_current(path)
    newest, compaction = current["newest"], current["compaction"]
    return [named for named in (newest, None if compaction == newest else compaction) if named is not None]


def group_of(path: Path, number: int) -> Path:
    """The folder of a checkpoint."""
    return checkpoint_path(path, number)


def described(path: Path, number: int) -> dict[str, Any]:
    """What a checkpoint says of itself, but for its sha256."""
    group = json.loads((group_of(path, number) / "zarr.json").read_text(encoding="utf-8"))
    return {name: value for name, value in group["attributes"].items() if name != "sha256"}


def seal(path: Path, number: int, known: Mapping[str, Any]) -> None:
    """Have a checkpoint say this of itself, with the right sha256, and `CURRENT` of it."""
    header = group_of(path, number) / "zarr.json"
    known = sealed(known)
    group = json.loads(header.read_text(encoding="utf-8")) | {"attributes": known}
    header.write_text(json.dumps(group), encoding="utf-8")
    current = get_current(path)
    for named in filter(None, (current["newest"], current["compaction"])):
        if named["number"] == number:
            named |= {name: known.get(name) for name in ("number", "last_sequence", "sha256")}
    set_current(path, **current)


def describe_again(path: Path, text: str | None = None, **changes: Any) -> None:
    """Change what the newest checkpoint says of itself, with the right sha256, and have `CURRENT` name it so.

    `CURRENT` says as before which it is. text: what it says, where that is no JSON of ours.
    """
    number = get_current(path)["newest"]["number"]
    header = group_of(path, number) / "zarr.json"
    known = sealed(described(path, number) | changes)
    group = json.loads(header.read_text(encoding="utf-8")) | {"attributes": known}
    header.write_text(json.dumps(group) if text is None else text, encoding="utf-8")
    set_current(path, newest=get_current(path)["newest"] | {"sha256": known["sha256"]})


def refiled(path: Path, number: int) -> dict[str, Any]:
    """What a checkpoint says of itself, with the digests of its files as they are now."""
    group = group_of(path, number)
    files = [file for file in sorted(group.glob("*/**/*")) if file.is_file()]
    digests = {str(file.relative_to(group)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}
    return described(path, number) | {"files": digests}


def put_arrays(path: Path, number: int, arrays: Mapping[str, np.ndarray], gone: Iterable[str] = ()) -> dict[str, Any]:
    """Write arrays into a checkpoint's group, in place of those of their names; what it then has to say of itself.

    They are written without any codec but that for bytes, in one chunk each, as anyone may. gone: arrays that go.
    """
    for name in (*arrays, *gone):
        shutil.rmtree(group_of(path, number) / name, ignore_errors=True)
    for name, array in arrays.items():
        put_array(group_of(path, number) / name, np.asarray(array, order="C"))
    return refiled(path, number)


def put_array(folder: Path, array: np.ndarray) -> None:
    """Write one array as a zarr array of one chunk."""
    chunk = folder.joinpath("c", *["0"] * array.ndim)
    chunk.parent.mkdir(parents=True)
    about = array_about(array, None)
    about["chunk_grid"]["configuration"]["chunk_shape"] = [max(1, length) for length in array.shape]
    (folder / "zarr.json").write_text(json.dumps(about), encoding="utf-8")
    if array.size:
        chunk.write_bytes(array.tobytes())


def frames_of(path: Path) -> dict[int, Frame]:
    """The frames of the rows that verify, by sequence."""
    with Log(log_of(path)) as log:
        found: list[Frame] = []
        for batch in log.scan(lambda _, frames, found=found: found.extend(frames)):
            found.extend(batch)
        return {row_sequence(log.read(frame.offset, frame.size)): frame for frame in found if frame.kind == ROW}


def spoil_row(path: Path, sequence: int = 0, *, head: bool = False) -> None:
    """Change a bit of a row's arrays, or of its head, on the disk; 0: of all rows."""
    found = frames_of(path)
    with log_of(path).open("r+b") as file:
        for frame in (found[number] for number in found if sequence in (0, number)):
            at = frame.payload_offset + HEAD_BYTES if head else frame.end - 1
            file.seek(at)
            byte = file.read(1)[0] ^ 1
            file.seek(at)
            file.write(bytes([byte]))


def row_of(path: Path, sequence: int = 1) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """A row's attributes and arrays, the caller's to change."""
    with Store.open(path, mode="read") as store:
        record = store.record(sequence)
        return dict(record.attributes), dict(record.arrays)


def checkpoint_of(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The attributes and arrays of the newest checkpoint, the caller's to change."""
    with Store.open(path, mode="read") as store:
        newest = store.latest()
        return dict(newest.attributes), dict(newest.arrays)


def put_checkpoint(path: Path, attributes: Any, arrays: Mapping[str, np.ndarray], *, compaction: bool = False) -> None:
    """Make this the newest checkpoint, or the compaction checkpoint of all rows."""
    with Store.open(path) as store:
        if compaction:
            store.compact(arrays, last_sequence=store.last, attributes=attributes)
        else:
            store.commit(arrays, last_sequence=store.last, attributes=attributes)


def copied(source: Path, target: Path) -> Path:
    """A copy of a memory's folder."""
    shutil.copytree(source, target)
    return target
