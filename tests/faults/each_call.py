"""A failure, and a crash, at each call in turn: `python tests/faults/each_call.py`.

Each step of a short history, which has all operations, begins from a copy of the memory as it lies on the disk just
before. Of the calls that the C library gets for files of the memory meanwhile, SQLite's and zarr's among them, the
first fails, then the second, and so on (of the steps in ALIKE each fourth):

- EIO, then ENOSPC (of a write half is done before): a StoreError, and the memory is as before, or success, and it is
  as after; the step can be done again, then another observation, and opening anew finds it all.
- EIO when a file is opened to read, or read: the same.
- kill -9 in place of the call, and in the middle of each write: opened again it is as before or as after, and goes on.

Watched are open, write, pwrite, fsync, fdatasync, ftruncate, rename, link, unlink, mkdir, rmdir, read and pread, in
all their variants; others that could write abort the process (see shim.c). SQLite's shared memory is mapped, and its
stores are not calls; it is not needed to recover.
"""

from __future__ import annotations

import argparse
import errno
import shutil
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import scroll_tactile.memory.ledger
from faults import shim as watch
from faults.common import folder, parser, progress, quiet_coroutines, run, warnings_told
from faults.model import Operation, Other, State, after, one_scale, opened, perform, seen, settle, warm
from faults.plans import prepare
from faults.shim import Shim
from faults.zygote import Zygote
from store import StoreError

NEVER = 2**40
SLOW = ("compact", "fine_tune")
GENERATIONS = ("fine-tune", "compact", "close", "compact all but 3", "observe, and a generation", "open")
SECOND_LOOK = 3  # of so many calls of a step that writes generations one is looked at by opening anew, too
# They write a generation as two others do, call for call, whose every call is tried: of these one in four is.
ALIKE = {"fine-tune": 4, "compact": 4, "close": 4}
THOROUGH = 5  # of so many calls of a slow step one is followed by doing all of it again

MODES = {
    "EIO": (watch.FAIL, watch.WRITES, errno.EIO),
    "ENOSPC": (watch.FAIL, watch.WRITES, errno.ENOSPC),
    "EIO in reading": (watch.FAIL, watch.LOOKS | watch.READS, errno.EIO),
    "crash": (watch.CRASH, watch.WRITES, 0),
    "torn write": (watch.TEAR, watch.WRITES, 0),
}

OBSERVE: Operation = ("observe", "c", (4, 90))
HISTORY: tuple[tuple[str, Operation, int], ...] = (
    # name of the step, operation, rows between generations
    ("make", ("open",), NEVER),
    ("observe", ("observe", "a", (0, 90)), NEVER),
    ("", ("batch", tuple(("observe", name, (i, 90)) for i in range(3) for name in "abü")), NEVER),
    ("observe, and a generation", ("observe", "b", (5, 60)), 1),
    ("batch", ("batch", (OBSERVE, ("observe", "a", (2, 40)), ("retract", 3), ("forget", "ü"))), NEVER),
    ("retract", ("retract", 2), NEVER),
    ("forget", ("forget", "c"), NEVER),
    ("describe", ("describe", "b", (("silk", 0.25), ("wool", 0.75))), NEVER),
    ("merge", ("merge", "taken", "twice", "theirs"), NEVER),
    ("merge of one compacted", ("merge", "compacted", "twice", "theirs"), NEVER),
    ("fine-tune", ("fine_tune",), NEVER),
    ("compact all but 3", ("compact", 3), NEVER),
    ("", ("observe", "b", (3, 60)), NEVER),
    ("compact", ("compact", 0), NEVER),
    ("close", ("close",), NEVER),
    ("open", ("open",), NEVER),
)


@dataclass
class Step:
    """One step: how the memory lies on the disk before it, and what must be there before and after it."""

    name: str
    operation: Operation
    every: int
    start: Path
    before: State
    then: State
    result: Any
    calls: Counter[str] = field(default_factory=Counter)
    outcomes: Counter[str] = field(default_factory=Counter)


def copied(path: Path, to: Path) -> None:
    """A copy as after a crash; what the lock's holder and SQLite have in memory only is left out."""
    shutil.rmtree(to, ignore_errors=True)
    if path.exists():
        shutil.copytree(path, to, ignore=shutil.ignore_patterns("*-shm", "lock"))


