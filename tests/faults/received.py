"""Memories to be mutated, and what is done to one that came from elsewhere, all of which may only end in our errors.

A reader is a function of a `Case`; it returns what came of it in a few words, raises what the library raised, and
raises `Wrong` where something is not as it has to be.
"""

from __future__ import annotations

import math
import random
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scroll_tactile_store import Store, StoreError, check_store, repair_store
from touches import stream
from typer.testing import CliRunner

from faults.cases import Wrong
from faults.common import fingerprint, warnings_told
from faults.learners import opened, perform, samples
from faults.model import Operation
from scroll_tactile import TactileLearner
from scroll_tactile.clients.cli import application
from scroll_tactile.clients.learning.plain_export import export_plain
from scroll_tactile.errors import ScrollTactileError
from scroll_tactile.validation.gate import check_memory

OURS = (ScrollTactileError, StoreError)
GOLDEN = Path(__file__).parents[1] / "data" / "format-3.zip"
TOUCHES: tuple[Operation, ...] = tuple(("observe", name, (i, 30)) for i in range(2) for name in "ab")
HISTORIES: dict[str, tuple[Operation, ...]] = {
    "rows": TOUCHES,
    "crashed": (*TOUCHES, ("describe", "a", (("x", 0.5), ("y", 0.5))), ("retract", 2)),
    "snapshot": (*TOUCHES, ("describe", "b", (("x", 1.0),))),
    "compacted": (*TOUCHES, ("describe", "a", (("x", True),)), ("compact", 1), ("observe", "c", (3, 40))),
    "merged": (("observe", "b", (7, 30)), ("merge", "compacted", "theirs"), ("retract", 1)),
    "tuned": (*TOUCHES, ("observe", "a", (5, 40)), ("fine_tune",)),
}
WITHOUT_CHECKPOINT = ("rows", "crashed")


@dataclass
class Memory:
    """A memory of the corpus: where it lies, what it holds, and what it held behind each of its earlier rows."""

    name: str
    path: Path
    seen: dict[str, Any]
    earlier: list[dict[str, Any]] = field(default_factory=list)


def glance(learner: TactileLearner) -> dict[str, Any]:
    """What can be seen of a learner without an answer of it, and without its journal."""
    exemplars = sorted((name, key.hex()) for name, key, _ in learner.memory.exemplars or ())
    told = {"materials": learner.materials, "descriptions": repr(learner.descriptions), "exemplars": exemplars}
    return samples(learner) | told | {"tuned": learner.tuned_digest()}


def corpus(home: Path) -> list[Memory]:
    """All memories, made in a folder, and the golden one of format 3."""
    made = []
    for name, history in HISTORIES.items():
        learner = opened(home / name)
        earlier = [glance(learner)]  # of a log that is lost whole
        for operation in history:
            perform(learner, operation, home)
            earlier.append(glance(learner))
        if name in WITHOUT_CHECKPOINT:
            learner._ledger._saved = learner.memory.sequence
        if name == "crashed":
            shutil.copytree(home / name, home / "copy")
        learner.close()
        if name == "crashed":
            shutil.rmtree(home / name)
            (home / "copy").rename(home / name)
        made.append(Memory(name, home / name, earlier[-1], earlier[:-1]))
    shutil.unpack_archive(GOLDEN, home / "golden")
    with TactileLearner.open(home / "golden") as learner:  # closing it writes a checkpoint of all
        learner.digest()
    with TactileLearner.open(home / "golden", mode="read") as learner:
        made.append(Memory("golden", home / "golden", glance(learner)))
    return made


