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
from scroll_tactile.prediction.fitting import Draft
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
class _Fit:
    """A fit of a memory, done or in a thread, and what changed since it began.

    version, retractions: of the memory then. changed: the materials that changed since; None where any may have.
    """

    model: Future[Model]
    version: int
    retractions: int
    changed: set[str] | None = field(default_factory=set)

    @classmethod
    def done(cls, model: Model, version: int, retractions: int) -> _Fit:
        """Of a model that is there."""
        made = cls(Future(), version, retractions)
        made.model.set_result(model)
        return made


class CurrentModel:
    """The model of one memory. The caller holds the ledger's lock."""

    def __init__(self, settings: Settings) -> None:
        self._kind = settings.readout
        self._fit: _Fit | None = None  # its model follows the memory
        self._job: _Fit | None = None
        self._version = -1  # of the memory up to which changes are noted
        self._worker: ThreadPoolExecutor | None = None
        self._process = os.getpid()
        self._composer: tuple[Model, int, int, Composer] | None = None
        self._estimator: Estimator | None = None

    def present(self, ledger: Ledger) -> Model:
        """The model that predictions are made with; it never changes."""
        memory = ledger.memory  # first: after an interrupted change this reads the memory again, a new version
        self._note_changes(ledger)
        (fit, self._fit), job = (self._fit, None), self._job  # an interrupted call leaves no model
        if job is not None and job.model.done():
            self._job = None
            if job.model.exception() is None and job.changed is not None:
                fit = job
        elif fit is None:
            fit = self._restored(ledger)
        model = None if fit is None else _followed(fit, memory)
        if fit is None or model is None:
            return self._fitted(memory, None if fit is None else fit.model.result())
        self._fit = _Fit.done(model, fit.version, fit.retractions)
        self.prepare(ledger)
        return model

    def _note_changes(self, ledger: Ledger) -> None:
        """Have the model and the fit under way know what changed since the last call."""
        if self._process != os.getpid():  # a forked process has not the thread
            self._process, self._worker, self._job = os.getpid(), None, None
        if ledger.version == self._version:
            return
        changed, ledger.changed, self._version = ledger.changed, set(), ledger.version
        for fit in (self._fit, self._job):
            if fit is not None:
                fit.changed = None if fit.changed is None or changed is None else fit.changed | changed

    def prepare(self, ledger: Ledger) -> None:
        """Begin a fit if enough touches came or went. A lack of memory or threads raises nothing here."""
        self._note_changes(ledger)
        if self._fit is None or self._job is not None:
            return
        model, memory = self._fit.model.result(), ledger.memory
        if abs(memory.statistics.touches - model.touches) < max(LEAST, model.touches // GROWTH):
            return
        # Lack of memory or threads, or too many materials for the ridge: the next prediction raises the error.
        with suppress(MemoryError, InputError, RuntimeError):
            draft = Draft.of(memory, self._kind, model)
            self._worker = self._worker or ThreadPoolExecutor(1, "scroll-tactile fit")
            self._job = _Fit(self._worker.submit(draft.fit), self._version, memory.retractions)

    def settle(self, ledger: Ledger) -> Model:
        """The model fitted to the present memory: a function of the set of observations alone."""
        memory = ledger.memory
        self._note_changes(ledger)
        before = None if self._fit is None else self._fit.model.result()
        if before is None or self._fit is None or self._fit.version != self._version:
            return self._fitted(memory, before)
        return before

    def _restored(self, ledger: Ledger) -> _Fit | None:
        """The model by the weighing of the checkpoint that the memory was read from; None where it has none that fits.

        It was fitted to these touches or to fewer: a retraction drops it.
        """
        if (text := ledger.take_weighing()) is None:
            return None
        try:
            model = read_weighing(text, Draft.of(ledger.memory, self._kind).solved())
        except ValueError as error:
            logger.warning("the weighing in the memory's checkpoint is not used, and fitted anew: %.300s", error)
            return None
        return _Fit.done(model, -1, ledger.memory.retractions)

    def stored(self, ledger: Ledger) -> str | None:
        """The weighing of the present model, for a checkpoint; None where there is none of touches that all count."""
        if self._fit is None or self._fit.retractions != ledger.memory.retractions:
            return None
        return weighing_text(self._fit.model.result())

    def _fitted(self, memory: Memory, before: Model | None) -> Model:
        self._fit, self._job = None, None
        model = Draft.of(memory, self._kind, before).fit()
        self._fit = _Fit.done(model, self._version, memory.retractions)
        return model

    def close(self) -> None:
        """End the thread; a later prediction starts a new one if it needs it."""
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.shutdown()

    def composer(self, ledger: Ledger) -> Composer:
        """The heads of all constituents that were described, over a model of this memory."""
        model = self.present(ledger)
        if not {material for material, *_ in model.held_out.sample} <= model.known:
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


def _followed(fit: _Fit, memory: Memory) -> Model | None:
    """A fit's model with what changed since; None where a call waits for another fit."""
    model, now = fit.model.result(), memory.statistics.touches
    if fit.changed is None:
        return None
    if model.touches <= FEW:
        outgrown = abs(now - model.touches) >= min(LEAST, model.touches + 1)
    else:
        outgrown = not model.touches <= FASTER * now <= FASTER * FASTER * model.touches
    if outgrown:
        return None
    return model.followed(memory, fit.changed) if fit.changed else model
