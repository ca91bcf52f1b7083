"""Recordings of ROS that were made to harm; see `recording_attacks`."""

from __future__ import annotations

import io
import os
import shutil
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from made import SKIN, ros

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
