"""Attacks that were found by hand before anything withstood them, of which no other test has every reader: by defect.

Each is done to a copy of the memory "snapshot", which has a checkpoint; `REFUSED` names those that nobody may take in.
tests/storage and tests/validation do those of `folder_attacks`.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from folder_attacks import ROWS, newest_is, row
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

from faults.attacks import Attack, Scene
from scroll_tactile.memory.touch_rows import pack_codes

Folder = Callable[[Path], object]


def newest(path: Path) -> int:
    """The number of the newest checkpoint."""
    return int(named_in(path)[0]["number"])


def put(**changes: Any) -> Folder:
    """A row of nothing but this."""
    return lambda path: put_row(path, **changes)


def observed(**changes: Any) -> Folder:
    """A sound observation again, of which something is other."""

    def attack(path: Path) -> None:
        attributes, payload = observation(path)
        put_row(path, **{"attributes": attributes, "payload": payload} | changes)

    return attack


def shaped(shape: list[int], chunk: list[int], *, named: bool) -> Folder:
    """An array of the newest checkpoint that claims this shape; named: with the right sha256 of its files."""

    def write(path: Path) -> None:
        number = newest(path)
        folder = group_of(path, number) / "rows-15"
        about = json.loads((folder / "zarr.json").read_text())
        about["shape"], about["chunk_grid"]["configuration"]["chunk_shape"] = shape, chunk
        (folder / "zarr.json").write_text(json.dumps(about))
        shutil.rmtree(folder / "c")
        if named:
            seal(path, number, refiled(path, number))

    return write


def endless(name: str, *, pipe: bool) -> Folder:
    """A pipe, or /dev/zero, in the place of a file."""

    def make(path: Path) -> None:
        files = sorted(file for file in group_of(path, newest(path)).glob("*/c/0") if file.is_file())
        place = path / name.replace("ARRAY", str(files[0].parents[1]))
        place.unlink(missing_ok=True)
        os.mkfifo(place) if pipe else place.symlink_to("/dev/zero")

    return make


def codes(value: Any, dtype: Any = np.int32) -> Attack:
    """Codes that a merge took in, and that broke the memory or its answers."""

    def attack(_: Any, path: Path, scene: Scene) -> str:
        attributes, payload = observation(path)
        arrays = unpack(payload)
        more = [raw(name, np.full(one.shape, value, dtype)) for name, one in pack_codes(scene.codes["touch"]).items()]
        for i in range(3):
            put_row(path, attributes=attributes, payload=pack([*arrays, *more]), key=bytes([i]) * 32)
        return f"{value}"

    return attack


def content(**changes: Any) -> Folder:
    """The newest checkpoint says other things of itself."""
    return lambda path: seal(path, newest(path), described(path, newest(path)) | changes)


def doubled(path: Path) -> None:
    """Each row comes twice."""
    rows = read_log(path)[1]
    write_log(path, [*rows, *rows])


LARGE = zstd.compress(bytes(2**28), 1)
MANY = [Packed(f"codes-{i}", "|u1", [2**28], LARGE) for i in range(60)]
ONE = [Packed("codes-15", "<i4", [2**20, 64], LARGE)]
TEBIBYTE = [Packed("x", "|u1", [2**40], b"", 2**40)]
DEEP = "[" * 100_000 + "]" * 100_000

FOLDERS: dict[str, Folder] = {
    # A few bytes that ask for all memory, or all time.
    "D3: one array": put(payload=pack(ONE), attributes={"columns": 30}),
    "D3: 60 arrays": put(payload=pack(MANY), attributes={"columns": 30}),
    "D3: tebibyte": put(payload=pack(TEBIBYTE), attributes={"columns": 30}),
    "D3: spans": put(kind="retract", label="", attributes={"sequences": [[1, 10**12]]}),
    "D3: columns": observed(attributes={"columns": 10**9, "nbytes": 240}),
    "D3: shape": shaped([2**29], [2**29], named=True),
    "D3: shape, not named": shaped([2**29], [2**29], named=False),
    "D3: chunks": shaped([2**28], [1], named=True),
    "D3: a sequence": put(sequence=2**62),
    "D3: a log with a hole": lambda path: os.truncate(log_of(path), 2**40),
    **{
        f"D3: {'pipe' if pipe else 'zeros'} {name}": endless(name, pipe=pipe)
        for name in ("ARRAY/zarr.json", "ARRAY/c/0", "log-00000001", "CURRENT", "holder.json")
        for pipe in (False, True)
    },
    # Rows that a merge took in.
    **{f"D4: {name}": row(**ROWS[name]) for name in ("out of range", "an escape for a name", "a short key")},
    # A `CURRENT` that verifies, and says what cannot be.
    "D5: a checkpoint of another number": lambda path: set_current(path, newest=newest_is(path, number=7)),
    "D5: no checkpoint": lambda path: set_current(path, newest=None),
    "D5: a compaction checkpoint": lambda path: set_current(path, compaction=get_current(path)["newest"]),
    "D5: rows that come twice": doubled,
    # What left as KeyError, TypeError, RecursionError and the like.
    "D6: no sequences": put(kind="retract", label="", attributes={}),
    "D6: values of no scale": put(payload=pack([raw("values-x", np.zeros(3, np.int32))]), attributes={"columns": 30}),
    "D6: deep attributes": observed(attributes=DEEP),
    "D6: deep identity": lambda path: set_identity(path, DEEP),
    "D6: content of a newer format": content(format=4),
    "D6: no attributes of a checkpoint": content(attributes={}),
    "D12: a time": observed(time=-1e14),  # a clock that was wrong by three million years
}


def _by_nobody(attack: Folder) -> Attack:
    """The same attack, in which neither a random generator nor the scene has a say."""
    return lambda rng, path, scene: str(attack(path))


NAMED: dict[str, Attack] = {name: _by_nobody(attack) for name, attack in FOLDERS.items()} | {
    f"D4: codes of {told}": codes(*given)
    for told, given in {"2^31": (2**31 - 1,), "NaN": (np.nan, np.float32), "2^20 + 1": (2**20 + 1,)}.items()
}
"""By name, all of them."""

# Of these nothing can be taken in. Others are to be passed over: a checkpoint of no use, with a warning.
OF_ROWS = ("D4", "D6: no sequences", "D6: values", "D6: deep")
REFUSED = {name for name in NAMED if name.startswith(OF_ROWS)} | {"D3: spans", "D3: columns", "D3: tebibyte"}
