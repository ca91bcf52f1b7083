"""The one way in which a memory changes: a row of the journal is applied to it.

So at opening, after each new row, and where a reader follows a writer; and what a retraction takes out of the samples
is chosen again from the rows that are left.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from copy import copy
from itertools import takewhile
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scroll_tactile_store import CompactedError, DamageError, Head, Record, Store

from scroll_tactile.memory.exemplars import Exemplar, rank
from scroll_tactile.memory.state import Memory, MemoryFields
from scroll_tactile.memory.touch_rows import Changed, Codes, Kind, declared_by, refusing, unpack_readings, unspanned
from scroll_tactile.persistence.ram_store import AnyStore
from scroll_tactile.signals.correction import Correction
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import mean_code

__all__ = ["apply", "chosen_without", "exemplar_candidates", "follow", "load", "ranked_exemplars", "refill", "until"]

logger = logging.getLogger(__name__)

Gone = Mapping[int, Record] | None  # observations that are retracted, by number
LOAD_ATTEMPTS = 20  # of a reader, while a writer changes the store


def load(empty: Memory, store: AnyStore, attempts: int = LOAD_ATTEMPTS) -> Memory:
    """The memory that a store holds: its newest checkpoint, then the journal's rows after it; made as the empty one."""
    memory = empty.empty_like()
    try:
        newest = store.latest()
        memory.compacted = store.compacted  # behind `latest`, which may look again
        # Where no checkpoint is sound, that of a compaction raises what is lost; without one the journal has every row.
        if (start := newest or store.compaction()) is not None:
            memory.fill(start, store.path)
        memory.checkpoint, memory.saved = None if newest is None else newest.number, memory.sequence
        for record in store.records(after=memory.sequence):
            apply(memory, record, store)
        refill(memory, store)
    except CompactedError:  # a writer compacted it meanwhile
        if attempts > 1:
            return load(empty, store, attempts - 1)
        raise
    logger.info("%s: checkpoint %s, and rows up to %d", store.path, memory.checkpoint, memory.sequence)
    return memory


def apply(
    memory: Memory, row: Record, store: AnyStore, *, codes: Codes | None = None, gone: Gone = None, summed: bool = False
) -> list[Changed] | None:
    """Apply a journal row; return the touches that came or went, None where it brought a whole memory.

    Nothing else adds a row to a memory, whether it was just written, read again or embedded anew. codes: of an
    observation; None: they are read from the row, or made from its readings. gone: rows that it retracts, by number;
    others are read. summed: whether the sums of observations are joined as a whole, behind their rows. Call `refill`
    after the last row. Raises CapacityError before anything is added, DamageError for what cannot be.
    """
    changed: list[Changed] | None = []
    with refusing(store.path, row):
        _note(memory, row)
    if row.kind == Kind.OBSERVE and summed:
        memory.add_exemplar(row)
    elif row.kind == Kind.OBSERVE:
        changed = [memory.add(row, codes)]
    elif row.kind == Kind.RETRACT:
        changed = _retract(memory, row, store, gone or {})
    elif row.kind == Kind.MERGE:
        _join(memory, row, store.path)
        changed = None
    memory.sequence = row.sequence
    return changed


def _note(memory: Memory, row: Head) -> None:
    """Apply what a row says of quantities, descriptions and the skin, if anything."""
    if row.kind == Kind.DECLARE:
        memory.quantities.setdefault(row.label, declared_by(row))
    elif row.kind in (Kind.DESCRIBE, Kind.RETRACT):  # a retraction, which says none, names what was forgotten
        if constituents := row.attributes.get("constituents"):
            memory.descriptions[row.label] = dict(cast(Any, constituents))
        else:
            memory.descriptions.pop(row.label, None)
    elif row.kind == Kind.ADAPT and "retracts" in row.attributes:
        memory.corrections.pop(cast(int, row.attributes["retracts"]), None)
    elif row.kind == Kind.ADAPT:
        memory.correct(row.sequence, Correction.from_text(row.attributes["correction"], memory.recipe.sensor))


def _retract(memory: Memory, row: Record, store: AnyStore, known: Mapping[int, Record]) -> list[Changed]:
    gone = unspanned(row.attributes["sequences"])
    if kept := [sequence for sequence in gone if sequence <= memory.compacted and sequence not in memory.retracted]:
        # A repair made the compaction checkpoint: `compact` would have left them out.
        why = "its features were lost to damage. Only a copy from before the damage can leave it out"
        for one in kept:
            logger.warning(
                "%s: observation %d was retracted by row %d, but still counts: %s", store.path, one, row.sequence, why
            )
    later = [sequence for sequence in gone if sequence > memory.compacted]
    with refusing(store.path, row):
        return [memory.retract(known.get(sequence) or store.record(sequence)) for sequence in later]


def _join(memory: Memory, row: Record, path: Path) -> None:
    """Add another memory of the same recipe, from a row with the arrays and attributes of its compaction checkpoint."""
    other = memory.empty_like().fill(row, path, source=row.sequence)
    memory.join(other, exemplars="exemplars-held-readings" in row.arrays)


