"""One operation done while the disk fails, and what must be seen of the memory then and afterwards."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import scroll_tactile.persistence.open_memory
from faults.model import Operation, Other, State, opened, perform, seen, settle
from store import StoreError

NEVER = 2**40  # rows between checkpoints
SUCCESS = "success"


def copied(path: Path, to: Path) -> None:
    """A copy as after a crash; the lock is left out."""
    shutil.rmtree(to, ignore_errors=True)
    if path.exists():
        shutil.copytree(path, to, ignore=shutil.ignore_patterns("lock"))


class Attempt:
    """An operation, to be done once in folder `path`, on a copy of `start` where one is given.

    every: rows between checkpoints while it is done. home: where the memories lie that are merged.
    """

    def __init__(
        self, operation: Operation, path: Path, home: Path, start: Path | None = None, every: int = NEVER
    ) -> None:
        self.operation, self.path, self.home, self.every = operation, path, home, every
        self.learner: Any = None
        scroll_tactile.persistence.open_memory.SNAPSHOT_EVERY = NEVER
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
            self.learner._ledger._saved = -1

    @property
    def changes_nothing(self) -> bool:
        """Whether it leaves what is seen of a memory as it was."""
        return self.operation[0] in ("open", "close")

    def do(self) -> Any:
        """Do it, and wait for what goes on behind it."""
        scroll_tactile.persistence.open_memory.SNAPSHOT_EVERY = self.every
        try:
            if self.operation[0] == "open":
                self.learner = opened(self.path)
                return None
            if self.operation[0] == "close":
                return self.learner.close()
            result = perform(self.learner, self.operation, self.home)
            self.learner._ledger.store._checkpoints.wait()
            return result
        finally:
            scroll_tactile.persistence.open_memory.SNAPSHOT_EVERY = NEVER


class Trials:
    """Attempts, what came of them and what was wrong with it; `others` are the memories that are merged."""

    def __init__(self, home: Path, others: dict[str, Other]) -> None:
        self.home, self.others = home, others
        self.failures: list[str] = []
        self.outcomes: dict[str, Counter[str]] = {}

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

    def examined(self, where: str, look: Callable[[], None]) -> None:
        """Look at what is left; what that raises is a failure, and not the end."""
        try:
            look()
        except Exception as error:
            self.failures.append(f"{where}: afterwards {error!r}")

    def require(self, where: str, learner: Any, states: Sequence[State]) -> State:
        """What is seen of a learner is one of the states; which."""
        state, differ = settle(seen(learner), list(states))
        if state is None:
            self.failures.append(f"{where}: differs in {differ}")
        return state or states[-1]

    def note(self, name: str, outcome: str) -> None:
        """Count."""
        self.outcomes.setdefault(name, Counter())[outcome] += 1

    @property
    def tried(self) -> int:
        """How many were counted."""
        return sum(sum(counted.values()) for counted in self.outcomes.values())
