"""Partials are made: of a memory, and of other partials, whose sums add up in any order to the same bytes."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from scroll_tactile.errors import MismatchError
from scroll_tactile.memory.buffer import candidates_of
from scroll_tactile.memory.exemplars import Exemplar
from scroll_tactile.memory.identity import Identity
from scroll_tactile.memory.merge import standing
from scroll_tactile.memory.partial import Partial, sums_without, write_partial
from scroll_tactile.memory.rows import MERGE, SOURCE
from scroll_tactile.memory.state import Memory
from store import Store

__all__ = ["pack_memory", "reduce_partials"]


def pack_memory(
    store: Store, memory: Memory, path: Path, *, rows: bool = True, readings: bool = True, source: str | None = None
) -> None:
    """Write all that a memory learned as a partial; the arguments are those of `TactileLearner.pack`."""
    found = standing(store.heads())
    heads = [head for head in found if head.kind != MERGE]
    whole = not memory.base and len(heads) == len(found)
    with_rows = rows and readings and whole
    identity: dict[str, Any] = Identity.read(store).to_json()
    candidates: list[Exemplar] | None = None if with_rows else candidates_of(memory, store)
    if not readings:
        identity, memory, candidates = _without_readings(identity), copy(memory), []
        memory.kept = memory.exemplars = None
        memory.capacity = 0
    with write_partial(path) as partial:
        for head in heads:
            said = {key: value for key, value in head.attributes.items() if readings or key != "nbytes"}
            said |= {} if source is None or SOURCE in said else {SOURCE: source}
            arrays = store.record(head.sequence).arrays if with_rows else None
            partial.touch(replace(head, attributes=said), arrays)
        partial.finish(identity, memory, candidates)


def _without_readings(identity: dict[str, Any]) -> dict[str, Any]:
    return identity | {"exemplars": 0, "recall": 0}


def reduce_partials(
    parts: Sequence[tuple[Path, Collection[int]]], target: Path, memory: Memory, *, thorough: bool = False
) -> None:
    """Sum up partials of one making as a partial without rows, exactly, whatever their order.

    parts: each with the numbers of its touches that are left out, since they came before; these need their rows.
    memory: an empty one of their making, which is filled.

    Raises MismatchError where they are of different makings; DamageError and other StoreErrors.
    """
    identity: dict[str, Any] | None = None
    exemplars = True
    with write_partial(target) as joint:
        for path, left_out in parts:
            with Partial(path) as partial:
                partial.read_with(memory.plan, thorough=thorough)
                if identity is not None and partial.identity != identity:
                    raise MismatchError(f"{path} was made with other settings than {parts[0][0]}: it cannot be added")
                identity = dict(partial.identity)
                exemplars = exemplars and not partial.has_rows
                memory.join(sums_without(partial, memory, left_out))
                for head in partial.named:
                    if head.sequence not in left_out:
                        joint.touch(head)
        candidates = [cast(Exemplar, source) for *_, source in memory.exemplars or ()] if exemplars else None
        joint.finish(identity or {}, memory, candidates)
