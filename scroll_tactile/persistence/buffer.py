"""The buffer of exemplars, read from the journal, its compaction checkpoint, or the memory itself."""

from __future__ import annotations

import logging
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scroll_tactile_store import Record, Store

from scroll_tactile.memory.exemplars import Exemplar, exemplars_from_arrays, rank
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import OBSERVE, only_readings
from scroll_tactile.persistence.replaying import require_compaction
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import mean_code

__all__ = ["exemplar_candidates", "ranked_exemplars"]

logger = logging.getLogger(__name__)


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