def plan(home: Path, others: dict[str, Other]) -> list[Step]:
    """The steps, each with the copy that it begins from."""
    path, state, steps = home / "plan" / "memory", State(), []
    learner: Any = None
    path.parent.mkdir()
    for name, operation, every in HISTORY:
        start = home / f"start-{len(steps)}"
        if operation[0] == "close":  # so that there is something to be written
            perform(learner, OBSERVE, home)
            state, _ = after(state, OBSERVE, others)
        copied(path, start)
        ends = operation[0] in ("open", "close")
        then, result = (state, None) if ends else after(state, operation, others)
        if name:
            steps.append(Step(name, operation, every, start, state, then, result))
        if operation == ("open",) and learner is not None:
            leave_unfinished(start)
        elif operation == ("open",):
            learner = opened(path)
        elif operation[0] != "close" and learner is not None:
            assert perform(learner, operation, home) == result
        state = then
    learner.close()
    return steps


def leave_unfinished(path: Path) -> None:
    """What crashes may leave behind, and opening has to clear away."""
    generations = path / "generations"
    newest = max(generations.iterdir())
    shutil.copytree(newest, generations / "00000091")
    shutil.copytree(newest, generations / "00000092.partial")
    (path / "holder.json.new").write_text("{", encoding="utf-8")


class Attempt:
    """One step done once, on a fresh copy, with one call of it failing."""

    def __init__(self, step: Step, path: Path, home: Path, *, fresh: bool = True) -> None:
        self.step, self.path, self.home = step, path, home
        self.learner: Any = None
        if not fresh:
            return
        copied(step.start, path)
        path.parent.mkdir(exist_ok=True)
        scroll_tactile.memory.ledger.SNAPSHOT_EVERY = NEVER
        if step.operation[0] != "open":
            self.learner = opened(path)
        if step.operation[0] == "close":
            # Opening replayed all rows: nothing would be written.
            self.learner._ledger._saved = -1

    def do(self) -> Any:
        """Do the step, and wait for what goes on behind it."""
        scroll_tactile.memory.ledger.SNAPSHOT_EVERY = self.step.every
        try:
            if self.step.operation[0] == "open":
                self.learner = opened(self.path)
                return None
            if self.step.operation[0] == "close":
                return self.learner.close()
            result = perform(self.learner, self.step.operation, self.home)
            self.learner._ledger.store._generations.wait()
            return result
        finally:
            scroll_tactile.memory.ledger.SNAPSHOT_EVERY = NEVER


def crash(channel: Connection, step: Step, path: Path, home: Path, how: str, number: int) -> None:
    """The child: do a step, and end in the middle of it; it returns where there is no such call."""
    attempt = Attempt(step, path, home)
    mode, what, error = MODES[how]
    shim = Shim()
    with warnings_told(lambda text: None):
        shim.arm(path.parent, mode, what, first=number, error=error)
        attempt.do()
        shim.disarm()
    channel.send("not reached")


