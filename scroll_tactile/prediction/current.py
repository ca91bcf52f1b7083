"""The model of a memory as it is now: followed from touch to touch, and fitted again beside, so that no call waits.

Right after an observation the readouts are those of all that was observed (see `readouts.readout`). What else is
fitted, the shrinkage and the calibration, follows when the memory has grown by an eighth: a sixteenth earlier a thread
begins to fit it, to the integers. When which of them answers depends on the calls that came and not on how fast that
thread is, so the same calls give the same answers.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from typing import cast

from scroll_tactile.memory.ledger import Ledger
from scroll_tactile.memory.rows import Added
from scroll_tactile.memory.state import Memory
from scroll_tactile.prediction.composition import Composer
from scroll_tactile.prediction.filling import Filling
from scroll_tactile.prediction.model import Draft, Model
from scroll_tactile.settings import Settings

__all__ = ["CurrentModel"]

LAG = 8  # of the touches that a model was fitted to, one in so many may be missing in its calibration
LEAST = 2  # touches, in a small memory


class CurrentModel:
    """The model of one memory. Whoever calls holds the ledger's lock.

    channels, bound: of the sensor and of the embedding, by which dead channels are filled in.
    """

    def __init__(self, settings: Settings, channels: int, bound: float) -> None:
        self._kind = settings.readout
        self._channels = channels
        self._bound = bound
        self._version = -1
        self._model: Model | None = None
        self._exact = False  # whether the model was fitted to the memory as it is, and not followed
        self._behind: list[Added] | None = []  # what came since the model; None where it cannot be followed
        self._coming: Future[Model] | None = None
        self._since: list[Added] = []  # what came since the coming one was begun
        self._worker: ThreadPoolExecutor | None = None
        self._filling: tuple[int, Filling | None] | None = None
        self._composer: tuple[Model, int, int, Composer] | None = None

    def present(self, ledger: Ledger) -> Model:
        """The model that predictions are made with."""
        memory = ledger.memory  # first: reading it again after a change that was cut short counts as a version
        self._take_in(ledger)
        model, behind = self._model, self._behind
        if model is None or behind != []:
            self._model = None  # until it is whole again: Ctrl-C may come at any point
            self._exact = False
            followed = model is not None and behind is not None and not self._overdue(model, memory)
            if not followed or not cast(Model, model).follow(memory, cast("list[Added]", behind)):
                model = self._adopted(memory)
            self._model, self._behind = model, []
        assert model is not None
        self.prepare(ledger)
        return model

    def prepare(self, ledger: Ledger) -> None:
        """Begin to fit the next model where the memory has grown enough since the last."""
        self._take_in(ledger)
        model, touches = self._model, ledger.memory.statistics.touches
        if model is None or self._behind is None or self._coming is not None:
            return
        if abs(touches - model.fitted_to) >= max(LEAST // 2, model.fitted_to // (2 * LAG)):
            self._worker = self._worker or ThreadPoolExecutor(1, "scroll-tactile fit")
            self._since = []
            self._coming = self._worker.submit(Draft.of(ledger.memory, self._kind).fit)

    def settle(self, ledger: Ledger) -> Model:
        """The model that is fitted to the memory as it is: a function of what was observed, and of nothing else."""
        memory = ledger.memory
        self._take_in(ledger)
        if self._model is None or self._behind != [] or not self._exact:
            self._model, self._coming = None, None
            self._model, self._behind = self._fitted(memory), []
        return self._model

    def close(self) -> None:
        """End the thread that fits."""
        if self._worker is not None:
            self._worker.shutdown()

    def _take_in(self, ledger: Ledger) -> None:
        """Note what has changed since it was last noted."""
        if ledger.version == self._version:
            return
        added = ledger.added if self._model is not None else None
        if added is None:
            self._behind, self._coming = None, None
        else:
            self._since = [*self._since, *added]
            self._behind = None if self._behind is None else [*self._behind, *added]
        self._version = ledger.version
        ledger.follow, ledger.added = True, []

    def _overdue(self, model: Model, memory: Memory) -> bool:
        return abs(memory.statistics.touches - model.fitted_to) >= max(LEAST, model.fitted_to // LAG)

    def _adopted(self, memory: Memory) -> Model:
        """The coming model, followed to the memory as it is; a new one where there is none, or it cannot follow."""
        coming, self._coming = self._coming, None
        if coming is not None:
            model, self._exact = coming.result(), not self._since
            if not self._overdue(model, memory) and model.follow(memory, self._since):
                return model
        return self._fitted(memory)

    def _fitted(self, memory: Memory) -> Model:
        model = Draft.of(memory, self._kind).fit()
        self._exact = True
        return model

    def filling(self, ledger: Ledger) -> Filling | None:
        """What fills in dead channels; None where the embedding does not ask for that."""
        memory = ledger.memory
        if not memory.plan.filled:
            return None
        if self._filling is None or self._filling[0] != ledger.version:
            self._filling = ledger.version, Filling.of(memory.statistics, self._channels, self._bound)
        return self._filling[1]

    def composer(self, ledger: Ledger, model: Model) -> Composer:
        """The heads of all constituents that were described, over a model of this memory."""
        state = model, ledger.version, ledger.described
        if self._composer is None or self._composer[:3] != state:
            self._composer = *state, Composer.of(model, ledger.memory)
        return self._composer[3]
