"""What is done to a memory before somebody receives it: by class, each a function of a folder and a random generator.

Each returns what it did. `watched` is a folder that is none of the memory's: nothing may ever change there.
"""

from __future__ import annotations

import json
import random
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from forging import (
    as_text,
    generations,
    get_identity,
    group_of,
    name_generation,
    observation,
    pack,
    put_arrays,
    put_row,
    raw,
    seal,
    set_identity,
    set_meta,
)

from faults.mutants import DTYPES, NUMBERS, TEXTS, mutated_arrays, mutated_bytes, mutated_json, mutated_payload
from faults.places import Attack, Scene, hot_journal, other_schema, strange_file
from scroll_tactile.memory.rows import pack_codes, unpack_readings
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream
from store.encoding import decode_payload, encode_payload

KINDS = ("observe",) * 12 + ("retract", "retract", "describe", "describe", "merge", "member", "x", "", "OBSERVE")


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
        spans = (
            [[1, 1]],
            [[1, 10**12]],
            [[2, 1]],
            [[0, 0]],
            [[-5, 1]],
            [[1, 1], [1, 1]],
            [[99, 99]],
            [[1, 2], [2, 3]],
            "x",
        )
        row["attributes"] = {
            "sequences": rng.choice((*spans, [], [[]], [1], [[1, 1, 1]], [[True, 1]], [[1.0, 1]], None))
        }
    elif kind == "describe":
        shares = (
            {"x": 1.0},
            {"x": 2.0},
            {"x": float("nan")},
            "x",
            [],
            {"wool": "x"},
            {"": True},
            {"a\nb": None},
            {"x": 1},
        )
        row["attributes"] = {"constituents": rng.choice((*shares, {}, None, 5, {"x": {"y": 1}}, {"x": True, "y": 0.7}))}
    if rng.random() < 0.25 and kind != "observe":
        told_of, row["attributes"] = mutated_json(rng, row.get("attributes", {}))
        told.append(f"attributes: {told_of}")
    if rng.random() < 0.15:
        name, value = rng.choice(
            (("label", rng.choice(TEXTS)), ("key", rng.randbytes(rng.choice((0, 3, 31, 33, 64, 65)))))
        )
        row[name] = value
        told.append(f"{name} {str(value)[:20]!r}")
    if rng.random() < 0.1:
        row["time"] = rng.choice((1e14, -1e14, float("inf"), 0, -1, 1e308, 253402300800.0))
        told.append(f"time {row['time']}")
    if rng.random() < 0.08:
        row["sequence"] = rng.choice((1, 2, 3, -1, 0, 50, 2**40, 2**63 - 1, -(2**63)))
        told.append(f"sequence {row['sequence']}")
    if rng.random() < 0.03:
        row["size"] = rng.choice(NUMBERS[:18])
        told.append(f"size {row['size']}")
    return ", ".join(told), row


def _fill(rng: random.Random, row: dict[str, Any], path: Path, scene: Scene) -> str:
    """Give a row attributes and arrays of an observation, or of a generation, of which some are others."""
    attributes, payload = observation(path)
    way = rng.choice(("arrays", "arrays", "arrays", "payload", "payload", "attributes", "sound"))
    if row["kind"] == "member" and way != "sound":
        way = "attributes"
    if row["kind"] == "merge":
        named = [row for other in scene.others for row in generations(other) if row.base]
        attributes = json.loads(named[0].attributes) if named else {}
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
    """Another identity, or other rows of table meta, with right checksums."""
    if rng.random() < 0.1:
        key = rng.choice(("format", "created", "repaired", "x"))
        spans = (
            '{"heads":[[1,2]]}',
            '{"heads":[[1,1000000000000]]}',
            '{"heads":"x"}',
            '{"heads":[[5,1]]}',
            "[" * 100_000,
        )
        value = rng.choice((*spans, "2", "0", "", "x", "-1", "null", '{"heads":[[1,2]],"generations":5}'))
        set_meta(path, key, value)
        return f"{key} {value[:30]}"
    told, text = mutated_json(rng, get_identity(path))
    set_identity(path, text)
    return told


