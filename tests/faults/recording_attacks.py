"""Recordings made to harm, by name: each a function of an empty folder and of a file that is none of its business.

It returns the recording's path and what `read` takes to read it. Each may only end in a RecordingError.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import shutil
import sqlite3
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
from made import SKIN, TIP, buffer, lerobot, ros
from numcodecs import Blosc

from faults.parquet_attacks import PARQUETS

Attack = Callable[[Path, Path], tuple[Path, dict[str, Any]]]


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


def mcap(
    chunks: Callable[[], list[bytes]], definition: str = FLOATS, kind: str = "a/msg/B", form: str = "ros2msg"
) -> Attack:
    """An MCAP of one topic, /skin."""

    def make(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
        head = record(3, struct.pack("<H", 1) + text(kind.encode()) + text(form.encode()) + text(definition.encode()))
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


def idl(member: str = "float data[3];", constant: str = "") -> Attack:
    """A definition in IDL with a member and a constant."""
    text = f"module a {{ module msg {{ {constant} struct B {{ {member} }}; }}; }};"
    return mcap(lambda: [message(ONE)], text, form="ros2idl")


def hole(begin: bytes, size: int, end: bytes = b"", name: str = "x.mcap") -> Attack:
    """A file that takes up little of the disk."""

    def make(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
        with (folder / name).open("wb") as file:
            file.write(begin)
            file.seek(size, os.SEEK_CUR)
            file.write(end or bytes(4))
        return folder / name, SKIN

    return make


def small_fields(count: int) -> bytes:
    """A ROS 1 bag of a header with a number of fields, a few bytes each."""
    fields = (struct.pack("<I", 1) + b"=") * count
    return b"#ROSBAG V2.0\n" + struct.pack("<I", len(fields)) + fields


MAGIC = b"\x89MCAP0\r\n"


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


def yaml(text: str | None) -> Attack:
    """The metadata of a ROS 2 bag; None: a FIFO in place of it."""

    def make(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
        path = ros(folder, "mcap")
        (path / "metadata.yaml").unlink()
        os.mkfifo(path / "metadata.yaml") if text is None else (path / "metadata.yaml").write_text(text)
        return path, SKIN

    return make


ALIASES = "rosbag2_bagfile_information:\n  a0: &a0 [x, x]\n" + "".join(
    f"  a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 10)}]\n" for i in range(9)
)
ALIASES += "  compression_mode: ''\n  relative_file_paths: *a9\n"


def part_outside(folder: Path, watched: Path) -> tuple[Path, dict[str, Any]]:
    """A part of a bag that is a link to a bag elsewhere."""
    path = ros(folder, "mcap")
    part = next(path.glob("*.mcap"))
    shutil.move(part, watched.parent / "other.mcap")
    part.symlink_to(watched.parent / "other.mcap")
    return path, SKIN


BAGS: dict[str, Attack] = {
    "R7 mcap: chunks of zeros": mcap(lambda: [mcap_chunk(bytes(300 << 20), "zstd")] * 3),
    "R7 mcap: equal messages": mcap(lambda: [mcap_chunk(message(ONE, 2_000_000))]),
    "R7 mcap: equal messages of nobody": mcap(lambda: [mcap_chunk(record(9, b"") * 8_000_000)]),
    "R7 mcap: large pictures": mcap(large_pictures, COMPRESSED, "sensor_msgs/msg/CompressedImage"),
    "R7 msg: an array of messages": mcap(
        lambda: [message(ONE)], "a/C[1000000000] data\n" + "=" * 80 + "\nMSG: a/C\nint8 x\n"
    ),
    "R7 msg: fields": mcap(lambda: [message(ONE)], "".join(f"float32 f{i}\n" for i in range(20_000))),
    "R7 msg: a tower": mcap(lambda: [message(ONE)], tower(12, 10)),
    "R7 msg: of itself": mcap(lambda: [message(ONE)], "a/B data"),
    "R7 idl: many in parentheses": idl(constant="".join(f"const long X{i} = (1);" for i in range(2000))),
    "R7 idl: a length in parentheses": idl("float data[((((1))))];"),
    "R7 idl: a sequence's in parentheses": idl("sequence<float,/**/((((1))))> data;"),
    "R7 idl: a text's in parentheses": idl("string<((((1))))> data;"),
    "R7 idl: a default in parentheses": idl('@verbatim (text=")") @default(value=((((1))))) float data;'),
    "R7 idl: sequences in sequences": idl("sequence<" * 24 + "float" + ">" * 24 + " data;"),
    "R7 idl: a shift": idl(constant="const long X = 1 << 800000000000;"),
    "R7 idl: a power": idl(constant="const long X = " + " * ".join(["99999999"] * 20_000) + ";"),
    "R7 idl: a long text": idl("float data[4];", f'const string X = "{"x" * (1 << 22)}";'),
    "R7 idl: lengths in one line": idl(", ".join(f"data{i}[1]" for i in range(20_000)).join(("float ", ";"))),
    "R7 idl: comments never closed": idl("/* " * 400_000),
    "R7 bag: a header in a hole": hole(b"#ROSBAG V2.0\n" + struct.pack("<I", 10**9), 10**9, name="x.bag"),
    "R7 bag: a header of many fields": hole(small_fields(10**7), 0, name="x.bag"),
    "R7 mcap: a message in a hole": hole(MAGIC + struct.pack("<BQ", 5, 1 << 30), 1 << 30, b"\x0f"),
    "R7 mcap: half a chunk in a hole": hole(MAGIC + struct.pack("<BQ", 6, 1 << 40), 1 << 30),
    "R7 db3: a view": db3(view),
    "R7 db3: generated": db3(generated),
    "R7 yaml: aliases": yaml(ALIASES),
    "R7 yaml: a FIFO": yaml(None),
    "R7 yaml: a name that climbs": yaml(
        "rosbag2_bagfile_information:\n  compression_mode: ''\n  relative_file_paths:\n    - ..\n"
    ),
    "R7 bag: a part elsewhere": part_outside,
}


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
