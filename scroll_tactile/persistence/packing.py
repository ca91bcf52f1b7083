"""Packing a memory into one file, and the sums that such a file adds to another memory."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from copy import copy
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from scroll_tactile_store import Head, Store
from scroll_tactile_store.archive import write_archive
from scroll_tactile_store.exceptions import reported

from scroll_tactile.memory.identity import Identity
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import (
    ADAPT,
    CHANNELS,
    DECLARE,
    DESCRIBE,
    MERGE,
    OBSERVE,
    SENSE,
    SOURCE,
    active_rows,
    annotation_of,
    declaration,
)
from scroll_tactile.persistence.ram_store import AnyStore
from scroll_tactile.persistence.replaying import exemplar_candidates
from scroll_tactile.statistics.sample import Sample

__all__ = ["pack_memory", "sums_without"]


def pack_memory(
    store: AnyStore, memory: Memory, path: Path, *, rows: bool = True, readings: bool = True, source: str | None = None
) -> None:
    """Write all that a memory learned as a packed memory; the arguments are those of `TactileLearner.pack`."""
    found = active_rows(store.heads())
    heads = [head for head in found if head.kind != MERGE]
    with_rows = rows and readings and not memory.compacted and len(heads) == len(found)
    identity: dict[str, Any] = Identity.read(store).to_json()
    packed = copy(memory)
    packed.tuned, packed.tuned_last_sequence, packed.retracted = None, 0, set()
    packed.corrections = {}  # they are of this unit; what was read through them is in the touches
    if not readings:
        identity |= {"exemplars": 0, "kept_touches": 0}
        packed.kept = packed.exemplars = None
    with reported(path, "packing a memory"):
        path.parent.mkdir(parents=True, exist_ok=True)
        # The packed file is whole even where a failing disk does not let its draft be removed.
        made = TemporaryDirectory(
            dir=path.parent, prefix=f"{path.name}.", suffix=".partial", ignore_cleanup_errors=True
        )
    with made as folder:
        with Store.open(folder, identity=identity) as into:
            with into.batch():
                for quantity in memory.quantities.values():
                    into.append(DECLARE, quantity.name, b"", attributes=declaration(quantity))
                touches = [_append(into, store, head, source, arrays=with_rows, readings=readings) for head in heads]
                for material, constituents in memory.descriptions.items():
                    into.append(DESCRIBE, material, b"", attributes={"constituents": constituents})
            if with_rows:
                if packed.exemplars is not None:
                    packed.exemplars = _among(touches, memory)
                written, attributes = packed.to_arrays()
                into.commit(written, last_sequence=into.last, attributes=attributes)
            else:
                written, attributes = packed.to_arrays(
                    into.last, exemplar_candidates(memory, store) if readings else []
                )
                into.compact(written, last_sequence=into.last, attributes=attributes)
        write_archive(Path(folder), path)


def _append(into: Store, store: AnyStore, head: Head, source: str | None, *, arrays: bool, readings: bool) -> Head:
    """Append a touch to a packed memory and return its row there. Raises StoreError."""
    attributes = {key: value for key, value in head.attributes.items() if readings or key not in ("nbytes", CHANNELS)}
    attributes |= {} if source is None or SOURCE in attributes else {SOURCE: source}
    own = store.record(head.sequence).arrays if arrays else None
    return into.append(head.kind, head.label, head.key, attributes=attributes, arrays=own, time=head.time)


def _among(touches: Sequence[Head], memory: Memory) -> Sample[int] | None:
    """The exemplars among some touches, for a memory with the recipe of `memory`."""
    exemplars = memory.empty_like().exemplars
    if exemplars is not None:
        exemplars.update((head.label, head.key, head.sequence) for head in touches if "nbytes" in head.attributes)
    return exemplars


def sums_without(source: AnyStore, heads: Sequence[Head], memory: Memory, left_out: Collection[int]) -> Memory | None:
    """The sums of another memory without some of its touches, exactly; None where its rows must be replayed instead.

    heads: its rows. memory: any with the same recipe. Raises DamageError.
    """
    observed = [head for head in heads if head.kind == OBSERVE]
    if len(observed) != sum(head.kind not in (DECLARE, DESCRIBE, SENSE, ADAPT) for head in heads):
        return None
    found = source.latest()
    if found is None or not heads or found.last_sequence != heads[-1].sequence:
        return None
    sums = memory.empty_like().fill(found, source.path)
    if not left_out:
        return sums
    gone, rest = memory.empty_like(), memory.empty_like()
    for sequence in left_out:
        record = source.record(sequence)
        steps, codes = memory.codes(record)
        gone.statistics.add(record.label, codes, steps)
        gone.targets.add(record.label, record.key, annotation_of(record.attributes), codes, steps)
    rest.statistics, rest.targets = sums.statistics - gone.statistics, sums.targets - gone.targets
    rest.exemplars = None  # the rows have them
    rest.choose([head for head in observed if head.sequence not in left_out], source.record, sums)
    return rest
