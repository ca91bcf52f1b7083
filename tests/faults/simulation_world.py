"""Machines and what may befall them: an operation is done, and what is then seen must be what the model says.

Each event has a seed of its own and is played on what there is: one that has nothing to do does nothing. `Wrong` is
what must not happen.
"""

from __future__ import annotations

import errno
import random
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scroll_tactile_store import StoreError, check_store

from faults.disks import Event
from faults.learners import KIT, opened, perform
from faults.model import Operation, Others, State, Then, after
from faults.shim import Shim
from faults.simulation_disk import Disks, Held, abandon
from faults.simulation_kit import expected, seen
from scroll_tactile.errors import EmbeddingMismatchError, InputError, MismatchError

MACHINES = ("robot-1", "robot-2", "central")
ERRORS = (errno.ENOSPC, errno.ENOSPC, errno.EIO)
Fate = tuple[str, Any]


class Wrong(Exception):
    """Something is not as it has to be."""


@dataclass
class Machine:
    """A machine. candidates: what its memory may hold, the first of them unless something went wrong.

    begins: the counts of rows before batches, of which a flip can take the last away unnoticed; none of a log that
    replaced another. copies: its backups, whether each was acknowledged, and their batches.
    """

    name: str
    path: Path
    candidates: list[State] = field(default_factory=lambda: [State()])
    learner: Any = None
    readers: list[Any] = field(default_factory=list)
    begins: list[int] = field(default_factory=list)
    copies: dict[Path, tuple[list[State], bool, list[int]]] = field(default_factory=dict)
    made: bool = False

    @property
    def state(self) -> State:
        """What it holds, where nothing is open."""
        return self.candidates[0]

    @property
    def settled(self) -> bool:
        """Whether there is a memory, and one thing alone that it may hold."""
        return self.made and len(self.candidates) == 1 and (self.path / "CURRENT").exists()

    def become(self, state: State) -> None:
        """It holds these rows, which are another batch, or the last one less, or all that there were in a new log."""
        before, now = self.state.last, state.last
        self.begins = [begin for begin in self.begins if begin < min(before, now)] if before != now else []
        if now > before:
            self.begins.append(before)
        self.candidates = [state]


