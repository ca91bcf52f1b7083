"""What a machine does with its own memory: it learns, takes back, compacts, copies, dies, and is read meanwhile."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import store.backup
from faults import simulation_model as model
from faults.simulation_disk import abandon
from faults.simulation_model import Rows
from faults.simulation_touches import EMBEDDINGS, MATERIALS, SAID, TOUCHES, stream
from faults.simulation_world import Machine, World, Wrong
from scroll_tactile.errors import InputError
from store import StoreError


@contextmanager
def interleaved(place: int, between: Callable[[], None]) -> Iterator[None]:
    """While it lasts, do something just before the so many-th file is copied; 0: before the log is read."""
    copy, reader = store.backup.copy_regular, store.backup.LogReader
    left = [place] if place >= 0 else []

    def due(now: bool) -> None:
        if left and now:
            left.clear()
            between()

    def copied(*given: Any) -> None:
        due(left == [1])
        left[:] = [count - 1 for count in left]
        copy(*given)

    def read(*given: Any, **named: Any) -> Any:
        due(True)
        return reader(*given, **named)

    store.backup.copy_regular, store.backup.LogReader = copied, read  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        store.backup.copy_regular, store.backup.LogReader = copy, reader  # type: ignore[misc]


class OneMemory(World):
    """The events of one memory."""

    def _change(self, rng: random.Random, rows: Rows) -> tuple[str, Callable[[Any], Any], Callable[[Rows], Any]]:
        """A small change of a memory."""
        kind = rng.choice(("observe", "observe", "observe", "observe", "retract", "describe", "forget"))
        material, touch = rng.choice(MATERIALS), rng.randrange(TOUCHES)
        if kind == "observe":
            again = rng.random() < 0.4
            return (
                f"observe {material} {touch} {again}",
                lambda learner: learner.observe(material, stream(touch), again=again).sequence,
                lambda ours: model.observe(ours, material, touch, again),
            )
        if kind == "describe":
            said = rng.choice(SAID)
            return (
                f"describe {material} {said}",
                lambda learner: learner.describe(material, said and dict(said)),
                lambda ours: model.describe(ours, material, said),
            )
        if kind == "forget":
            return (
                f"forget {material}",
                lambda learner: learner.forget(material),
                lambda ours: model.forget(ours, material),
            )
        sequence = self._some(rng, rows)
        return (
            f"retract {sequence}",
            lambda learner: learner.retract(sequence),
            lambda ours: model.retract(ours, sequence),
        )

    @staticmethod
    def _some(rng: random.Random, rows: Rows) -> int:
        loose = rows.loose
        return rng.choice(loose) if loose and rng.random() < 0.95 else rng.randint(1, len(rows.rows) + 2)

    def _small(self, machine: Machine, rng: random.Random) -> None:
        if self.opened(machine, rng) is not None:
            self._do(machine, rng, *self._change(rng, machine.rows))

    def _batch(self, machine: Machine, rng: random.Random) -> None:
        if self.opened(machine, rng) is None:
            return
        rows, parts = machine.rows, []
        results = []
        for _ in range(rng.randint(2, 5)):
            what, call, after = self._change(rng, rows)
            rows, result = after(rows)
            parts.append((what, call))
            results.append(result)

        def do(learner: Any) -> list[Any]:
            found = []
            with learner.batch():
                for _, call in parts:
                    try:
                        found.append(call(learner))
                    except InputError as error:
                        found.append(type(error).__name__)
            return found

        self._do(machine, rng, f"batch of {[what for what, _ in parts]}", do, lambda _: (rows, results))

    def _relabel(self, machine: Machine, rng: random.Random) -> None:
        if self.opened(machine, rng) is not None:
            sequence, material = self._some(rng, machine.rows), rng.choice(MATERIALS)
            self._do(
                machine,
                rng,
                f"relabel {sequence} {material}",
                lambda learner: learner.relabel(sequence, material),
                lambda ours: model.relabel(ours, sequence, material),
            )

    def _compact(self, machine: Machine, rng: random.Random) -> None:
        keep = rng.choice((0, 1, 2, 3, 5))
        self._do(
            machine,
            rng,
            f"compact {keep}",
            lambda learner: learner.compact(keep=keep).last_sequence,
            lambda ours: model.compact(ours, keep),
        )

    def _reembed(self, machine: Machine, rng: random.Random) -> None:
        if self.opened(machine, rng) is None:
            return
        to = "other" if machine.rows.embedding == "own" or rng.random() < 0.2 else "own"
        rows = machine.rows
        then = (replace(rows, embedding=to), None) if rows.whole else (rows, "MismatchError")
        self._shut(machine, readers_only=True)
        self._do(machine, rng, f"reembed {to}", lambda learner: self._reembedded(learner, to), lambda _: then)
        if machine.learner is not None and machine.learner._ledger._closed:
            abandon(machine.learner)
            machine.learner = None

    @staticmethod
    def _reembedded(learner: Any, to: str) -> None:
        shutil.rmtree(learner.reembed(EMBEDDINGS[to]), ignore_errors=True)

    def _tick(self, machine: Machine, rng: random.Random) -> None:
        """What was handed to the background is done now."""
        if machine.learner is not None and machine.learner._ledger.store._checkpoints._worker.jobs:
            worker = machine.learner._ledger.store._checkpoints._worker
            self.operate(machine, rng, "background commit", worker.run, (machine.rows, None))
            self.counts["background commits later"] += 1

    def _close(self, machine: Machine, rng: random.Random) -> None:
        learner = machine.learner
        if learner is not None:
            self.operate(machine, rng, "close", learner.close, (machine.rows, None))
            machine.learner = None

    def _shut(self, machine: Machine, *, readers_only: bool = False) -> None:
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

    def _cut(self, machine: Machine, rng: random.Random) -> None:
        self.crash(machine, rng, "cut")

    def _kill(self, machine: Machine, rng: random.Random) -> None:
        """The writer dies, and its readers go on."""
        if machine.learner is not None:
            abandon(machine.learner)
            machine.learner = None

    def _reader(self, machine: Machine, rng: random.Random) -> None:
        if machine.made and len(machine.candidates) == 1 and (machine.path / "CURRENT").exists():
            machine.readers.append(self._open(machine, machine.path, machine.candidates, "read"))
            self.look(machine, machine.readers[-1], "a reader opened")

    def _refresh(self, machine: Machine, rng: random.Random) -> None:
        for reader in machine.readers:
            reader.refresh()
            self.look(machine, reader, "a reader refreshed")

    def _leave(self, machine: Machine, rng: random.Random) -> None:
        if machine.readers:
            machine.readers.pop(rng.randrange(len(machine.readers))).close()

    def _backup(self, machine: Machine, rng: random.Random) -> None:
        if self.opened(machine, rng) is None:
            return
        rows, begins, to = machine.rows, list(machine.begins), machine.path.with_name(f"copy-{self.step}")
        # While it copies, the memory goes on.
        then, place = rows, rng.choice((-1, 0, 1, 5, 20))
        if place >= 0:
            material, touch = rng.choice(MATERIALS), rng.randrange(TOUCHES)
            then = model.observe(rows, material, touch, True)[0]

        def do(learner: Any) -> str:
            def between() -> None:
                learner.observe(material, stream(touch), again=True)
                learner._ledger.require_writing()  # passes over the failure of an earlier checkpoint
                learner._ledger._snapshot()

            with interleaved(place, between):
                learner.backup(to)
            return "done"

        done = self._do(machine, rng, f"backup {to.name}, going on at {place}", do, lambda _: (then, "done"))
        machine.copies[to] = [rows, then], done == "done", begins

    def _restore(self, machine: Machine, rng: random.Random) -> None:
        """A copy is whole; now and then it takes the memory's place, or is copied over it, file by file."""
        if not machine.copies:
            return
        path = rng.choice(sorted(machine.copies))
        rows, acknowledged, begins = machine.copies[path]
        if not path.exists():
            if acknowledged:
                raise Wrong(f"{path.name} of {machine.name} is gone")
            return
        if problems := self._problems(path):
            raise Wrong(f"{path.name} of {machine.name}: {problems}")
        if rng.random() < 0.5:
            self._shut(machine)
            over = rng.random() < 0.5
            if not over:
                shutil.rmtree(machine.path, ignore_errors=True)
            shutil.copytree(path, machine.path, dirs_exist_ok=True)
            self.disks.settle(machine.name)
            machine.candidates, machine.begins = rows, begins
            machine.made = True
            self.say(f"  {machine.name}: restored {path.name}{', over what was there' if over else ''}")
            self.counts[f"restored{' over what was there' if over else ''}"] += 1
        else:
            learner = self._open(machine, path, rows, "read")
            self.look(Machine(path.name, path, rows), learner, "a backup")
            learner.close()
