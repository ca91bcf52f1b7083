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
from typing import cast

import numpy as np
import numpy.typing as npt
from scroll_tactile_store import CompactedError, DamageError, Head, Record

from scroll_tactile.errors import UnknownMaterialError
from scroll_tactile.memory.descriptions import describe
from scroll_tactile.memory.exemplars import Exemplar, rank
from scroll_tactile.memory.state import Memory, MemoryFields
from scroll_tactile.memory.touch_rows import (
    ADAPT,
    CORRECTION,
    DECLARE,
    DESCRIBE,
    MERGE,
    OBSERVE,
    RETRACT,
    RETRACTS,
    Changed,
    Codes,
    Readings,
    active_rows,
    declared_by,
    retracted_by,
    unpack_readings,
    unspanned,
)
from scroll_tactile.persistence.ram_store import AnyStore
from scroll_tactile.signals.correction import Correction
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import mean_code

__all__ = [
    "apply",
    "apply_appended",
    "chosen_without",
    "exemplar_candidates",
    "load",
    "note",
    "ranked_exemplars",
    "refill",
    "require_compaction",
    "until",
]

logger = logging.getLogger(__name__)

LOAD_ATTEMPTS = 20  # of a reader, while a writer changes the store


def load(empty: Memory, store: AnyStore) -> Memory:
    """The memory that a store holds: its newest checkpoint, then the journal's rows after it; made as the empty one."""
    for _ in range(LOAD_ATTEMPTS - 1):
        newest = store.newest
        try:
            memory = _loaded(empty.empty_like(), store)
        except CompactedError:  # a writer compacted it meanwhile
            continue
        # A checkpoint that came between the reads may hold a tuned model from before the rows that were read.
        if store.newest == newest:
            return memory
    return _loaded(empty.empty_like(), store)


def _loaded(memory: Memory, store: AnyStore) -> Memory:
    memory.compacted = store.compacted
    # Where no checkpoint is sound, that of a compaction raises what is lost; without one the journal has every row.
    newest = store.latest()
    start = store.compaction() if newest is None else newest
    if start is not None:
        memory.fill(start, store.path)
    memory.checkpoint = None if newest is None else newest.number
    memory.saved = memory.sequence
    for record in store.records(after=memory.sequence):
        apply(memory, record, store)
    refill(memory, store)
    logger.info("%s: checkpoint %s, and rows up to %d", store.path, memory.checkpoint, memory.sequence)
    return memory


def apply(
    memory: Memory,
    row: Record,
    store: AnyStore,
    codes: Codes | None = None,
    *,
    gone: Mapping[int, Record] | None = None,
    summed: bool = False,
) -> list[Changed] | None:
    """Apply a journal row; return the touches that came or went, None where it brought a whole memory.

    Nothing else adds a row to a memory, whether it was just written, read again or embedded anew. codes: of an
    observation; None: they are read from the row, or made from its readings. gone: rows that it retracts, by number;
    others are read. summed: whether the sums of observations are joined as a whole, behind their rows. Call `refill`
    after the last row. Raises CapacityError before anything is added, DamageError for what cannot be.
    """
    changed: list[Changed] | None = []
    note(memory, row)
    if row.kind == OBSERVE and summed:
        memory.add_exemplar(row)
    elif row.kind == OBSERVE:
        changed = [memory.add(row, codes)]
    elif row.kind == RETRACT:
        changed = _retract(memory, row, store, gone or {})
    elif row.kind == MERGE:
        _join(memory, row, store.path)
        changed = None
    memory.sequence = row.sequence
    return changed