class Trial:
    """All the calls of all the steps."""

    def __init__(self, home: Path, zygote: Zygote, others: dict[str, Other]) -> None:
        self.home, self.zygote, self.others = home, zygote, others
        self.path = home / "run" / "memory"
        self.shim = Shim()
        self.failures: list[str] = []
        self.shown = 0
        self.tried: Counter[str] = Counter()

    def fail(self, step: Step, how: str, number: int) -> bool:
        """Let call `number` fail; whether there was one."""
        mode, what, error = MODES[how]
        attempt = Attempt(step, self.path, self.home)
        warned: list[str] = []
        with warnings_told(warned.append):
            self.shim.arm(self.path.parent, mode, what, first=number, error=error)
            outcome = self._outcome(attempt.do)
            _, hit = self.shim.disarm()
            where = f"{step.name}, {how} at call {number} ({hit})"
            if hit:
                if outcome == "success":
                    outcome += ", warned" if warned else ""
                self._note(step, how, hit, outcome)
                self._examined(where, lambda: self._goes_on(where, attempt, outcome, number))
            elif outcome != "success":
                self.failures.append(f"{where}: {outcome} without a fault")
        self._let_go(attempt)
        return bool(hit)

    def _outcome(self, do: Callable[[], Any]) -> str:
        try:
            do()
        except StoreError as error:
            return type(error).__name__
        except Exception as error:
            return f"not a StoreError: {error!r}"
        return "success"

    def _note(self, step: Step, how: str, hit: str, outcome: str) -> None:
        self.tried[how] += 1
        step.calls[hit.split(maxsplit=1)[0]] += 1
        step.outcomes[f"{how}: {outcome}"] += 1
        if outcome.startswith("not a StoreError"):
            self.failures.append(f"{step.name}, {how} ({hit}): {outcome}")

    def _examined(self, where: str, look: Callable[[], None]) -> None:
        try:
            look()
        except Exception as error:
            self.failures.append(f"{where}: afterwards {error!r}")

    def _goes_on(self, where: str, attempt: Attempt, outcome: str, number: int) -> None:
        step, done = attempt.step, outcome.startswith("success")
        if self._second_look(step, number):
            copied(self.path, crashed := self.home / "crashed")
            with opened(crashed, "read" if (crashed / "journal.sqlite").exists() else "write") as learner:
                self._require(f"{where}: as it lay on the disk then", seen(learner), [step.before, step.then])
        if step.operation[0] == "close" or attempt.learner is None:
            attempt.learner = opened(self.path)
        state = step.then if done else step.before
        self._require(f"{where}: the learner, after {outcome}", seen(attempt.learner), [state])
        self._finish(where, attempt, state, number)

    def _finish(self, where: str, attempt: Attempt, state: State, number: int) -> None:
        """Go on from a state as if nothing had been: what was not done is done again, and one more observation."""
        step, learner, thorough = attempt.step, attempt.learner, number % THOROUGH == 0
        if state is not step.then and (thorough or step.operation[0] not in SLOW):
            if (again := perform(learner, step.operation, self.home)) != step.result:
                self.failures.append(f"{where}: done again it gave {again}, expected {step.result}")
            state = step.then
        state, _ = after(state, OBSERVE, self.others)
        perform(learner, OBSERVE, self.home)
        self._require(f"{where}: after one more", seen(learner), [state])
        # Closing the store alone writes no generation: what was told is in the journal.
        if not thorough:
            learner._ledger.store._generations.raise_failure = lambda: None
        outcome = self._outcome(learner.close if thorough else learner._ledger.store.close)
        if outcome != "success":
            step.outcomes[f"closing told of the failure before it: {outcome}"] += 1
        if self._second_look(step, number):
            with opened(self.path) as again:
                self._require(f"{where}: opened at last", seen(again), [state])

    def _second_look(self, step: Step, number: int) -> bool:
        return step.name not in GENERATIONS or number % SECOND_LOOK == 0

    def _require(self, where: str, found: dict[str, Any], states: list[State]) -> State:
        state, differ = settle(found, states)
        if state is None:
            self.failures.append(f"{where}: differs in {differ}")
        return state or states[-1]

    def told(self) -> None:
        """Show failures as they come."""
        for failure in self.failures[self.shown :]:
            progress(f"FAILED {failure}")
        self.shown = len(self.failures)

    def _let_go(self, attempt: Attempt) -> None:
        if attempt.learner is not None:
            self._outcome(attempt.learner.close)

    def crash(self, step: Step, how: str, number: int) -> bool:
        """End the process at call `number`, and look at what is left; whether there was one."""
        child = self.zygote.spawn(crash, step, self.path, self.home, how, number)
        told: list[str] = []
        status = child.wait(told.append)
        if told == ["not reached"]:
            return False
        where = f"{step.name}, {how} at call {number}"
        if status != -9:
            self.failures.append(f"{where}: the child ended with {status}")
            return True
        self._note(step, how, "-", "killed")
        with warnings_told(lambda text: self.failures.append(f"{where}: warned {text}")):
            self._examined(where, lambda: self._recovers(where, step, number))
        return True

    def _recovers(self, where: str, step: Step, number: int) -> None:
        attempt = Attempt(step, self.path, self.home, fresh=False)
        attempt.learner = opened(self.path)
        state = self._require(f"{where}: opened again", seen(attempt.learner), [step.before, step.then])
        step.outcomes["found as after" if state is step.then and step.then != step.before else "found as before"] += 1
        self._finish(where, attempt, state, number)


def main(options: argparse.Namespace) -> dict[str, Any]:
    """Every call of every step, or every so-many-th."""
    every = 400 if options.quick else options.every
    quiet_coroutines()
    one_scale()
    warm()
    with folder(options, in_memory=True) as home, Zygote() as zygote:
        others = prepare(home)
        trial = Trial(home, zygote, others)
        steps = plan(home, others)
        for place, step in enumerate(steps):
            for how in list(MODES)[place % 3 :: 3] if options.quick else MODES:
                attempt = trial.crash if MODES[how][0] in (watch.CRASH, watch.TEAR) else trial.fail
                stride = every * ALIKE.get(step.name, 1)
                number = 1 + options.seed % stride
                while attempt(step, how, number):
                    number += stride
                    trial.told()
            progress(f"{step.name}: {sum(trial.tried.values())} calls so far, {len(trial.failures)} failures")
    return {
        "every": {"calls": every, "but of steps alike": {name: every * times for name, times in ALIKE.items()}},
        "calls": dict(trial.tried),
        "steps": {step.name: dict(step.calls) for step in steps},
        "outcomes": {step.name: dict(step.outcomes) for step in steps},
        "failures": trial.failures,
    }


if __name__ == "__main__":
    watch.begin_again_watched()
    run("each_call", parser(__doc__, every=1).parse_args(), main)