def follow(memory: Memory, store: Store, records: Sequence[Record]) -> list[Changed] | None:
    """Take over the tuned model of a writer, and apply the rows that it appended; returns the changes as `apply`."""
    newest = None if (number := store.state(look=False).newest) == memory.checkpoint else store.latest()
    if newest is not None and newest.number == number:  # another may have come since, and rows behind these
        memory.checkpoint = number
        memory.take_tuned(MemoryFields.of(newest, memory.statistics.dimension, store.path))
    changed = [apply(memory, record, store) for record in records]
    refill(memory, store)
    return None if None in changed else [each for touches in changed for each in touches or ()]


def refill(memory: Memory, store: AnyStore) -> None:
    """Choose sample and exemplars again after a retraction; does nothing if no retracted touch was among them."""
    if not memory.stale:
        return
    try:
        store.compaction()
    except DamageError as damage:
        # The statistics are complete without it, and a repair has them where a checkpoint is written behind it.
        what = "no other touch can take the place of a retracted one: repair it (scroll-tactile memory repair)"
        logger.warning("%s; %s", damage, what)
        heads, left = store.heads(memory.compacted), memory.empty_like()
        gone = {(head.label, head.key) for head in heads if head.sequence in memory.retracted}
        for sample, before in zip(left.samples, memory.samples, strict=True):
            sample.update(item for item in before if item[:2] not in gone)
        memory.take_chosen(left)
    else:
        # Rows that a writer appended since this memory was read are left for the next `load`.
        memory.take_chosen(_chosen(memory, store, memory.sequence))


def chosen_without(memory: Memory, store: AnyStore, gone: Mapping[int, Record]) -> Memory | None:
    """A memory with what is chosen where these observations are retracted; None where none of them was chosen.

    A damaged row is named by this, while the retraction has no row yet: on it every later opening would fail.
    """
    if not any(sample.holds(row.label, row.key) for sample in memory.samples for row in gone.values()):
        return None
    rest = copy(memory)
    rest.retracted = memory.retracted | gone.keys()
    return _chosen(rest, store, memory.sequence)


def until(memory: Memory, store: AnyStore, last_sequence: int) -> Memory:
    """The memory of all observations up to a row, without retracted ones: a compaction at that row keeps it."""
    made, later = _chosen(memory, store, last_sequence), memory.empty_like()
    for head in store.heads(last_sequence):  # whoever compacts has read all
        if head.kind in (Kind.OBSERVE, Kind.MERGE) and head.sequence not in memory.retracted:
            apply(later, store.record(head.sequence), store)
    made.take_sums(memory, later, last_sequence)
    return made


def _chosen(memory: Memory, store: AnyStore, last_sequence: int) -> Memory:
    """A memory with what was chosen and noted up to a row, without the retracted observations.

    Raises DamageError for a damaged row: without it other touches would be chosen.
    """
    fresh = memory.empty_like()
    _require_compaction(memory, store)
    if (compaction := store.compaction()) is not None:
        fresh.fill(compaction, store.path)
    heads = list(takewhile(lambda head: head.sequence <= last_sequence, store.heads(memory.compacted)))
    for head in heads:
        _note(fresh, head)
        if head.kind == Kind.MERGE:
            _join(fresh, store.record(head.sequence), store.path)
    observed = [head for head in heads if head.kind == Kind.OBSERVE and head.sequence not in memory.retracted]
    fresh.choose(observed, store.record, memory)
    return fresh


def _require_compaction(memory: Memory, store: AnyStore) -> None:
    """Raise CompactedError where the store was compacted since this memory was read."""
    if store.compacted != memory.compacted:
        raise CompactedError(f"{store.path} was compacted since it was read: read it again")


def ranked_exemplars(memory: Memory, store: AnyStore) -> dict[str, list[Exemplar]]:
    """The buffer, ranked by `rank` against the exact means of all observations. Raises as `exemplar_candidates`."""
    statistics = memory.statistics

    def mean(material: str, scale: Scale) -> npt.NDArray[np.int64]:
        return mean_code(statistics.sums(scale, [material])[0], int(statistics.counts(scale, [material])[0]))

    return rank(exemplar_candidates(memory, store), memory.recipe.exemplars, mean)


def exemplar_candidates(memory: Memory, store: AnyStore) -> list[Exemplar]:
    """The candidates for the buffer with their readings, by material and key; those lost to damage are left out.

    Raises CompactedError where the store was compacted since the memory was read, DamageError, StoreClosedError.
    """
    _require_compaction(memory, store)
    wanted = list(memory.exemplars or ())
    # The compaction checkpoint holds what was compacted.
    sources = {source if source > memory.compacted else 0 for *_, source in wanted}
    held = {(one.material, one.key): one for row in sources for one in _exemplars_in(memory, store, row)}
    found = [held[material, key] for material, key, _ in wanted if (material, key) in held]
    if lost := len(wanted) - len(found):
        logger.warning("%s: the readings of %d candidates for exemplars were lost to damage", store.path, lost)
    return found


def _exemplars_in(memory: Memory, store: AnyStore, sequence: int) -> list[Exemplar]:
    """The exemplars that a row of the journal holds; 0: those of the compaction checkpoint."""
    row = store.record(sequence) if sequence else store.compaction()
    if isinstance(row, Record) and row.kind == Kind.OBSERVE:
        steps, codes = memory.codes(row)
        readings, stages = cast(Any, unpack_readings(row.arrays)), memory.plan.scored_stages(steps)
        return [Exemplar.of(row.label, row.key, readings, stages, codes)]
    kept = None if row is None else MemoryFields.of(row, memory.statistics.dimension, store.path).exemplars
    return [] if kept is None else kept.exemplars()