def note(memory: Memory, row: Head) -> None:
    """Apply what a row says of quantities, descriptions and the skin, if anything."""
    if row.kind == DECLARE:
        memory.quantities.setdefault(row.label, declared_by(row))
    elif row.kind in (DESCRIBE, RETRACT):  # a retraction has no constituents, and names a material only in `forget`
        describe(memory.descriptions, row.label, row.attributes.get("constituents"))
    elif row.kind == ADAPT and RETRACTS in row.attributes:
        memory.corrections.pop(cast(int, row.attributes[RETRACTS]), None)
    elif row.kind == ADAPT:
        memory.correct(row.sequence, Correction.from_text(row.attributes[CORRECTION], memory.recipe.sensor))


def _retract(memory: Memory, row: Record, store: AnyStore, known: Mapping[int, Record]) -> list[Changed]:
    gone = unspanned(row.attributes["sequences"])
    for sequence in sorted({sequence for sequence in gone if sequence <= memory.compacted} - memory.retracted):
        logger.warning(  # a repair made the compaction checkpoint: `compact` would have left it out
            "%s: observation %d was retracted by row %d, but still counts: its features were lost to damage. Only a "
            "copy from before the damage can leave it out",
            store.path,
            sequence,
            row.sequence,
        )
    changed = []
    for sequence in (sequence for sequence in gone if sequence > memory.compacted):
        observed = known[sequence] if sequence in known else store.record(sequence)
        try:
            if observed.kind != OBSERVE or sequence in memory.retracted:
                raise UnknownMaterialError(f"row {sequence} is none that counts")
            changed.append(memory.retract(observed))
        except UnknownMaterialError as error:  # the sums are without it
            raise DamageError(
                f"row {row.sequence} of {store.path} retracts row {sequence}, which is no observation, or not in the "
                "sums any more: it is damaged, or was made by another program (scroll-tactile memory check)",
                path=store.path,
                sequence=row.sequence,
            ) from error
    return changed


def _join(memory: Memory, row: Record, path: Path) -> None:
    """Add another memory of the same recipe, from a row with the arrays and attributes of its compaction checkpoint."""
    other = memory.empty_like().fill(row, path, source=row.sequence)
    memory.join(other, exemplars="exemplars-held-readings" in row.arrays)


def apply_appended(memory: Memory, store: AnyStore, records: Sequence[Record]) -> list[Changed] | None:
    """Apply rows that a writer appended, and take over its tuned model; returns the changes as `apply` does."""
    changed = [apply(memory, record, store) for record in records]
    refill(memory, store)
    newest = store.latest() if store.newest != memory.checkpoint else None
    if newest is not None and newest.last_sequence <= memory.sequence:
        memory.checkpoint = newest.number
        # Heads of all kinds are read: filtered ones skip damaged rows, and such a row may be a retraction.
        behind = takewhile(lambda head: head.sequence <= memory.sequence, store.heads(newest.last_sequence))
        gone = min(retracted_by(behind), default=None)
        made = MemoryFields.of(newest, memory.statistics.dimension, store.path)
        if gone is None or gone > made.tuned_last_sequence:
            memory.take_tuned(made)
    return None if None in changed else [each for touches in changed for each in touches or ()]


def refill(memory: Memory, store: AnyStore) -> None:
    """Choose sample and exemplars again after a retraction; does nothing if no retracted touch was among them."""
    if memory.stale:
        # Rows that a writer appended since this memory was read are left for the next `load`.
        memory.take_chosen(_chosen(memory, store, memory.sequence))


def chosen_without(memory: Memory, store: AnyStore, gone: Mapping[int, Record]) -> Memory | None:
    """A memory with what is chosen where these observations are retracted; None where none of them was chosen.

    A damaged row is named by this, while the retraction has no row yet: on it every later opening would fail.
    """
    if not any(sample.holds(row.label, row.key) for sample in memory.samples for row in gone.values()):
        return None
    store.compaction()  # raises where it is damaged: with the memory as it was, there is still a choice
    rest = copy(memory)
    rest.retracted = memory.retracted | gone.keys()
    return _chosen(rest, store, memory.sequence)