@dataclass
class Case:
    """A memory as it was received.

    path: its folder. home: a folder for what a reader makes. rng: for what a reader chooses. before: what the memory
    held before it was mutated. same: whether it may hold nothing else without a word. again: mutates another folder in
    the same way. target: of merges.
    """

    path: Path
    home: Path
    rng: random.Random
    memory: Memory
    same: bool
    again: Callable[[Path], Any]
    target: Target

    def judge(self, learner: TactileLearner, warned: list[str]) -> str:
        """What to call what was opened; raises Wrong where it is other than before, and nothing was said."""
        found = glance(learner)
        if found == self.memory.seen:
            return "as before"
        if warned or not self.same:
            return "warned" if warned else "accepted"
        if found in self.memory.earlier and self.memory.name in WITHOUT_CHECKPOINT:
            return "the end of the log dropped"
        differ = [name for name, value in found.items() if value != self.memory.seen[name]]
        raise Wrong(f"opened without a word, and differs in {differ}")


class Target:
    """A sound memory into which others are merged; it stays open until one came in."""

    def __init__(self, sound: Path, path: Path) -> None:
        self._sound, self.path = sound, path
        self._learner: TactileLearner | None = None

    def opened(self) -> TactileLearner:
        """The memory, opened to write."""
        if self._learner is None:
            shutil.rmtree(self.path, ignore_errors=True)
            shutil.copytree(self._sound, self.path)
            self._before = fingerprint(self.path)
            self._learner = TactileLearner.open(self.path)
            self.digest, self.last = self._learner.digest(), self._learner._ledger.store.last
        return self._learner

    def close(self) -> None:
        """Close it; raises Wrong where it is not as it was, to the byte."""
        if self._learner is None:
            return
        self._learner.close()
        self._learner = None
        now = fingerprint(self.path)
        if changed := [name for name in now if now[name] != self._before.get(name) and name != "lock"]:
            raise Wrong(f"merges that failed left {changed} of the memory changed")

    def drop(self) -> TactileLearner:
        """The memory, which the caller closes: it is another now."""
        learner, self._learner = self.opened(), None
        return learner


@contextmanager
def heard() -> Iterator[list[str]]:
    """The warnings that are logged meanwhile."""
    found: list[str] = []
    with warnings_told(found.append):
        yield found


def touch_of(learner: TactileLearner) -> np.ndarray:
    """A touch that the learner's sensor could have measured."""
    return stream((11, 30)) if learner.sensor.channels == 2 else np.full((30, min(learner.sensor.channels, 512)), 0.5)


def require_sane(learner: TactileLearner) -> None:
    """Raise Wrong where an answer is no probability."""
    answers = [learner.predict(touch_of(learner), tuned=tuned) for tuned in (False, learner.tuned_digest() is not None)]
    for answer in answers:
        shares = [share for _, share in answer.ranking]
        sound = all(math.isfinite(share) and 0 <= share <= 1 for share in (answer.probability, *shares))
        if not sound or abs(sum(shares) - 1) > 1e-6 or not math.isfinite(answer.novelty or 0.0):
            raise Wrong(f"the answer is {answer}")
    if learner.descriptions:
        learner.compose(touch_of(learner))


def read(case: Case) -> str:
    """Open it to read, list what it holds, and now and then ask."""
    with heard() as warned, TactileLearner.open(case.path, mode="read") as learner:
        came = case.judge(learner, warned)
        learner.observations()
        if case.rng.random() < 0.05:
            require_sane(learner)
            len(learner.exemplars)
    return came


def write(case: Case) -> str:
    """Open it to write, observe, open again, retract, and compact: what was acknowledged is there."""
    with heard() as warned:
        with TactileLearner.open(case.path) as learner:
            came = case.judge(learner, warned)
            before, counted = learner.digest(), learner.materials.get("b", 0)
            receipt = learner.observe("b", touch_of(learner))
        with TactileLearner.open(case.path) as learner:
            if learner.materials.get("b") != counted + 1:
                raise Wrong(f"an observation was lost: {learner.materials}, and {counted} before it")
            learner.retract(receipt.sequence)
            if learner.digest() != before:
                raise Wrong("after an observation was retracted the digest is another")
            if case.rng.random() < 0.3:
                require_sane(learner)
            if case.rng.random() < 0.5:
                learner.compact()
        with TactileLearner.open(case.path, mode="read") as learner:
            if learner.digest() != before:
                raise Wrong("opened at last, the digest is another")
    return came


