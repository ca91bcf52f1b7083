"""Recordings made to harm, by name: each a function of an empty folder and of a file that is none of its business.

It returns the recording's path and what `read` takes to read it. Each may only end in a RecordingError.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import shutil
import socket
import sqlite3
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
from made import SKIN, TIP, buffer, lerobot, ros
from numcodecs import Blosc

Attack = Callable[[Path, Path], tuple[Path, dict[str, Any]]]

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
    if kind == "fifo":
        os.mkfifo(place)
    elif kind == "socket":
        here = Path.cwd()
        os.chdir(place.parent)  # names of sockets are short
        try:
            with socket.socket(socket.AF_UNIX) as made:
                made.bind(place.name)
        finally:
            os.chdir(here)
    elif kind == "folder":
        place.mkdir()
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


def record(kind: int, data: bytes) -> bytes:
    """A record of MCAP."""
    return struct.pack("<BQ", kind, len(data)) + data


def text(value: bytes) -> bytes:
    """A text of MCAP or CDR."""
    return struct.pack("<I", len(value)) + value


def mcap_chunk(data: bytes, form: str = "zstd") -> bytes:
    """A chunk with a right length and no checksum."""
    from backports import zstd

    packed = zstd.compress(data, 19) if form == "zstd" else data
    return record(
        6, struct.pack("<QQQI", 0, 0, len(data), 0) + text(form.encode()) + struct.pack("<Q", len(packed)) + packed
    )


FLOATS = "float32[] data"


def mcap(chunks: Callable[[], list[bytes]], definition: str = FLOATS, kind: str = "a/msg/B") -> Attack:
    """An MCAP of one topic, /skin."""

    def make(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
        head = record(3, struct.pack("<H", 1) + text(kind.encode()) + text(b"ros2msg") + text(definition.encode()))
        head += record(4, struct.pack("<HH", 1, 1) + text(b"/skin") + text(b"cdr") + text(b""))
        body = head + b"".join(chunks()) + record(15, bytes(4))
        (folder / "x.mcap").write_bytes(b"\x89MCAP0\r\n" + body)
        return folder / "x.mcap", SKIN

    return make


def message(data: bytes, count: int = 1) -> bytes:
    """Equal messages of topic 1."""
    return record(5, struct.pack("<HIQQ", 1, 0, 10**9, 10**9) + data) * count


ONE = struct.pack("<BBHI19f", 0, 1, 0, 19, *range(19))


def large_pictures() -> list[bytes]:
    """Six PNG of 132 million pixels."""
    from PIL import Image

    picture = io.BytesIO()
    Image.new("L", (11500, 11500)).save(picture, "PNG")
    stamp = struct.pack("<BBHiI", 0, 1, 0, 1, 1)
    return [message(stamp + text(b"\0") + bytes(3) + text(b"png\0") + text(picture.getvalue())) for _ in range(6)]


COMPRESSED = (
    "std_msgs/Header header\nstring format\nuint8[] data\n" + "=" * 80 + "\nMSG: std_msgs/Header\n"
    "builtin_interfaces/Time stamp\nstring frame_id\n" + "=" * 80 + "\nMSG: builtin_interfaces/Time\n"
    "int32 sec\nuint32 nanosec\n"
)


def tower(levels: int, wide: int) -> str:
    """Messages of messages, the last of which takes no byte (in ROS 1)."""
    parts = [f"a/L0[{wide}] data"]
    parts += [f"MSG: a/L{i}\na/L{i + 1}[{wide}] data" for i in range(levels)]
    return ("\n" + "=" * 80 + "\n").join([*parts, f"MSG: a/L{levels}\n"])


def db3(change: Callable[[Any], None]) -> Attack:
    """A ROS 2 SQLite file in which something else is done."""

    def make(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
        path = next(ros(folder, "db3").glob("*.db3"))
        base = sqlite3.connect(path, isolation_level=None)
        change(base)
        base.close()
        return path, SKIN

    return make


ENDLESS = (
    "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
    "SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n"
)


def view(base: Any) -> None:
    """A view that never ends, posing as a table."""
    base.execute("PRAGMA writable_schema = ON")
    base.execute("DELETE FROM sqlite_master WHERE tbl_name = 'messages' AND type = 'index'")
    base.execute("UPDATE sqlite_master SET sql = ?, rootpage = 0 WHERE name = 'messages'", (ENDLESS,))


def generated(base: Any) -> None:
    """A column that is computed: 900 MB of zeros."""
    base.execute("DROP TABLE messages")
    base.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
        "data BLOB AS (zeroblob(900000000)))"
    )
    base.execute("INSERT INTO messages(topic_id, timestamp) VALUES (1, 1)")


def yaml(text: str) -> Attack:
    """The metadata of a ROS 2 bag."""

    def make(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
        path = ros(folder, "mcap")
        (path / "metadata.yaml").write_text(text)
        return path, SKIN

    return make


ALIASES = "rosbag2_bagfile_information:\n  a0: &a0 [x, x]\n" + "".join(
    f"  a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 10)}]\n" for i in range(9)
)
ALIASES += "  compression_mode: ''\n  relative_file_paths: *a9\n"


def yaml_fifo(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
    """A FIFO in place of the metadata."""
    path = ros(folder, "mcap")
    (path / "metadata.yaml").unlink()
    os.mkfifo(path / "metadata.yaml")
    return path, SKIN


def part_outside(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
    """A part of a bag that is a link to a bag elsewhere."""
    path = ros(folder, "mcap")
    part = next(path.glob("*.mcap"))
    shutil.move(part, watched.parent / "other.mcap")
    part.symlink_to(watched.parent / "other.mcap")
    return path, SKIN


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
    """A parquet file of 2.5·10^7 equal rows in some KB, as runs of one number, or in pages that become long."""
    count = 25_000_000
    name = "observation.tactile.tip"
    about["features"][name]["shape"] = [1]
    table = pa.table({name: pa.array(np.zeros(count, "f4")), "timestamp": pa.array(np.zeros(count, "f8"))})
    file = path / "data/chunk-000/file-000.parquet"
    pq.write_table(table, file, compression="zstd", row_group_size=count, use_dictionary=dictionary)


def parquet_link(path: Path, about: Any, watched: Path) -> None:
    """A parquet file that is elsewhere."""
    file = path / "data/chunk-000/file-000.parquet"
    shutil.move(file, watched.parent / "other.parquet")
    file.symlink_to(watched.parent / "other.parquet")


ATTACKS: dict[str, Attack] = {
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
    "R7 mcap: chunks of zeros": mcap(lambda: [mcap_chunk(bytes(300 << 20), "zstd")] * 3),
    "R7 mcap: equal messages": mcap(lambda: [mcap_chunk(message(ONE, 2_000_000))]),
    "R7 mcap: equal messages of nobody": mcap(lambda: [mcap_chunk(record(9, b"") * 8_000_000)]),
    "R7 mcap: large pictures": mcap(large_pictures, COMPRESSED, "sensor_msgs/msg/CompressedImage"),
    "R7 msg: an array of messages": mcap(
        lambda: [message(ONE)], "a/C[1000000000] data\n" + "=" * 80 + "\nMSG: a/C\nint8 x\n"
    ),
    "R7 msg: an array of texts": mcap(lambda: [message(ONE)], "string[1000000000] data"),
    "R7 msg: fields": mcap(lambda: [message(ONE)], "".join(f"float32 f{i}\n" for i in range(20_000))),
    "R7 msg: a tower": mcap(lambda: [message(ONE)], tower(12, 10)),
    "R7 msg: of itself": mcap(lambda: [message(ONE)], "a/B data"),
    "R7 db3: a view": db3(view),
    "R7 db3: generated": db3(generated),
    "R7 yaml: aliases": yaml(ALIASES),
    "R7 yaml: a FIFO": yaml_fifo,
    "R7 yaml: a name that climbs": yaml(
        "rosbag2_bagfile_information:\n  compression_mode: ''\n  relative_file_paths:\n    - ..\n"
    ),
    "R7 bag: a part elsewhere": part_outside,
    "R7 lerobot: names by width": named("data/{chunk_index:0999999999d}.parquet"),
    "R7 lerobot: names by attribute": named("data/{chunk_index.__class__}.parquet"),
    "R7 lerobot: names that climb": named("../watched/{chunk_index}.parquet"),
    "R7 lerobot: equal rows": robot_set(lambda path, about, _: equal_rows(path, about, dictionary=True)),
    "R7 lerobot: long pages": robot_set(lambda path, about, _: equal_rows(path, about, dictionary=False)),
    "R7 lerobot: a link": robot_set(parquet_link),
} | {
    f"R7 {kind}: {name}": alone(name, kind)
    for name in ("x.npy", "x.csv", "x.h5", "x.mcap", "x.bag", "x.db3", "x.zarr.zip")
    for kind in ("fifo", "socket", "device")
}
