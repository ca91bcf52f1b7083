"""What was tried of memories, what came of it and what was wrong; and one operation, done while the disk fails."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from scroll_tactile_store import StoreError

import scroll_tactile.persistence.ledger
from faults.common import progress
from faults.learners import opened, perform, seen, settle, unsound_copies
from faults.model import Operation, State

NEVER = 2**40  # rows between checkpoints
SUCCESS = "success"


def checkpoints_every(rows: int) -> None:
    """From here on, a memory in this process writes a checkpoint behind its back every so many rows."""
    scroll_tactile.persistence.ledger.CHECKPOINT_EVERY = rows


def copied(path: Path, to: Path) -> None:
    """A copy as after a crash; the lock is left out."""
    shutil.rmtree(to, ignore_errors=True)
    if path.exists():
        shutil.copytree(path, to, ignore=shutil.ignore_patterns("lock"))


class Trials:
    """What was tried and found wrong; `others` are the memories that are merged, which lie in `home`."""

    def __init__(self, home: Path, others: dict[str, State]) -> None:
        self.home, self.others = home, others
        self.failures: list[str] = []
        self.counts: Counter[str] = Counter()
        self.outcomes: dict[str, Counter[str]] = {}
        self._shown = 0

    def outcome(self, where: str, do: Callable[[], Any]) -> str:
        """Do something: the name of the StoreError, or success; any other error is a failure."""
        try:
            do()
        except StoreError as error:
            return type(error).__name__
        except Exception as error:
            self.failures.append(f"{where}: not a StoreError: {error!r}")
            return "not a StoreError"
        return SUCCESS

    @contextmanager
    def examined(self, where: str) -> Iterator[None]:
        """In the block what is left is looked at; what that raises is a failure, and not the end."""
        try:
            yield
        except Exception as error:
            self.failures.append(f"{where}: {error!r}")

    def settled(self, where: str, found: Any, states: Sequence[State]) -> State | None:
        """Which of the states is the one that is seen; None, and a failure, where none is.

        found: what is seen, or a learner. states: where two differ, what was before an operation, and behind it.
        """
        state, differ = settle(found if isinstance(found, dict) else seen(found), states)
        if state is None:
            self.failures.append(f"{where}: differs in {differ}")
        elif len(states) == 2 and states[0] != states[1]:
            self.counts["begun, and found " + ("done" if state is states[1] else "not done")] += 1
        return state

    def require(self, where: str, learner: Any, states: Sequence[State]) -> State:
        """What is seen of a learner is one of the states; which, or the last."""
        return self.settled(where, learner, states) or states[-1]

    def require_copies(self, where: str, path: Path, states: Sequence[State]) -> None:
        """The backups of a memory are whole, and each is of one of the states."""
        self.failures += [f"{where}: {what}" for what in unsound_copies(path, states)]

    def note(self, name: str, outcome: str) -> None:
        """Count."""
        self.outcomes.setdefault(name, Counter())[outcome] += 1

    @property
    def tried(self) -> int:
        """How many were counted."""
        return sum(sum(counted.values()) for counted in self.outcomes.values())

    def tell(self, done: str = "") -> None:
        """Show failures as they come, and how far it is."""
        for failure in self.failures[self._shown :]:
            progress(f"FAILED {failure}")
        self._shown = len(self.failures)
        if done:
            progress(f"{done}, {len(self.failures)} failures")

    def figures(self) -> dict[str, Any]:
        """What a record has of it."""
        return {"counts": dict(sorted(self.counts.items())), "failures": self.failures}


class Attempt:
    """An operation, to be done once in folder `path`, on a copy of `start` where one is given.

    every: rows between checkpoints while it is done. home: where the memories lie that are merged.
    """

    def __init__(
        self, operation: Operation, path: Path, home: Path, start: Path | None = None, every: int = NEVER
    ) -> None:
        self.operation, self.path, self.home, self.every = operation, path, home, every
        self.learner: Any = None
        checkpoints_every(NEVER)
        if start is None:
            return
        copied(start, path)
        for copy in path.parent.glob(f"{path.name}-copy-*"):
            shutil.rmtree(copy)
        path.parent.mkdir(exist_ok=True)
        if operation[0] != "open":
            self.learner = opened(path)
        if operation[0] == "close":
            # Opening replayed all rows: nothing would be written.
            self.learner.memory.saved = -1

    @property
    def changes_nothing(self) -> bool:
        """Whether it leaves what is seen of a memory as it was."""
        return self.operation[0] in ("open", "close")

    def do(self) -> Any:
        """Do it, and wait for what goes on behind it."""
        checkpoints_every(self.every)
        try:
            if self.operation[0] == "open":
                self.learner = opened(self.path)
                return None
            result = perform(self.learner, self.operation, self.home)
            if self.operation[0] != "close":
                self.learner._ledger.store._wait()
            return result
        finally:
            checkpoints_every(NEVER)
