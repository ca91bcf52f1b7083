"""What an acknowledged row costs: the log beside a table of SQLite, in turns on one disk.

Beside them stands the least that a durable row can cost: its bytes written to the end of a file, and fdatasync. Bytes
are those that the disk counts, the file system's own journal among them, so other programs must leave the disk alone:
the median over rounds passes over what they do now and then.
"""

from __future__ import annotations

import os
import sqlite3
import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from examples.benchmarks.timing import Timing, circumstances, timed
from scroll_tactile.cli.terminal import console
from store.log_writer import LogWriter, create_log
from store.row_encoding import ROW, encode_row

__all__ = ["run_appending", "show_appending"]

ROW_BYTES = 4300  # of a touch with its readings, BioTac
ROWS = 240  # in a round: about one MiB, so that each round has one write of zeros ahead
BLOCK = 512  # bytes, of the disk's counters
WRITTEN = 6  # the place of blocks written among them

Append = Callable[[int, bytes], object]


def run_appending(folder: Path, *, rounds: int, seed: int, note: Callable[[str], None]) -> dict[str, Any]:
    """Append rows in rounds, each way in its turn, every other round in the other order."""
    rng = np.random.default_rng(seed)
    result: dict[str, Any] = {"bench": "log", **circumstances(seed), "row_bytes": ROW_BYTES, "rows": rounds * ROWS}
    with ExitStack() as opened:
        ways = _ways(folder, opened)
        seconds: dict[str, list[float]] = {name: [] for name in ways}
        written: dict[str, list[float]] = {name: [] for name in ways}
        sequence = 0
        for number in range(rounds):
            note(f"round {number + 1} of {rounds}")
            payloads = [rng.bytes(ROW_BYTES) for _ in range(ROWS)]
            for name in list(ways) if number % 2 else reversed(list(ways)):
                before = _bytes_written(folder)
                for index, payload in enumerate(payloads, sequence + 1):
                    seconds[name].append(_seconds(ways[name], index, payload))
                after = _bytes_written(folder)
                if before is not None and after is not None:
                    written[name].append((after - before) / ROWS)
            sequence += ROWS
    return result | {"records": _records(seconds, written)}


def _ways(folder: Path, opened: ExitStack) -> dict[str, Append]:
    database = opened.enter_context(closing(sqlite3.connect(folder / "rows.sqlite", isolation_level=None)))
    for statement in ("PRAGMA journal_mode = WAL", "PRAGMA synchronous = FULL"):
        database.execute(statement)
    database.execute("CREATE TABLE row (sequence INTEGER PRIMARY KEY, bytes BLOB) STRICT")
    create_log(folder / "log", b"{}")
    log = opened.enter_context(LogWriter(folder / "log"))
    bare = os.open(folder / "bare", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    opened.callback(os.close, bare)
    about = ("add", "material", bytes(32), time.time(), "{}")

    def as_row(sequence: int, payload: bytes) -> bytes:
        return encode_row(sequence, *about, payload=payload, size=len(payload))

    def to_bare(_: int, payload: bytes) -> None:
        os.write(bare, payload)
        os.fdatasync(bare)

    return {
        "SQLite, WAL, synchronous=FULL": lambda *row: database.execute(
            "INSERT INTO row VALUES (?, ?)", (row[0], as_row(*row))
        ),
        "the log": lambda *row: log.append(ROW, as_row(*row)),
        "a bare file that grows, fdatasync": to_bare,
    }


def _seconds(append: Append, sequence: int, payload: bytes) -> float:
    return timed(lambda: append(sequence, payload))


def _bytes_written(folder: Path) -> int | None:
    """The bytes that the folder's disk has written so far; None where the system does not count them."""
    device = folder.stat().st_dev
    counters = Path(f"/sys/dev/block/{os.major(device)}:{os.minor(device)}/stat")
    try:
        return int(counters.read_text(encoding="ascii").split()[WRITTEN]) * BLOCK
    except OSError:
        return None


def _records(seconds: dict[str, list[float]], written: dict[str, list[float]]) -> list[dict[str, Any]]:
    timings = {name: Timing.of(taken) for name, taken in seconds.items()}
    first = next(iter(timings.values()))
    return [
        {
            "case": name,
            **timing.record(),
            "times_sqlite": timing.median / first.median,
            "p99_times_sqlite": timing.p99 / first.p99,
            "written_bytes": statistics.median(written[name]) if written[name] else None,
        }
        for name, timing in timings.items()
    ]


def show_appending(result: dict[str, Any]) -> None:
    """Print what a row costs each way."""
    table = Table("a row of 4.3 kB", "ms, median / p99", "times SQLite's", "p99, times", "written, kB")
    for record in result["records"]:
        times = f"{record['median_milliseconds']:.2f} / {record['p99_milliseconds']:.2f}"
        kilobytes = "" if record["written_bytes"] is None else f"{record['written_bytes'] / 1e3:.1f}"
        ratios = f"{record['times_sqlite']:.2f}", f"{record['p99_times_sqlite']:.2f}"
        table.add_row(record["case"], times, *ratios, kilobytes)
    console().print(table)
