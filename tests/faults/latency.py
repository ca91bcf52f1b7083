"""What a durable observation costs, and what of it the disk takes: `python tests/faults/latency.py`.

Beside each observation (the embedding is done beforehand; BioTac: 400 readings of 19 channels, 1008 features) stand,
in turns on the same disk, the least that durability can cost: as many bytes as its row has appended to a file and
fdatasync, and as many inserted into a bare SQLite database with a write-ahead log and synchronous=FULL.

    overhead = (ours - append and fdatasync) / (append and fdatasync), of the medians

Of ours the store's part is told by itself, too, and packing the codes for it: the rest is arithmetic, adding to the
memory's sums. The bulk: as many observations in one `batch()`, against one by one, on this disk and on one on which
each sync is made to take longer (5 ms: a good card; 30 ms: a cheap card, or a disk that turns).
"""

from __future__ import annotations

import argparse
import os
import random
import sqlite3
import statistics
import sys
import time
from collections.abc import Callable
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from faults.common import file_system, folder, parser, progress, run
from faults.feeding import BIOTAC, TINY, endless, observe, touches
from faults.shim import Shim, begin_again_watched
from scroll_tactile import TactileLearner
from scroll_tactile.memory.touch_rows import pack_codes

INSERT = "INSERT INTO kept (bytes) VALUES (?)"
TOGETHER = 25  # of one kind in a row
SLOWER = (5.0, 30.0)  # milliseconds


def told(seconds: list[float]) -> dict[str, float]:
    """Percentiles, in milliseconds."""
    ordered = sorted(seconds)
    return {
        "p50 ms": 1e3 * statistics.median(ordered),
        "p99 ms": 1e3 * ordered[int(0.99 * (len(ordered) - 1))],
        "mean ms": 1e3 * statistics.fmean(ordered),
    }


def timed(do: Callable[[], object]) -> float:
    """Seconds."""
    begun = time.perf_counter()
    do()
    return time.perf_counter() - begun


def one_by_one(home: Path, settings: dict[str, Any], count: int, **more: Any) -> dict[str, Any]:
    """Observations, and in turns with them what durability costs at least."""
    rng = random.Random(0)
    feed = endless(touches(settings, 4, 3))
    seconds: dict[str, list[float]] = {"observe": [], "packing": [], "store.append": [], "file": [], "sqlite": []}
    with (
        TactileLearner.open(home / "memory", **settings, **more) as learner,
        (home / "file").open("ab", buffering=0) as file,
        closing(sqlite3.connect(home / "bare.sqlite", isolation_level=None)) as bare,
    ):
        bare.execute("PRAGMA journal_mode = WAL")
        bare.execute("PRAGMA synchronous = FULL")
        bare.execute("CREATE TABLE kept (sequence INTEGER PRIMARY KEY, bytes BLOB)")
        store = learner._ledger.store
        assert store is not None
        append = store.append

        def measured(*arguments: Any, **named: Any) -> Any:
            begun = time.perf_counter()
            head = append(*arguments, **named)
            seconds["store.append"].append(time.perf_counter() - begun)
            sizes.append(head.size)
            return head

        def to_file(data: bytes) -> None:
            file.write(data)
            os.fdatasync(file.fileno())

        store.append = measured  # type: ignore[method-assign]
        sizes: list[int] = []
        while len(seconds["observe"]) < count:
            fed = [next(feed) for _ in range(TOGETHER)]
            seconds["observe"] += [timed(lambda one=one: observe(learner, one)) for one in fed]
            seconds["packing"] += [timed(lambda one=one: pack_codes(one.codes)) for one in fed]
            parts = [rng.randbytes(size) for size in sizes[-TOGETHER:]]
            seconds["file"] += [timed(lambda part=part: to_file(part)) for part in parts]
            seconds["sqlite"] += [timed(lambda part=part: bare.execute(INSERT, (part,))) for part in parts]
    bare_cost = statistics.median(seconds["file"])
    figures: dict[str, Any] = {name: told(those) for name, those in seconds.items()}
    figures["observations"] = len(seconds["observe"])
    figures["bytes of a row"] = statistics.fmean(sizes)
    for name in ("observe", "store.append", "sqlite"):
        figures[f"overhead of {name}"] = (statistics.median(seconds[name]) - bare_cost) / bare_cost
    figures["share of the disk"] = bare_cost / statistics.median(seconds["observe"])
    return figures


def bulk(home: Path, settings: dict[str, Any], count: int, slower: float, **more: Any) -> dict[str, float]:
    """Observations a second, one by one and in a batch, where each sync takes some milliseconds more."""
    feed, rates, shim = endless(touches(settings, 4, 3)), {}, Shim()
    for name in ("one by one", "batch"):
        of = min(count, 100) if slower and name == "one by one" else count
        fed = [next(feed) for _ in range(of)]
        with TactileLearner.open(home / f"{name}, {slower:g} ms", **settings, **more) as learner:
            observe(learner, fed[0])
            shim.slow(slower)
            begun = time.perf_counter()
            with learner.batch() if name == "batch" else nullcontext():
                for one in fed:
                    observe(learner, one)
            rates[f"{name}, a second"] = of / (time.perf_counter() - begun)
            shim.slow(0)
    return rates | {"ratio": rates["batch, a second"] / rates["one by one, a second"]}


def main(options: argparse.Namespace) -> dict[str, Any]:
    """Everything, and the load of the machine meanwhile."""
    count = 25 if options.quick else options.count
    figures: dict[str, Any] = {}
    with folder(options) as home:
        figures["disk"] = file_system(home)
        figures["load before"] = os.getloadavg()[0]
        kinds = {
            "BioTac, 1008 features": (BIOTAC, {}),
            "BioTac, 1008 features, exemplars=0": (BIOTAC, {"exemplars": 0}),
            "tiny, 64 features, exemplars=0": (TINY, {"exemplars": 0}),
        }
        if options.quick:
            kinds = dict([kinds.popitem()])
        for number, (name, (settings, more)) in enumerate(kinds.items()):
            (where := home / str(number)).mkdir()
            figures[name] = one_by_one(where, settings, count, **more)
            progress(f"{name}: {figures[name]['observe']}")
            for slower in (0.0, *SLOWER[: 1 if options.quick else 2]):
                told_as = f"bulk: {name}" + (f", each sync {slower:g} ms longer" if slower else "")
                figures[told_as] = bulk(where, settings, count, slower, **more)
                progress(f"{told_as}: {figures[told_as]}")
        figures["load after"] = os.getloadavg()[0]
    return figures


if __name__ == "__main__":
    begin_again_watched()
    run("latency", parser(__doc__, count=1000).parse_args(), main)
