"""The plug pulled at random instants: `python tests/faults/power_cut.py --disks 2000`.

All that a history does to the files of a memory is written down, call by call, zarr's among it (see
shim.c). From that the disk is rebuilt as it may look after a power cut at a random instant (see disks.py), and
opened: it must hold all that was acknowledged before that instant, or that and the operation that had begun, without
a warning, and go on. The next history goes on with one of these disks.

That the disks are harsh enough shows `--without folders` (or files, log): syncs of folders, of a checkpoint's files or
of the log are taken not to have happened, and failures must then be found. Exit code 1 is right there.
"""

from __future__ import annotations

import argparse
import bisect
import random
import shutil
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import scroll_tactile.persistence.open_memory
from faults import shim as watch
from faults.common import folder, parser, progress, run, warnings_told
from faults.disks import STYLES, Disk, Event, events
from faults.model import (
    Operation,
    Other,
    State,
    after,
    expected,
    one_scale,
    opened,
    perform,
    seen,
    settle,
    unsound_copies,
    warm,
)
from faults.plans import KINDS, draw, history, prepare
from faults.shim import Shim

SNAPSHOT_EVERY = 6
LENGTH = 12  # operations of a history
OF_EACH = 60  # disks of a history
ENDS = ("open", "close")


@dataclass
class Recorded:
    """A history that was done: its operations, the state after each, and what it did to the disk."""

    operations: list[Operation]
    states: list[State]
    events: list[Event]

    def instants(self) -> list[tuple[int, int]]:
        """Of each operation: the first event behind its beginning, and the first behind its end."""
        marks = [(i, event.path.split()) for i, event in enumerate(self.events) if event.kind == "M"]
        begun = {int(number): i + 1 for i, (what, number) in marks if what == "begin"}
        done = {int(number): i + 1 for i, (what, number) in marks if what == "done"}
        return [(begun[number], done[number]) for number in range(len(self.operations))]


WITHOUT = {
    "": lambda event: False,
    "folders": lambda event: event.kind == "F",
    "files": lambda event: event.kind == "S" and "/checkpoints/" in event.path,
    "log": lambda event: event.kind == "S" and Path(event.path).name.startswith("log-"),
}


