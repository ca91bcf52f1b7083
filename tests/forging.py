"""Rows, identities and checkpoints with right checksums, as anyone can make them who reads store/FORMAT.md."""

from __future__ import annotations

import hashlib
import json
import struct
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from scroll_tactile_store import Store
from storage.second_reader import COMMIT, HEAD, MARK, ROW, ROW_KIND, Frame, digest, frame_at, frames
from storage.second_reader import row as read_row

DIGEST_BYTES = 16


def as_text(value: Any) -> str:
    """JSON as the store writes it; a text is taken to be JSON, or meant to be none."""
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True, separators=(",", ":"))


def sealed(known: Mapping[str, Any]) -> dict[str, Any]:
    """What `CURRENT`, or a checkpoint's group, says, with the sha256 of it."""
    known = {name: value for name, value in known.items() if name != "sha256"}
    return {**known, "sha256": hashlib.sha256(as_text(known).encode("ascii")).hexdigest()}


def get_current(path: Path) -> dict[str, Any]:
    """What `CURRENT` says."""
    return dict(json.loads((path / "CURRENT").read_text(encoding="ascii")))


def set_current(path: Path, **changes: Any) -> None:
    """Have `CURRENT` say other things, with the right sha256."""
    (path / "CURRENT").write_text(as_text(sealed(get_current(path) | changes)) + "\n", encoding="ascii")


def log_of(path: Path) -> Path:
    """The log that `CURRENT` names."""
    return path / f"log-{get_current(path)['log'][0]:08d}"


def frames_of(path: Path) -> dict[int, Frame]:
    """The frames of a log's rows whose first 88 bytes are right, by the rows' sequences."""
    data, offset, found = log_of(path).read_bytes(), 0, {}
    while (frame := frame_at(data, offset)) is not None:
        if frame.kind == ROW_KIND:
            found[int.from_bytes(data[frame.offset + HEAD.size :][:8], "little")] = frame
        offset = frame.end
    return found


def read_log(path: Path) -> tuple[bytes, list[bytes]]:
    """The payload of a store's first frame, and the bytes of each of its rows."""
    data = log_of(path).read_bytes()
    about, whole, _ = frames(data)
    return about, [data[frame.offset + HEAD.size : frame.end] for frame in whole if frame.kind == ROW_KIND]


def write_log(path: Path, rows: Sequence[bytes], header: bytes | None = None) -> None:
    """Put a log of these rows, each in a batch of its own, in the place of the one there is.

    `CURRENT` then names the checkpoints' places in it.
    """
    current = get_current(path)
    identity, log = bytes.fromhex(current["log"][1]), bytearray()
    places: list[list[Any]] = []
    previous, number = bytes(16), 0

    def put(batch: int, kind: int, payload: bytes) -> None:
        nonlocal previous, number
        head = struct.pack(
            "<8s8sQQII16s16s", MARK, identity, number, batch, kind, len(payload), previous, digest(payload)
        )
        previous, number = digest(head), number + 1
        log.extend(head + previous + payload)

    put(0, 0, read_log(path)[0] if header is None else header)
    for row in rows:
        places.append([len(log), number, previous.hex()])
        put(number, ROW_KIND, row)
        put(number - 1, COMMIT, b"")
    places.append([len(log), number, previous.hex()])
    log_of(path).write_bytes(log)
    sequences = [int.from_bytes(row[:8], "little") for row in rows]
    for named in filter(None, (current["newest"], current["compaction"])):
        behind = [i for i, sequence in enumerate(sequences) if sequence > named["last_sequence"]]
        named["place"] = places[min(behind, default=len(rows))]
    set_current(path, **current)


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
) -> int:
    """Put a row into a log, in place of any that has its sequence, and return that: by default the next one.

    payload: bytes, or arrays by name. size: where the row is to say another than the right one.
    """
    body = payload if isinstance(payload, bytes) else pack([raw(*one) for one in sorted((payload or {}).items())])
    rows = {int.from_bytes(row[:8], "little"): row for row in read_log(path)[1]}
    if sequence is None:
        sequence = 1 + max([*rows, *(named["last_sequence"] for named in named_in(path))], default=0)
    told = as_text({} if attributes is None else attributes)
    texts = (key[:255], *(text.encode("utf-8", "surrogatepass") for text in (kind, label, told)))
    fields = ROW.pack(sequence % 2**64, time, (len(body) if size is None else size) % 2**64, 1, *map(len, texts))
    rows[sequence % 2**64] = b"".join((fields, digest(b"".join((fields, *texts))), *texts, body))
    write_log(path, [rows[number] for number in sorted(rows)])
    return sequence


def observation(path: Path) -> tuple[dict[str, Any], bytes]:
    """The attributes and the payload of the first observation of a memory whose arrays are there."""
    for row in map(read_row, read_log(path)[1]):
        if row.kind == "observe" and row.arrays is not None:
            return row.attributes, row.arrays
    raise ValueError(f"{path} has no observation with its arrays")


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


