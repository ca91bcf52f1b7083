"""Replaying a journal into a memory: at opening, after each new row, and to choose samples again; and its exemplars."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scroll_tactile_store import CompactedError, DamageError, Head, Record, Store

from scroll_tactile.errors import UnknownMaterialError
from scroll_tactile.memory.descriptions import describe
from scroll_tactile.memory.exemplars import Exemplar, exemplars_from_arrays, rank
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import (
    ADAPT,
    CORRECTION,
    DECLARE,
    DESCRIBE,
    MEMBER,
    MERGE,
    OBSERVE,
    RETRACT,
    RETRACTS,
    SENSE,
    Arrays,
    Changed,
    Codes,
    active_rows,
    annotation_of,
    only_readings,
    retracted_by,
    unpack_readings,
    unspanned,
)
from scroll_tactile.signals.correction import Correction
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import mean_code
from scroll_tactile.validation.gate import misdeclared, wrong_values

__all__ = [
    "append_row",
    "apply_appended",
    "apply_note",
    "exemplar_candidates",
    "load",
    "ranked_exemplars",
    "refill",
    "replay",
    "require_compaction",
    "until",
]

logger = logging.getLogger(__name__)

LOAD_ATTEMPTS = 20  # of a reader, while a writer changes the store


def load(empty: Memory, store: Store) -> Memory:
    """The memory that a store holds: its newest checkpoint, then the journal's rows after it; made as the empty one."""
    for _ in range(LOAD_ATTEMPTS - 1):
        state = store.state()
        try:
            memory = _loaded(empty.empty_like(), store)
        except CompactedError:  # a writer compacted it meanwhile
            continue
        # Where a writer has replaced the checkpoint meanwhile, a later one was read, or none.
        if store.state(look=False)[1:] == state[1:]:
            return memory
    return _loaded(empty.empty_like(), store)


def _loaded(memory: Memory, store: Store) -> Memory:
    memory.compacted = store.compacted
    # Where no checkpoint is sound, that of a compaction raises what is lost; without one the journal has every row.
    newest = store.latest()
    start = store.compaction() if newest is None else newest
    if start is not None:
        memory.fill(start.arrays, start.attributes, start.last_sequence, source=0)
    memory.checkpoint = None if newest is None else newest.number
    memory.saved = memory.sequence
    for record in store.records(after=memory.sequence):
        replay(memory, record, store)
    refill(memory, store)
    logger.info("%s: checkpoint %s, and rows up to %d", store.path, memory.checkpoint, memory.sequence)
    return memory


def replay(memory: Memory, record: Record, store: Store, codes: Codes | None = None) -> list[Changed] | None:
    """Apply a journal row; return the touches that it added or retracted, None where it brought a whole memory.

    Every row is added to the memory here, whether it was just written, read again or embedded anew. codes: of an
    observation; None: they are read from the row, or made from its readings. Call `refill` after the last row. Raises
    CapacityError before anything is added.
    """
    changed: list[Changed] | None = []
    apply_note(memory, record, store.path)
    if record.kind == OBSERVE:
        steps = cast(int, record.attributes["columns"])
        codes = memory.codes(record)[1] if codes is None else codes
        source = record.sequence if only_readings(record.arrays) else None
        wanted = memory.kept is not None and memory.kept.wants(record.label, record.key)
        readings = unpack_readings(record.arrays) if wanted else None
        annotation = annotation_of(record.attributes)
        memory.add(record.label, record.key, steps, codes, record.sequence, source, readings, annotation)
        changed = [Changed(record.label, annotation.labels)]
    elif record.kind == RETRACT:
        gone = unspanned(record.attributes["sequences"])
        changed = [_retracted(memory, record, sequence, store) for sequence in gone if sequence > memory.compacted]
        for sequence in sorted({sequence for sequence in gone if sequence <= memory.compacted} - memory.excluded):
            logger.warning(  # a repair made the compaction checkpoint: `compact` would have left it out
                "%s: observation %d was retracted by row %d, but still counts: its features were lost to damage. Only "
                "a copy from before the damage can leave it out",
                store.path,
                sequence,
                record.sequence,
            )
    elif record.kind == MERGE:
        _join(memory, record, store)
        changed = None
    else:
        assert record.kind in (MEMBER, DESCRIBE, DECLARE, SENSE, ADAPT), "the gate lets no other row through"
    memory.sequence = record.sequence
    return changed


