"""Recordings made to harm, by name: each a function of an empty folder and of a file that is none of its business.

It returns the recording's path and what `read` takes to read it. Each may only end in a RecordingError.
"""

from __future__ import annotations

import json
import os
import pickle
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from folder_attacks import no_file
from made import TIP, buffer, lerobot
from numcodecs import Blosc

from faults.bag_attacks import BAGS, Attack
from faults.parquet_attacks import PARQUETS

Made = tuple[Path, dict[str, Any]]
FIELD = {"field": "data/tactile"}
SECRET = 0xA5  # what files are full of that nobody may read
RAN = "RAN"  # what code that is run leaves behind, beside the watched file


class Evil:
    """What runs a command where it is unpickled."""

    def __init__(self, watched: Path) -> None:
        self.command = f"touch {watched.parent / RAN}"

    def __reduce__(self) -> Any:
        return os.system, (self.command,)


ARRAY: dict[str, Any] = {"zarr_format": 2, "shape": [4096, 19], "chunks": [4096, 19], "dtype": "|u1", "filters": None}
ARRAY |= {"compressor": None, "fill_value": 0, "order": "C"}


def describe(folder: Path, key: str, **about: Any) -> Path:
    """A Zarr array's description, version 2; its folder."""
    place = folder / key
    place.mkdir(parents=True, exist_ok=True)
    (place / ".zarray").write_text(json.dumps(ARRAY | about))
    return place


def zarr_of(folder: Path, watched: Path, *, chunk: Callable[[Path], bytes] | None = None, **about: Any) -> Made:
    """A Zarr group with one array that is described so; chunk: of the watched file, what its first chunk is."""
    path = folder / "x.zarr"
    (path / "data").mkdir(parents=True)
    for place in (path, path / "data"):
        (place / ".zgroup").write_text('{"zarr_format": 2}')
    describe(path, "data/tactile", **about)
    if chunk is not None:
        (path / "data/tactile" / ".".join("0" * len(about.get("shape", "xy")))).write_bytes(chunk(watched))
    return path, FIELD


def pickled(folder: Path, watched: Path, *, ends: bool) -> Made:
    """R1: a text array whose filters are vlen-utf8 over pickle; of the readings, or of where the episodes end."""
    path = buffer(folder, 2)
    if not ends:
        shutil.rmtree(path / "meta")
    key = "meta/episode_ends" if ends else "data/tactile"
    shutil.rmtree(path / key)
    filters = [{"id": "vlen-utf8"}, {"id": "pickle", "protocol": 4}]
    place = describe(path, key, shape=[1], chunks=[1], dtype="|O", filters=filters)
    (place / "0").write_bytes(pickle.dumps(Evil(watched)))
    return path, FIELD


def pickled_by_lies(folder: Path, watched: Path) -> Made:
    """R1 with numbers for a type, a pickle for what compresses, and the truth in .zmetadata alone."""
    about: dict[str, Any] = {"shape": [1], "chunks": [1], "dtype": "<f8", "compressor": {"id": "pickle", "protocol": 4}}
    path, options = zarr_of(folder, watched, chunk=lambda file: pickle.dumps(Evil(file)), **about)
    lies = {".zgroup": {"zarr_format": 2}, "data/tactile/.zarray": ARRAY | about}
    (path / ".zmetadata").write_text(json.dumps({"zarr_consolidated_format": 1, "metadata": lies}))
    return path, options


def blosc(flags: int, block: int, stored: int) -> Attack:
    """R2: a frame of Blosc that leads c-blosc out of its buffers."""
    frame = struct.pack("<BBBBIII", 2, 1, flags, 1, 4096 * 19, block, stored) + struct.pack("<i", 2**30)
    return partial(zarr_of, compressor=Blosc().get_config(), chunk=lambda _: frame)


def special(place: Path, kind: str, watched: Path, to: str = "/dev/zero") -> None:
    """Make no file here: a FIFO, a socket, a folder, or a link to the watched file or a device."""
    if kind in ("fifo", "socket", "folder"):
        no_file(place, kind)
    else:
        place.symlink_to(watched if kind == "link" else to)


def entry(folder: Path, watched: Path, name: str, kind: str) -> Made:
    """A FIFO, socket or link where a file is expected, in a Zarr group."""
    path, options = zarr_of(folder, watched, shape=[64, 64], chunks=[64, 64])
    place = path / "data/tactile" / name
    place.unlink(missing_ok=True)
    special(place, kind, watched)
    return path, options


