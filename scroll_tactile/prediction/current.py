"""The model of a memory in its present state: its means follow each touch, and a thread fits it anew as touches come.

After a fit the class means, the kept touches and the materials follow at once, while the scatter and the weighing stay
as they were fitted: measured right as often as a fit of all touches. When the memory has grown or shrunk by an eighth,
a thread fits again, from a copy of the sums; its model is taken as soon as it is there, and follows what came since. In
memories of at most FEW touches, and where touches came much faster than fits, a call waits.
"""

from __future__ import annotations

import logging
import os
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field

from scroll_tactile.errors import InputError
from scroll_tactile.memory.state import Memory
from scroll_tactile.persistence.ledger import Ledger
from scroll_tactile.prediction.composition import Composer
from scroll_tactile.prediction.fitting import Draft, rehearse
from scroll_tactile.prediction.model import Model
from scroll_tactile.prediction.stored import read_weighing, weighing_text
from scroll_tactile.readouts.estimation import Estimator
from scroll_tactile.settings import Settings

logger = logging.getLogger(__name__)

__all__ = ["CurrentModel", "estimator_of"]

GROWTH = 8  # a fit begins when the memory has changed by one in so many touches
LEAST = 2  # touches by which it has changed at least
FEW = 16  # touches: in a memory with no more, a call waits for the fit
FASTER = 2  # times the touches of the last fit: where there are more, or fewer than their share, a call waits


@dataclass
class _Job:
    """A fit in a thread.

    retractions, version: of the memory when it began. changed: the materials that changed since; None where that is
    not known.
    """

    future: Future[Model]
    retractions: int
    version: int
    changed: set[str] | None = field(default_factory=set)


class CurrentModel:
    """The model of one memory. The caller holds the ledger's lock."""

    def __init__(self, settings: Settings) -> None:
        self._kind = settings.readout
        self._model: Model | None = None
        self._behind: set[str] | None = set()  # the materials that changed since the model; None where any may have
        self._version = -1  # of the memory up to which that is so
        self._retractions = 0  # of the memory when the model was fitted
        self._exact = False  # whether the model was fitted to the present memory
        self._job: _Job | None = None
        self._worker: ThreadPoolExecutor | None = None
        self._process = os.getpid()
        self._composer: tuple[Model, int, int, Composer] | None = None
        self._estimator: Estimator | None = None

    def present(self, ledger: Ledger) -> Model:
        """The model that predictions are made with; it never changes."""
        memory = ledger.memory  # first: after an interrupted change this reads the memory again, a new version
        self._note_changes(ledger)
        (model, self._model), behind = (self._model, None), self._behind  # an interrupted call leaves no model
        if (job := self._job) is not None and job.future.done():
            self._job = None
            if job.changed is not None and job.future.exception() is None:
                model, behind, self._exact = job.future.result(), job.changed, job.version == self._version
                self._retractions = job.retractions
        elif model is None:
            model = self._restored(ledger)
        followed = None
        if model is not None and behind is not None and not _outgrown(model, memory):
            self._exact = self._exact and not behind
            followed = model.followed(memory, behind) if behind else model
        if followed is None:
            return self._fitted(memory, model)
        self._model = model = followed
        self._behind = set()
        self.prepare(ledger)
        return model

    def _note_changes(self, ledger: Ledger) -> None:
        """Have the model and the fit under way know what changed since the last call."""
        if self._process != os.getpid():  # a forked process has not the thread
            self._process, self._worker, self._job = os.getpid(), None, None
        if ledger.version == self._version:
            return
        changed, ledger.changed = ledger.changed, set()
        self._version, self._exact = ledger.version, False  # of an axis, a touch without a label changes samples alone
        self._behind = _joined(self._behind, changed)
        if self._job is not None:
            self._job.changed = _joined(self._job.changed, changed)

    def prepare(self, ledger: Ledger) -> None:
        """Begin a fit if enough touches came or went. A lack of memory or threads raises nothing here."""
        self._note_changes(ledger)
        model, memory = self._model, ledger.memory
        if model is None or self._job is not None:
            return
        if abs(memory.statistics.touches - model.touches) < max(LEAST, model.touches // GROWTH):
            return
        # Lack of memory or threads, or too many materials for the ridge: the next prediction raises the error.
        with suppress(MemoryError, InputError, RuntimeError):
            draft = Draft.of(memory, self._kind, model)
            self._worker = self._worker or ThreadPoolExecutor(1, "scroll-tactile fit")
            fitted = self._worker.submit(draft.fit)
            self._job = _Job(fitted, memory.retractions, self._version)

    def rehearsed(self, ledger: Ledger) -> Model:
        """The present model with the trajectories of held-out touches; later fits have them, too."""
        model = self.present(ledger)
        rehearse(model)
        return model

    def settle(self, ledger: Ledger) -> Model:
        """The model fitted to the present memory: a function of the set of observations alone."""
        memory = ledger.memory
        self._note_changes(ledger)
        if self._model is None or self._behind != set() or not self._exact:
            return self._fitted(memory, self._model)
        return self._model

    def _restored(self, ledger: Ledger) -> Model | None:
        """The model by the weighing of the checkpoint that the memory was read from; None where it has none that fits.

        It was fitted to these touches or to fewer: a retraction drops it.
        """
        if (text := ledger.take_weighing()) is None:
            return None
        try:
            return read_weighing(text, Draft.of(ledger.memory, self._kind).solved(), ledger.memory)
        except ValueError as error:
            logger.warning("the weighing in the memory's checkpoint is not used, and fitted anew: %.300s", error)
            return None

    def stored(self, ledger: Ledger) -> str | None:
        """The weighing of the present model, for a checkpoint; None where there is none of touches that all count."""
        if self._model is None or self._retractions != ledger.memory.retractions:
            return None
        return weighing_text(self._model)

    def _fitted(self, memory: Memory, before: Model | None) -> Model:
        self._model, self._job = None, None
        self._model = model = Draft.of(memory, self._kind, before).fit()
        self._behind, self._exact, self._retractions = set(), True, memory.retractions
        return model

    def close(self) -> None:
        """End the thread; a later prediction starts a new one if it needs it."""
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.shutdown()

    def composer(self, ledger: Ledger) -> Composer:
        """The heads of all constituents that were described, over a model of this memory."""
        model = self.present(ledger)
        weighing = model.weighing
        if weighing is not None and not {material for material, *_ in weighing.sample} <= model.known:
            model = self.settle(ledger)
        state = model, ledger.version, ledger.described
        if self._composer is None or self._composer[:3] != state:
            self._composer = *state, Composer.of(model, ledger.memory)
        return self._composer[3]

    def estimator(self, ledger: Ledger) -> Estimator:
        """The estimator of this memory; it keeps its fitted heads while the sampled touches are the same."""
        self._estimator = estimator_of(ledger.memory, self._estimator)
        return self._estimator


def estimator_of(memory: Memory, before: Estimator | None = None) -> Estimator:
    """What estimates by the sampled touches of a memory. before: see `Estimator.of`."""
    least = max(1, memory.statistics.fifth_percentile_length)
    return Estimator.of(memory.plan, memory.sample, memory.quantities, least, before)


def _outgrown(model: Model, memory: Memory) -> bool:
    """Whether so many touches came or went that a call waits for the fit."""
    now, fitted = memory.statistics.touches, model.touches
    if fitted <= FEW:
        return abs(now - fitted) >= min(LEAST, fitted + 1)
    return not fitted <= FASTER * now <= FASTER * FASTER * fitted


def _joined(before: set[str] | None, changed: set[str] | None) -> set[str] | None:
    return None if before is None or changed is None else before | changed
