"""What is done to the files of a memory, and to the tables in its journal, before somebody receives it."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from forging import connected


@dataclass(frozen=True)
class Scene:
    """Where an attack takes place. others: further memories; codes: the rows of codes of a touch, by scale."""

    watched: Path
    others: tuple[Path, ...] = ()
    codes: Any = None


Attack = Callable[[random.Random, Path, Scene], str]


STRANGE_FILES = ("journal.sqlite", "journal.sqlite-wal", "journal.sqlite-shm", "journal.sqlite-journal", "lock")
STRANGE_FILES += ("journal.sqlite.new", "journal.sqlite.repaired", "holder.json", "holder.json.new", "generations")
STRANGE_FILES += ("journal.sqlite.new-journal", "journal.sqlite.damaged", "GROUP", "GROUP/zarr.json", "ARRAY")
STRANGE_FILES += ("ARRAY/zarr.json", "ARRAY/c", "ARRAY/c/0", "generations/99999999", "generations/00000099.partial")


def strange_file(rng: random.Random, path: Path, scene: Scene) -> str:
    """A link, a pipe, a device, a folder or a file of a terabyte in the place of a file or folder, or beside them."""
    name = rng.choice(STRANGE_FILES)
    target = path / name
    if name.startswith(("GROUP", "ARRAY")):
        groups = sorted((path / "generations").glob("[0-9]*"))
        if not groups:
            return "no generation"
        first = groups[0]
        array = rng.choice(sorted(folder.parent for folder in first.glob("*/zarr.json")))
        target = path / name.replace("GROUP", str(first)).replace("ARRAY", str(array))
    kind = rng.choice(
        ("link", "link", "link", "loop", "nowhere", "pipe", "device", "folder", "sparse", "hard", "socket")
    )
    moved = path.parent / "moved"
    if os.path.lexists(target):
        target.rename(moved)
    target.parent.mkdir(parents=True, exist_ok=True)
    if kind == "link":
        inside = ("12345", "file", "memory", "memory/journal.sqlite", "12345/data", ".", "memory/generations")
        to = rng.choice(
            (
                *(scene.watched / name for name in inside),
                moved,
                Path("/dev/zero"),
                Path("/dev/full"),
                Path("/proc/self/mem"),
            )
        )
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


TABLES = ("meta", "record", "payload", "generation")
SCHEMAS = (
    "CREATE TRIGGER t AFTER INSERT ON payload BEGIN DELETE FROM record; DELETE FROM payload; END",
    "CREATE TRIGGER t AFTER INSERT ON payload BEGIN UPDATE payload SET bytes = x'00'; END",
    "CREATE TRIGGER t BEFORE INSERT ON record BEGIN SELECT RAISE(IGNORE); END",
    "CREATE TRIGGER t AFTER INSERT ON record BEGIN INSERT INTO meta WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT"
    " i + 1 FROM n) SELECT i, '', x'' FROM n; END",
    "CREATE TRIGGER t AFTER INSERT ON record BEGIN UPDATE record SET attributes = hex(zeroblob(500000000)); END",
    "CREATE TRIGGER t AFTER DELETE ON meta BEGIN DELETE FROM record; END",
    "CREATE TRIGGER t AFTER INSERT ON record BEGIN SELECT load_extension('/tmp/x.so'); END",
    "CREATE VIEW v AS SELECT * FROM record",
    "CREATE INDEX i ON record(label)",
    "CREATE UNIQUE INDEX i ON record(label, sequence)",
    "CREATE INDEX i ON record(kind) WHERE kind = 'observe'",
    "CREATE INDEX i ON record(abs(random()))",
    "CREATE TABLE more (x)",
    "CREATE TABLE sqlite_x AS SELECT 1",
    "CREATE VIRTUAL TABLE f USING fts5(x)",
    "CREATE VIRTUAL TABLE f USING rtree(a, b, c)",
    "ANALYZE",
    "ALTER TABLE record ADD COLUMN more TEXT",
    "ALTER TABLE record RENAME TO recorded",
    "DROP TABLE generation",
    "PRAGMA user_version = 2",
    "PRAGMA user_version = -1",
    "PRAGMA application_id = 0",
    "PRAGMA journal_mode = DELETE",
)


RECORD = "WHERE name = 'record'"
MASTERS = (
    f"UPDATE sqlite_master SET rootpage = rootpage + 1 {RECORD}",
    f"UPDATE sqlite_master SET sql = 'CREATE TABLE record(x)' {RECORD}",
    f"UPDATE sqlite_master SET sql = replace(sql, 'NOT NULL', 'NOT NULL DEFAULT (abs(-1))') {RECORD}",
    "UPDATE sqlite_master SET sql = replace(sql, ' STRICT', '')",
    "UPDATE sqlite_master SET sql = sql || ' -- x' WHERE name = 'payload'",
    "UPDATE sqlite_master SET tbl_name = 'record' WHERE name = 'payload'",
    "UPDATE sqlite_master SET rootpage = 2 WHERE name = 'generation'",
    "UPDATE sqlite_master SET rootpage = 99999 WHERE name = 'payload'",
    "DELETE FROM sqlite_master WHERE type = 'index'",
    "INSERT INTO sqlite_master VALUES ('trigger', 't', 'record', 0, 'CREATE TRIGGER t BEFORE INSERT ON record BEGIN"
    " SELECT RAISE(IGNORE); END')",
)


def other_schema(rng: random.Random, path: Path, scene: Scene) -> str:
    """Tables that are not ours: triggers, views, indexes, values of types that a table cannot hold."""
    way = rng.choice(("statement", "statement", "rebuilt", "master", "value"))
    with connected(path) as connection:
        if way == "statement":
            told = rng.choice(SCHEMAS)
            connection.execute(told)
        elif way == "rebuilt":
            told = _rebuild(rng, path, connection)
        elif way == "master":
            told = rng.choice(MASTERS)
            connection.execute("PRAGMA writable_schema = ON")
            connection.execute(told)
        else:
            connection.execute("PRAGMA ignore_check_constraints = ON")
            table, column = rng.choice(
                (("record", "attributes"), ("record", "label"), ("record", "kind"), ("meta", "value"))
            )
            told = f"{table}.{column} with NUL or in Latin-1"
            value = rng.choice((b"a\x00b", b"\xff\xfe", b"\xc3", b""))
            connection.execute(f"UPDATE {table} SET {column} = CAST(? AS TEXT)", (value,))
    return told


def _rebuild(rng: random.Random, path: Path, connection: sqlite3.Connection) -> str:
    """The same rows in a file of other tables, or of another making: not STRICT, without row ids, another page size."""
    texts = dict(connection.execute("SELECT name, sql FROM sqlite_master WHERE sql NOT NULL").fetchall())
    rows = {name: connection.execute(f"SELECT * FROM {name}").fetchall() for name in TABLES}
    way = rng.choice(("loose", "loose", "page size", "vacuum", "encoding", "rowid", "order", "text for bytes"))
    made = path / "made"
    with sqlite3.connect(made, isolation_level=None) as other:
        settings = {"page size": "page_size = 512", "vacuum": "auto_vacuum = FULL", "encoding": "encoding = 'UTF-16le'"}
        other.execute(f"PRAGMA {settings.get(way, 'page_size = 4096')}")
        for name in reversed(TABLES) if way == "order" else TABLES:
            text = texts[name]
            if way in ("loose", "text for bytes"):
                text = text.replace(" STRICT", "")
            if way == "rowid":
                text = text.replace(" STRICT", " STRICT, WITHOUT ROWID")
            other.execute(text)
            marks = ",".join("?" * len(rows[name][0])) if rows[name] else ""
            kept = rows[name]
            if way == "text for bytes" or (way == "loose" and name == "record"):
                kept = [tuple(_loosened(rng, value) for value in row) for row in kept]
            other.executemany(f"INSERT OR IGNORE INTO {name} VALUES ({marks})", kept)
        other.execute("PRAGMA application_id = 0x41725263")
        other.execute("PRAGMA user_version = 1")
        other.execute("PRAGMA journal_mode = WAL")
    other.close()
    connection.close()
    made.replace(path / "journal.sqlite")
    return f"rebuilt: {way}"


def _loosened(rng: random.Random, value: Any) -> Any:
    if rng.random() < 0.8 or isinstance(value, int):
        return value
    if isinstance(value, bytes):
        return rng.choice((value.hex(), 7, value + b"\x00"))
    return rng.choice((7, 0.5, str(value).encode(), "x"))


def hot_journal(rng: random.Random, path: Path, scene: Scene) -> str:
    """A rollback journal of another program, which SQLite would play back; it names a file that is to be removed."""
    page = rng.randrange(1, 7)
    record = struct.pack(">I", page) + rng.randbytes(4096) + bytes(4)
    header = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7" + struct.pack(">IIIII", 1, 0, 6, 512, 4096)
    victim = str(scene.watched / "file").encode()
    end = struct.pack(">I", 2**30 // 4096 + 1) + victim + struct.pack(">II", len(victim), sum(victim)) + header[:8]
    (path / "journal.sqlite-journal").write_bytes(header.ljust(512, b"\0") + record + rng.choice((end, b"")))
    return f"a rollback journal of page {page}"
