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
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer
from scroll_tactile_store.log import Log, create_log
from scroll_tactile_store.rows import ROW, encode_row

from examples.benchmarks.timing import Timing, timed
from examples.paper.runs.options import Json, Seed
from examples.paper.runs.results import show, write
from scroll_tactile.clients.cli.terminal import progress_bar

__all__ = ["log", "run_appending"]

ROW_BYTES = 4300  # of a touch with its readings, BioTac
ROWS = 240  # in a round: about one MiB, so that each round has one write of zeros ahead
BLOCK = 512  # bytes, of the disk's counters
WRITTEN = 6  # the place of blocks written among them

Append = Callable[[int, bytes], object]


def run_appending(folder: Path, *, rounds: int, seed: int, note: Callable[[str], None]) -> dict[str, Any]:
    """Append rows in rounds, each way in its turn, every other round in the other order."""
    rng = np.random.default_rng(seed)
    result: dict[str, Any] = {"bench": "log", "row_bytes": ROW_BYTES, "rows": rounds * ROWS}
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
    journal = opened.enter_context(Log(folder / "log", write=True))
    journal.prepare()
    bare = os.open(folder / "bare", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    opened.callback(os.close, bare)
    about = ("add", "material", bytes(32), time.time(), "{}")

    def as_row(sequence: int, payload: bytes) -> bytes:
        return encode_row(sequence, *about, payload=payload, size=len(payload))

    def to_log(*row: Any) -> None:
        journal.stage(ROW, as_row(*row))
        journal.commit()

    def to_bare(_: int, payload: bytes) -> None:
        os.write(bare, payload)
        os.fdatasync(bare)

    return {
        "SQLite, WAL, synchronous=FULL": lambda *row: database.execute(
            "INSERT INTO row VALUES (?, ?)", (row[0], as_row(*row))
        ),
        "the log": to_log,
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


def log(
    context: typer.Context,
    rounds: Annotated[int, typer.Option(min=1, help=f"Of {ROWS} rows, each way in its turn.")] = 40,
    folder: Annotated[Path | None, typer.Option(help="On the disk to measure; the system's temporary one.")] = None,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Time a durable row of 4.3 kB, and count the bytes it makes the disk write: the log beside a table of SQLite."""
    with progress_bar() as progress, TemporaryDirectory(dir=folder) as scratch:
        result = run_appending(Path(scratch), rounds=rounds, seed=seed, note=lambda what: progress(what, 0, 1))
    columns = {"a row of 4.3 kB": "{./case}", "ms, p50": "{./median_milliseconds|.2f}"}
    columns |= {"p99": "{./p99_milliseconds|.2f}", "times SQLite's": "{./times_sqlite|.2f}"}
    columns |= {"p99, times": "{./p99_times_sqlite|.2f}", "written, kB": "{?./written_bytes|/1000|.1f}"}
    show("appending", columns, result["records"])
    write(context, result)
