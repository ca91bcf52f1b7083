"""Attacks that were found by hand, one by one, before anything withstood them: D1 to D7 and D12 of issue 17.

Each is done to a copy of the memory "snapshot", which has a checkpoint; `REFUSED` names those that nobody may take in.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from forging import (
    Packed,
    described,
    get_current,
    get_identity,
    group_of,
    log_of,
    named_in,
    observation,
    pack,
    put_row,
    raw,
    read_log,
    refiled,
    seal,
    set_current,
    set_identity,
    unpack,
    write_log,
)
from numcodecs import zstd

from faults.places import Attack, Scene
from scroll_tactile.memory.touch_rows import pack_codes

Named = Callable[[Path, Scene], object]


def newest(path: Path) -> int:
    """The number of the newest checkpoint."""
    return int(named_in(path)[0]["number"])


BLOSC = struct.pack("<BBBBIII", 2, 1, 0x20, 1, 65536, 65536, 2**31 - 1) + struct.pack("<i", 2**30)
COPIED = struct.pack("<BBBBIII", 2, 1, 2, 1, 65536, 65536, 65552)  # 16 bytes that claim 65536 behind them


def frames() -> dict[str, Named]:
    """D1: Blosc frames that lead c-blosc out of its buffers."""

    def row(frame: bytes) -> Named:
        arrays = [Packed("codes-64", "|u1", (65536,), 1, 65536, frame)]
        return lambda path, _: put_row(path, payload=pack(arrays), attributes={"columns": 400, "nbytes": 30400})

    def chunk(flags: int) -> Named:
        def spoil(path: Path, _: Scene) -> None:
            for file in group_of(path, newest(path)).glob("*/c/**/[0-9]*"):
                data = file.read_bytes() if file.is_file() else b""
                if len(data) > 16:
                    size = data[4:8]
                    file.write_bytes(
                        struct.pack("<BBBB", 2, 1, flags, 1) + size * 2 + struct.pack("<Ii", 2**31 - 1, 2**30)
                    )
            seal(path, newest(path), refiled(path, newest(path)))

        return spoil

    return {"stream": row(BLOSC), "copied": row(COPIED), "chunk": chunk(0x20), "copied chunk": chunk(2)}


def links() -> dict[str, Named]:
    """D2: links out of the folder."""

    def instead(name: str, to: str) -> Named:
        def link(path: Path, scene: Scene) -> None:
            place = path / name
            shutil.rmtree(place, ignore_errors=True)
            place.unlink(missing_ok=True)
            place.symlink_to(scene.watched / to)

        return link

    return {
        "checkpoints": instead("checkpoints", "."),
        "holder": instead("holder.json.new", "file"),
        "log": instead("log-00000001", "memory/log-00000001"),
        "draft of a log": instead("log-00000002.new", "file"),
        "current": instead("CURRENT", "memory/CURRENT"),
        "draft of current": instead("CURRENT.new", "file"),
        "checkpoint": instead("checkpoints/00000001", "12345"),
        "partial": instead("checkpoints/00000009.partial", "12345"),
    }


def sizes() -> dict[str, Named]:
    """D3: a few bytes that ask for all memory, or all time."""

    def row(**changes: Any) -> Named:
        return lambda path, _: put_row(path, **changes)

    def meta(shape: list[int], chunk: list[int], named: bool) -> Named:
        def write(path: Path, _: Scene) -> None:
            number = newest(path)
            folder = group_of(path, number) / "rows-15"
            about = json.loads((folder / "zarr.json").read_text())
            about["shape"], about["chunk_grid"]["configuration"]["chunk_shape"] = shape, chunk
            (folder / "zarr.json").write_text(json.dumps(about))
            shutil.rmtree(folder / "c")
            if named:
                known = described(path, number)
                known["arrays"]["rows-15"]["shape"] = shape
                seal(path, number, known)

        return write

    def special(name: str, *, pipe: bool) -> Named:
        def make(path: Path, _: Scene) -> None:
            files = sorted(file for file in group_of(path, newest(path)).glob("*/c/0") if file.is_file())
            place = path / name.replace("ARRAY", str(files[0].parents[1]))
            place.unlink(missing_ok=True)
            os.mkfifo(place) if pipe else place.symlink_to("/dev/zero")

        return make

    large = zstd.compress(bytes(2**28), 1)
    many = [Packed(f"codes-{i}", "|u1", (2**28,), 1, 2**28, large) for i in range(60)]
    one = [Packed("codes-15", "<i4", (2**20, 64), 1, 2**28, large)]
    made = {
        "one array": row(payload=pack(one), attributes={"columns": 30}),
        "spans": row(kind="retract", label="", attributes={"sequences": [[1, 10**12]]}),
        "columns": lambda path, _: put_row(
            path, attributes={"columns": 10**9, "nbytes": 240}, payload=observation(path)[1]
        ),
        "shape": meta([2**29], [2**29], named=True),
        "shape, not named": meta([2**29], [2**29], named=False),
        "chunks": meta([2**28], [1], named=True),
        "60 arrays": row(payload=pack(many), attributes={"columns": 30}),
        "tebibyte": row(payload=pack([Packed("x", "|u1", (2**40,), 0, 2**40, b"", 2**40)]), attributes={"columns": 30}),
        "a sequence": row(sequence=2**62),
        "a log with a hole": lambda path, _: os.truncate(log_of(path), 2**40),
    }
    for name in ("ARRAY/zarr.json", "ARRAY/c/0", "log-00000001", "CURRENT", "holder.json"):
        made |= {f"zeros {name}": special(name, pipe=False), f"pipe {name}": special(name, pipe=True)}
    return made


def poison() -> dict[str, Named]:
    """D4: rows that a merge took in, and that broke the memory or its answers."""

    def row(change: Callable[[dict[str, Any], dict[str, np.ndarray], Scene], Any], **columns: Any) -> Named:
        def put(path: Path, scene: Scene) -> None:
            attributes, payload = observation(path)
            version, arrays = unpack(payload)
            more: dict[str, np.ndarray] = {}
            for i in range(3):
                if change(attributes, more, scene) is not None:
                    arrays = []
                put_row(
                    path,
                    attributes=attributes,
                    payload=pack([*arrays, *(raw(name, array) for name, array in more.items())], version),
                    **{"key": bytes([i]) * 32} | columns,
                )

        return put

    def codes(value: Any, dtype: Any = np.int32) -> Named:
        def change(_: dict[str, Any], more: dict[str, np.ndarray], scene: Scene) -> None:
            more |= {
                name: np.full(array.shape, value, dtype) for name, array in pack_codes(scene.codes["touch"]).items()
            }

        return row(change)

    def readings(value: np.ndarray) -> Named:
        return row(lambda attributes, more, _: more.update(readings=value) or "alone")

    def nothing(*_: Any) -> None:
        pass

    def attribute(**changed: Any) -> Named:
        return row(lambda attributes, *_: attributes.update(changed))

    return {
        "codes of 2^31": codes(2**31 - 1),
        "codes of NaN": codes(np.nan, np.float32),
        "codes of 2^20 + 1": codes(2**20 + 1),
        "three readings": readings(np.zeros(3, np.float32)),
        "readings of text": readings(np.array(["x", "y"])),
        "readings of NaN": readings(np.full((30, 2), np.nan, np.float32)),
        "readings out of range": readings(np.full((30, 2), 1e30, np.float32)),
        "key of 3 bytes": row(nothing, key=b"abc"),
        "no number of bytes": attribute(nbytes="a"),
        "columns below 0": attribute(columns=-1),
        "a name with an escape": row(nothing, label="\x1b]0;pwned\x07\x1b[2J\x1b[31mevil\nline"),
        "an empty name": row(nothing, label=""),
        "a name of 10 MB": row(nothing, label="x" * 10_000_000),
        "a description": lambda path, _: put_row(
            path, kind="describe", label="a", attributes={"constituents": {"wool": "x"}}
        ),
    }


def currents() -> dict[str, Named]:
    """D5: a `CURRENT` that verifies, and says what cannot be."""

    def change(**changes: Any) -> Named:
        return lambda path, _: set_current(path, **changes)

    def newest_is(**changes: Any) -> Named:
        return lambda path, _: set_current(path, newest=get_current(path)["newest"] | changes)

    def other_log(path: Path, _: Scene) -> None:
        set_current(path, log=[1, "00" * 8])

    def doubled(path: Path, _: Scene) -> None:
        rows = read_log(path)[1]
        write_log(path, [*rows, *rows])

    return {
        "another log": other_log,
        "a log that is not there": lambda path, _: set_current(path, log=[9, get_current(path)["log"][1]]),
        "a log of number 2^63 - 1": lambda path, _: set_current(path, log=[2**63 - 1, get_current(path)["log"][1]]),
        "a place behind the end": newest_is(place=[2**62, 2**62, "00" * 16]),
        "a place at the beginning": newest_is(place=[0, 0, "00" * 16]),
        "a checkpoint of another number": newest_is(number=7),
        "a checkpoint up to 2^62": newest_is(last_sequence=2**62),
        "no checkpoint": change(newest=None),
        "a compaction checkpoint": lambda path, _: set_current(path, compaction=get_current(path)["newest"]),
        "rows that come twice": doubled,
        "a text": change(newest="x"),
        "a number that is none": newest_is(last_sequence=True),
    }


def untyped() -> dict[str, Named]:
    """D6: what left as KeyError, TypeError, RecursionError and the like."""

    def identity(**changed: Any) -> Named:
        return lambda path, _: set_identity(path, {**get_identity(path), **changed})

    def embedding(dimension: Any) -> Named:
        return lambda path, _: set_identity(
            path, (about := get_identity(path)) | {"embedding": {**about["embedding"], "dimension": dimension}}
        )

    def content(**changes: Any) -> Named:
        return lambda path, _: seal(path, newest(path), described(path, newest(path)) | changes)

    def without(name: str) -> Named:
        return lambda path, _: seal(
            path, newest(path), {key: value for key, value in described(path, newest(path)).items() if key != name}
        )

    def row(**changes: Any) -> Named:
        return lambda path, _: put_row(path, **changes)

    deep = "[" * 100_000 + "]" * 100_000
    return {
        "no attributes": lambda path, _: put_row(path, payload=observation(path)[1]),
        "no sequences": row(kind="retract", label="", attributes={}),
        "values of no scale": row(payload=pack([raw("values-x", np.zeros(3, np.int32))]), attributes={"columns": 30}),
        "deep attributes": lambda path, _: put_row(path, attributes=deep, payload=observation(path)[1]),
        "deep identity": lambda path, _: set_identity(path, deep),
        "sensor": identity(sensor="x"),
        "embedding": identity(embedding="x"),
        "empty embedding": identity(embedding={}),
        "grid": identity(grid=None),
        "exemplars": identity(exemplars="abc"),
        "augmentation": identity(augmentation="x"),
        "unknown augmentation": identity(augmentation={"x": 1}),
        **{f"dimension {size}": embedding(size) for size in (0, -5, 10**9, True)},
        "content without format": without("format"),
        "content without arrays": without("arrays"),
        "content of format x": content(format="x"),
        "content of a newer format": content(format=2),
        "arrays of a list": content(arrays=[1]),
        "no attributes of a checkpoint": content(attributes={}),
        "too many materials": lambda path, _: seal(
            path,
            newest(path),
            (about := described(path, newest(path)))
            | {"attributes": about["attributes"] | {"materials": ["a", "b", "c", "d"]}},
        ),
    }


def dates() -> dict[str, Named]:
    """D12: a clock that was wrong by three million years."""

    def row(path: Path, _: Scene) -> None:
        attributes, payload = observation(path)
        put_row(path, attributes=attributes, payload=payload, time=-1e14)

    return {"a time": row}


def _by_nobody(attack: Named) -> Attack:
    """The same attack, in which a random generator has no say."""
    return lambda rng, path, scene: str(attack(path, scene))


NAMED: dict[str, Attack] = {
    f"{defect}: {name}": _by_nobody(attack)
    for defect, attacks in {
        "D1": frames(),
        "D2": links(),
        "D3": sizes(),
        "D4": poison(),
        "D5": currents(),
        "D6": untyped(),
        "D12": dates(),
    }.items()
    for name, attack in attacks.items()
}
"""By name, all of them."""

# Of these nothing can be taken in. Others are to be passed over: a checkpoint of no use, with a warning, or a link
# in the place of what a writer removes.
PASSED_OVER = ("content", "arrays", "checkpoint", "materials")
REFUSED = {name for name in NAMED if name.startswith("D6") and not any(word in name for word in PASSED_OVER)}
REFUSED |= {name for name in NAMED if name.startswith("D4")}
REFUSED |= {"D1: stream", "D1: copied", "D3: spans", "D3: columns", "D3: tebibyte"}
