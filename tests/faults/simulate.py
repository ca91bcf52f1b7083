"""The whole system in one seeded simulation: `python tests/faults/simulate.py --seeds 10000 --json FILE`.

Two robots and a central memory observe, retract, relabel, compact, back up, pack and merge, while their disks lose what
was not synced, fill up and rot, their processes die, and a bucket between them loses, doubles and delays what is packed
(see simulation_world.py, and what goes on from it). What is seen of each memory must be what a dumb model says (see
simulation_model.py). All of a run comes from its seed; one that fails is made shorter, and told. `--json` names a file
from which a later call goes on.

That it is harsh enough shows `--plant NAME`: the bug of that name (see planted.py) is put in, and must be found;
`--plants` does so with all of them. `--seed S` replays one seed.
"""

from __future__ import annotations

import argparse
import gc
import json
import random
import shutil
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from faults import shim as watch
from faults import simulation_disk, simulation_touches
from faults.common import folder, progress, warnings_told
from faults.planted import PLANTS
from faults.shim import Shim
from faults.simulation_system import System
from scroll_tactile.errors import RangeWarning

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
    "derived": 4,
    "quiet": 3,
}
QUICK_SEEDS = 12
QUICK_PLANTS = ("the log is not synced", "CURRENT is not synced", "a retraction is lost in a merge")
MISFITS = ("=> AttributeError", "=> NameError", "=> TypeError")  # of a bug that is put in where nothing is
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

    def shortened(self, events: list[Event], most: int = 400) -> list[Event]:
        """Fewer events that fail, too."""
        size, tried = len(events) // 2, 0
        while size and tried < most:
            place = 0
            while place < len(events) and tried < most:
                fewer = events[:place] + events[place + size :]
                tried += 1
                if fewer and self.play(fewer)[0] is not None:
                    events = fewer
                else:
                    place += size
            size //= 2
        return events

    def tell(self, seed: int, *, shorten: bool = True) -> str:
        """A seed that fails, as a story."""
        events = events_of(seed)
        if self.play(events)[0] is None:
            return f"seed {seed} does not fail"
        events = self.shortened(events) if shorten else events
        why, told = self.play(events)
        return "\n".join([f"seed {seed}, {len(events)} events:", *told, f"=> {why}"])


def prepare() -> None:
    """Have everything small, quick and in the hands of the schedule."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 100)
    simulation_disk.prepare()
    simulation_touches.prepare()
    warnings.simplefilter("ignore", RangeWarning)


def parsed() -> argparse.Namespace:
    """The options."""
    made = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    made.add_argument("--quick", action="store_true", help="some seeds, and some bugs, in seconds")
    made.add_argument("--seeds", type=int, default=1000)
    made.add_argument("--first", type=int, default=0)
    made.add_argument("--seed", type=int, help="replay one")
    made.add_argument("--whole", action="store_true", help="do not make it shorter")
    made.add_argument("--json", type=Path, help="file for the record, from which a later call goes on")
    made.add_argument("--home", type=Path)
    made.add_argument("--plant", help="put this bug in", choices=PLANTS)
    made.add_argument("--plants", action="store_true", help="put each of the bugs in, one after another")
    return made.parse_args()


class Record:
    """What is known so far, in a file."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.known: dict[str, Any] = {}
        if path is not None and path.exists():
            self.known = json.loads(path.read_text(encoding="utf-8"))

    def write(self, **more: Any) -> None:
        """Add to it."""
        self.known |= more
        if self.path is not None:
            self.path.write_text(json.dumps(self.known, indent=1) + "\n", encoding="utf-8")


def many(simulation: Simulation, first: int, seeds: int, told: Callable[[int, float], None] | None) -> int | None:
    """Play seeds until one fails: that one, None where none does."""
    begun = last = time.perf_counter()
    for seed in range(first, first + seeds):
        if simulation.play(events_of(seed))[0] is not None:
            return seed
        now = time.perf_counter()
        if told is not None and (now - last > 5 or seed == first + seeds - 1):
            last = now
            told(seed, (seed + 1 - first) / (now - begun))
    return None


def sound(simulation: Simulation, options: argparse.Namespace) -> int:
    """Without any plant: no seed fails."""
    record = Record(options.json)
    failures = record.known.get("failures", {})
    simulation.counts.update(record.known.get("events", {}))
    end, next_one = options.first + options.seeds, record.known.get("next", options.first)

    def told(seed: int, speed: float) -> None:
        progress(f"seed {seed} of {end}, {speed:.1f} a second, {len(failures)} failed")
        record.write(next=seed + 1, events=dict(sorted(simulation.counts.items())), failures=failures)

    while next_one < end and (failed := many(simulation, next_one, end - next_one, told)) is not None:
        counts = Counter(simulation.counts)
        failures[str(failed)] = simulation.tell(failed, shorten=not options.whole)
        simulation.counts = counts
        progress(failures[str(failed)])
        next_one = failed + 1
        record.write(next=next_one, events=dict(sorted(simulation.counts.items())), failures=failures)
    for name, count in sorted(simulation.counts.items()):
        print(f"  {name:<36} {count}")
    print(f"{options.seeds} seeds, {len(failures)} failed: {sorted(map(int, failures))}")
    return bool(failures)


def planted(simulation: Simulation, options: argparse.Namespace) -> int:
    """With each plant: some seed fails."""
    record = Record(options.json)
    found: dict[str, Any] = record.known.setdefault("plants", {})
    for name in [options.plant] if options.plant else QUICK_PLANTS if options.quick else PLANTS:
        if not options.plant and name in found:
            continue
        with PLANTS[name]():
            begun = time.perf_counter()
            failed = many(simulation, options.first, options.seeds, None)
            if failed is None:
                progress(f"{name}: not found in {options.seeds} seeds")
                found[name] = {"seeds": None, "tried": options.seeds}
            else:
                told = simulation.tell(failed, shorten=False).splitlines()[-1]
                if told.startswith(MISFITS):
                    sys.exit(f"{name} does not fit what it spoils any more: {told}")
                if options.plant:
                    progress(simulation.tell(failed))
                taken = failed + 1 - options.first
                progress(f"{name}: found in {taken} seeds, {time.perf_counter() - begun:.0f} s: {told[:160]}")
                found[name] = {"seeds": taken, "told": told[:400]}
        record.write(plants=found)
    missed = [name for name, about in found.items() if about["seeds"] is None]
    print(f"{len(found)} plants, {len(missed)} not found: {missed}")
    return bool(missed)


def main() -> int:
    """As asked."""
    options = parsed()
    prepare()
    with folder(options, in_memory=True) as home:
        simulation = Simulation(home)
        if options.seed is not None:
            text = simulation.tell(options.seed, shorten=not options.whole)
            print(text)
            return "does not fail" not in text
        if options.plant or options.plants:
            return planted(simulation, options)
        if options.quick:
            options.seeds = QUICK_SEEDS
            return sound(simulation, options) or planted(simulation, options)
        return sound(simulation, options)


if __name__ == "__main__":
    watch.begin_again_watched()
    sys.exit(main())