class Cutting:
    """Histories, and the disks that they may leave."""

    def __init__(self, home: Path, seed: int, without: str) -> None:
        self.home = home
        self.left_out = WITHOUT[without]
        self.shim = Shim()
        self.rng = random.Random(seed)
        self.others: dict[str, Other] = prepare(home)
        self.counts: Counter[str] = Counter()
        self.cut_in: Counter[str] = Counter()
        self.styles: Counter[str] = Counter()
        self.unsafe: list[int] = []
        self.failures: list[str] = []
        self.disks = self.events = self.histories = 0

    def _planned(self, state: State) -> list[Operation]:
        """Random operations, with the memory closed and opened now and then."""
        operations: list[Operation] = [("open",)]
        for kind in [*self.rng.sample(KINDS, len(KINDS)), *self.rng.choices(KINDS, k=LENGTH - len(KINDS))]:
            operations += history(self.rng, state, self.others, [kind])
            state, _ = after(state, operations[-1], self.others)
            if self.rng.random() < 0.2:
                operations += [("close",), ("open",)]
        return [*operations, ("close",)]

    def record(self, root: Path, state: State) -> tuple[Disk, Recorded]:
        """Do a history in folder `root`, which holds the memory in that state, or nothing."""
        disk, operations, states = Disk(root), self._planned(state), [state]
        log = self.home / "log"
        log.unlink(missing_ok=True)
        self.shim.log(log)
        self.shim.arm(root, watch.LOG)
        learner: Any = None
        for number, operation in enumerate(operations):
            self.shim.mark(f"begin {number}")
            if operation[0] == "open":
                learner, result = opened(root / "memory"), None
            elif operation[0] == "close":
                result = learner.close()
            else:
                result = perform(learner, operation, self.home)
            self.shim.mark(f"done {number}")
            then, foretold = (states[-1], None) if operation[0] in ENDS else after(states[-1], operation, self.others)
            states.append(then)
            if result != foretold:
                self.failures.append(f"history {self.histories}: {operation} gave {result}, expected {foretold}")
        self.shim.disarm()
        recorded = Recorded(operations, states, list(events(log)))
        self.histories += 1
        self.events += len(recorded.events)
        return disk, recorded

    def cut(self, disk: Disk, recorded: Recorded, count: int) -> State | None:
        """Look at so many disks; the state of the last, None where it was not right. It stays in folder "disk"."""
        instants = recorded.instants()
        # An operation at random, and then an instant of it: by events alone nearly all would fall into compactions.
        chosen = [self.rng.choice(instants) for _ in range(count)]
        places = sorted(self.rng.randint(begin, end) for begin, end in chosen)
        i, state = 0, None
        for place in places:
            while i < place:
                if not self.left_out(recorded.events[i]):
                    disk.apply(recorded.events[i])
                i += 1
            number = bisect.bisect_right([begin for begin, _ in instants], place) - 1
            state = self._look(disk, recorded, number, done=place >= instants[number][1], place=place)
        return state

    def _look(self, disk: Disk, recorded: Recorded, number: int, *, done: bool, place: int) -> State | None:
        style = self.rng.choice(STYLES)
        to = self.home / "disk"
        shutil.rmtree(to, ignore_errors=True)
        disk.rebuilt(to, self.rng, style)
        operation = recorded.operations[number]
        self.disks += 1
        self.styles[style] += 1
        self.cut_in["between two" if done else operation[0]] += 1
        self.unsafe.append(disk.unsafe())
        where = f"history {self.histories - 1}, event {place}, {'after' if done else 'in'} {operation}, style {style!r}"
        candidates = [recorded.states[number + 1]] if done else recorded.states[number : number + 2]
        before = len(self.failures)
        state = None
        try:
            with warnings_told(lambda text: self.failures.append(f"{where}: warned {text}")):
                made = sum(operation == ("backup",) for operation in recorded.operations[: number + done])
                there = len([path for path in to.glob("*-copy-*") if not path.name.endswith(".partial")])
                if there - made not in (0, operation == ("backup",)):
                    self.failures.append(f"{where}: {there} backups are there of {made} that were acknowledged")
                wrong = unsound_copies(to / "memory", recorded.states[: number + 1])
                self.failures += [f"{where}: {what}" for what in wrong]
                state = self._opens(where, to / "memory", candidates)
        except Exception as error:
            self.failures.append(f"{where}: {error!r}")
        if len(self.failures) > before:
            progress(self.failures[-1])
            return None
        return state

    def _opens(self, where: str, path: Path, candidates: list[State]) -> State | None:
        """Open a disk, find which state it is in, and go on from it."""
        with opened(path) as learner:
            state, differ = settle(seen(learner), candidates)
            if state is None:
                self.failures.append(f"{where}: differs in {differ}")
                return None
            if len(candidates) > 1 and candidates[0] != candidates[1]:
                self.counts["begun, and found " + ("done" if state is candidates[1] else "not done")] += 1
            if self.rng.random() < 0.3:
                operation = draw(self.rng, state, self.others, self.rng.choice(KINDS))
                if operation[0] == "pack":  # the history that is cut reads its own again
                    operation = ("pack", f"{operation[1]}-{self.disks}", *operation[2:])
                state, foretold = after(state, operation, self.others)
                if (result := perform(learner, operation, self.home)) != foretold or seen(learner) != expected(state):
                    self.failures.append(f"{where}: going on, {operation} gave {result}, expected {foretold}")
                self.counts["gone on from"] += 1
        return state


def main(options: argparse.Namespace) -> dict[str, Any]:
    """As many disks as asked."""
    disks = 30 if options.quick else options.disks
    scroll_tactile.persistence.open_memory.SNAPSHOT_EVERY = SNAPSHOT_EVERY
    one_scale()
    warm()
    with folder(options, in_memory=True) as home:
        cutting, root, state = Cutting(home, options.seed, options.without), home / "run", None
        while cutting.disks < disks:
            shutil.rmtree(root, ignore_errors=True)
            if state is None or cutting.histories % 4 == 0:
                root.mkdir()
                state = State()
            else:
                (home / "disk").rename(root)
            disk, recorded = cutting.record(root, state)
            state = cutting.cut(disk, recorded, min(OF_EACH, disks - cutting.disks))
            progress(f"{cutting.disks} disks, {len(cutting.failures)} failures")
    return {
        "disks": cutting.disks,
        "without syncs of": options.without or "none",
        "histories": cutting.histories,
        "calls written down": cutting.events,
        "changes not synced, median": sorted(cutting.unsafe)[len(cutting.unsafe) // 2],
        "cut in": dict(sorted(cutting.cut_in.items())),
        "styles": dict(sorted(cutting.styles.items())),
        "counts": dict(sorted(cutting.counts.items())),
        "failures": cutting.failures,
    }


if __name__ == "__main__":
    watch.begin_again_watched()
    run("power_cut", parser(__doc__, disks=2000, without="").parse_args(), main)