def merge(case: Case) -> str:
    """Merge it into a sound memory, which afterwards is as it was, or answers, and can be rid of it again."""
    target = case.target.opened()
    descriptions: Any = case.rng.choice(("same", "theirs"))
    with heard():
        try:
            target.merge(case.path, descriptions=descriptions)
        except OURS:
            if (target.digest(), target._ledger.store.last) != (case.target.digest, case.target.last):
                case.target.drop().close()
                raise Wrong("a merge failed, and changed the memory") from None
            raise
        with case.target.drop() as learner:
            if case.rng.random() < 0.25:
                require_sane(learner)
            came = [row for row in learner.observations() if row.sequence > case.target.last and row.state == "kept"]
            whole = all(row.kind in ("observe", "retract", "describe") for row in _heads(learner, case.target.last))
            for row in came:
                learner.retract(row.sequence)
            if whole and learner.digest() != case.target.digest:
                raise Wrong("after all that came in was retracted, the digest is another")
            if case.rng.random() < 0.25:
                learner.compact()
        with TactileLearner.open(case.target.path, mode="read") as learner:
            learner.digest()
    return "merged"


def _heads(learner: TactileLearner, after: int) -> list[Any]:
    return list(learner._ledger.store.heads(after))


def check(case: Case) -> str:
    """Look for damage; where there is none to be found it must open, and without a word."""
    found = [problem.what for problem in check_store(case.path) if problem.kind != "leftover"]
    found = found or check_memory(case.path)
    if found:
        return "found"
    with heard() as warned:
        try:
            with TactileLearner.open(case.path, mode="read") as learner:
                case.judge(learner, warned)
        except (StoreError, ScrollTactileError) as error:
            if type(error).__name__ == "DamageError":
                raise Wrong(f"check finds nothing, and opening says {error}") from error
    if warned:
        raise Wrong(f"check finds nothing, and opening warns: {warned[0]}")
    return "sound"


def repair(case: Case) -> str:
    """Repair it; what is left is sound."""
    with heard():
        repair_store(case.path)
        if left := [problem.what for problem in check_store(case.path) if problem.kind != "leftover"]:
            raise Wrong(f"a repair left {left}")
        with TactileLearner.open(case.path, mode="read") as learner:
            learner.digest()
    return "repaired"


def backup(case: Case) -> str:
    """Copy it."""
    with heard(), Store.open(case.path, mode="read") as store:
        store.backup(case.home / "backup")
    return "copied"


def export(case: Case) -> str:
    """Write it as plain files."""
    with heard(), TactileLearner.open(case.path, mode="read") as learner:
        export_plain(learner, case.home / "export")
    return "exported"


def inspect(case: Case) -> str:
    """Show it on a terminal: no traceback, and nothing that the terminal would obey."""
    with heard():
        # A check is a process of its own, which imports all anew.
        words = case.rng.choices((["inspect"], ["inspect", "--json"], ["memory", "check"]), (10, 10, 1))[0]
        done = CliRunner().invoke(application(), [*words, str(case.path)])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    told = done.stdout + done.stderr
    if strange := [letter for letter in told if not letter.isprintable() and letter != "\n"]:
        raise Wrong(f"shown on the terminal: {strange[:5]!r}")
    if done.exit_code not in (0, 1):
        raise Wrong(f"ended with {done.exit_code}")
    return f"ended with {done.exit_code}"


def refresh(case: Case) -> str:
    """A reader of it as it was sees what it became."""
    path = case.home / "refreshed"
    shutil.copytree(case.memory.path, path, symlinks=True)
    with heard() as warned, TactileLearner.open(path, mode="read") as learner:
        case.again(path)
        learner.refresh()
        return case.judge(learner, warned)


Reader = Callable[[Case], str]
READING: tuple[Reader, ...] = (read, merge, check, backup, export, inspect)
WRITING: tuple[Reader, ...] = (write, repair, refresh)
