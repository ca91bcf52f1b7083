"""What a memory must hold: a list of touches that cannot go wrong, and the operations that change it.

An operation is a tuple: ("observe", material, touch, again), ("batch", operations), ("retract", sequence),
("forget", material), ("relabel", sequence, material), ("describe", material, constituents or None),
("merge", name, shared), ("compact", keep), ("fine_tune",), ("backup",), ("pack", name, rows), ("reembed", embedding),
("fleet", pairs). `after` says what it makes of a `State` and what the call returns, `perform` does it to a learner (and
`recorded.learn_files` a fleet's), and `expected` is what can be seen of a learner in that state: made anew, in memory,
from the touches in another order.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import shutil
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from touches import PAD, SETTINGS, SMALL, SmallSample, fed, stream

import scroll_tactile.memory.state
from scroll_tactile import Kernels, TactileLearner
from scroll_tactile.errors import InputError, MismatchError
from store import check_store

MATERIALS = ("a", "b", "c", "ü")
LENGTHS = (2, 16, 25, 40, 60, 90, 120)  # the widest scale needs 37, a fine-tune some of two materials

# Few touches, so that the same stream is observed again, by this memory and by those merged into it.
SEEDS = 6

# By the names that a `State` has for them: that which memories are made with, and one to embed them again with.
EMBEDDINGS = {"own": SMALL, "other": Kernels(seed=3, dimension=SMALL.dimension)}

Touch = tuple[int, int]
DRAWN: tuple[Touch, ...] = tuple(itertools.product(range(SEEDS), LENGTHS))
Constituents = tuple[tuple[str, float | bool | None], ...]
Operation = tuple[Any, ...]


def warm() -> None:
    """Have everything imported and set, so that a process forked from here begins at once, with no thread running."""
    torch.set_num_threads(1)
    scroll_tactile.memory.state.TouchSample = SmallSample  # type: ignore[misc]  # for good: this process does nothing else
    learner = TactileLearner(**settings())
    for i in range(4):
        for name in MATERIALS[:2]:
            learner.observe(name, stream((i, 90)))
    learner.fine_tune(epochs=1)
    learner.predict(stream((9, 90)))
    import filelock  # noqa: F401  # what the store imports late
    import zarr  # noqa: F401
    from numcodecs import zstd  # noqa: F401


# Fewer kept touches than are observed, so that what was left out of them has to come back.
_settings: dict[str, Any] = SETTINGS | {"kept_touches": 5}


def settings() -> dict[str, Any]:
    """The arguments of every learner here."""
    return _settings


def one_scale() -> None:
    """Have touches read at one scale only, from here on: fewer files, where each call for each of them is tried."""
    _settings["sensor"] = PAD.model_copy(update={"duration": 0.3})


def opened(path: Path, mode: Any = "write", **more: Any) -> TactileLearner:
    """The memory in folder `path`."""
    return TactileLearner.open(path, mode=mode, **settings() | more)


@dataclass(frozen=True)
class Observation:
    """An observation; fixed: it can no longer be retracted."""

    sequence: int
    material: str
    touch: Touch
    fixed: bool = False

    @property
    def pair(self) -> tuple[str, Touch]:
        """What was observed, whenever it was."""
        return self.material, self.touch


Pairs = tuple[tuple[str, Touch], ...]


@dataclass(frozen=True)
class Other:
    """A memory to be merged. felt: what it holds, of which the first `fixed` were compacted. based: any row was.

    said: what it says that materials are made of. embedding: the name of the one that made it.
    """

    observed: Pairs
    fixed: int
    based: bool
    said: tuple[tuple[str, Constituents], ...] = ()
    embedding: str = "own"


@dataclass(frozen=True)
class State:
    """All that a memory holds. last: its rows. compacted: the last that was compacted. tuned: what f* was made from.

    said: materials with what they are made of, in alphabetical order. embedding: its name. brought: whether a memory
    came in without its rows. packed: what it was packed as, by the name of the file.
    """

    observed: tuple[Observation, ...] = ()
    last: int = 0
    compacted: int = 0
    tuned: Pairs | None = None
    tuned_last_sequence: int = 0
    said: tuple[tuple[str, Constituents], ...] = ()
    embedding: str = "own"
    brought: bool = False
    packed: tuple[tuple[str, Other], ...] = ()

    @property
    def pairs(self) -> Pairs:
        """What was observed, in an order of its own."""
        return tuple(sorted(one.pair for one in self.observed))

    def without(self, sequences: set[int]) -> State:
        """The state after a row that takes observations back."""
        left = tuple(one for one in self.observed if one.sequence not in sequences)
        gone = any(sequence <= self.tuned_last_sequence for sequence in sequences)
        return replace(self, observed=left, last=self.last + 1, tuned=None if gone else self.tuned)

    def with_one(self, material: str, touch: Touch, *, fixed: bool = False) -> State:
        """The state after an observation."""
        one = Observation(self.last + 1, material, touch, fixed)
        return replace(self, observed=(*self.observed, one), last=self.last + 1)

    def with_said(self, material: str, constituents: Constituents | None) -> State:
        """The state in which this is said of a material; None: nothing is."""
        said = dict(self.said)
        said.pop(material, None)
        said |= {} if constituents is None else {material: constituents}
        return replace(self, said=tuple(sorted(said.items())))

    @property
    def loose(self) -> list[Observation]:
        """What can still be retracted."""
        return [one for one in self.observed if not one.fixed]


def after(state: State, operation: Operation, others: dict[str, Other]) -> tuple[State, Any]:
    """What an operation makes of a state, and what the call returns: JSON, or the name of the error that it raises."""
    kind, *rest = operation
    return _AFTER[kind](state, others, *rest)


def _observe(state: State, _: Any, material: str, touch: Touch, again: bool = True) -> tuple[State, Any]:
    there = [one.sequence for one in state.observed if one.pair == (material, touch)]
    if there and not again:
        return state, min(there)
    then = state.with_one(material, touch)
    return then, then.last


def _batch(state: State, others: dict[str, Other], operations: tuple[Operation, ...]) -> tuple[State, Any]:
    results = []
    for one in operations:
        state, result = after(state, one, others)
        results.append(result)
    return state, results


def _retract(state: State, _: Any, sequence: int) -> tuple[State, Any]:
    if sequence not in {one.sequence for one in state.loose}:
        return state, "ObservationError"
    return state.without({sequence}), None


def _forget(state: State, _: Any, material: str) -> tuple[State, Any]:
    found = [one for one in state.observed if one.material == material]
    if not found:
        return state, "UnknownMaterialError"
    if any(one.fixed for one in found):
        return state, "ObservationError"
    return state.without({one.sequence for one in found}).with_said(material, None), len(found)


def _relabel(state: State, _: Any, sequence: int, material: str) -> tuple[State, Any]:
    found = {one.sequence: one for one in state.loose}
    if sequence not in found:
        return state, "ObservationError"
    if found[sequence].material == material:
        return state, "InputError"
    then = state.without({sequence}).with_one(material, found[sequence].touch)
    return then, then.last


def _describe(state: State, _: Any, material: str, constituents: Constituents | None) -> tuple[State, Any]:
    changed = repr(dict(state.said).get(material)) != repr(constituents)
    return replace(state.with_said(material, constituents), last=state.last + changed), None


def _merge(
    state: State, others: dict[str, Other], name: str, shared: str, descriptions: str = "same"
) -> tuple[State, Any]:
    other, said = (others | dict(state.packed))[name], dict(state.said)
    if other.embedding != state.embedding:
        return state, "MismatchError"
    ours = {one.pair for one in state.observed}
    both = [i for i, pair in enumerate(other.observed) if pair in ours]
    if shared == "once" and any(i < other.fixed for i in both):
        return state, "ObservationError"
    new = {material: parts for material, parts in other.said if repr(said.get(material)) != repr(parts)}
    if descriptions == "same" and new.keys() & said.keys():
        return state, "MismatchError"
    if descriptions == "ours":
        new = {material: parts for material, parts in new.items() if material not in said}
    coming = [i for i in range(len(other.observed)) if shared == "twice" or i not in both]
    for material, parts in new.items():
        state = state.with_said(material, parts)
    state = replace(state, last=state.last + len(new) + other.based, brought=state.brought or other.based)
    for i in coming:
        state = state.with_one(*other.observed[i], fixed=i < other.fixed)
    return state, [len(coming), len(both), len(new)]


def _compact(state: State, _: Any, keep: int) -> tuple[State, Any]:
    loose = state.loose
    last_sequence = state.last if keep == 0 else loose[-keep].sequence - 1 if len(loose) > keep else 0
    last_sequence = max(last_sequence, state.compacted)
    observed = tuple(replace(one, fixed=one.fixed or one.sequence <= last_sequence) for one in state.observed)
    return replace(state, observed=observed, compacted=last_sequence), last_sequence


def _fine_tune(state: State, _: Any) -> tuple[State, Any]:
    digest = tuned_digest(state.pairs, state.embedding)
    if digest is None:
        return state, "InputError"
    return replace(state, tuned=state.pairs, tuned_last_sequence=state.last), digest


def _backup(state: State, _: Any) -> tuple[State, Any]:
    return state, None


def _pack(state: State, _: Any, name: str, rows: bool) -> tuple[State, Any]:
    """Rows stay behind where any are missing."""
    whole = rows and not (state.compacted or state.brought)
    pairs = tuple(one.pair for one in state.observed)
    other = Other(pairs, 0 if whole else len(pairs), not whole, state.said, state.embedding)
    return replace(state, packed=(*state.packed, (name, other))), None


def _reembed(state: State, _: Any, embedding: str) -> tuple[State, Any]:
    """Nothing is lost but f*."""
    if state.compacted or state.brought:
        return state, "MismatchError"
    return replace(state, embedding=embedding, tuned=None, tuned_last_sequence=0), None


def _fleet(state: State, _: Any, touches: Pairs) -> tuple[State, Any]:
    ours = {one.pair for one in state.observed}
    coming = [pair for pair in dict.fromkeys(touches) if pair not in ours]
    for pair in coming:
        state = state.with_one(*pair)
    return state, len(coming)


_AFTER = {
    "observe": _observe,
    "batch": _batch,
    "retract": _retract,
    "forget": _forget,
    "relabel": _relabel,
    "describe": _describe,
    "merge": _merge,
    "compact": _compact,
    "fine_tune": _fine_tune,
    "backup": _backup,
    "pack": _pack,
    "reembed": _reembed,
    "fleet": _fleet,
}


def perform(learner: TactileLearner, operation: Operation, home: Path) -> Any:
    """Do an operation, and return what `after` says of it; others to be merged lie in folder `home`."""
    kind, *rest = operation
    try:
        return _CALLS[kind](learner, home, *rest)
    except (InputError, MismatchError) as error:
        return type(error).__name__


def _do_observe(learner: TactileLearner, _: Path, material: str, touch: Touch, again: bool = True) -> int:
    return learner.observe(material, stream(touch), again=again).sequence


def _do_batch(learner: TactileLearner, home: Path, operations: tuple[Operation, ...]) -> list[Any]:
    with learner.batch():
        return [perform(learner, one, home) for one in operations]


def _do_merge(learner: TactileLearner, home: Path, name: str, shared: Any, descriptions: Any = "same") -> list[int]:
    merged = learner.merge(home / name, shared=shared, descriptions=descriptions)
    return [merged.observations, merged.shared, merged.described]


def _do_backup(learner: TactileLearner, _: Path) -> None:
    store = learner._ledger.store
    store.backup(store.path.with_name(f"{store.path.name}-copy-{time.time_ns()}"))


def _do_reembed(learner: TactileLearner, _: Path, embedding: str) -> None:
    shutil.rmtree(learner.reembed(EMBEDDINGS[embedding]))


_CALLS = {
    "observe": _do_observe,
    "batch": _do_batch,
    "retract": lambda learner, _, sequence: learner.retract(sequence),
    "forget": lambda learner, _, material: learner.forget(material),
    "relabel": lambda learner, _, sequence, material: learner.relabel(sequence, material),
    "describe": lambda learner, _, material, said: learner.describe(material, said and dict(said)),
    "merge": _do_merge,
    "compact": lambda learner, _, keep: learner.compact(keep=keep).last_sequence,
    "fine_tune": lambda learner, _: learner.fine_tune(epochs=1).digest,
    "backup": _do_backup,
    "pack": lambda learner, home, name, rows: learner.pack(home / name, rows=rows),
    "reembed": _do_reembed,
}


def unsound_copies(path: Path, states: Sequence[State]) -> list[str]:
    """What is wrong with the backups that there are of a memory: each must be whole, and in one of the states.

    They are removed, and so is what was cut short.
    """
    wrong = []
    for copy in sorted(path.parent.glob(f"{path.name}-copy-*")):
        if not copy.name.endswith(".partial"):
            wrong += [f"a backup: {problem.what}" for problem in check_store(copy) if problem.kind != "leftover"]
            with opened(copy, "read", embedding=EMBEDDINGS[states[-1].embedding]) as learner:
                if settle(seen(learner), states)[0] is None:
                    wrong.append(f"{copy.name} is a backup of no state that there was")
        shutil.rmtree(copy)
    return wrong


def seen(learner: TactileLearner) -> dict[str, Any]:
    """What can be seen of a learner, as JSON."""
    memory, store = learner._ledger.memory, learner._ledger.store
    return {
        "materials": learner.materials,
        "names": {str(touch): names for touch in DRAWN if (names := learner.names_of(stream(touch)))},
        "digest": learner.digest(),
        "descriptions": learner.descriptions,
        "exemplars": {name: [key.hex() for key in keys] for name, keys in learner.exemplars.items()},
        "tuned": learner.tuned_digest(),
        "pool": _pool(learner),
        "kept": _kept(learner),
        "last": memory.sequence,
        "compacted": memory.compacted if store is None else store.compacted,
    }


def _pool(learner: TactileLearner) -> str:
    digest = hashlib.sha256()
    for name, key, touch in learner._ledger.memory.sample:
        digest.update(repr((name, key, touch.rows.tobytes(), touch.pairs.tobytes(), touch.copies)).encode())
    return digest.hexdigest()


def _kept(learner: TactileLearner) -> str:
    """A digest of the arrays of the kept touches."""
    arrays, materials = learner._ledger.memory.kept.to_arrays()
    digest = hashlib.sha256(repr(materials).encode())
    for name in sorted(arrays):
        digest.update(repr((name, arrays[name].shape)).encode() + arrays[name].tobytes())
    return digest.hexdigest()


def expected(state: State) -> dict[str, Any]:
    """What must be seen of a learner in this state."""
    counted = dict(sorted(Counter(one.material for one in state.observed).items()))
    tuned = None if state.tuned is None else tuned_digest(state.tuned, state.embedding)
    said = {material: dict(constituents) for material, constituents in state.said}
    names: dict[str, list[str]] = {}
    for one in sorted(state.observed, key=lambda one: one.sequence):
        if one.touch in DRAWN and one.material not in names.setdefault(str(one.touch), []):
            names[str(one.touch)].append(one.material)
    told = {
        "materials": counted,
        "tuned": tuned,
        "last": state.last,
        "compacted": state.compacted,
        "descriptions": said,
    }
    return _observed(state.pairs, state.embedding) | told | {"names": names}


def settle(found: dict[str, Any], states: Sequence[State]) -> tuple[State | None, list[list[str]]]:
    """The first of the states that is the one seen, None where none is; and what differs from each of them."""
    differ = [[key for key in found if found[key] != expected(state)[key]] for state in states]
    return next((state for state, keys in zip(states, differ, strict=True) if not keys), None), differ


@functools.lru_cache(maxsize=4096)
def _observed(pairs: Pairs, embedding: str) -> dict[str, Any]:
    return seen(fed(pairs, again=True, **settings() | {"embedding": EMBEDDINGS[embedding]}))


@functools.lru_cache(maxsize=4096)
def tuned_digest(pairs: Pairs, embedding: str = "own") -> str | None:
    """The digest of the f* that is made from touches; None where none can be."""
    try:
        made = settings() | {"embedding": EMBEDDINGS[embedding]}
        return fed(pairs, again=True, **made).fine_tune(epochs=1).digest
    except InputError:
        return None
