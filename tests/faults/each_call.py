"""A failure, and a crash, at each call in turn: `python tests/faults/each_call.py`.

Each step of a short history, which has all operations, begins from a copy of the memory as it lies on the disk just
before. Of the calls that the C library gets for files of the memory meanwhile, zarr's among them, the
first fails, then the second, and so on (of the steps in ALIKE each fourth):

- EIO, then ENOSPC (of a write half is done before): a StoreError, and the memory is as before, or success, and it is
  as after; the step can be done again, then another observation, and opening anew finds it all.
- EIO when a file is opened to read, or read: the same.
- kill -9 in place of the call, and in the middle of each write: opened again it is as before or as after, and goes on.

Watched are open, write, pwrite, fsync, fdatasync, ftruncate, rename, link, unlink, mkdir, rmdir, read and pread, in
all their variants; others that could write abort the process (see shim.c).
"""

from __future__ import annotations

import argparse
import errno
import shutil
import sys
from collections import Counter
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from faults import shim as watch
from faults.common import folder, parser, quiet_coroutines, run, warnings_told
from faults.learners import one_scale, opened, perform, warm
from faults.model import Operation, State, after
from faults.plans import prepare
from faults.shim import Shim
from faults.trials import NEVER, SUCCESS, Attempt, Trials, copied
from faults.zygote import Zygote

SLOW = ("compact", "fine_tune")
CHECKPOINTS = ("fine-tune", "compact", "close", "compact all but 3", "observe, and a checkpoint", "open")
SECOND_LOOK = 3  # of so many calls of a step that writes checkpoints one is looked at by opening anew, too
# They write a checkpoint as two others do, call for call, whose every call is tried: of these one in four is.
ALIKE = {"fine-tune": 4, "compact": 4, "close": 4}
QUICK = 700
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
    # name of the step, operation, rows between checkpoints
    ("make", ("open",), NEVER),
    ("observe", ("observe", "a", (0, 90)), NEVER),
    ("", ("batch", tuple(("observe", name, (i, 90)) for i in range(3) for name in "abü")), NEVER),
    ("observe, and a checkpoint", ("observe", "b", (5, 60)), 1),
    ("batch", ("batch", (OBSERVE, ("observe", "a", (2, 40)), ("retract", 3), ("forget", "ü"))), NEVER),
    ("retract", ("retract", 2), NEVER),
    ("relabel", ("relabel", 5, "ü"), NEVER),
    ("forget", ("forget", "c"), NEVER),
    ("describe", ("describe", "b", (("silk", 0.25), ("wool", 0.75))), NEVER),
    ("merge", ("merge", "taken", "theirs"), NEVER),
    ("merge of one compacted", ("merge", "compacted", "theirs"), NEVER),
    ("fine-tune", ("fine_tune",), NEVER),
    ("backup", ("backup",), NEVER),
    ("compact all but 3", ("compact", 3), NEVER),
    ("", ("observe", "b", (3, 60)), NEVER),
    ("compact", ("compact", 0), NEVER),
    ("close", ("close",), NEVER),
    ("open", ("open",), NEVER),
)


@dataclass
class Step:
    """One step: how the memory lies on the disk before it, and what must be there before and after it.

    parts: what may be there where a batch ended early, because something could not be read.
    """

    name: str
    operation: Operation
    every: int
    start: Path
    before: State
    then: State
    result: Any
    parts: list[State] = field(default_factory=list)
    calls: Counter[str] = field(default_factory=Counter)
    outcomes: Counter[str] = field(default_factory=Counter)

    def attempt(self, path: Path, home: Path) -> Attempt:
        """The step, to be done on a fresh copy."""
        return Attempt(self.operation, path, home, self.start, self.every)


def plan(home: Path, others: dict[str, State]) -> list[Step]:
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
        then, result = after(state, operation, others)
        if name:
            done = range(1, len(operation[1])) if operation[0] == "batch" else ()
            parts = [after(state, ("batch", operation[1][:count]), others)[0] for count in done]
            steps.append(Step(name, operation, every, start, state, then, result, parts))
        if operation == ("open",) and learner is not None:
            leave_unfinished(start)
        elif operation == ("open",):
            learner = opened(path)
        elif operation != ("close",):  # what opening finds then is as after a crash
            assert perform(learner, operation, home) == result
        state = then
    learner.close()
    return steps


def leave_unfinished(path: Path) -> None:
    """What crashes may leave behind, and opening has to clear away."""
    checkpoints = path / "checkpoints"
    newest = max(checkpoints.iterdir())
    shutil.copytree(newest, checkpoints / "00000091")
    shutil.copytree(newest, checkpoints / "00000092.partial")
    log = max(path.glob("log-*"))
    shutil.copy(log, path / "log-00000091")
    for name in ("log-00000092.new", "CURRENT.new"):
        (path / name).write_bytes(log.read_bytes()[:100])
    (path / "holder.json.new").write_text("{", encoding="utf-8")


def crash(channel: Connection, step: Step, path: Path, home: Path, how: str, number: int) -> None:
    """The child: do a step, and end in the middle of it; it returns where there is no such call."""
    attempt = step.attempt(path, home)
    mode, what, error = MODES[how]
    shim = Shim()
    with warnings_told(lambda text: None):
        shim.arm(path.parent, mode, what, first=number, error=error)
        attempt.do()
        shim.disarm()
    channel.send("not reached")