class World:
    """All of it, in an empty folder."""

    def __init__(self, home: Path, shim: Shim, log: Path, counts: Counter[str]) -> None:
        self.root, self.net, self.trees = (home / name for name in ("disks", "net", "trees"))
        for folder in (*(self.root / name for name in MACHINES), self.net, self.trees):
            folder.mkdir(parents=True)
        self.disks = Disks(self.root, shim, log)
        self.machines = [Machine(name, self.root / name / "memory") for name in MACHINES]
        self.bucket: dict[str, list[tuple[bytes, State]]] = {}
        self.flying: list[tuple[int, str, tuple[bytes, State]]] = []
        self.step, self.counts = 0, counts
        self.warned: list[str] = []
        self.told: list[str] = []

    def say(self, text: str) -> None:
        """Note what happened."""
        self.told.append(text)

    def close(self) -> None:
        """Let go of everything."""
        for machine in self.machines:
            self.drop(machine)

    @staticmethod
    def problems(path: Path) -> list[Any]:
        """What a check finds, but for leftovers."""
        return [one for one in check_store(path) if one.kind != "leftover"]

    def drop(self, machine: Machine) -> None:
        """The processes of a machine are gone."""
        for learner in [machine.learner, *machine.readers]:
            if learner is not None:
                abandon(learner)
        machine.learner, machine.readers = None, []

    def play(self, kind: str, seed: int) -> None:
        """One event."""
        rng = random.Random(seed)
        self.step += 1
        self.say(f"{self.step} {kind} {seed}")
        for landed in [one for one in self.flying if one[0] <= self.step]:
            self.flying.remove(landed)
            self.bucket.setdefault(landed[1], []).append(landed[2])
        self.counts[kind] += 1
        getattr(self, f"_{kind}")(rng.choice(self.machines), rng)

    # What is done to a disk, and what may come between.

    def crash(self, machine: Machine, rng: random.Random, how: str) -> None:
        """Power cut, or the death of all of its processes in the midst of something."""
        self.drop(machine)
        if how == "cut":
            self.say(f"    power cut of {machine.name}: {self.disks.cut(machine.name, rng)}")
        else:
            self.disks.kill(machine.name)
            self.say(f"    {machine.name} killed")
        self.counts[f"crash: {how}"] += 1

    def fate(self, rng: random.Random) -> Fate:
        """What happens to an operation."""
        drawn, where = rng.random(), rng.random()
        if drawn < 0.09:
            return "cut", where
        if drawn < 0.12:
            return "kill", where
        if drawn < 0.19:
            return "full", (where, rng.choice((1, 1, 2, 10**6)), rng.choice(ERRORS))
        return "", None

    def do(self, machine: Machine, rng: random.Random, operation: Operation, others: Others | None = None) -> Any:
        """Do an operation of the model to the memory of a machine, with its fate."""
        if (learner := self.opened(machine, rng)) is None:
            return None
        what, then = " ".join(map(str, operation)), after(machine.state, operation, others or {})
        return self.operate(machine, rng, what, lambda: perform(learner, operation, self.net), then)

    def operate(
        self,
        machine: Machine,
        rng: random.Random,
        what: str,
        do: Callable[[], Any],
        then: Then,
        either: Then | None = None,
    ) -> Any:
        """Do something that writes, with its fate; what it returned, None where that is not known.

        either: what may come of it as well; then it has no fate.
        """
        kind, about = ("", None) if either else self.fate(rng)
        Held.at_once = rng.random() < 0.3
        before, (now, foretold) = machine.state, then
        held = None if machine.learner is None else machine.learner._ledger.store
        late = held is not None and held._later is not None and held._later.failed()  # closing tells of it
        fail = None
        if kind == "full":
            first = 1 + int(about[0] ** 3 * 400) if rng.random() < 0.5 else rng.randint(1, 12)
            fail = first, first + about[1] - 1, about[2]
        self.disks.begin(fail)
        try:
            result = do()
        except (InputError, MismatchError) as error:
            result = type(error).__name__
        except StoreError as error:
            result = error
        finally:
            done = self.disks.end()
        self.say(f"  {machine.name}: {what}" + (f" [{kind} {about}]" if kind else "") + f" -> {result!r:.110}")
        self.counts[f"fate: {kind or 'none'}"] += 1
        if kind in ("cut", "kill"):
            machine.candidates = [before, *machine.candidates[1:]] + ([now] if now != before else [])
            self._strike(machine, rng, done, kind, about)
            return None
        self.disks.go(done)
        if isinstance(result, StoreError):
            self.counts["refused by a full disk"] += kind == "full"
            if kind != "full" and not (late and what.startswith(("close", "reembed"))):
                raise Wrong(f"{what} said {result!r}")
            self._refused(machine, what, now, result)
            return None
        if either is not None and result == either[1]:
            now, foretold = either
            self.counts["damaged on the way: the same"] += 1
        if result != foretold:
            raise Wrong(f"{what} gave {result!r}, expected {foretold!r}")
        if now != before:
            machine.become(now)
        return result

    def _strike(self, machine: Machine, rng: random.Random, done: list[Event], kind: str, about: float) -> None:
        """Cut what was done short, rather where its order matters most; now and then once more after opening."""
        count = int(about * (len(done) + 1))
        order = [i for i, one in enumerate(done) if one.kind in "RSF" and not one.path.count("/checkpoints/")]
        if order and rng.random() < 0.5:
            count = max(0, min(len(done), rng.choice(order) + rng.randint(0, 2)))
        self.disks.go(done[:count])
        self.crash(machine, rng, kind)
        if kind == "kill" and rng.random() < 0.4 and self.opened(machine, rng) is not None:
            self.counts["cut after a kill"] += 1
            self.crash(machine, rng, "cut")

    def _refused(self, machine: Machine, what: str, now: State, error: StoreError) -> None:
        """What failed was not done, but may come back with a crash."""
        before = machine.state
        if now != before:
            machine.candidates = [*machine.candidates, now]
        if machine.learner is not None and not machine.learner._ledger._closed:
            self.look(machine, machine.learner, f"after {what} failed")
            if machine.state != before and not what.startswith(("compact", "backup")):
                raise Wrong(f"{what} said {error!r}, and was done")

    def look(
        self, machine: Machine, learner: Any, where: str, *, settle: bool = False, but: Sequence[str] = ()
    ) -> None:
        """What is seen of a memory is one of its candidates; settle: no other any more; but: what may differ."""
        found, differ = seen(learner), []
        for state in machine.candidates:
            wanted = expected(state)
            differ.append([name for name, value in found.items() if value != wanted[name] and name not in but])
            if not differ[-1]:
                others = [] if settle else [other for other in machine.candidates if other is not state]
                if learner is machine.learner:
                    if state is not machine.state:
                        machine.become(state)
                    machine.candidates = [state, *others]
                return
        wanted = expected(machine.state)
        about = [(name, str(found[name])[:300], str(wanted[name])[:300]) for name in differ[0][:2]]
        raise Wrong(f"{where}: {machine.name} differs in {differ}: {about}")

    # Opening.

    def opened(self, machine: Machine, rng: random.Random) -> Any:
        """The memory of a machine, opened to write; None where its fate was not to be."""
        if machine.learner is not None:
            return machine.learner

        def do() -> None:
            machine.learner = self.open(machine, machine.path, machine.candidates)

        self.operate(machine, rng, "open", do, (machine.state, None))
        if machine.learner is not None:
            machine.made = True
            self.look(machine, machine.learner, "opened", settle=True)
        return machine.learner

    @staticmethod
    def open(machine: Machine, path: Path, candidates: list[State], mode: Any = "write") -> Any:
        """A memory of one of the candidates, opened without any fate."""
        for name in dict.fromkeys(state.embedding for state in candidates):
            try:
                return opened(path, mode, embedding=KIT.embeddings[name])
            except EmbeddingMismatchError as error:
                refused = error
        raise Wrong(f"{machine.name} has another embedding: {refused}")

    def shut(self, machine: Machine, *, readers_only: bool = False) -> None:
        """Close without any fate."""
        for reader in machine.readers:
            reader.close()
        machine.readers = []
        if not readers_only and machine.learner is not None:
            learner, machine.learner = machine.learner, None
            with self.disks.taken_in():
                try:
                    learner.close()
                except StoreError as error:  # of an earlier background commit
                    self.say(f"    closing said {error!r:.100}")
