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

from faults import shim as watch
from faults.common import folder, parser, run, warnings_told
from faults.disks import STYLES, Disk, Event, events
from faults.learners import expected, one_scale, opened, perform, seen, warm
from faults.model import Operation, State, after
from faults.plans import KINDS, draw, history, prepare
from faults.shim import Shim
from faults.trials import Trials, checkpoints_every

CHECKPOINT_EVERY = 6
LENGTH = 12  # operations of a history
OF_EACH = 60  # disks of a history
QUICK = 12  # disks


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


class Cutting(Trials):
    """Histories, and the disks that they may leave."""

    def __init__(self, home: Path, seed: int, without: str) -> None:
        super().__init__(home, prepare(home))
        self.left_out = WITHOUT[without]
        self.shim, self.rng = Shim(), random.Random(seed)
        self.cut_in: Counter[str] = Counter()
        self.styles: Counter[str] = Counter()
        self.unsafe: list[int] = []
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
            if operation == ("open",):
                learner, result = opened(root / "memory"), None
            else:
                result = perform(learner, operation, self.home)
            self.shim.mark(f"done {number}")
            then, foretold = after(states[-1], operation, self.others)
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
            self.tell()
        return state

    def _look(self, disk: Disk, recorded: Recorded, number: int, *, done: bool, place: int) -> State | None:
        style, to, operation = self.rng.choice(STYLES), self.home / "disk", recorded.operations[number]
        shutil.rmtree(to, ignore_errors=True)
        disk.rebuilt(to, self.rng, style)
        self.disks += 1
        self.styles[style] += 1
        self.cut_in["between two" if done else operation[0]] += 1
        self.unsafe.append(disk.unsafe())
        where = f"history {self.histories - 1}, event {place}, {'after' if done else 'in'} {operation}, style {style!r}"
        candidates = [recorded.states[number + 1]] if done else recorded.states[number : number + 2]
        before, state = len(self.failures), None
        warned = lambda text: self.failures.append(f"{where}: warned {text}")  # noqa: E731
        with self.examined(where), warnings_told(warned):
            made = recorded.operations[: number + done].count(("backup",))
            there = len([path for path in to.glob("*-copy-*") if not path.name.endswith(".partial")])
            if there - made not in (0, operation == ("backup",)):
                self.failures.append(f"{where}: {there} backups are there of {made} that were acknowledged")
            self.require_copies(where, to / "memory", recorded.states[: number + 1])
            with opened(to / "memory") as learner:
                state = self.settled(where, learner, candidates)
                if state is not None and self.rng.random() < 0.3:
                    state = self._gone_on(where, learner, state)
        return None if len(self.failures) > before else state

    def _gone_on(self, where: str, learner: Any, state: State) -> State:
        """A further operation, and the state after it."""
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
    disks = QUICK if options.quick else options.disks
    checkpoints_every(CHECKPOINT_EVERY)
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
            cutting.tell(f"{cutting.disks} disks")
    return {
        "disks": cutting.disks,
        "without syncs of": options.without or "none",
        "histories": cutting.histories,
        "calls written down": cutting.events,
        "changes not synced, median": sorted(cutting.unsafe)[len(cutting.unsafe) // 2],
        "cut in": dict(sorted(cutting.cut_in.items())),
        "styles": dict(sorted(cutting.styles.items())),
        **cutting.figures(),
    }


if __name__ == "__main__":
    watch.begin_again_watched()
    run("power_cut", parser(__doc__, disks=2000, without="").parse_args(), main)
