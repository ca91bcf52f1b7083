"""A model brought up to date between two fits: its readouts are those of all that was observed, to rounding.

Choosing λ and calibrating takes a dozen factorisations a scale. Where observing and predicting alternate, that is done
again only when the memory has grown by a share; in between the readouts are updated row by row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

from scroll_tactile.memory.rows import Added
from scroll_tactile.memory.state import Memory
from scroll_tactile.prediction.model import Model
from scroll_tactile.readouts.recursive import RecursiveLeastSquares, RecursiveReadout, WoodburyReadout
from scroll_tactile.readouts.shrinkage import Selection
from scroll_tactile.signals.windows import CHANNELS, Scale
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["IncrementalModel", "SolverName"]

SolverName = Literal["exact", "recursive"]
READOUTS: dict[SolverName, type[RecursiveReadout]] = {"exact": WoodburyReadout, "recursive": RecursiveLeastSquares}


class IncrementalModel:
    """What a model that was fitted to a memory becomes as touches are added.

    model: fitted to the memory as it is now. refit: the share by which the memory may grow before `update` refuses.
    solver: "exact", against a factor of the exact statistics, or "recursive", by the paper's recursion.
    """

    def __init__(self, model: Model, memory: Memory, refit: float, solver: SolverName) -> None:
        self.model = model
        self._kind = READOUTS[solver]
        self._observations = sum(memory.statistics.materials.values())
        self._most = (1 + refit) * self._observations
        self._readouts: dict[Scale, RecursiveReadout] = {}

    def update(self, memory: Memory, added: Sequence[Added]) -> bool:
        """Update the model with the touches that were added since; False where it has to be fitted again.

        memory: with these touches in it.
        """
        statistics = memory.statistics
        self._observations += len(added)
        judging = [scale for scale in statistics.scales if scale != CHANNELS]
        grown = self._observations > self._most
        if grown or any(statistics.names(scale) != self._names(scale) for scale in judging):
            return False
        with one_thread():
            self.model = replace(self.model, selections=self._updated(statistics, added), longest=statistics.longest)
        return True

    def _updated(self, statistics: Statistics, added: Sequence[Added]) -> dict[Scale, Selection]:
        selections = dict(self.model.selections)
        for scale, selection in selections.items():
            rows = [(selection.places[name], codes[scale]) for name, codes in added if len(codes.get(scale, ()))]
            if not rows:
                continue
            if (recursive := self._readouts.get(scale)) is None:
                recursive = self._readouts[scale] = self._kind(statistics, scale, selection.readout)
            elif not all(recursive.add(codes, place) for place, codes in rows):
                recursive.anchor(statistics)
            selections[scale] = replace(selection, readout=recursive.readout())
        return selections

    def _names(self, scale: Scale) -> list[str]:
        selection = self.model.selections.get(scale)
        return [] if selection is None else selection.names
