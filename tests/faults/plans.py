"""Random operations on a memory, and the small memories that are merged into it."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from faults.learners import KIT, opened, perform
from faults.model import Operation, Others, State, Touch, after

KINDS = (
    *("observe", "batch", "retract", "forget", "relabel", "describe", "merge", "compact", "fine_tune", "backup"),
    "pack",
)
TOGETHER = ("observe", "observe", "observe", "retract", "forget", "describe")  # in a batch
SAID = (None, (("silk", 1.0),), (("silk", 0.25), ("wool", 0.75)), (("soft", True), ("wool", None)))

# The memories that are merged: so many observations, and what was done then.
OTHERS: dict[str, tuple[int, tuple[Operation, ...]]] = {
    "plain": (3, ()),
    "taken": (4, (("retract", 2), ("describe", "b", SAID[1]))),
    "compacted": (4, (("retract", 1), ("compact", 2), ("describe", "a", SAID[1]), ("describe", "ü", SAID[3]))),
}


def prepare(home: Path) -> dict[str, State]:
    """Make the memories to be merged in folder `home`: as observed, with some retracted, and compacted."""
    rng, others = random.Random(17), {}
    for name, (count, more) in OTHERS.items():
        state = State()
        with opened(home / name) as learner:
            for operation in (*(("observe", rng.choice(KIT.materials), touch(rng)) for _ in range(count)), *more):
                state, result = after(state, operation, {})
                assert perform(learner, operation, home) == result
        others[name] = state
    return others


def touch(rng: random.Random) -> Touch:
    """A random touch."""
    return rng.choice(KIT.touches)


def draw(rng: random.Random, state: State, others: Others, kind: str) -> Operation:
    """A random operation of a kind; now and then one that is refused."""
    drawn: dict[str, Callable[[], tuple[Any, ...]]] = {
        "observe": lambda: (rng.choice(KIT.materials), touch(rng)),
        "batch": lambda: (tuple(history(rng, state, others, rng.choices(TOGETHER, k=rng.randrange(1, 7)))),),
        "describe": lambda: (rng.choice(KIT.materials), rng.choice(SAID)),
        "retract": lambda: (_row(rng, state),),
        "forget": lambda: (_material(rng, state),),
        "relabel": lambda: (_row(rng, state), rng.choice(KIT.materials)),
        "merge": lambda: (rng.choice([*sorted(others), *dict(state.packed)]), rng.choice(("same", "ours", "theirs"))),
        "compact": lambda: (rng.choice((0, 1, 2, 4)),),
        "pack": lambda: (f"packed-{len(state.packed)}", rng.random() < 0.7),
        "reembed": lambda: (rng.choice(sorted(KIT.embeddings)),),
        "fleet": lambda: (_of_one_name(rng, state),),
    }
    return kind, *drawn.get(kind, tuple)()


def _row(rng: random.Random, state: State) -> int:
    loose = state.loose
    return rng.choice(loose) if loose and rng.random() < 0.95 else rng.randint(1, state.last + 3)


def _material(rng: random.Random, state: State) -> str:
    """One that can be forgotten, mostly."""
    loose = [state.rows[sequence - 1][1] for sequence in state.loose]
    there = sorted(name for name, count in state.materials.items() if loose.count(name) == count)
    return rng.choice(there if there and rng.random() < 0.95 else KIT.materials)


def _of_one_name(rng: random.Random, state: State) -> tuple[tuple[str, Touch], ...]:
    """Touches, some of which are there, in this list or in the memory; each content under one name only."""
    names = {touch: material for _, (material, touch) in state.listed}
    bare = [one for one in KIT.touches if not any(KIT.noted(one))]  # what is in a file has no values or labels
    drawn = [rng.choice(bare) for _ in range(rng.randrange(1, 6))]
    return tuple((names.setdefault(one, rng.choice(KIT.materials)), one) for one in drawn)


def history(rng: random.Random, state: State, others: Others, kinds: Sequence[str]) -> list[Operation]:
    """Random operations of these kinds, one after another."""
    operations = []
    for kind in kinds:
        operations.append(draw(rng, state, others, kind))
        state, _ = after(state, operations[-1], others)
    return operations