def forged_generation(rng: random.Random, path: Path, scene: Scene) -> str:
    """A generation whose row, description and arrays agree with each other, and are not what a memory has."""
    named = generations(path)
    row = rng.choice(named)
    way = rng.choice(("attributes", "attributes", "content", "arrays", "arrays", "arrays", "metadata", "row"))
    if way == "attributes":
        told, text = mutated_json(rng, json.loads(row.attributes))
        seal(path, replace(row, attributes=text))
    elif way == "content":
        told, text = mutated_json(rng, json.loads(row.content))
        seal(path, replace(row, content=text))
    elif way == "arrays":
        arrays = _group_arrays(path, row)
        told, changed = mutated_arrays(rng, arrays)
        content = json.loads(row.content)
        for name in set(arrays) - set(changed):
            del content["arrays"][name]
        new = {name: array for name, array in changed.items() if array is not arrays.get(name) and _is_name(name)}
        seal(path, put_arrays(path, replace(row, content=as_text(content)), new))
    elif way == "metadata":
        header = rng.choice(sorted(group_of(path, row).rglob("zarr.json")))
        told, text = mutated_json(rng, json.loads(header.read_text(encoding="utf-8")))
        header.write_text(text, encoding="utf-8")
    else:
        column, value = rng.choice(
            (("number", 2**40), ("number", -1), ("upto", 10**9), ("upto", -1), ("upto", 0), ("base", 1))
        )
        told = f"{column} {value}"
        name_generation(path, replace(row, **{column: value}))
    return f"{way}: {told}"


def _is_name(name: str) -> bool:
    return bool(name) and all(letter.isalnum() or letter in "-_." for letter in name) and name[0] not in "._-"


def _group_arrays(path: Path, row: Any) -> dict[str, np.ndarray]:
    import zarr

    described = json.loads(row.content)["arrays"]
    group = zarr.open_group(group_of(path, row), mode="r")
    return {name: np.asarray(group[name][...]) for name in described if described[name]["dtype"] in DTYPES[:12]}


def spoiled_bytes(rng: random.Random, path: Path, scene: Scene) -> str:
    """One file with other bytes."""
    files = [file for file in path.rglob("*") if file.is_file()]
    own = [file for file in files if file.parent == path]
    file = rng.choice(sorted(own if rng.random() < 0.6 else files))
    name = file.relative_to(path)
    others = [(other / name).read_bytes() for other in scene.others if (other / name).is_file()]
    told, data = mutated_bytes(rng, file.read_bytes(), others)
    while file.name == "journal.sqlite" and data in others:  # which is another memory, and no damage to this one
        told, data = mutated_bytes(rng, file.read_bytes(), others)
    file.write_bytes(data)
    return f"{name}: {told}"


def foreign_log(rng: random.Random, path: Path, scene: Scene) -> str:
    """The log of another memory, whole or mutated, or one that was made up."""
    logs = [other / "journal.sqlite-wal" for other in scene.others if (other / "journal.sqlite-wal").is_file()]
    data = rng.choice(logs).read_bytes() if logs else b"7\x7f\x06\x82" + rng.randbytes(28)
    told = "as it is"
    if rng.random() < 0.7:
        told, data = mutated_bytes(rng, data, [])
    name = rng.choice(("-wal", "-wal", "-shm"))
    (path / f"journal.sqlite{name}").write_bytes(data)
    return f"{name}: {told}"


CLASSES: dict[str, tuple[Attack, ...]] = {
    "rows": (forged_row,),
    "identities": (forged_identity,),
    "generations": (forged_generation,),
    "bytes": (spoiled_bytes,) * 9 + (foreign_log,),
    "files": (strange_file,) * 9 + (hot_journal,),
    "tables": (other_schema,),
}
FORGED = ("rows", "identities", "generations")