def append_row(
    memory: Memory,
    store: Store,
    kind: str,
    label: str,
    key: bytes = b"",
    *,
    attributes: Mapping[str, Any],
    arrays: Arrays | None = None,
    time: float | None = None,
    codes: Codes | None = None,
) -> tuple[int, list[Changed] | None]:
    """Append a row to the journal, then apply it; return its number, and what `replay` returns."""
    head = store.append(kind, label, key, attributes=attributes, arrays=arrays, time=time)
    return head.sequence, replay(memory, Record(**vars(head), arrays=arrays or {}), store, codes)


def _retracted(memory: Memory, record: Record, sequence: int, store: Store) -> Changed:
    """Retract an observation as a journal row says. Raises DamageError where there is none that could be."""
    observed = store.record(sequence)
    try:
        if observed.kind == OBSERVE and sequence not in memory.retracted:
            return memory.retract(observed)
    except UnknownMaterialError as error:  # the sums are without it
        logger.debug("%s", error)
    raise DamageError(
        f"row {record.sequence} of {store.path} retracts row {sequence}, which is no observation, or not in the "
        "sums any more: it is damaged, or was made by another program (scroll-tactile memory check)",
        path=store.path,
        sequence=record.sequence,
    )


def _join(memory: Memory, record: Record, store: Store) -> None:
    """Add another memory of the same recipe, from a row with the arrays and attributes of its compaction checkpoint."""
    other = memory.empty_like().fill(record.arrays, record.attributes, source=record.sequence)
    for name, quantity in other.quantities.items():
        if memory.quantities.get(name) != quantity:
            raise misdeclared(store.path, record, f"values of {quantity}, which is not what was declared")
    memory.join(other, exemplars="exemplar-readings" in record.arrays)


def apply_note(memory: Memory, row: Head, path: Path) -> None:
    """Apply what a row of the journal at a path says of quantities, descriptions and the skin, if anything.

    A forgotten material loses its description. Raises DamageError for a value or a quantity that cannot be.
    """
    for wrong in wrong_values(path, [row], memory.quantities):
        raise wrong
    if row.kind in (DESCRIBE, RETRACT):  # a retraction has no constituents, and names a material only in `forget`
        describe(memory.descriptions, row.label, row.attributes.get("constituents"))
    elif row.kind == ADAPT and RETRACTS in row.attributes:
        memory.corrections.pop(cast(int, row.attributes[RETRACTS]), None)
    elif row.kind == ADAPT:
        memory.correct(row.sequence, Correction.from_text(row.attributes[CORRECTION], memory.recipe.sensor))


def apply_appended(memory: Memory, store: Store, records: Sequence[Record]) -> list[Changed] | None:
    """Apply rows that a writer appended, and take over its tuned model; returns the changes as `replay` does."""
    changed = [replay(memory, record, store) for record in records]
    refill(memory, store)
    newest = store.latest() if store.newest != memory.checkpoint else None
    if newest is not None and newest.last_sequence <= memory.sequence:
        memory.checkpoint = newest.number
        # Heads of all kinds are read: filtered ones skip damaged rows, and such a row may be a retraction.
        behind = takewhile(lambda head: head.sequence <= memory.sequence, store.heads(newest.last_sequence))
        gone = min(retracted_by(behind), default=None)
        if gone is None or gone > cast(int, newest.attributes["tuned_last_sequence"]):
            memory.take_tuned(newest.arrays, newest.attributes)
    return None if None in changed else [each for added in changed for each in added or ()]


def refill(memory: Memory, store: Store) -> None:
    """Choose sample and exemplars again after a retraction; does nothing if no retracted touch was among them."""
    if memory.stale:
        # Rows that a writer appended since this memory was read are left for the next `load`.
        memory.chosen = _chosen(memory, store, memory.sequence).chosen


def until(memory: Memory, store: Store, last_sequence: int) -> Memory:
    """The memory of all observations up to a row, without retracted ones: a compaction at that row keeps it."""
    made, later = _chosen(memory, store, last_sequence), memory.empty_like()
    later.quantities = dict(memory.quantities)
    for head in store.heads(last_sequence):  # whoever compacts has read all
        if head.kind in (OBSERVE, MERGE) and head.sequence not in memory.retracted:
            replay(later, store.record(head.sequence), store)
    made.take_sums(memory, later, last_sequence)
    return made