def until(memory: Memory, store: AnyStore, last_sequence: int) -> Memory:
    """The memory of all observations up to a row, without retracted ones: a compaction at that row keeps it."""
    made, later = _chosen(memory, store, last_sequence), memory.empty_like()
    for head in store.heads(last_sequence):  # whoever compacts has read all
        if head.kind in (OBSERVE, MERGE) and head.sequence not in memory.retracted:
            apply(later, store.record(head.sequence), store)
    made.take_sums(memory, later, last_sequence)
    return made


def _chosen(memory: Memory, store: AnyStore, last_sequence: int) -> Memory:
    """A memory with what was chosen and noted up to a row, without the retracted observations.

    Raises DamageError for a damaged row: without it other touches would be chosen.
    """
    fresh = _compaction_samples(memory, store)
    try:
        heads = list(takewhile(lambda head: head.sequence <= last_sequence, store.heads(memory.compacted)))
    except DamageError as damage:
        raise DamageError(
            f"{damage}. Without it the samples of touches cannot be chosen again after a retraction: repair the "
            "memory (scroll-tactile memory repair)",
            path=damage.path,
            sequence=damage.sequence,
        ) from damage
    for head in heads:
        note(fresh, head)
        if head.kind == MERGE:
            _join(fresh, store.record(head.sequence), store.path)
    observed = [head for head in heads if head.kind == OBSERVE and head.sequence not in memory.retracted]
    fresh.choose(observed, store.record, memory)
    return fresh


def _compaction_samples(memory: Memory, store: AnyStore) -> Memory:
    """A memory filled from the compaction checkpoint; an empty one if there is none."""
    fresh = memory.empty_like()
    require_compaction(memory, store)
    try:
        if (compaction := store.compaction()) is not None:
            fresh.fill(compaction, store.path)
    except DamageError as damage:
        # The statistics are complete without it, and a repair has them where a checkpoint is written behind it.
        logger.warning(
            "%s; no other touch can take the place of a retracted one: repair the memory (scroll-tactile memory "
            "repair)",
            damage,
        )
        rows = active_rows(head for head in store.heads() if head.sequence <= memory.compacted)
        # The memory is asked as well: a row that retracts one of them may have been lost to damage.
        left = {(head.label, head.key) for head in rows if not memory.is_gone(head.sequence)}
        fresh.quantities = dict(memory.quantities)
        for sample, before in zip(fresh.samples, memory.samples, strict=True):
            sample.update(item for item in before if item[:2] in left)
    return fresh


def require_compaction(memory: Memory, store: AnyStore) -> None:
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
    wanted: dict[int, set[tuple[str, bytes]]] = {}
    for material, key, source in memory.exemplars or ():
        # The compaction checkpoint holds what was compacted.
        wanted.setdefault(source if source > memory.compacted else 0, set()).add((material, key))
    found: list[Exemplar] = []
    for source, touches in wanted.items():
        held = [one for one in _exemplars_in(memory, store, source) if (one.material, one.key) in touches]
        if lost := len(touches) - len(held):
            logger.warning("%s: the readings of %d candidates for exemplars were lost to damage", store.path, lost)
        found += held
    return sorted(found, key=lambda exemplar: (exemplar.material, exemplar.key))


def _exemplars_in(memory: Memory, store: AnyStore, sequence: int) -> list[Exemplar]:
    """The exemplars that a row of the journal holds; 0: those of the compaction checkpoint."""
    require_compaction(memory, store)
    row = store.record(sequence) if sequence else store.compaction()
    if isinstance(row, Record) and row.kind == OBSERVE:
        steps, codes = memory.codes(row)
        readings, stages = cast(Readings, unpack_readings(row.arrays)), memory.plan.scored_stages(steps)
        return [Exemplar.of(row.label, row.key, readings, stages, codes)]
    kept = None if row is None else MemoryFields.of(row, memory.statistics.dimension, store.path).exemplars
    return [] if kept is None else kept.exemplars()
