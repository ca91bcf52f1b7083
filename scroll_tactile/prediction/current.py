"""The model of a memory as it is now: followed from touch to touch, and fitted again beside, so that no call waits.

Right after an observation the readouts are those of all that was observed (see `readouts.readout`). What else is
fitted, the shrinkage and the calibration, follows when the memory has grown by three sixteenths, or three quarters of
what the readouts can follow has come: a sixteenth before, or an eighth, a thread begins to fit it, to the integers. A
call waits for that thread only where the readouts can follow no further, and in a memory of few touches, where each of
them counts. Otherwise touches that come faster than the thread fits have an earlier calibration a little longer.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from weakref import ReferenceType, ref

from scroll_tactile.errors import InputError
from scroll_tactile.memory.ledger import Ledger
from scroll_tactile.memory.rows import Added
from scroll_tactile.memory.state import Memory, give_back_scratch
from scroll_tactile.prediction.composition import Composer
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.fitting import Draft
from scroll_tactile.prediction.model import Model
from scroll_tactile.settings import Settings

__all__ = ["CurrentModel", "FrozenModel"]

BEGIN, ADOPT = 2, 3  # sixteenths of the touches that a model was fitted to: then the next is begun, and answers
LEAST = 2  # touches, in the smallest of memories
FEW = 64  # touches: of a memory with no more the calibration is worth waiting for
MOST_BEHIND = 256  # touches: their codes are kept, and more of them could hardly be followed


class FrozenModel:
    """Holds a model as it is, whatever is observed meanwhile: a copy is followed, for as long as somebody has this."""

    def __init__(self, model: Model) -> None:
        self.model = model


class CurrentModel:
    """The model of one memory. Whoever calls holds the ledger's lock."""

    def __init__(self, settings: Settings, extractor: FeatureExtractor) -> None:
        self._kind, self._extractor = settings.readout, extractor
        self._version = -1
        self._model: Model | None = None
        self._exact = False  # whether the model was fitted to the memory as it is, and not followed
        self._behind: list[Added] | None = []  # what came since the model; None where it cannot be followed
        self._coming: Future[Model] | None = None
        self._since: list[Added] = []  # what came since the coming one was begun
        self._worker: ThreadPoolExecutor | None = None
        self._process = os.getpid()
        self._composer: tuple[Model, int, int, Composer] | None = None
        self._lent: list[ReferenceType[FrozenModel]] = []

    def frozen(self, ledger: Ledger) -> FrozenModel:
        """The present model, which stays as it is for as long as what is returned is held."""
        model = self.present(ledger)
        lent = self._holder(model)
        if lent is None:
            model.freeze(ledger.memory.statistics)
            lent = FrozenModel(model)
            self._lent = [*(one for one in self._lent if one() is not None), ref(lent)]
        return lent

    def _holder(self, model: Model) -> FrozenModel | None:
        """What holds a model as it is, if anything does."""
        return next((lent for one in self._lent if (lent := one()) is not None and lent.model is model), None)

    def present(self, ledger: Ledger) -> Model:
        """The model that predictions are made with."""
        memory = ledger.memory  # first: reading it again after a change that was cut short counts as a version
        self.take_in(ledger)
        # Until the model is whole again: following that is cut short leaves it between two states.
        (model, behind), (self._model, self._behind) = (self._model, self._behind), (None, None)
        if model is not None and (behind is None or self._due(model, memory)):
            model = None
        if model is not None and behind:
            self._exact = False
            # In place where nobody holds it: to copy one takes as long as half a prediction.
            model = model.copy() if self._holder(model) is not None else model
            if not model.follow(memory, behind):
                model = None
        # The last one is let go first, and its memory given back: each is some tens of MB.
        present = self._adopted(memory) if model is None else model
        self._model, self._behind = present, []
        self.prepare(ledger)
        return present

    def prepare(self, ledger: Ledger) -> None:
        """Begin to fit the next model where enough has come since the last. Raises nothing: an observation is kept."""
        self.take_in(ledger)
        model, touches = self._model, ledger.memory.statistics.touches
        if model is None or self._behind is None or self._coming is not None:
            return
        lag = abs(touches - model.fitted_to)
        if lag >= max(LEAST // 2, BEGIN * model.fitted_to // 16) or (lag and model.crowded):
            # Where there is no memory or no thread for it, or the ridge has too many materials, a prediction says so.
            with suppress(MemoryError, InputError, RuntimeError):
                self._worker = self._worker or ThreadPoolExecutor(1, "scroll-tactile fit")
                self._since = []
                self._coming = self._worker.submit(Draft.of(ledger.memory, self._kind).fit, self._extractor)

    def settle(self, ledger: Ledger) -> Model:
        """The model that is fitted to the memory as it is: a function of what was observed, and of nothing else."""
        memory = ledger.memory
        self.take_in(ledger)
        if self._model is None or self._behind != [] or not self._exact:
            self._model, self._coming = None, None
            self._model, self._behind = self._fitted(memory), []
        return self._model

    def close(self) -> None:
        """End the thread that fits; a later prediction begins another where it needs one."""
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.shutdown()

    def take_in(self, ledger: Ledger) -> None:
        """Note what has changed since it was last noted."""
        if self._process != os.getpid():  # a forked process has not the thread
            self._process, self._worker, self._coming = os.getpid(), None, None
        if ledger.version == self._version:
            return
        if self._model is not None and self._holder(self._model) is None:
            self._model.read(ledger.memory.statistics)  # lets a snapshot go, which would keep all that changes
        added = ledger.added if self._model is not None else None
        # Until all is noted nothing can be followed: cut short in between, it would be noted twice, or never.
        (behind, coming), (self._behind, self._coming) = (self._behind, self._coming), (None, None)
        self._version = ledger.version
        ledger.follow, ledger.added = True, []
        if added is not None:
            coming = coming if coming is not None and _with(self._since, added) is not None else None
            self._behind, self._coming = _with(behind, added), coming

    def _due(self, model: Model, memory: Memory) -> bool:
        """Whether another model takes its place: it is late, and the next is there or worth waiting for."""
        late = abs(memory.statistics.touches - model.fitted_to) >= max(LEAST, ADOPT * model.fitted_to // 16)
        if late and model.fitted_to <= FEW:
            return True
        # Not only where it can follow no further: until then two models would be held most of the time.
        pressed = any(readout.pressed for readout in model.readouts.values())
        return (late or pressed) and self._coming is not None and self._coming.done()

    def _adopted(self, memory: Memory) -> Model:
        """The coming model, followed to the memory as it is; a new one where there is none, or it cannot follow."""
        coming = self._coming
        if coming is not None and coming.exception() is None:  # it waits; interrupted there, the next call does
            model, since = coming.result(), self._since
            self._exact, self._coming, self._since = not since, None, []
            del coming
            if not self._due(model, memory) and model.follow(memory, since):
                give_back_scratch()
                return model
        self._coming = None
        return self._fitted(memory)

    def _fitted(self, memory: Memory) -> Model:
        model = Draft.of(memory, self._kind).fit(self._extractor)
        self._exact = True
        return model

    def composer(self, ledger: Ledger, model: Model) -> Composer:
        """The heads of all constituents that were described, over a model of this memory."""
        state = model, ledger.version, ledger.described
        if self._composer is None or self._composer[:3] != state:
            self._composer = *state, Composer.of(model, ledger.memory)
        return self._composer[3]


def _with(touches: list[Added] | None, more: Sequence[Added]) -> list[Added] | None:
    """The list with some more in it; None where it would be too long."""
    if touches is None or len(touches) + len(more) > MOST_BEHIND:
        return None
    touches.extend(more)
    return touches