def _chosen(memory: Memory, store: Store, last_sequence: int) -> Memory:
    """A memory with what was chosen and noted up to a row, without the retracted observations."""
    fresh, heads = _compaction_samples(memory, store), _behind_compaction(memory, store, last_sequence)
    for head in heads:
        apply_note(fresh, head, store.path)
        if head.kind == MERGE:
            _join(fresh, store.record(head.sequence), store)
    observed = [head for head in heads if head.kind == OBSERVE and head.sequence not in memory.retracted]
    fresh.choose(observed, store.record, memory)
    return fresh


def _behind_compaction(memory: Memory, store: Store, last_sequence: int) -> list[Head]:
    """The rows up to one from which samples are chosen. Raises DamageError: a damaged row may be of any kind."""
    try:
        return list(takewhile(lambda head: head.sequence <= last_sequence, store.heads(memory.compacted)))
    except DamageError as damage:
        raise DamageError(
            f"{damage}. Without it the samples of touches cannot be chosen again after a retraction: repair the "
            "memory (scroll-tactile memory repair)",
            path=damage.path,
            sequence=damage.sequence,
        ) from damage


def _compaction_samples(memory: Memory, store: Store) -> Memory:
    """A memory filled from the compaction checkpoint; an empty one if there is none."""
    fresh = memory.empty_like()
    require_compaction(memory, store)
    try:
        if (compaction := store.compaction()) is not None:
            fresh.fill(compaction.arrays, compaction.attributes, source=0)
    except DamageError as damage:
        # The statistics are complete without it: better to open with fewer samples than not at all.
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


def require_compaction(memory: Memory, store: Store) -> None:
    """Raise CompactedError where the store was compacted since this memory was read."""
    if store.compacted != memory.compacted:
        raise CompactedError(f"{store.path} was compacted since it was read: read it again")


def ranked_exemplars(memory: Memory, store: Store | None) -> dict[str, list[Exemplar]]:
    """The buffer, ranked by `rank` against the exact means of all observations. Raises as `exemplar_candidates`."""
    statistics = memory.statistics

    def mean(material: str, scale: Scale) -> npt.NDArray[np.int64]:
        return mean_code(statistics.sums(scale, [material])[0], int(statistics.counts(scale, [material])[0]))

    return rank(exemplar_candidates(memory, store), memory.recipe.exemplars, mean)


def exemplar_candidates(memory: Memory, store: Store | None) -> list[Exemplar]:
    """The candidates for the buffer with their readings, by material and key; those lost to damage are left out.

    store: of the memory, None where it has none. Raises CompactedError where it was compacted since the memory was
    read, DamageError, StoreClosedError.
    """
    found: dict[tuple[str, bytes], Exemplar] = {}
    wanted: dict[int, list[tuple[str, bytes]]] = {}
    for material, key, source in memory.exemplars or ():
        if isinstance(source, Exemplar):
            found[material, key] = source
        else:  # the compaction checkpoint holds what was compacted
            wanted.setdefault(source if source > memory.compacted else 0, []).append((material, key))
    for sequence, streams in sorted(wanted.items()):
        assert store is not None
        held = {(exemplar.material, exemplar.key): exemplar for exemplar in _exemplars_in(memory, store, sequence)}
        found |= {stream: held[stream] for stream in streams if stream in held}
        if lost := len(set(streams) - set(held)):
            logger.warning("%s: the readings of %d candidates for exemplars were lost to damage", store.path, lost)
    return [found[stream] for stream in sorted(found)]


def _exemplars_in(memory: Memory, store: Store, sequence: int) -> list[Exemplar]:
    """The exemplars that a row of the journal holds; 0: those of the compaction checkpoint."""
    require_compaction(memory, store)
    row = store.record(sequence) if sequence else store.compaction()
    if isinstance(row, Record) and row.kind == OBSERVE:
        steps, codes = memory.codes(row)
        readings, stages = only_readings(row.arrays), memory.plan.scored_stages(steps)
        return [Exemplar.of(row.label, row.key, readings, stages, codes)]
    about = None if row is None else cast(Any, row.attributes.get("exemplars"))
    return [] if row is None or about is None else exemplars_from_arrays(row.arrays, about)
