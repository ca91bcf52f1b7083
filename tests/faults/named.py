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
from folder_attacks import (
    CHECKPOINTS,
    CONSTITUENTS,
    CURRENTS,
    LINKS,
    ROWS,
    as_link,
    description,
    identities,
    newest_is,
    row,
)
from forging import (
    Packed,
    described,
    get_current,
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


def by_folder(attack: Callable[[Path], Any]) -> Named:
    """An attack that needs nothing but the folder."""
    return lambda path, _: attack(path) and None


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
        target = "memory/log-00000001" if to == "log" else to
        return lambda path, scene: as_link(path / name, scene.watched / target)

    return {name: instead(name, to) for name, to in LINKS.items()}


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

    def codes(value: Any, dtype: Any = np.int32) -> Named:
        def attack(path: Path, scene: Scene) -> None:
            attributes, payload = observation(path)
            version, arrays = unpack(payload)
            touch = pack_codes(scene.codes["touch"]).items()
            more = [raw(name, np.full(array.shape, value, dtype)) for name, array in touch]
            for i in range(3):
                key = bytes([i]) * 32
                put_row(path, attributes=attributes, payload=pack([*arrays, *more], version), key=key)

        return attack

    return {
        "codes of 2^31": codes(2**31 - 1),
        "codes of NaN": codes(np.nan, np.float32),
        "codes of 2^20 + 1": codes(2**20 + 1),
        **{name: by_folder(row(**changes)) for name, (_, changes) in ROWS.items()},
        **{f"a description {said}": by_folder(description(said)) for said in CONSTITUENTS},
    }


def currents() -> dict[str, Named]:
    """D5: a `CURRENT` that verifies, and says what cannot be."""

    def named_as(**changes: Any) -> Named:
        return lambda path, _: set_current(path, newest=newest_is(path, **changes))

    def doubled(path: Path, _: Scene) -> None:
        rows = read_log(path)[1]
        write_log(path, [*rows, *rows])

    return {
        **{name: by_folder(attack) for name, attack in CURRENTS.items()},
        "a checkpoint of another number": named_as(number=7),
        "a checkpoint up to 2^62": named_as(last_sequence=2**62),
        "no checkpoint": lambda path, _: set_current(path, newest=None),
        "a compaction checkpoint": lambda path, _: set_current(path, compaction=get_current(path)["newest"]),
        "rows that come twice": doubled,
    }


def untyped() -> dict[str, Named]:
    """D6: what left as KeyError, TypeError, RecursionError and the like."""

    def content(**changes: Any) -> Named:
        return lambda path, _: seal(path, newest(path), described(path, newest(path)) | changes)

    def row(**changes: Any) -> Named:
        return lambda path, _: put_row(path, **changes)

    deep = "[" * 100_000 + "]" * 100_000
    return {
        "no sequences": row(kind="retract", label="", attributes={}),
        "values of no scale": row(payload=pack([raw("values-x", np.zeros(3, np.int32))]), attributes={"columns": 30}),
        "deep attributes": lambda path, _: put_row(path, attributes=deep, payload=observation(path)[1]),
        "deep identity": lambda path, _: set_identity(path, deep),
        **{f"identity: {name}": by_folder(attack) for *_, name, attack in identities()},
        **{f"content: {name}": by_folder(attack) for name, attack in CHECKPOINTS.items()},
        "content of a newer format": content(format=3),
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

# Those that tests/storage and tests/validation do, too, which a quick run leaves to them.
LISTED = frozenset(
    name
    for name in NAMED
    if name.startswith(("D2: ", "D6: identity: ", "D6: content: ")) or name.removeprefix("D5: ") in CURRENTS
)
# Of these nothing can be taken in. Others are to be passed over: a checkpoint of no use, with a warning, or a link
# in the place of what a writer removes.
PASSED_OVER = ("content", "arrays", "checkpoint", "materials")
REFUSED = {name for name in NAMED if name.startswith("D6") and not any(word in name for word in PASSED_OVER)}
REFUSED |= {name for name in NAMED if name.startswith("D4")}
REFUSED |= {"D1: stream", "D1: copied", "D3: spans", "D3: columns", "D3: tebibyte"}
