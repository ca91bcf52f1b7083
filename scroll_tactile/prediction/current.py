"""The model of a memory as it is now: fitted where the memory changed, or updated where `refit` allows."""

from __future__ import annotations

from dataclasses import replace

from scroll_tactile.memory.ledger import Ledger
from scroll_tactile.memory.state import Memory
from scroll_tactile.prediction.composition import Composer
from scroll_tactile.prediction.filling import Filling
from scroll_tactile.prediction.incremental import IncrementalModel
from scroll_tactile.prediction.model import Model
from scroll_tactile.settings import Settings

__all__ = ["CurrentModel"]


class CurrentModel:
    """Models of one memory, each kept until the memory changes. Whoever calls holds the ledger's lock.

    channels, bound: of the sensor and of the embedding, by which dead channels are filled in.
    """

    def __init__(self, settings: Settings, channels: int, bound: float) -> None:
        self._settings = settings
        self._channels = channels
        self._bound = bound
        self._fitted: tuple[int, Model] | None = None
        self._updated: tuple[int, IncrementalModel] | None = None
        self._composer: tuple[Model, int, Composer] | None = None

    def fitted(self, ledger: Ledger) -> Model:
        """The readouts and calibrations of all that was observed."""
        memory, version = ledger.memory, ledger.version
        if self._fitted is None or self._fitted[0] != version:
            self._fitted = version, Model.of(memory, self._settings.readout, self._filling(memory))
        return self._fitted[1]

    def present(self, ledger: Ledger) -> Model:
        """The model that predictions are made with: `fitted`, or one updated since where `refit` allows."""
        if not self._settings.refit:
            return self.fitted(ledger)
        memory = ledger.memory  # first: reading it again after a change that was cut short counts as a version
        if self._updated is None or self._updated[0] != ledger.version:
            model, added = self._updated and self._updated[1], ledger.added
            if model is None or added is None or not model.update(memory, added):
                model = IncrementalModel(self.fitted(ledger), memory, self._settings.refit, self._settings.solver)
            else:
                model.model = replace(model.model, filling=self._filling(memory))
            self._updated = ledger.version, model
            ledger.follow, ledger.added = True, []
        return self._updated[1].model

    def composer(self, ledger: Ledger, model: Model) -> Composer:
        """The heads of all constituents that were described, over a model of this memory."""
        if self._composer is None or self._composer[0] is not model or self._composer[1] != ledger.described:
            self._composer = model, ledger.described, Composer.of(model, ledger.memory)
        return self._composer[2]

    def _filling(self, memory: Memory) -> Filling | None:
        return Filling.of(memory.statistics, self._channels, self._bound) if memory.plan.filled else None
