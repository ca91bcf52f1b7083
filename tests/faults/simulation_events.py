"""What a machine does with its own memory: it learns, takes back, compacts, copies, dies, and is read meanwhile."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import scroll_tactile_store.backup

from faults.learners import KIT, perform
from faults.model import after
from faults.plans import draw, touch
from faults.simulation_disk import abandon
from faults.simulation_world import Machine, World, Wrong

SMALL = ("observe",) * 4 + ("retract", "describe", "forget")


@contextmanager
def interleaved(place: int, between: Callable[[], None]) -> Iterator[None]:
    """While it lasts, do something just before the so many-th file is copied; 0: before the log is read."""
    copy, reader = scroll_tactile_store.backup.copy_regular, scroll_tactile_store.backup.Log
    left = [place] if place >= 0 else []

    def due(now: bool) -> None:
        if left and now:
            left.clear()
            between()

    def copied(*given: Any, **named: Any) -> None:
        due(left == [1])
        left[:] = [count - 1 for count in left]
        copy(*given, **named)

    def read(*given: Any, **named: Any) -> Any:
        due(True)
        return reader(*given, **named)

    scroll_tactile_store.backup.copy_regular, scroll_tactile_store.backup.Log = copied, read  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        scroll_tactile_store.backup.copy_regular, scroll_tactile_store.backup.Log = copy, reader  # type: ignore[misc]


class OneMemory(World):
    """The events of one memory."""

    def _drawn(self, machine: Machine, rng: random.Random, kind: str) -> None:
        if self.opened(machine, rng) is not None:
            self.do(machine, rng, draw(rng, machine.state, {}, kind))

    def _small(self, machine: Machine, rng: random.Random) -> None:
        self._drawn(machine, rng, rng.choice(SMALL))

    def _batch(self, machine: Machine, rng: random.Random) -> None:
        self._drawn(machine, rng, "batch")

    def _relabel(self, machine: Machine, rng: random.Random) -> None:
        self._drawn(machine, rng, "relabel")

    def _compact(self, machine: Machine, rng: random.Random) -> None:
        self._drawn(machine, rng, "compact")

    def _reembed(self, machine: Machine, rng: random.Random) -> None:
        if self.opened(machine, rng) is None:
            return
        to = "other" if machine.state.embedding == "own" or rng.random() < 0.2 else "own"
        self.shut(machine, readers_only=True)
        self.do(machine, rng, ("reembed", to))
        if machine.learner is not None and machine.learner._ledger._closed:
            abandon(machine.learner)
            machine.learner = None

    def _tick(self, machine: Machine, rng: random.Random) -> None:
        """What was handed to the background is done now."""
        if machine.learner is not None and machine.learner._ledger.store._worker.jobs:
            worker = machine.learner._ledger.store._worker
            self.operate(machine, rng, "background commit", worker.run, (machine.state, None))
            self.counts["background commits later"] += 1

    def _close(self, machine: Machine, rng: random.Random) -> None:
        if machine.learner is not None:
            self.do(machine, rng, ("close",))
            machine.learner = None

    def _cut(self, machine: Machine, rng: random.Random) -> None:
        self.crash(machine, rng, "cut")

    def _kill(self, machine: Machine, rng: random.Random) -> None:
        """The writer dies, and its readers go on."""
        if machine.learner is not None:
            abandon(machine.learner)
            machine.learner = None

    def _reader(self, machine: Machine, rng: random.Random) -> None:
        if machine.settled:
            machine.readers.append(self.open(machine, machine.path, machine.candidates, "read"))
            self.look(machine, machine.readers[-1], "a reader opened")

    def _refresh(self, machine: Machine, rng: random.Random) -> None:
        for reader in machine.readers:
            reader.refresh()
            self.look(machine, reader, "a reader refreshed")

    def _leave(self, machine: Machine, rng: random.Random) -> None:
        if machine.readers:
            machine.readers.pop(rng.randrange(len(machine.readers))).close()

    def _backup(self, machine: Machine, rng: random.Random) -> None:
        if (learner := self.opened(machine, rng)) is None:
            return
        state, begins, to = machine.state, list(machine.begins), machine.path.with_name(f"copy-{self.step}")
        # While it copies, the memory goes on.
        then, place = state, rng.choice((-1, 0, 1, 5, 20))
        observation = ("observe", rng.choice(KIT.materials), touch(rng))
        if place >= 0:
            then, _ = after(state, observation, {})

        def between() -> None:
            perform(learner, observation, machine.path)
            learner._ledger.require_writing()  # passes over the failure of an earlier checkpoint
            learner._ledger._write_checkpoint()

        def do() -> str:
            with interleaved(place, between):
                learner.backup(to)
            return "done"

        done = self.operate(machine, rng, f"backup {to.name}, going on at {place}", do, (then, "done"))
        machine.copies[to] = [state, then], done == "done", begins

    def _restore(self, machine: Machine, rng: random.Random) -> None:
        """A copy is whole; now and then it takes the memory's place, or is copied over it, file by file."""
        if not machine.copies:
            return
        path = rng.choice(sorted(machine.copies))
        states, acknowledged, begins = machine.copies[path]
        if not path.exists():
            if acknowledged:
                raise Wrong(f"{path.name} of {machine.name} is gone")
            return
        if problems := self.problems(path):
            raise Wrong(f"{path.name} of {machine.name}: {problems}")
        if rng.random() < 0.5:
            learner = self.open(machine, path, states, "read")
            self.look(Machine(path.name, path, states), learner, "a backup")
            learner.close()
            return
        self.shut(machine)
        over = rng.random() < 0.5
        if not over:
            shutil.rmtree(machine.path, ignore_errors=True)
        shutil.copytree(path, machine.path, dirs_exist_ok=True)
        self.disks.settle(machine.name)
        machine.candidates, machine.begins, machine.made = states, begins, True
        told = f"restored{' over what was there' if over else ''}"
        self.say(f"  {machine.name}: {told}, {path.name}")
        self.counts[told] += 1
