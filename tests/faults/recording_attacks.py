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

FIELD = {"field": "data/tactile"}
SECRET = 0xA5  # what files are full of that nobody may read
RAN = "RAN"  # what code that is run leaves behind, beside the watched file


class Evil:
    """What runs a command where it is unpickled."""

    def __init__(self, watched: Path) -> None:
        self.command = f"touch {watched.parent / RAN}"

    def __reduce__(self) -> Any:
        return os.system, (self.command,)


def describe(folder: Path, key: str, **about: Any) -> Path:
    """A Zarr array's description, version 2; its folder."""
    place = folder / key
    place.mkdir(parents=True, exist_ok=True)
    (place / ".zarray").write_text(json.dumps(ARRAY | about))
    return place


ARRAY = {
    "zarr_format": 2,
    "shape": [4096, 19],
    "chunks": [4096, 19],
    "dtype": "|u1",
    "filters": None,
    "compressor": None,
    "fill_value": 0,
    "order": "C",
}


def group(folder: Path, **about: Any) -> Path:
    """A Zarr group with one array; its folder."""
    path = folder / "x.zarr"
    (path / "data").mkdir(parents=True)
    for place in (path, path / "data"):
        (place / ".zgroup").write_text('{"zarr_format": 2}')
    describe(path, "data/tactile", **about)
    return path


