"""What is done to a memory before somebody receives it: by class, each a function of a folder and a random generator.

Each returns what it did. `watched` is a folder that is none of the memory's: nothing may ever change there.
"""

from __future__ import annotations

import json
import os
import random
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from forging import (
    described,
    get_current,
    get_identity,
    group_of,
    log_of,
    named_in,
    observation,
    pack,
    put_arrays,
    put_row,
    raw,
    read_log,
    seal,
    sealed,
    set_identity,
    write_log,
)
from scroll_tactile_store.encoding import decode_payload, encode_payload
from scroll_tactile_store.framing import FRAME_BYTES, read_frame

from faults.mutants import NUMBERS, TEXTS, mutated_arrays, mutated_bytes, mutated_json, mutated_payload
from scroll_tactile.memory.touch_rows import pack_codes, unpack_readings
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream


@dataclass(frozen=True)
class Scene:
    """Where an attack takes place. others: further memories; codes: the rows of codes of a touch, by scale."""

    watched: Path
    others: tuple[Path, ...] = ()
    codes: Any = None


Attack = Callable[[random.Random, Path, Scene], str]


STRANGE_FILES = ("LOG", "LOG", "CURRENT", "CURRENT", "CURRENT.new", "log-00000009", "log-00000009.new", "lock")
STRANGE_FILES += ("LOG.damaged", "log-x", "holder.json", "holder.json.new", "checkpoints", "GROUP", "GROUP/zarr.json")
STRANGE_FILES += ("ARRAY", "ARRAY/zarr.json", "ARRAY/c", "ARRAY/c/0", "checkpoints/99999999", "GROUP.damaged")
STRANGE_FILES += ("checkpoints/00000099.partial",)
ODD = ("link", "link", "link", "loop", "nowhere", "pipe", "device", "folder", "sparse", "hard", "socket")
INSIDE = ("12345", "file", "memory", "memory/CURRENT", "12345/data", ".", "memory/checkpoints")
DEVICES = tuple(map(Path, ("/dev/zero", "/dev/full", "/proc/self/mem")))


def strange_file(rng: random.Random, path: Path, scene: Scene) -> str:
    """A link, a pipe, a device, a folder or a file of a terabyte in the place of a file or folder, or beside them."""
    name = rng.choice(STRANGE_FILES)
    target = path / name.replace("LOG", min(log.name for log in path.glob("log-*")))
    if name.startswith(("GROUP", "ARRAY")):
        groups = sorted((path / "checkpoints").glob("[0-9]*"))
        if not groups:
            return "no checkpoint"
        first = groups[0]
        array = rng.choice(sorted(folder.parent for folder in first.glob("*/zarr.json")))
        target = path / name.replace("GROUP", str(first)).replace("ARRAY", str(array))
    kind = rng.choice(ODD)
    moved = path.parent / "moved"
    if os.path.lexists(target):
        target.rename(moved)
    target.parent.mkdir(parents=True, exist_ok=True)
    if kind == "link":
        to = rng.choice((*(scene.watched / name for name in INSIDE), moved, *DEVICES))
        target.symlink_to(to)
        kind = f"link to {to.name}"
    elif kind in ("loop", "nowhere"):
        target.symlink_to(target if kind == "loop" else scene.watched / "new")
    elif kind in ("pipe", "device", "socket"):
        kinds = {"pipe": 0o010600, "device": 0o020600, "socket": 0o140600}
        os.mknod(target, kinds[kind], os.makedev(1, 5))
    elif kind == "folder":
        target.mkdir()
        (target / "12345").mkdir()
        (target / "file").write_text("x")
    elif kind == "sparse":
        with target.open("wb") as file:
            if moved.is_file():
                file.write(moved.read_bytes())
            file.truncate(rng.choice((2**31, 2**40)))
    else:
        os.link(scene.watched / "file", target)
    if moved.is_symlink() or moved.is_file():
        moved.unlink()
    elif moved.exists() and "moved" not in kind:
        shutil.rmtree(moved)
    return f"{name}: {kind}"


KINDS = ("observe",) * 12 + ("retract", "retract", "describe", "describe", "merge", "member", "x", "", "OBSERVE")

SPANS: tuple[Any, ...] = ([[1, 1]], [[1, 10**12]], [[2, 1]], [[-5, 1]], [[99, 99]], [], [1], [[True, 1]], None)
SHARES: tuple[Any, ...] = ({"x": 1.0}, {"x": float("nan")}, "x", {"wool": "x"}, {"a\nb": None}, {}, None, {"x": True})
TIMES = (1e14, float("inf"), -1, 253402300800.0)
SEQUENCES = (1, 3, -1, 0, 2**40, 2**63 - 1, -(2**63))