def alone(folder: Path, watched: Path, name: str, kind: str) -> Made:
    """No file where a whole recording is expected."""
    special(folder / name, kind, watched)
    return folder / name, {}


def through_a_folder(folder: Path, watched: Path) -> Made:
    """A chunk in a folder that is a link."""
    path, options = zarr_of(folder, watched, shape=[4096, 1], chunks=[4096, 1], dimension_separator="/")
    shutil.copy(watched, watched.with_name("0"))
    (path / "data/tactile/0").symlink_to(watched.parent)
    return path, options


def zeros(*_: Path) -> bytes:
    """A quarter of a gigabyte of zeros, deflated."""
    made = zlib.compressobj(1)
    return b"".join(made.compress(bytes(1 << 24)) for _ in range(16)) + made.flush()


def zip_bomb(folder: Path, watched: Path) -> Made:
    """A zip whose chunk unfolds to more than its shape says."""
    with zipfile.ZipFile(folder / "x.zarr.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(".zgroup", '{"zarr_format": 2}')
        file.writestr("data/tactile/.zarray", json.dumps(ARRAY))
        with file.open("data/tactile/0.0", "w") as chunk:
            for _ in range(8):
                chunk.write(bytes(1 << 24))
    return folder / "x.zarr.zip", FIELD


def hdf5(folder: Path, watched: Path, fill: Callable[[Any, Path], Any]) -> Made:
    """An HDF5 file; fill: what is in it, of the watched file."""
    with h5py.File(folder / "x.h5", "w") as file:
        fill(file, watched)
    return folder / "x.h5", {"field": "tactile"}


def external(file: Any, watched: Path, *, fifo: bool = False) -> None:
    """R3: external storage; in a FIFO it is waited for."""
    if fifo:
        os.mkfifo(watched := Path(file.filename).with_name("fifo"))
    file.create_dataset("tactile", shape=(50, 19), dtype="u1", external=[(str(watched), 0, 950)])


def elsewhere(file: Any, watched: Path, *, is_link: bool) -> None:
    """R3: a link to a data set in another file, or a virtual data set of it."""
    other = watched.with_name("other.h5")
    with h5py.File(other, "w") as there:
        there["secret"] = np.full((50, 19), SECRET, "u1")
    if is_link:
        file["tactile"] = h5py.ExternalLink(str(other), "secret")
    else:
        layout = h5py.VirtualLayout((50, 19), "u1")
        layout[:] = h5py.VirtualSource(str(other), "secret", (50, 19))
        file.create_virtual_dataset("tactile", layout)


def deep(file: Any, watched: Path) -> None:
    """Groups within each other, 3000."""
    inside = file
    for _ in range(3000):
        inside = inside.create_group("g")
    inside["tactile"] = TIP


def bomb(file: Any, watched: Path) -> None:
    """A chunk that deflate makes longer than its shape says."""
    data = file.create_dataset("tactile", shape=(2**23, 1), chunks=(2**23, 1), dtype="u1", compression="gzip")
    data.id.write_direct_chunk((0, 0), zeros())


def npy(folder: Path, watched: Path, shape: tuple[int, ...], size: int = 0) -> Made:
    """A .npy by its header; size: of the file, where most of it is a hole."""
    with (folder / "x.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})
        file.write(bytes(100))
        file.truncate(size or file.tell())
    return folder / "x.npy", {}


def pickle_npy(folder: Path, watched: Path) -> Made:
    """Objects in a .npy."""
    np.save(folder / "x.npy", np.array([Evil(watched)], object), allow_pickle=True)
    return folder / "x.npy", {}


def robot_set(folder: Path, watched: Path, change: Callable[[Path, Any, Path], Any]) -> Made:
    """A LeRobotDataset in which something else is done."""
    path = lerobot(folder / "set")
    about = json.loads((path / "meta/info.json").read_text())
    change(path, about, watched)
    (path / "meta/info.json").write_text(json.dumps(about))
    return path, {"field": "tip"}


def named(pattern: str) -> Attack:
    """Data files by this pattern."""
    return partial(robot_set, change=lambda path, about, watched: about.update(data_path=pattern))


def parquet_file(name: str, write: Callable[[Path], Any]) -> Attack:
    """Another parquet file in place of one, with a number a row."""

    def change(path: Path, about: Any, watched: Path) -> None:
        about["features"]["observation.tactile.tip"]["shape"] = [1]
        write(path / name)

    return partial(robot_set, change=change)


def equal_rows(file: Path, *, dictionary: bool) -> None:
    """A parquet file of 3.6·10^7 equal rows in some KB, as runs of one number, or in pages that become long."""
    batch = pa.record_batch({"observation.tactile.tip": np.zeros(10**6, "f4"), "timestamp": np.zeros(10**6, "f8")})
    with pq.ParquetWriter(file, batch.schema, compression="zstd", use_dictionary=dictionary) as writer:
        for _ in range(36):  # in one group of rows; whole, it does not fit into what an attacked process may take
            writer.write_batch(batch, row_group_size=64_000_000)


def parquet_link(path: Path, about: Any, watched: Path) -> None:
    """A parquet file that is elsewhere."""
    file = path / DATA
    shutil.move(file, watched.parent / "other.parquet")
    file.symlink_to(watched.parent / "other.parquet")


DATA = "data/chunk-000/file-000.parquet"
ATTACKS: dict[str, Attack] = (
    BAGS
    | {
        "R1 pickled ends": partial(pickled, ends=True),
        "R1 pickled readings": partial(pickled, ends=False),
        "R1 pickle that compresses": pickled_by_lies,
        "R2 a block far away": blosc(0x20, 4096 * 19, 2**31 - 1),
        "R2 copied from behind the frame": blosc(2, 4096 * 19, 4096 * 19 + 16),
        "R2 a chunk that is a link": partial(entry, name="0.0", kind="link"),
        "R3 external storage": partial(hdf5, fill=external),
        "R3 external storage in a FIFO": partial(hdf5, fill=partial(external, fifo=True)),
        "R3 virtual": partial(hdf5, fill=partial(elsewhere, is_link=False)),
        "R3 external link": partial(hdf5, fill=partial(elsewhere, is_link=True)),
        "R7 zarr: a chunk that is a FIFO": partial(entry, name="0.0", kind="fifo"),
        "R7 zarr: a chunk that is a device": partial(entry, name="0.0", kind="device"),
        "R7 zarr: .zarray that is a FIFO": partial(entry, name=".zarray", kind="fifo"),
        "R7 zarr: .zarray that is a link": partial(entry, name=".zarray", kind="link"),
        "R7 zarr: a chunk's folder that is a link": through_a_folder,
        "R7 zarr: rows never written": partial(zarr_of, shape=[10**12, 19]),
        "R7 zarr: chunks of one number, never written": partial(zarr_of, shape=[10**7, 100], chunks=[1, 1]),
        "R7 zarr: chunks beyond memory": partial(zarr_of, shape=[10, 19], chunks=[10**12, 19]),
        "R7 zarr: deflated": partial(zarr_of, compressor={"id": "zlib", "level": 9}, chunk=zeros),
        "R7 zarr: zip": zip_bomb,
        "R7 zarr: fill of another type": partial(zarr_of, fill_value="x" * 1000),
        "R7 zarr: deep": partial(zarr_of, shape=json.loads("[" * 400 + "]" * 400)),
        "R7 hdf5: rows never written": partial(
            hdf5, fill=lambda file, _: file.create_dataset("tactile", (10**12, 19), "f4", chunks=(1024, 19))
        ),
        "R7 hdf5: deep": partial(hdf5, fill=deep),
        "R7 hdf5: deflated": partial(hdf5, fill=bomb),
        "R7 npy: rows of nothing": partial(npy, shape=(10**10, 0)),
        "R7 npy: sparse": partial(npy, shape=(10**11,), size=4 * 10**11 + 128),
        "R7 npy: pickle": pickle_npy,
        "R7 lerobot: names by width": named("data/{chunk_index:0999999999d}.parquet"),
        "R7 lerobot: names by attribute": named("data/{chunk_index.__class__}.parquet"),
        "R7 lerobot: names that climb": named("../watched/{chunk_index}.parquet"),
        "R7 lerobot: equal rows": parquet_file(DATA, partial(equal_rows, dictionary=True)),
        "R7 lerobot: long pages": parquet_file(DATA, partial(equal_rows, dictionary=False)),
        "R7 lerobot: a link": partial(robot_set, change=parquet_link),
    }
    | {f"R7 lerobot: {name}": parquet_file(*file) for name, file in PARQUETS.items()}
    | {
        f"R7 {kind}: {name}": partial(alone, name=name, kind=kind)
        for name in ("x.npy", "x.csv", "x.h5", "x.mcap", "x.bag", "x.db3", "x.zarr.zip")
        for kind in ("fifo", "socket", "device")
    }
)
