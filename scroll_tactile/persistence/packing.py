"""Packing a memory into one file that travels."""

from __future__ import annotations

from copy import copy
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from scroll_tactile_store import Store
from scroll_tactile_store.archive import write_archive
from scroll_tactile_store.exceptions import reported

from scroll_tactile.memory.identity import Identity
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import (
    CHANNELS,
    DECLARE,
    DESCRIBE,
    MERGE,
    SOURCE,
    active_rows,
    declaration,
)
from scroll_tactile.persistence.ram_store import AnyStore
from scroll_tactile.persistence.replaying import exemplar_candidates

__all__ = ["pack_memory"]


def pack_memory(
    store: AnyStore, memory: Memory, path: Path, *, rows: bool = True, readings: bool = True, source: str | None = None
) -> None:
    """Write all that a memory learned as a packed memory; the arguments are those of `TactileLearner.pack`."""
    found = active_rows(store.heads())
    heads = [head for head in found if head.kind != MERGE]
    with_arrays = rows and readings and not memory.compacted and len(heads) == len(found)
    identity: dict[str, Any] = Identity.read(store).to_json()
    packed = copy(memory)
    packed.tuned, packed.tuned_last_sequence, packed.retracted, packed.excluded = None, 0, set(), set()
    packed.corrections = {}  # they are of this unit; what was read through them is in the touches
    packed.exemplars = memory.empty_like().exemplars  # their rows have other numbers there
    left_out: tuple[str, ...] = ()
    if not readings:
        left_out = "nbytes", CHANNELS
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
                for head in heads:
                    attributes: dict[str, Any] = {} if source is None else {SOURCE: source}
                    attributes |= {name: value for name, value in head.attributes.items() if name not in left_out}
                    row: Any = {"attributes": attributes, "time": head.time}
                    row["arrays"] = store.record(head.sequence).arrays if with_arrays else None
                    packed.add_exemplar(into.append(head.kind, head.label, head.key, **row))
                for material, constituents in memory.descriptions.items():
                    into.append(DESCRIBE, material, b"", attributes={"constituents": constituents})
            candidates = exemplar_candidates(memory, store) if readings and not with_arrays else []
            arrays, told = packed.to_arrays(*(() if with_arrays else (into.last, candidates)))
            keep = into.commit if with_arrays else into.compact
            keep(arrays, last_sequence=into.last, attributes=told)
        write_archive(Path(folder), path)