def forged_row(rng: random.Random, path: Path, scene: Scene) -> str:
    """A row with right checksums, of which one thing or more is not as this library writes it."""
    told, row = made_row(rng, path, scene)
    put_row(path, **row)
    return told


def made_row(rng: random.Random, path: Path, scene: Scene) -> tuple[str, dict[str, Any]]:
    """The arguments of `put_row` for such a row, and what was done."""
    kind = rng.choice(KINDS)
    row: dict[str, Any] = {"kind": kind, "label": rng.choice(("a", "b", "new")), "key": rng.randbytes(32)}
    told = [kind]
    if kind in ("observe", "merge", "member"):
        told.append(_fill(rng, row, path, scene))
    elif kind == "retract":
        row["attributes"] = {"sequences": rng.choice(SPANS)}
    elif kind == "describe":
        row["attributes"] = {"constituents": rng.choice(SHARES)}
    if rng.random() < 0.25 and kind != "observe":
        told_of, row["attributes"] = mutated_json(rng, row.get("attributes", {}))
        told.append(f"attributes: {told_of}")
    others: tuple[tuple[str, float, Any], ...] = (
        ("label", 0.07, rng.choice(TEXTS)),
        ("key", 0.07, rng.randbytes(rng.choice((0, 3, 31, 33, 64, 65)))),
        ("time", 0.1, rng.choice(TIMES)),
        ("sequence", 0.08, rng.choice(SEQUENCES)),
        ("size", 0.03, rng.choice(NUMBERS[:18])),
        ("kept", 0.03, rng.choice((0, 1, 2, 255))),
    )
    for name, share, value in others:
        if rng.random() < share:
            row[name] = value
            told.append(f"{name} {str(value)[:20]!r}")
    return ", ".join(told), row


def _fill(rng: random.Random, row: dict[str, Any], path: Path, scene: Scene) -> str:
    """Give a row attributes and arrays of an observation, or of a checkpoint, of which some are others."""
    attributes, payload = observation(path)
    way = rng.choice(("arrays", "arrays", "arrays", "payload", "payload", "attributes", "sound"))
    if row["kind"] == "member" and way != "sound":
        way = "attributes"
    if row["kind"] == "merge":
        compactions = [
            (other, compaction["number"]) for other in scene.others if (compaction := get_current(other)["compaction"])
        ]
        attributes = described(*compactions[0])["attributes"] if compactions else {}
        payload = scene.codes["merge"]
    told = way
    arrays = decode_payload(payload)
    if row["kind"] == "observe" and rng.random() < 0.5:
        packed = pack_codes(scene.codes["touch"])
        arrays = rng.choice(({**arrays, **packed}, packed))
        if not any(name.startswith("readings") for name in arrays):
            attributes.pop("nbytes", None)
    if way == "arrays":
        told, arrays = mutated_arrays(rng, arrays)
    try:
        payload = encode_payload(arrays)
    except Exception:  # names or values that the store never writes
        payload = pack([raw(name[:255], np.ascontiguousarray(array)) for name, array in arrays.items()])
    if way == "payload":
        told, payload = mutated_payload(rng, payload)
    if way == "attributes":
        told, row["attributes"] = mutated_json(rng, attributes)
    else:
        row["attributes"] = attributes
    row["payload"] = payload
    if row["kind"] == "observe" and rng.random() < 0.9:  # another is refused whatever else there is
        row["key"] = _right_key(path, arrays) or row["key"]
    return told


def _right_key(path: Path, arrays: dict[str, np.ndarray]) -> bytes | None:
    """The content hash of the readings in these arrays; None where there are none."""
    with suppress(Exception):  # they may be anything
        readings = unpack_readings(arrays)
        assert readings is not None
        return Stream(Sensor(**get_identity(path)["sensor"]), readings.astype(np.float32)).key
    return None


def forged_identity(rng: random.Random, path: Path, scene: Scene) -> str:
    """Another identity, with right checksums."""
    told, text = mutated_json(rng, get_identity(path))
    set_identity(path, text)
    return told


def forged_checkpoint(rng: random.Random, path: Path, scene: Scene) -> str:
    """A checkpoint whose description, arrays and place in `CURRENT` agree, and are not what a memory has."""
    number = rng.choice(named_in(path))["number"]
    known = described(path, number)
    way = rng.choice(("known", "known", "arrays", "arrays", "metadata"))
    if way == "known":
        told, text = mutated_json(rng, known)
        with suppress(ValueError, RecursionError, TypeError):
            seal(path, number, json.loads(text))
    elif way == "arrays":
        arrays = _group_arrays(path, number)
        told, changed = mutated_arrays(rng, arrays)
        new = {name: array for name, array in changed.items() if array is not arrays.get(name) and _is_name(name)}
        known = put_arrays(path, number, new, gone=set(arrays) - set(changed))
        seal(path, number, known)
    else:
        header = rng.choice(sorted(group_of(path, number).rglob("zarr.json")))
        told, text = mutated_json(rng, json.loads(header.read_text(encoding="utf-8")))
        header.write_text(text, encoding="utf-8")
    return f"{way}: {told}"


