"""What a memory takes on the disk, and how long one of a million observations takes to open: `python
tests/faults/space.py --observations 1000000`.

With the default kernels and simulated BioTac touches: bytes of an observation (a row of the log), of a material
and of an exemplar (in the checkpoint), before and after compaction. Then the store alone, with as many small rows: how
long opening takes, a reader's look whether something came, the newest checkpoint and the rows behind it. Then synthetic
features of 64 dimensions, in batches of 10 000, without exemplars; compacted; opened three times, each in a fresh
process.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from scroll_tactile_store import Store

from faults.common import file_system, folder, parser, progress, run
from faults.feeding import BIOTAC, TINY, endless, observe, touches
from scroll_tactile import TactileLearner

BATCH = 10_000
BAR = 2.0  # seconds to open

OPEN = """
import sys, time
sys.path.insert(0, {tests!r})
from faults.feeding import TINY
from scroll_tactile import TactileLearner
begun = time.perf_counter()
learner = TactileLearner.open({path!r}, exemplars=0, **TINY)
print(time.perf_counter() - begun, learner.digest())
learner.close()
"""


def sizes(path: Path, materials: int, of_each: int, exemplars: int | None, keep: int | None = None) -> dict[str, int]:
    """Bytes of the log and of the newest checkpoint of a memory, after it was closed."""
    fed = islice(endless(touches(BIOTAC, materials, 1)), materials * of_each)
    with TactileLearner.open(path, **BIOTAC, exemplars=exemplars) as learner:
        with learner.batch():
            for one in fed:
                observe(learner, one)
        if keep is not None:
            learner.compact(keep=keep)
    (log,) = path.glob("log-*")
    checkpoints = sorted((path / "checkpoints").iterdir())
    return {
        "log": log.stat().st_size,
        "checkpoint": sum(file.stat().st_size for file in checkpoints[-1].rglob("*") if file.is_file()),
        "all": sum(file.stat().st_size for file in path.rglob("*") if file.is_file()),
    }


def apiece(home: Path, count: int) -> dict[str, float]:
    """Bytes of one more of each."""
    few, many = sizes(home / "1", 2, count, 0), sizes(home / "2", 2, 2 * count, 0)
    raw = sizes(home / "3", 2, 2 * count, None)
    more = sizes(home / "4", 8, count // 2, 0)
    compacted = sizes(home / "5", 2, 2 * count, None, keep=0)
    bare = sizes(home / "6", 2, 2 * count, 0, keep=0)
    kept = min(4 * count, 1200)  # three candidates for each of 400 exemplars
    return {
        "an observation, without readings": (many["log"] - few["log"]) / (2 * count),
        "an observation, with readings": raw["log"] / (4 * count),
        "a material, in a checkpoint": (more["checkpoint"] - few["checkpoint"]) / 6,
        "a candidate for an exemplar, in a checkpoint": (raw["checkpoint"] - many["checkpoint"]) / kept,
        f"all of {4 * count} observations": raw["all"],
        "the same, compacted": compacted["all"],
        "an observation, compacted (what is known of it)": bare["log"] / (4 * count),
    }


def rows_alone(home: Path, count: int) -> dict[str, Any]:
    """Milliseconds of what a reader does with a store of so many rows, of which the last 100 are in no checkpoint."""
    path, x = home / "rows", np.arange(8, dtype=np.int16)
    with Store.open(path, identity={}) as store:
        for begin in range(0, count, BATCH):
            with store.batch():
                for i in range(begin, min(begin + BATCH, count)):
                    store.append("a", f"material {i % 1000}", i.to_bytes(16), arrays={"x": x})
        store.commit({"x": np.zeros(1000)}, last_sequence=max(count - 100, 0))
    figures: dict[str, Any] = {"rows": count, "bytes": sum(file.stat().st_size for file in path.glob("log-*"))}
    for mode in ("read", "write"):
        begun = time.perf_counter()
        store = Store.open(path, mode=mode)
        figures[f"ms to open to {mode}"] = 1e3 * (time.perf_counter() - begun)
        for what, look in {
            "look whether something came": lambda store: store.state(),
            "read the newest checkpoint": lambda store: store.latest(),
            "read the rows behind it": lambda store: list(store.records(after=store.latest().last_sequence)),
            "find the rows of one material": lambda store: [
                head for head in store.heads() if head.label == "material 7"
            ],
        }.items():
            begun = time.perf_counter()
            look(store)
            figures[f"ms to {what}, {mode}"] = 1e3 * (time.perf_counter() - begun)
        store.close()
    return figures


def million(home: Path, observations: int, minutes: float, openings: int) -> dict[str, Any]:
    """A large memory: as many observations as asked, or as fit into the time."""
    path, figures = home / "large", {"asked": observations}
    feed = endless(touches(TINY, 20, 10))
    begun, done = time.perf_counter(), 0
    with TactileLearner.open(path, **TINY, exemplars=0) as learner:
        while done < observations and time.perf_counter() - begun < 60 * minutes:
            fed = list(islice(feed, min(BATCH, observations - done)))
            with learner.batch():
                for one in fed:
                    observe(learner, one)
            done += len(fed)
            progress(f"{done} observations, {done / (time.perf_counter() - begun):.0f} a second")
        figures |= {"observations": done, "a second": done / (time.perf_counter() - begun)}
        begun = time.perf_counter()
        compacted = learner.compact(keep=0)
        figures |= {
            "seconds to compact": time.perf_counter() - begun,
            "bytes before": compacted.bytes_before,
            "bytes after": compacted.bytes_after,
        }
        digest = learner.digest()
    command = OPEN.format(tests=str(Path(__file__).resolve().parents[1]), path=str(path))
    figures["seconds to open"] = []
    for _ in range(openings):
        said = subprocess.run(
            [sys.executable, "-c", command], check=True, capture_output=True, text=True
        ).stdout.split()
        figures["seconds to open"].append(float(said[0]))
        figures["digest is the same"] = said[1] == digest
    return figures


def main(options: argparse.Namespace) -> dict[str, Any]:
    """Both."""
    observations = 500 if options.quick else options.observations
    with folder(options) as home:
        figures: dict[str, Any] = {"disk": file_system(home), "load before": os.getloadavg()[0]}
        if not options.quick:  # a memory of the default kernels takes seconds to make
            figures["bytes"] = apiece(home, 100)
            progress(str(figures["bytes"]))
        figures["rows"] = rows_alone(home, observations)
        figures["large"] = large = million(home, observations, options.minutes, 1 if options.quick else 3)
        figures["load after"] = os.getloadavg()[0]
    failures = [f"opened in {took:.2f} s" for took in large["seconds to open"] if took > BAR and not options.quick]
    if not large["digest is the same"]:
        failures.append("the large memory is not what it was when it is opened again")
    return figures | {"failures": failures}


if __name__ == "__main__":
    run("space", parser(__doc__, observations=1_000_000, minutes=8.0).parse_args(), main)
