"""The whole system in one seeded simulation: `python tests/faults/simulate.py --seeds 10000 --json FILE`.

Two robots and a central memory observe, retract, relabel, compact, back up, pack and merge, while their disks lose what
was not synced, fill up and rot, their processes die, and a bucket between them loses, doubles and delays what is packed
(see simulation_world.py, and what goes on from it). What is seen of each memory must be what the model says (see
model.py). All of a run comes from its seed; one that fails is made shorter, and told. `--first S` begins with
another seed.

That it is harsh enough shows `--plant NAME`: the bug of that name (see planted_*.py) is put in, and must be found;
`--plants` does so with all of them. `--seed S` replays one seed, `--whole` without making it shorter.
"""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import faults.planted_reads
import faults.planted_writes  # noqa: F401  # which name their bugs
from faults import shim as watch
from faults import simulation_kit
from faults.common import folder, parser, progress, run, warnings_told
from faults.planting import BUGS, planted
from faults.shim import Shim
from faults.simulation_system import System

WEIGHTS = {
    "small": 36,
    "batch": 6,
    "relabel": 4,
    "compact": 3,
    "reembed": 0.4,
    "tick": 6,
    "close": 4,
    "cut": 3,
    "kill": 4,
    "reader": 3,
    "refresh": 10,
    "leave": 2,
    "backup": 2.5,
    "restore": 4,
    "pack": 4,
    "collect": 5,
    "merge": 3,
    "rot": 3.5,
    "quiet": 3,
}
QUICK_SEEDS = 6
QUICK_PLANTS = ("the log is not synced", "a retraction is lost in a merge or in packing")
MISFITS = ("AttributeError", "NameError", "TypeError")  # of a bug that is put in where nothing is
SHORTENINGS = 400
Event = tuple[str, int]


def events_of(seed: int) -> list[Event]:
    """The events of a seed, each with its own."""
    rng = random.Random(seed)
    kinds = rng.choices(list(WEIGHTS), list(WEIGHTS.values()), k=rng.randint(60, 100))
    return [(kind, rng.randrange(2**32)) for kind in kinds]


class Simulation:
    """Seeds, one after another."""

    def __init__(self, home: Path) -> None:
        self._home, self._shim, self._log = home / "run", Shim(), home / "log"
        self._shim.log(self._log)
        self.counts: Counter[str] = Counter()

    def play(self, events: Sequence[Event]) -> tuple[str | None, list[str]]:
        """What went wrong, None where nothing did; and what happened."""
        shutil.rmtree(self._home, ignore_errors=True)
        world = System(self._home, self._shim, self._log, self.counts)
        try:
            with warnings_told(world.warned.append):
                for kind, seed in events:
                    world.play(kind, seed)
                world.finish(random.Random(events[-1][1]))
        except Exception as error:
            self._shim.disarm()
            return f"{type(error).__name__}: {error}", world.told
        finally:
            world.close()
        return None, world.told

    def first_failing(self, first: int, end: int) -> int | None:
        """The first of the seeds that fails, None where none does."""
        return next((seed for seed in range(first, end) if self.play(events_of(seed))[0] is not None), None)

    def _shortened(self, events: list[Event]) -> list[Event]:
        """Fewer events that fail, too."""
        size, tried = len(events) // 2, 0
        while size and tried < SHORTENINGS:
            place = 0
            while place < len(events) and tried < SHORTENINGS:
                fewer = events[:place] + events[place + size :]
                tried += 1
                if fewer and self.play(fewer)[0] is not None:
                    events = fewer
                else:
                    place += size
            size //= 2
        return events

    def tell(self, seed: int, *, shorten: bool) -> str:
        """A seed as a story, which ends with what failed, if anything; it counts for nothing."""
        counts, events = Counter(self.counts), events_of(seed)
        if shorten and self.play(events)[0] is not None:
            events = self._shortened(events)
        why, told = self.play(events)
        self.counts = counts
        return "\n".join([f"seed {seed}, {len(events)} events:", *told, f"=> {why or 'does not fail'}"])


def sound(simulation: Simulation, options: argparse.Namespace) -> dict[str, Any]:
    """Without any bug put in: no seed fails."""
    failures: list[str] = []
    begun = said = time.monotonic()
    end = options.first + options.seeds
    for seed in range(options.first, end):
        if simulation.first_failing(seed, seed + 1) is not None:
            failures.append(simulation.tell(seed, shorten=not options.whole))
            progress(failures[-1])
        if (now := time.monotonic()) - said > 5 or seed + 1 == end:
            said, done = now, seed + 1 - options.first
            progress(f"seed {seed + 1} of {end}, {done / (now - begun):.1f} a second, {len(failures)} failed")
    return {"seeds": options.seeds, "events": dict(sorted(simulation.counts.items())), "failures": failures}


def found(simulation: Simulation, options: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    """With each of these bugs some seed fails."""
    plants: dict[str, Any] = {}
    for name in names:
        with planted(name):
            begun, failed = time.monotonic(), simulation.first_failing(options.first, options.first + options.seeds)
            told = "" if failed is None else simulation.tell(failed, shorten=bool(options.plant))
        what = told.rpartition("=> ")[2]
        if what.startswith(MISFITS):
            sys.exit(f"{name} does not fit what it spoils any more: {what}")
        if options.plant:
            progress(told)
        taken = None if failed is None else failed + 1 - options.first
        progress(f"{name}: {taken} seeds, {time.monotonic() - begun:.0f} s: {what[:160]}")
        plants[name] = {"seeds": taken, "told": what[:400]}
    missed = [name for name in names if plants[name]["seeds"] is None]
    return {"plants": plants, "failures": [f"not found in {options.seeds} seeds: {name}" for name in missed]}


def main(options: argparse.Namespace) -> dict[str, Any]:
    """As asked."""
    if options.plant and options.plant not in BUGS:
        sys.exit(f"expected a bug to put in: {', '.join(BUGS)}")
    simulation_kit.prepare()
    with folder(options, in_memory=True) as home:
        simulation = Simulation(home)
        if options.seed is not None:
            print(text := simulation.tell(options.seed, shorten=not options.whole))
            return {"failures": [] if text.endswith("does not fail") else [text.splitlines()[-1]]}
        if options.plant or options.plants:
            return found(simulation, options, [options.plant] if options.plant else list(BUGS))
        if not options.quick:
            return sound(simulation, options)
        options.seeds = QUICK_SEEDS
        ours, options.seeds = sound(simulation, options), 50
        plants = found(simulation, options, QUICK_PLANTS)
        return ours | plants | {"failures": ours["failures"] + plants["failures"]}


if __name__ == "__main__":
    watch.begin_again_watched()
    run(
        "simulate",
        parser(__doc__, seed=None, seeds=1000, first=0, whole=False, plant="", plants=False).parse_args(),
        main,
    )