class Trial(Trials):
    """All the calls of all the steps."""

    def __init__(self, home: Path, zygote: Zygote, others: dict[str, State]) -> None:
        super().__init__(home, others)
        self.zygote, self.path, self.shim = zygote, home / "run" / "memory", Shim()

    def fail(self, step: Step, how: str, number: int) -> bool:
        """Let call `number` fail; whether there was one."""
        mode, what, error = MODES[how]
        attempt = step.attempt(self.path, self.home)
        warned: list[str] = []
        with warnings_told(warned.append):
            self.shim.arm(self.path.parent, mode, what, first=number, error=error)
            outcome = self.outcome(where := f"{step.name}, {how} at call {number}", attempt.do)
            _, hit = self.shim.disarm()
            where += f" ({hit})"
            if hit:
                if outcome == SUCCESS:
                    outcome += ", warned" if warned else ""
                self._count(step, how, hit, outcome)
                parts = step.parts if how == "EIO in reading" else []
                if step.operation[0] == "compact" and hit == f"fsync {self.path}":
                    parts = [step.then]  # `CURRENT` has its new name; whether on the disk, too, nobody knows
                with self.examined(f"{where}: afterwards"):
                    self._goes_on(where, step, parts, attempt, outcome, number)
            elif outcome != SUCCESS:
                self.failures.append(f"{where}: {outcome} without a fault")
        if attempt.learner is not None:
            self.outcome(f"{where}: closing", attempt.learner.close)
        return bool(hit)

    def _count(self, step: Step, how: str, hit: str, outcome: str) -> None:
        self.note(how, outcome)
        step.calls[hit.split(maxsplit=1)[0]] += 1
        step.outcomes[f"{how}: {outcome}"] += 1

    def _goes_on(self, where: str, step: Step, parts: list[State], attempt: Attempt, outcome: str, number: int) -> None:
        if self._second_look(step, number):
            copied(self.path, crashed := self.home / "crashed")
            with opened(crashed, "read" if (crashed / "CURRENT").exists() else "write") as learner:
                self.require(f"{where}: as it lay on the disk then", learner, [step.before, step.then, *parts])
        if step.operation[0] == "close" or attempt.learner is None:
            attempt.learner = opened(self.path)
        self.require_copies(where, self.path, [step.before])
        states = [step.then] if outcome.startswith(SUCCESS) else [*parts, step.before]
        state = self.require(f"{where}: the learner, after {outcome}", attempt.learner, states)
        self._finish(where, step, attempt.learner, state, number)

    def _finish(self, where: str, step: Step, learner: Any, state: State, number: int) -> None:
        """Go on from a state as if nothing had been: what was not done is done again, and one more observation."""
        thorough = number % THOROUGH == 0
        if state is step.before and state is not step.then and (thorough or step.operation[0] not in SLOW):
            if (again := perform(learner, step.operation, self.home)) != step.result:
                self.failures.append(f"{where}: done again it gave {again}, expected {step.result}")
            state = step.then
        state, _ = after(state, OBSERVE, self.others)
        perform(learner, OBSERVE, self.home)
        self.require(f"{where}: after one more", learner, [state])
        # Closing the store alone writes no checkpoint: what was told is in the log.
        if not thorough:
            learner._ledger.store._idle = lambda: None
        outcome = self.outcome(f"{where}: closing", learner.close if thorough else learner._ledger.store.close)
        if outcome != SUCCESS:
            step.outcomes[f"closing told of the failure before it: {outcome}"] += 1
        if self._second_look(step, number):
            with opened(self.path) as again:
                self.require(f"{where}: opened at last", again, [state])

    def _second_look(self, step: Step, number: int) -> bool:
        return step.name not in CHECKPOINTS or number % SECOND_LOOK == 0

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
        self._count(step, how, "-", "killed")
        warned = lambda text: self.failures.append(f"{where}: warned {text}")  # noqa: E731
        with warnings_told(warned), self.examined(f"{where}: afterwards"):
            self._recovers(where, step, number)
        return True

    def _recovers(self, where: str, step: Step, number: int) -> None:
        self.require_copies(where, self.path, [step.before])
        learner = opened(self.path)
        state = self.require(f"{where}: opened again", learner, [step.before, step.then])
        step.outcomes["found as after" if state is step.then and step.then != step.before else "found as before"] += 1
        self._finish(where, step, learner, state, number)


def main(options: argparse.Namespace) -> dict[str, Any]:
    """Every call of every step, or every so-many-th."""
    every = QUICK if options.quick else options.every
    quiet_coroutines()
    one_scale()
    warm()
    with folder(options, in_memory=True) as home, Zygote() as zygote:
        others = prepare(home)
        trial = Trial(home, zygote, others)
        steps = plan(home, others)
        for place, step in enumerate(steps):
            for how in list(MODES)[place % 5 :: 5] if options.quick else MODES:
                attempt = trial.crash if MODES[how][0] in (watch.CRASH, watch.TEAR) else trial.fail
                stride = every * ALIKE.get(step.name, 1)
                number = 1 + options.seed % stride
                while attempt(step, how, number):
                    number += stride
                    trial.tell()
            trial.tell(f"{step.name}: {trial.tried} calls so far")
    return {
        "every": {"calls": every, "but of steps alike": {name: every * times for name, times in ALIKE.items()}},
        "calls": {how: sum(counted.values()) for how, counted in trial.outcomes.items()},
        "steps": {step.name: dict(step.calls) for step in steps},
        "outcomes": {step.name: dict(step.outcomes) for step in steps},
        "failures": trial.failures,
    }


if __name__ == "__main__":
    watch.begin_again_watched()
    run("each_call", parser(__doc__, every=1).parse_args(), main)