def forged_current(rng: random.Random, path: Path, scene: Scene) -> str:
    """A `CURRENT` that verifies, and names something else."""
    current = get_current(path)
    known: Any = {key: value for key, value in current.items() if key != "sha256"}
    if (named := [name for name in ("newest", "compaction") if current[name]]) and rng.random() < 0.5:
        name, frames = rng.choice(named), _frames(path)
        i = rng.randrange(len(frames))
        known[name]["place"] = [sum(map(len, frames[: i + 1])), i + 1, frames[i][72:88].hex()]
        told = f"place of {name}: {known[name]['place']}"
    else:
        told, text = mutated_json(rng, known)
        with suppress(ValueError, RecursionError):
            known = json.loads(text)
    with suppress(TypeError, AttributeError, UnicodeEncodeError):
        known = sealed(known)
    (path / "CURRENT").write_text(json.dumps(known), encoding="utf-8")
    return told


def _frames(path: Path) -> list[bytes]:
    """The frames of a log as they are."""
    data, at, found = log_of(path).read_bytes(), 0, []
    while read_frame(data[at : at + FRAME_BYTES], at) is not None:
        end = at + FRAME_BYTES + int.from_bytes(data[at + 36 : at + 40], "little")
        found.append(data[at:end])
        at = end
    return found


def _reordered(rng: random.Random, parts: list[bytes], others: list[bytes]) -> str:
    """Have rows, or frames, in another order: swapped, doubled, taken out, of another memory, or with other bytes."""
    i, j = rng.randrange(len(parts)), rng.randrange(len(parts))
    way = rng.choice(("swapped", "doubled", "taken out", "other", "bytes"))
    if way == "swapped":
        parts[i], parts[j] = parts[j], parts[i]
    elif way == "doubled":
        parts.insert(j, parts[i])
    elif way == "taken out":
        del parts[min(i, j) : max(i, j) + 1]
    elif way == "other":
        parts[i : i + rng.randrange(2)] = [rng.choice(others)]
    else:
        way, parts[i] = mutated_bytes(rng, parts[i], parts)
    return f"{way}: {i}, {j}"


def spoiled_frames(rng: random.Random, path: Path, scene: Scene) -> str:
    """The frames of a log in another order, each as it is."""
    frames, data = _frames(path), log_of(path).read_bytes()
    rest = data[sum(map(len, frames)) :]
    others = _frames(rng.choice(scene.others))
    told = _reordered(rng, frames, others)
    log_of(path).write_bytes(b"".join(frames) + rng.choice((rest, rest, b"".join(others), bytes(2**20))))
    return told


def forged_log(rng: random.Random, path: Path, scene: Scene) -> str:
    """The rows of a log in another order, with right checksums."""
    rows = read_log(path)[1]
    told = _reordered(rng, rows, read_log(rng.choice(scene.others))[1])
    write_log(path, rows)
    return told


def _is_name(name: str) -> bool:
    return bool(name) and all(letter.isalnum() or letter in "-_." for letter in name) and name[0] not in "._-"


def _group_arrays(path: Path, number: int) -> dict[str, np.ndarray]:
    import zarr

    group = zarr.open_group(group_of(path, number), mode="r")
    return {name: np.asarray(array[...]) for name, array in group.arrays()}


def spoiled_bytes(rng: random.Random, path: Path, scene: Scene) -> str:
    """One file with other bytes."""
    files = [file for file in path.rglob("*") if file.is_file()]
    own = [file for file in files if file.parent == path]
    file = rng.choice(sorted(own if rng.random() < 0.6 else files))
    name = file.relative_to(path)
    others = [(other / name).read_bytes() for other in scene.others if (other / name).is_file()]
    told, data = mutated_bytes(rng, file.read_bytes(), others)
    file.write_bytes(data)
    return f"{name}: {told}"


CLASSES: dict[str, tuple[Attack, ...]] = {
    "rows": (forged_row,) * 9 + (forged_log,),
    "identities": (forged_identity,),
    "checkpoints": (forged_checkpoint,),
    "currents": (forged_current,),
    "bytes": (spoiled_bytes,) * 2 + (spoiled_frames,),
    "files": (strange_file,),
}
FORGED = ("rows", "identities", "checkpoints", "currents")