Packed = tuple[str, str, Sequence[int], bytes, int]
"""An array in a payload: its name, dtype, shape, its buffer, and how many bytes that is said to have."""


def raw(name: str, array: np.ndarray) -> Packed:
    """An array as it is, not compressed."""
    return name, array.dtype.str, array.shape, np.asarray(array, order="C").tobytes(), array.nbytes


def pack(arrays: Sequence[Packed], text: str | None = None) -> bytes:
    """A payload of arrays of which anything may be said; text: in place of what is said of them."""
    told = {name: [dtype, list(shape), stored] for name, dtype, shape, _, stored in arrays}
    said = (json.dumps(told) if text is None else text).encode("utf-8", "surrogatepass")  # in the order of the buffers
    return b"".join([struct.pack("<I", len(said)), said, *(buffer for _, _, _, buffer, _ in arrays)])


def named_in(path: Path) -> list[dict[str, Any]]:
    """The newest checkpoint and the compaction checkpoint, as `CURRENT` names them, each once."""
    current = get_current(path)
    newest, compaction = current["newest"], current["compaction"]
    return [named for named in (newest, None if compaction == newest else compaction) if named is not None]


def group_of(path: Path, number: int) -> Path:
    """The folder of a checkpoint."""
    return path / "checkpoints" / f"{number:08d}"


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


def lengthen_frame(path: Path) -> None:
    """Have the last row's frame say that it has 4 GiB."""
    log, last = log_of(path), max(frame.offset for frame in frames_of(path).values())
    data = bytearray(log.read_bytes())
    data[last + 36 : last + 40] = b"\xff" * 4
    data[last + 72 : last + 88] = digest(data[last : last + 72])
    log.write_bytes(data)


def put_touch(path: Path, **changes: Any) -> None:
    """A sound observation once more, with changes."""
    attributes, payload = observation(path)
    put_row(path, **{"attributes": attributes, "payload": payload, "label": "a"} | changes)


def say_in_current(path: Path, **changes: Any) -> None:
    """`CURRENT` says other things, or, by `newest`, of the newest checkpoint."""
    before = get_current(path)
    changes |= {"newest": before["newest"] | changes["newest"]} if "newest" in changes else {}
    changes |= {"log": [changes["log"], before["log"][1]]} if "log" in changes else {}
    set_current(path, **changes)


def set_configuration(path: Path, **configuration: Any) -> None:
    """Give a memory another configuration of its embedding."""
    known = get_identity(path)
    known["embedding"]["configuration"] = configuration
    set_identity(path, known)


def largest_array(path: Path) -> tuple[int, str]:
    """The newest checkpoint's number, and the name of its largest array."""
    number = get_current(path)["newest"]["number"]
    headers = [file for file in group_of(path, number).glob("*/zarr.json") if not file.parent.name.startswith("log-")]
    sizes = {file.parent.name: int(np.prod(json.loads(file.read_text())["shape"])) for file in headers}
    return number, max(sizes, key=lambda name: sizes[name])


def change_array(path: Path, codec: str = "", data: bytes = b"", named: str = "") -> None:
    """The newest checkpoint's largest array with another codec, bytes or name, and right checksums."""
    number, name = largest_array(path)
    folder = group_of(path, number) / name
    told = json.loads((folder / "zarr.json").read_text())
    if codec:
        told["codecs"] = [*told["codecs"][:1], {"name": codec, "configuration": {"level": 1, "checksum": False}}]
    (folder / "zarr.json").write_text(json.dumps(told))
    if data:
        next(file for file in (folder / "c").rglob("*") if file.is_file()).write_bytes(data)
    known = refiled(path, number)
    if named:
        known["files"] = {f"{named}/{file.partition('/')[2]}": one for file, one in known["files"].items()}
    seal(path, number, known)


def zipped(path: Path, change: Callable[[zipfile.ZipFile], object] = lambda made: None) -> Path:
    """A folder as a packed memory beside it; change: of the zip, before it gets its list of files."""
    files = [path / "CURRENT", *path.glob("log-*"), *sorted(path.glob("checkpoints/*/**/*"))]
    with zipfile.ZipFile(path.with_suffix(".zip"), "w") as made:
        for file in filter(Path.is_file, files):
            made.writestr(str(file.relative_to(path)), file.read_bytes())
        change(made)
    return path.with_suffix(".zip")


def spoil_row(path: Path, sequence: int = 0, *, head: bool = False) -> None:
    """Change a bit of a row's arrays, or of its head, on the disk; 0: of all rows."""
    found = frames_of(path)
    with log_of(path).open("r+b") as file:
        for frame in (found[number] for number in found if sequence in (0, number)):
            at = frame.offset + HEAD.size + ROW.size + DIGEST_BYTES if head else frame.end - 1
            file.seek(at)
            byte = file.read(1)[0] ^ 1
            file.seek(at)
            file.write(bytes([byte]))


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
