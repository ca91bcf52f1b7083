"""Messages out of ROS 2's SQLite files, `.db3`, whole or cut off, in the order they were written."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from scroll_tactile.errors import RecordingError
from scroll_tactile.recordings.bounds import LARGEST, Budget
from scroll_tactile.recordings.ros.bagfiles import Channel, Message, Scan, zstd

__all__ = ["scan_db3"]

_INSTRUCTIONS, _A_STEP = 20_000, 100  # of SQLite between two looks at their number; and in the time of a step of Python
_TABLES = ("topics", "messages", "message_definitions")
_TABLE = re.compile(r"CREATE TABLE\b", re.IGNORECASE)


def scan_db3(path: Path, scan: Scan, *, compressed: bool = False) -> Iterator[Message]:
    """The messages of a ROS 2 SQLite file, in the order they were written; `compressed`: each by itself, by zstd."""
    import sqlite3

    with ExitStack() as stack:
        budget = scan.budget
        base = stack.enter_context(closing(_connect(_whole_pages(path, scan, stack))))
        _bound(base, budget)
        try:
            channels = _channels(base)
        except sqlite3.DatabaseError as error:
            budget.work(0)
            raise RecordingError(f"{path} cannot be read as a ROS 2 bag, and may be damaged: {error}") from error
        wanted = [number for number, channel in channels.items() if scan.wanted(channel.topic)]
        marks = ",".join("?" * len(wanted))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY id"
        try:
            for number, log, data in base.execute(query, wanted):
                if not isinstance(data, bytes) or not isinstance(log, int):
                    scan.damaged += 1
                    continue
                budget.work()
                budget.take(len(data))
                yield Message(channels[number], log, None, None, 0, _inflated(data, budget) if compressed else data)
        except sqlite3.DatabaseError as error:
            budget.work(0)
            scan.cut_off = str(error)


def _inflated(data: bytes, budget: Budget) -> bytes:
    """A message that was compressed by itself."""
    inflating, parts = zstd().ZstdDecompressor(), []
    while not inflating.eof:
        part = inflating.decompress(data, max_length=1 << 24)
        if not part and inflating.needs_input:
            break  # it was cut off
        budget.take(len(part))
        parts.append(part)
        data = b""
    return b"".join(parts)


def _bound(base: Any, budget: Budget) -> None:
    """SQLite stops where a query costs more than a file of this size can ask for: a forged one can ask for ever."""
    import sqlite3

    def count() -> bool:
        try:
            budget.work(_INSTRUCTIONS // _A_STEP)
        except RecordingError:
            return True
        return False

    base.set_progress_handler(count, _INSTRUCTIONS)
    limits = {
        sqlite3.SQLITE_LIMIT_LENGTH: min(LARGEST, budget.room()),
        sqlite3.SQLITE_LIMIT_SQL_LENGTH: 1 << 20,
        sqlite3.SQLITE_LIMIT_EXPR_DEPTH: 100,
        sqlite3.SQLITE_LIMIT_ATTACHED: 0,
    }
    for limit, most in limits.items():
        base.setlimit(limit, most)


def _whole_pages(path: Path, scan: Scan, stack: ExitStack) -> Path:
    """A file that ends inside a page without that page, as a copy: SQLite would read zeros for what is missing."""
    with path.open("rb") as file:
        head = file.read(100)
        if head[:16] != b"SQLite format 3\0" or len(head) < 100:
            raise RecordingError(f"{path} does not begin as an SQLite file does")
        page = int.from_bytes(head[16:18], "big")
        page = 65536 if page == 1 else page
        size = path.stat().st_size
        if page < 512 or size % page == 0:
            return path
        scan.cut_off = "it ends in the middle of a page"
        scan.budget.take(size)
        target = Path(stack.enter_context(tempfile.TemporaryDirectory())) / path.name
        file.seek(0)
        with target.open("wb") as copy:
            for _ in range(size // page):
                copy.write(file.read(page))
    return target


def _connect(path: Path) -> Any:
    import sqlite3

    address = path.resolve().as_uri()
    for mode in ("mode=ro", "mode=ro&immutable=1"):  # a write-ahead log cannot be read where nothing may be written
        base = sqlite3.connect(f"{address}?{mode}", uri=True)
        base.text_factory = lambda data: data.decode(errors="replace")
        try:
            base.execute("PRAGMA trusted_schema=OFF")
            base.execute("PRAGMA writable_schema=ON")  # otherwise SQLite gives nothing of a file that was cut off
            base.execute("SELECT 1 FROM sqlite_master").fetchone()
            return base
        except sqlite3.OperationalError:
            base.close()
        except sqlite3.DatabaseError as error:
            base.close()
            raise RecordingError(f"{path} cannot be read as a ROS 2 bag, and may be damaged: {error}") from error
    raise RecordingError(f"{path} cannot be opened as an SQLite file: is it being written, or readable at all?")


def _plain(base: Any, table: str) -> bool:
    """Whether no column of a table is computed or hidden."""
    return not any(hidden for *_, hidden in base.execute("SELECT * FROM pragma_table_xinfo(?)", (table,)))


def _channels(base: Any) -> dict[int, Channel]:
    tables: set[str] = set()
    for kind, name, sql in base.execute("SELECT type, name, sql FROM sqlite_master"):
        # A view may pose as a table, and a column may be computed when it is read.
        if str(name).lower() in _TABLES and not (kind == "table" and _TABLE.match(str(sql)) and _plain(base, name)):
            raise RecordingError(f"{name} is no table as a ROS 2 bag has it: {str(sql)!r:.100}")
        tables |= {str(name)} if kind == "table" else set()
    if not {"topics", "messages"} <= tables:
        raise RecordingError(f"expected the tables topics and messages of a ROS 2 bag; there are {sorted(tables)[:20]}")
    definitions = {}
    if "message_definitions" in tables:  # since ROS 2 Iron
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        definitions = {name: (str(text), form == "ros2idl") for name, form, text in base.execute(query)}
    return {
        number: Channel(str(topic), str(name), str(form), *definitions.get(name, ("", False)))
        for number, topic, name, form in base.execute("SELECT id, name, type, serialization_format FROM topics")
    }