def pickled(*, ends: bool) -> Attack:
    """R1: a text array whose filters are vlen-utf8 over pickle; of the readings, or of where the episodes end."""

    def make(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
        path = buffer(folder, 2)
        if not ends:
            shutil.rmtree(path / "meta")
        key = "meta/episode_ends" if ends else "data/tactile"
        shutil.rmtree(path / key)
        filters = [{"id": "vlen-utf8"}, {"id": "pickle", "protocol": 4}]
        place = describe(path, key, shape=[1], chunks=[1], dtype="|O", filters=filters)
        (place / "0").write_bytes(pickle.dumps(Evil(watched)))
        return path, FIELD

    return make


def pickled_by_lies(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
    """R1 with numbers for a type, a pickle for a filter or for what compresses, and the truth in .zmetadata alone."""
    path = group(folder, shape=[1], chunks=[1], dtype="<f8", compressor={"id": "pickle", "protocol": 4})
    (path / "data/tactile/0").write_bytes(pickle.dumps(Evil(watched)))
    about = json.loads((path / "data/tactile/.zarray").read_text())
    lies = {"zarr_consolidated_format": 1, "metadata": {".zgroup": {"zarr_format": 2}, "data/tactile/.zarray": about}}
    (path / ".zmetadata").write_text(json.dumps(lies))
    return path, FIELD


def blosc(flags: int, block: int, stored: int, size: int = 4096 * 19) -> Attack:
    """R2: a frame of Blosc that leads c-blosc out of its buffers; format 2."""
    frame = struct.pack("<BBBBIII", 2, 1, flags, 1, size, block, stored) + struct.pack("<i", 2**30)

    def make(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
        path = group(folder, compressor=Blosc().get_config())
        (path / "data/tactile/0.0").write_bytes(frame)
        return path, FIELD

    return make


def blosc_3(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
    """R2 in format 3, by another codec as well."""
    from zarr.codecs import BloscCodec

    path = buffer(folder, 3, compressors=[BloscCodec()])
    size = 7 * 10 * 4
    (path / "data/tactile/c/0/0").write_bytes(struct.pack("<BBBBIII", 2, 1, 2, 1, size, size, size + 16))
    return path, FIELD


def entry(name: str, kind: str, to: str = "/dev/zero") -> Attack:
    """A FIFO, socket or link where a file is expected, in a Zarr group."""

    def make(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
        path = group(folder, shape=[64, 64], chunks=[64, 64])
        place = path / "data/tactile" / name
        place.unlink(missing_ok=True)
        special(place, kind, watched, to)
        return path, FIELD

    return make


def special(place: Path, kind: str, watched: Path, to: str = "/dev/zero") -> None:
    """Make no file here: a FIFO, a socket, a folder, or a link to the watched file or a device."""
    if kind in ("fifo", "socket", "folder"):
        no_file(place, kind)
    else:
        place.symlink_to(watched if kind == "link" else to)


def alone(name: str, kind: str) -> Attack:
    """No file where a whole recording is expected."""

    def make(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
        special(folder / name, kind, watched)
        return folder / name, {}

    return make


def through_a_folder(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
    """A chunk in a folder that is a link."""
    path = group(folder, shape=[4096, 1], chunks=[4096, 1], dimension_separator="/")
    shutil.copy(watched, watched.with_name("0"))
    (path / "data/tactile/0").symlink_to(watched.parent)
    return path, FIELD


def zeros() -> bytes:
    """A quarter of a gigabyte of zeros, deflated."""
    made = zlib.compressobj(1)
    return b"".join(made.compress(bytes(1 << 24)) for _ in range(16)) + made.flush()


def deflated(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
    """A chunk of a few bytes by its shape, and of a quarter of a gigabyte by what it holds."""
    path = group(folder, compressor={"id": "zlib", "level": 9})
    (path / "data/tactile/0.0").write_bytes(zeros())
    return path, FIELD


def zarr_of(**about: Any) -> Attack:
    """A group whose array is described so."""

    def make(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
        return group(folder, **about), FIELD

    return make


def zip_bomb(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
    """A zip whose chunk unfolds to more than its shape says."""
    with zipfile.ZipFile(folder / "x.zarr.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(".zgroup", '{"zarr_format": 2}')
        file.writestr("data/tactile/.zarray", json.dumps(ARRAY))
        with file.open("data/tactile/0.0", "w") as chunk:
            for _ in range(8):
                chunk.write(bytes(1 << 24))
    return folder / "x.zarr.zip", FIELD


def hdf5(fill: Callable[[Any, Path], None], field: str = "tactile") -> Attack:
    """An HDF5 file."""

    def make(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
        with h5py.File(folder / "x.h5", "w") as file:
            fill(file, watched)
        return folder / "x.h5", {"field": field}

    return make


def external(file: Any, watched: Path) -> None:
    """R3: external storage."""
    file.create_dataset("tactile", shape=(50, 19), dtype="u1", external=[(str(watched), 0, 950)])


def external_fifo(file: Any, watched: Path) -> None:
    """R3: external storage in a FIFO, which is waited for."""
    fifo = Path(file.filename).with_name("fifo")
    os.mkfifo(fifo)
    file.create_dataset("tactile", shape=(50, 19), dtype="u1", external=[(str(fifo), 0, 950)])


def virtual(file: Any, watched: Path) -> None:
    """R3: a virtual data set of another file."""
    other = _other(watched)
    layout = h5py.VirtualLayout((50, 19), "u1")
    layout[:] = h5py.VirtualSource(str(other), "secret", (50, 19))
    file.create_virtual_dataset("tactile", layout)


def _other(watched: Path) -> Path:
    """An HDF5 file beside the watched one."""
    other = watched.with_name("other.h5")
    if not other.exists():
        with h5py.File(other, "w") as there:
            there["secret"] = np.full((50, 19), SECRET, "u1")
    return other


def linked(file: Any, watched: Path) -> None:
    """R3: a link to a data set in another file."""
    _other(watched)
    file["tactile"] = h5py.ExternalLink(str(watched.with_name("other.h5")), "secret")


def never_written(file: Any, watched: Path) -> None:
    """10^12 rows of fill."""
    file.create_dataset("tactile", shape=(10**12, 19), chunks=(1024, 19), dtype="f4")


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


def npy(shape: tuple[int, ...], kind: str = "<f4", data: bytes = bytes(100)) -> Attack:
    """A .npy by its header."""

    def make(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
        with (folder / "x.npy").open("wb") as file:
            np.lib.format.write_array_header_1_0(file, {"descr": kind, "fortran_order": False, "shape": shape})
            file.write(data)
        return folder / "x.npy", {}

    return make


def sparse(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
    """A .npy of 400 GB, of which the disk has a page."""
    path, _ = npy((10**11,))(folder, watched)
    with path.open("r+b") as file:
        file.truncate(4 * 10**11 + 128)
    return path, {}


def pickle_npy(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
    """Objects in a .npy."""
    np.save(folder / "x.npy", np.array([Evil(watched)], object), allow_pickle=True)
    return folder / "x.npy", {}


def robot_set(change: Callable[[Path, Any, Path], None]) -> Attack:
    """A LeRobotDataset in which something else is done."""

    def make(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
        path = lerobot(folder / "set")
        about = json.loads((path / "meta/info.json").read_text())
        change(path, about, watched)
        (path / "meta/info.json").write_text(json.dumps(about))
        return path, {"field": "tip"}

    return make


def named(pattern: str) -> Attack:
    """Data files by this pattern."""

    def change(path: Path, about: Any, watched: Path) -> None:
        about["data_path"] = pattern

    return robot_set(change)


def equal_rows(path: Path, about: Any, *, dictionary: bool) -> None:
    """A parquet file of 3.6·10^7 equal rows in some KB, as runs of one number, or in pages that become long."""
    name = "observation.tactile.tip"
    about["features"][name]["shape"] = [1]
    batch = pa.record_batch({name: np.zeros(1_000_000, "f4"), "timestamp": np.zeros(1_000_000, "f8")})
    file = path / "data/chunk-000/file-000.parquet"
    with pq.ParquetWriter(file, batch.schema, compression="zstd", use_dictionary=dictionary) as writer:
        for _ in range(36):  # in one group of rows; whole, it does not fit into what an attacked process may take
            writer.write_batch(batch, row_group_size=64_000_000)


def parquet_file(name: str, write: Callable[[Path], Any]) -> Attack:
    """Another parquet file in place of one, with a number a row."""

    def change(path: Path, about: Any, watched: Path) -> None:
        about["features"]["observation.tactile.tip"]["shape"] = [1]
        write(path / name)

    return robot_set(change)


def parquet_link(path: Path, about: Any, watched: Path) -> None:
    """A parquet file that is elsewhere."""
    file = path / "data/chunk-000/file-000.parquet"
    shutil.move(file, watched.parent / "other.parquet")
    file.symlink_to(watched.parent / "other.parquet")


ATTACKS: dict[str, Attack] = (
    BAGS
    | {
        "R1 pickled ends": pickled(ends=True),
        "R1 pickled readings": pickled(ends=False),
        "R1 pickle that compresses": pickled_by_lies,
        "R2 a block far away": blosc(0x20, 4096 * 19, 2**31 - 1),
        "R2 copied from behind the frame": blosc(2, 4096 * 19, 4096 * 19 + 16),
        "R2 of items of none": blosc(0x21, 0, 20),
        "R2 format 3": blosc_3,
        "R2 a chunk that is a link": entry("0.0", "link"),
        "R3 external storage": hdf5(external),
        "R3 external storage in a FIFO": hdf5(external_fifo),
        "R3 virtual": hdf5(virtual),
        "R3 external link": hdf5(linked),
        "R7 zarr: a chunk that is a FIFO": entry("0.0", "fifo"),
        "R7 zarr: a chunk that is a device": entry("0.0", "device"),
        "R7 zarr: a chunk that is a socket": entry("0.0", "socket"),
        "R7 zarr: .zarray that is a FIFO": entry(".zarray", "fifo"),
        "R7 zarr: .zarray that is a link": entry(".zarray", "link"),
        "R7 zarr: a chunk's folder that is a link": through_a_folder,
        "R7 zarr: rows never written": zarr_of(shape=[10**12, 19]),
        "R7 zarr: chunks of one number, never written": zarr_of(shape=[10**7, 100], chunks=[1, 1]),
        "R7 zarr: chunks beyond memory": zarr_of(shape=[10, 19], chunks=[10**12, 19]),
        "R7 zarr: deflated": deflated,
        "R7 zarr: zip": zip_bomb,
        "R7 zarr: fill of another type": zarr_of(fill_value="x" * 1000),
        "R7 zarr: deep": zarr_of(shape=json.loads("[" * 400 + "]" * 400)),
        "R7 hdf5: rows never written": hdf5(never_written),
        "R7 hdf5: deep": hdf5(deep),
        "R7 hdf5: deflated": hdf5(bomb),
        "R7 npy: rows of nothing": npy((10**10, 0)),
        "R7 npy: sparse": sparse,
        "R7 npy: pickle": pickle_npy,
        "R7 lerobot: names by width": named("data/{chunk_index:0999999999d}.parquet"),
        "R7 lerobot: names by attribute": named("data/{chunk_index.__class__}.parquet"),
        "R7 lerobot: names that climb": named("../watched/{chunk_index}.parquet"),
        "R7 lerobot: equal rows": robot_set(lambda path, about, _: equal_rows(path, about, dictionary=True)),
        "R7 lerobot: long pages": robot_set(lambda path, about, _: equal_rows(path, about, dictionary=False)),
        "R7 lerobot: a link": robot_set(parquet_link),
    }
    | {f"R7 lerobot: {name}": parquet_file(*file) for name, file in PARQUETS.items()}
    | {
        f"R7 {kind}: {name}": alone(name, kind)
        for name in ("x.npy", "x.csv", "x.h5", "x.mcap", "x.bag", "x.db3", "x.zarr.zip")
        for kind in ("fifo", "socket", "device")
    }
)
