"""Random operations on a memory, and the small memories that are merged into it."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

from touches import stream

from faults.model import EMBEDDINGS, LENGTHS, MATERIALS, SEEDS, Operation, Other, State, Touch, after, opened

KINDS = (
    *("observe", "batch", "retract", "forget", "relabel", "describe", "merge", "compact", "fine_tune", "backup"),
    "pack",
)
MOST_TWICE = 16  # observations: a memory that is merged into itself would soon be all that a history does

SAID = (None, (("silk", 1.0),), (("silk", 0.25), ("wool", 0.75)), (("soft", True), ("wool", None)))


def touch(rng: random.Random) -> Touch:
    """A random touch."""
    return rng.randrange(SEEDS), rng.choice(LENGTHS)


def prepare(home: Path) -> dict[str, Other]:
    """Make the memories to be merged in folder `home`: as observed, with some retracted, and compacted."""
    rng = random.Random(17)
    others = {}
    for name, count, taken, keep in (("plain", 3, (), None), ("taken", 4, (1,), None), ("compacted", 4, (0,), 2)):
        observed = [(rng.choice(MATERIALS), touch(rng)) for _ in range(count)]
        with opened(home / name) as learner:
            receipts = [learner.observe(material, stream(one), again=True) for material, one in observed]
            for i in taken:
                learner.retract(receipts[i])
            left = tuple(one for i, one in enumerate(observed) if i not in taken)
            if keep is not None:
                learner.compact(keep=keep)
            fixed = 0 if keep is None else max(0, len(left) - keep)
            said = {"plain": (), "taken": (("b", SAID[1]),), "compacted": (("a", SAID[1]), ("ü", SAID[3]))}[name]
            for material, constituents in said:  # of one that was compacted behind its compaction checkpoint
                learner.describe(material, dict(constituents))
            others[name] = Other(left, fixed, learner._ledger.memory.compacted > 0, said)
    return others


def draw(rng: random.Random, state: State, others: dict[str, Other], kind: str) -> Operation:
    """A random operation of a kind; now and then one that is refused."""
    drawn: dict[str, Callable[[], Operation]] = {
        "observe": lambda: (rng.choice(MATERIALS), touch(rng), rng.random() < 0.5),
        "batch": lambda: (_together(rng, state, others),),
        "describe": lambda: (rng.choice(MATERIALS), rng.choice(SAID)),
        "retract": lambda: (_to_retract(rng, state, kind),),
        "forget": lambda: (_to_retract(rng, state, kind),),
        "relabel": lambda: (_to_retract(rng, state, kind), rng.choice(MATERIALS)),
        "merge": lambda: _to_merge(rng, state, others),
        "compact": lambda: (rng.choice((0, 1, 2, 4)),),
        "pack": lambda: (f"packed-{len(state.packed)}", rng.random() < 0.7),
        "reembed": lambda: (rng.choice(sorted(EMBEDDINGS)),),
        "fleet": lambda: (_of_one_name(rng, state),),
    }
    return kind, *drawn.get(kind, tuple)()


def _to_merge(rng: random.Random, state: State, others: dict[str, Other]) -> Operation:
    """One of the others, or what this memory was packed as."""
    name = rng.choice([*sorted(others), *dict(state.packed)])
    shared = rng.choice(("twice", "once")) if name in others or len(state.observed) <= MOST_TWICE else "once"
    return name, shared, rng.choice(("same", "ours", "theirs"))


def _to_retract(rng: random.Random, state: State, kind: str) -> int | str:
    """A sequence, or a material."""
    loose: list[int] | list[str] = [one.sequence for one in state.loose]
    if kind == "forget":
        loose = sorted({one.material for one in state.observed} - {one.material for one in state.observed if one.fixed})
    if loose and rng.random() < 0.95:
        return rng.choice(loose)
    return rng.choice(MATERIALS) if kind == "forget" else state.last + 3


def _of_one_name(rng: random.Random, state: State) -> tuple[tuple[str, Touch], ...]:
    """Touches, some of which are there, in this list or in the memory; each content under one name only."""
    names = {one.touch: one.material for one in state.observed}
    pairs = []
    for one in (touch(rng) for _ in range(rng.randrange(1, 6))):
        pairs.append((names.setdefault(one, rng.choice(MATERIALS)), one))
    return tuple(pairs)


def _together(rng: random.Random, state: State, others: dict[str, Other]) -> tuple[Operation, ...]:
    operations: list[Operation] = []
    for _ in range(rng.randrange(1, 7)):
        kind = rng.choice(("observe", "observe", "observe", "retract", "forget", "describe"))
        operations.append(draw(rng, state, others, kind))
        state, _ = after(state, operations[-1], others)
    return tuple(operations)


def history(rng: random.Random, state: State, others: dict[str, Other], kinds: list[str]) -> list[Operation]:
    """Random operations of these kinds, one after another."""
    operations = []
    for kind in kinds:
        operations.append(draw(rng, state, others, kind))
        state, _ = after(state, operations[-1], others)
    return operations
