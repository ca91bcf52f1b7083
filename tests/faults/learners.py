"""Learners beside the model: what memories are made with, operations done to one, and what must be seen of it then.

What must be seen is what can be seen of a learner without a path that was made anew from the touches, in another order.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import shutil
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from scroll_tactile_store import Record, check_store
from touches import PAD, SETTINGS, SMALL, SmallSample, stream

import scroll_tactile.memory.state
from faults.model import Operation, Pairs, State, Touch
from scroll_tactile import Kernels, Quantity, TactileLearner
from scroll_tactile.errors import InputError, MismatchError
from scroll_tactile.memory.touch_rows import annotated
from scroll_tactile.statistics.annotations import Annotation
from scroll_tactile.statistics.fields import encode

FORCE = Quantity(name="force", unit="N", low=0, high=1, resolution=0.01)
VALUED = 5  # the seed of the touches that have a value
SEEDS = 6  # few touches, so that the same is observed again, by this memory and by those merged into it
LENGTHS = (2, 16, 25, 40, 60, 90, 120)  # the widest scale needs 37, a fine-tune some of two materials


@dataclass
class Kit:
    """What touches are, their names, and what memories are made with; embeddings: by the names that a `State` has.

    noted: values and labels of a touch.
    """

    touches: tuple[Touch, ...]
    stream: Callable[[Touch], Any]
    noted: Callable[[Touch], tuple[dict[str, float], dict[str, str]]]
    materials: tuple[str, ...]
    settings: dict[str, Any]
    embeddings: dict[str, Any]


def noted(touch: Touch) -> tuple[dict[str, float], dict[str, str]]:
    """Half of the touches have a label, some of these another on a second axis; a sixth have a value, too."""
    seed, length = touch
    if seed % 3 and seed != VALUED:
        return {}, {}
    labels = {"slip": "north" if length % 4 else "south"} | ({"grip": "firm"} if length % 5 else {})
    return {"force": (length % 7) / 10} if seed == VALUED else {}, labels


KIT = Kit(
    tuple(itertools.product(range(SEEDS), LENGTHS)),
    stream,
    noted,
    ("a", "b", "c", "ü"),
    # Fewer kept touches than are observed, so that what was left out of them has to come back.
    SETTINGS | {"kept_touches": 5},
    {"own": SMALL, "other": Kernels(seed=3, dimension=SMALL.dimension)},
)


def one_scale() -> None:
    """Have touches read at one scale only, from here on: fewer files, where each call for each of them is tried."""
    KIT.settings = KIT.settings | {"sensor": PAD.model_copy(update={"duration": 0.3})}


def warm() -> None:
    """Have everything imported and set, so that a process forked from here begins at once, with no thread running."""
    torch.set_num_threads(1)
    scroll_tactile.memory.state.TouchSample = SmallSample  # type: ignore[misc]  # for good: this process does nothing else
    learner = TactileLearner(**KIT.settings)
    for i, name in itertools.product(range(4), KIT.materials[:2]):
        learner.observe(name, stream((i, 90)))
    learner.fine_tune(epochs=1)
    learner.predict(stream((9, 90)))
    import filelock  # noqa: F401  # what the store imports late
    import zarr  # noqa: F401
    from numcodecs import zstd  # noqa: F401


def opened(path: Path, mode: Any = "write", **more: Any) -> TactileLearner:
    """The memory in folder `path`."""
    return TactileLearner.open(path, mode=mode, **KIT.settings | more)


def fed(pairs: Pairs, embedding: str = "own", **more: Any) -> TactileLearner:
    """A memory without a path of these touches."""
    learner = TactileLearner(**KIT.settings | {"embedding": KIT.embeddings[embedding]} | more)
    learner.declare(FORCE)
    for at, (material, touch) in enumerate(pairs):
        _observe(learner, Path(), material, touch)
        if (material, touch) in pairs[:at]:  # damage hid it, and it was learned again
            _count_once_more(learner, material, touch)
    return learner


def _count_once_more(learner: TactileLearner, material: str, touch: Touch) -> None:
    stream, memory = learner.stream(KIT.stream(touch)), learner.memory
    annotation = Annotation.of(learner.quantities, *KIT.noted(touch))
    columns, codes = learner._predictor.extractor.learned(stream)
    attributes = {"columns": columns} | annotated(annotation)
    memory.add(Record(memory.sequence, "observe", material, stream.key, 0.0, attributes, 0, arrays={}), codes)


def perform(learner: TactileLearner, operation: Operation, home: Path) -> Any:
    """Do an operation, and return what `after` says of it; others to be merged lie in folder `home`."""
    kind, *rest = operation
    try:
        return _CALLS[kind](learner, home, *rest)
    except (InputError, MismatchError) as error:
        return type(error).__name__


def _observe(learner: TactileLearner, _: Path, material: str, touch: Touch) -> int:
    values, labels = KIT.noted(touch)
    if values and not learner.quantities:  # durable together
        with learner.batch():
            learner.declare(FORCE)
            return _observe(learner, _, material, touch)
    return learner.observe(material, KIT.stream(touch), values=values, labels=labels).sequence


def _batch(learner: TactileLearner, home: Path, operations: tuple[Operation, ...]) -> list[Any]:
    with learner.batch():
        return [perform(learner, one, home) for one in operations]


def _merge(
    learner: TactileLearner, home: Path, name: str, descriptions: Any = "same", of_sources: bool = False
) -> list[int]:
    if of_sources:
        merged, refused = learner._ledger.merge(home / name, lambda *_: None, choice=descriptions, one_name=True)
    else:
        merged, refused = learner.merge(home / name, descriptions=descriptions), []
    return [merged.observations, merged.shared, merged.described, len(refused)]


def _backup(learner: TactileLearner, _: Path) -> None:
    store = learner._ledger.store
    store.backup(store.path.with_name(f"{store.path.name}-copy-{time.time_ns()}"))


def _reembed(learner: TactileLearner, _: Path, embedding: str) -> None:
    shutil.rmtree(learner.reembed(KIT.embeddings[embedding]), ignore_errors=True)


_CALLS: dict[str, Callable[..., Any]] = {
    "observe": _observe,
    "batch": _batch,
    "retract": lambda learner, _, sequence: learner.retract(sequence),
    "forget": lambda learner, _, material: learner.forget(material),
    "relabel": lambda learner, _, sequence, material: learner.relabel(sequence, material),
    "describe": lambda learner, _, material, said: learner.describe(material, said and dict(said)),
    "merge": _merge,
    "compact": lambda learner, _, keep: learner.compact(keep=keep).last_sequence,
    "fine_tune": lambda learner, _: learner.fine_tune(epochs=1).digest,
    "backup": _backup,
    "close": lambda learner, _: learner.close(),
    "pack": lambda learner, home, name, rows: learner.pack(home / name, rows=rows),
    "reembed": _reembed,
}


def samples(learner: TactileLearner) -> dict[str, Any]:
    """The digests of what is learned, of the touches to calibrate on and of the kept touches."""
    memory = learner.memory
    pool = hashlib.sha256()
    for name, key, touch in memory.sample:
        pool.update(repr((name, key, touch.rows.tobytes(), touch.pairs.tobytes(), touch.annotation)).encode())
    arrays, told = ({}, None) if memory.kept is None else encode(scroll_tactile.memory.state.KeptFields.of(memory.kept))
    kept = hashlib.sha256(repr(told).encode())
    for name in sorted(arrays):
        kept.update(repr((name, arrays[name].shape)).encode() + arrays[name].tobytes())
    return {"digest": learner.digest(), "pool": pool.hexdigest(), "kept": kept.hexdigest()}


def held(learner: TactileLearner) -> dict[str, Any]:
    """What a memory keeps of the touches themselves, as JSON."""
    exemplars = {name: [key.hex() for key in keys] for name, keys in learner.exemplars.items()}
    return samples(learner) | {"exemplars": exemplars}


def seen(learner: TactileLearner) -> dict[str, Any]:
    """What can be seen of a learner, as JSON."""
    store = learner._ledger.store
    named = ((str(touch), learner.names_of(KIT.stream(touch))) for touch in KIT.touches)
    return held(learner) | {
        "embedding": learner.embedding.fingerprint,  # memories without a touch differ in nothing else
        "materials": learner.materials,
        "axes": learner.axes,
        "quantities": sorted(learner.quantities),
        "names": {touch: names for touch, names in named if names},
        "descriptions": learner.descriptions,
        "tuned": learner.tuned_digest(),
        "last": learner._ledger.memory.sequence,
        "compacted": learner._ledger.memory.compacted if store is None else store.compacted,
    }


def expected(state: State) -> dict[str, Any]:
    """What must be seen of a learner in this state."""
    names: dict[str, list[str]] = {}
    for _, (material, touch) in state.listed:
        if touch in KIT.touches and material not in names.setdefault(str(touch), []):
            names[str(touch)].append(material)
    return _held(state.pairs, state.embedding) | {
        "embedding": KIT.embeddings[state.embedding].fingerprint,
        "materials": state.materials,
        "axes": _axes(state.pairs),
        "quantities": ["force"] if state.declared else [],
        "names": names,
        "descriptions": state.said,
        "tuned": None if state.tuned is None else tuned_digest(state.tuned, state.embedding),
        "last": state.last,
        "compacted": state.compacted,
    }


def _axes(pairs: Pairs) -> dict[str, dict[str, int]]:
    """Axis → label → touches."""
    found = Counter(told for _, touch in pairs for told in KIT.noted(touch)[1].items())
    axes = dict.fromkeys(sorted({axis for axis, _ in found}))
    return {axis: {label: found[one, label] for one, label in sorted(found) if one == axis} for axis in axes}


@functools.lru_cache(maxsize=4096)
def _held(pairs: Pairs, embedding: str) -> dict[str, Any]:
    return held(fed(pairs, embedding))


@functools.lru_cache(maxsize=4096)
def tuned_digest(pairs: Pairs, embedding: str = "own") -> str | None:
    """The digest of the f* that is made from touches; None where none can be."""
    try:
        return fed(pairs, embedding).fine_tune(epochs=1).digest
    except InputError:
        return None


def settle(found: dict[str, Any], states: Sequence[State]) -> tuple[State | None, list[list[str]]]:
    """The first of the states that is the one seen, None where none is; and what differs from each of them."""
    differ = []
    for state in states:
        wanted = expected(state)
        differ.append([key for key in found if found[key] != wanted[key]])
    return next((state for state, keys in zip(states, differ, strict=True) if not keys), None), differ


def unsound_copies(path: Path, states: Sequence[State]) -> list[str]:
    """What is wrong with the backups that there are of a memory: each must be whole, and in one of the states.

    They are removed, and so is what was cut short.
    """
    wrong = []
    for copy in sorted(path.parent.glob(f"{path.name}-copy-*")):
        if not copy.name.endswith(".partial"):
            wrong += [f"a backup: {problem.what}" for problem in check_store(copy) if problem.kind != "leftover"]
            with opened(copy, "read", embedding=KIT.embeddings[states[-1].embedding]) as learner:
                if settle(seen(learner), states)[0] is None:
                    wrong.append(f"{copy.name} is a backup of no state that there was")
        shutil.rmtree(copy)
    return wrong
