"""The model of a memory in its present state: updated touch by touch, and fitted anew in threads, so that no call
waits.

Three things happen at different rates:

- Each observation updates the readouts at once (`Readout.follow`), so they always rest on all observations.
- A readout can be updated by a limited number of touches. Before it is full, a thread solves it again from the integer
  sums (a renewal).
- Shrinkage, calibration and the table of moments are fitted in another thread (a fit). It begins when the memory has
  grown by two sixteenths, and its model is adopted from three sixteenths on. If touches come faster, the earlier
  calibration stays a little longer. In memories of at most FEW touches a call waits for the fit.

A writer stores the model beside its last checkpoint, and the next opening reads it. A stored model cannot be updated
(see `prediction.stored`): when touches come or go, its readouts are solved again.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from weakref import ReferenceType, ref

from scroll_tactile_store import StoreError

from scroll_tactile.errors import InputError
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import Added
from scroll_tactile.persistence.ledger import Ledger
from scroll_tactile.persistence.open_memory import Derived, give_back_scratch
from scroll_tactile.prediction.composition import Composer
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.fitting import Draft, Renewal, examined
from scroll_tactile.prediction.model import Model
from scroll_tactile.prediction.stored import NAME, banks_to_arrays, model_from, model_to_arrays, with_banks
from scroll_tactile.readouts.estimation import Estimator
from scroll_tactile.settings import Settings
from scroll_tactile.validation.gate import WRONG

logger = logging.getLogger(__name__)

__all__ = ["CurrentModel", "FrozenModel", "estimator_of"]

BEGIN, ADOPT = 2, 3  # growth in sixteenths of the touches fitted to: a fit begins, and its model is adopted
LEAST = 2  # touches of growth at which a model is adopted at the earliest
FEW = 16  # touches: in a memory with no more, a call waits for the fit
MOST_BEHIND = 256  # touches that a model can lag behind: their codes are kept until it takes them in


class FrozenModel:
    """Keeps a model unchanged while this object lives: later touches update a copy."""

    def __init__(self, model: Model) -> None:
        self.model = model


@dataclass
class _Job:
    """A model that a thread makes.

    version: of the memory when it was begun. since: the touches that came since; None if they are too many.
    """

    future: Future[Model]
    version: int
    since: list[Added] | None = field(default_factory=list)

    @property
    def ready(self) -> bool:
        """Whether the model is made, and can be updated to the present memory."""
        return self.since is not None and self.future.done() and self.future.exception() is None


class CurrentModel:
    """The model of one memory. The caller holds the ledger's lock."""

    def __init__(self, settings: Settings, extractor: FeatureExtractor) -> None:
        self._kind, self._extractor, self._reading = settings.readout, extractor, extractor
        self._version = -1
        self._model: Model | None = None
        self._stored: Model | None = None  # the model that was read from the disk
        self._tried_stored = False  # whether the disk was read
        self._exact = False  # whether the model was fitted here to the present memory, without updates since
        self._behind: list[Added] | None = []  # the touches that the model lacks; None if it cannot take them in
        self._fit: _Job | None = None
        self._renewal: _Job | None = None
        self._workers: dict[str, ThreadPoolExecutor] = {}
        self._process = os.getpid()
        self._composer: tuple[Model, int, int, Composer] | None = None
        self._estimator: Estimator | None = None
        self._lent: list[ReferenceType[FrozenModel]] = []

    def frozen(self, ledger: Ledger) -> FrozenModel:
        """The present model, unchanged for as long as the returned object lives."""
        model = self.present(ledger)
        lent = self._holder(model)
        if lent is None:
            lent = FrozenModel(model)
            self._lent = [*(one for one in self._lent if one() is not None), ref(lent)]
        return lent

    def _holder(self, model: Model) -> FrozenModel | None:
        """The object that keeps a model unchanged, if there is one."""
        return next((lent for one in self._lent if (lent := one()) is not None and lent.model is model), None)

    def present(self, ledger: Ledger) -> Model:
        """The model that predictions are made with."""
        present = self._present(ledger)
        self.prepare(ledger)
        return present

    def _present(self, ledger: Ledger) -> Model:
        memory = ledger.memory  # first: after an interrupted change this reads the memory again, a new version
        self._load_stored(ledger)
        self.take_in(ledger)
        # The model is None during the update: an interrupted update leaves a half-updated model.
        (model, behind), (self._model, self._behind) = (self._model, self._behind), (None, None)
        before = model
        if model is not None and (behind is None or self._due(model, memory)):
            model = None
        if model is not None and behind:
            self._exact = False
            # Updated in place unless it is frozen: a copy takes as long as half a prediction.
            model = model.copy() if self._holder(model) is not None else model
            if not model.follow(memory, behind):
                model = None
        present = self._next(memory, before) if model is None else model
        self._model, self._behind = present, []
        return present

    def reading(self, ledger: Ledger) -> FeatureExtractor:
        """The extractor for touches to be predicted: its kernel banks may come from the disk."""
        self._load_stored(ledger)
        self.take_in(ledger)
        return self._reading

    def discard_stored(self) -> None:
        """Drop the stored model and its banks: they give other features than the memory was made with."""
        self._reading, self._model, self._stored = self._extractor, None, None
        self._fit = self._renewal = None

    def _load_stored(self, ledger: Ledger) -> None:
        """Start with the model that was stored beside the checkpoint, if there is one."""
        if self._tried_stored or self._model is not None:
            return
        self._tried_stored, memory = True, ledger.memory
        if ledger.added is None:
            return
        try:
            if (kept := ledger.derived(NAME)) is None:
                return
            embedding = with_banks(self._extractor.embedding, kept.arrays)
            self._model = self._stored = model_from(kept, memory, self._kind)
            if embedding is not self._extractor.embedding:
                self._reading = self._extractor.with_embedding(embedding)
        except (StoreError, *WRONG) as error:
            logger.info("the model that was kept is not used: %s", error)
        else:
            self._behind = [] if kept.last_sequence == memory.sequence else None
        give_back_scratch()

    def arrays_to_store(self, ledger: Ledger) -> Derived | None:
        """The present model as `prediction.stored` has it, with the banks; None if there is none to store.

        That is: no model was made, the stored one is still current, or a small memory's model is out of date.
        """
        memory, model = ledger.memory, self._model
        self.close()  # waits for the threads
        self.take_in(ledger)
        if model is None or (model is self._stored and self._behind == [] and not ledger.saved_since(memory)):
            return None
        if self._behind != [] and model.fitted_to <= FEW:
            return None
        if (made := model_to_arrays(self._present(ledger))) is None:
            return None
        return made[0] | banks_to_arrays(self._reading.embedding), *made[1:]

    def prepare(self, ledger: Ledger) -> None:
        """Start a fit or a renewal if enough touches came since the last. A lack of memory or threads raises nothing
        here."""
        self.take_in(ledger)
        model, memory = self._model, ledger.memory
        if model is None:
            return
        lag = abs(memory.statistics.touches - model.fitted_to)
        # Lack of memory or threads, or too many materials for the ridge: the next prediction raises the error.
        with suppress(MemoryError, InputError, RuntimeError):
            if self._fit is None and lag >= max(LEAST // 2, BEGIN * model.fitted_to // 16):
                draft = Draft.of(memory, self._kind)
                self._fit = _Job(self._worker("fit").submit(draft.fit, self._reading), self._version)
            if (
                self._renewal is None
                and self._behind
                and model.needs_renewal(self._behind)
                and _has_all_of(memory, model)
            ):
                solving = self._worker("renewal").submit(Renewal.of(model, memory).solve)
                self._renewal = _Job(solving, self._version)

    def _worker(self, name: str) -> ThreadPoolExecutor:
        if name not in self._workers:
            self._workers[name] = ThreadPoolExecutor(1, f"scroll-tactile {name}")
        return self._workers[name]

    def settle(self, ledger: Ledger) -> Model:
        """The model fitted to the present memory: a function of the set of observations alone."""
        memory = ledger.memory
        self.take_in(ledger)
        if self._model is None or self._behind != [] or not self._exact:
            self._model, self._fit, self._renewal = None, None, None
            self._reading = self._extractor  # the fitted model uses nothing that was read from the disk
            self._model, self._behind = self._fitted(memory), []
        return self._model

    def examined(self, ledger: Ledger) -> Model:
        """A copy of the present model, with the scores of its sampled touches, each held out."""
        model = self._present(ledger)
        if model.fusion is None or self._exact:
            return model.copy()
        return examined(model, ledger.memory)

    def close(self) -> None:
        """End the threads; a later prediction starts new ones if it needs them."""
        workers, self._workers = self._workers, {}
        for worker in workers.values():
            worker.shutdown()

    def take_in(self, ledger: Ledger) -> None:
        """Take the changes of the memory since the last call into `_behind` and the jobs."""
        if self._process != os.getpid():  # a forked process has not the threads
            self._process, self._workers, self._fit, self._renewal = os.getpid(), {}, None, None
        if ledger.version == self._version:
            return
        self._exact = False  # of an axis, a touch without a label changes the samples alone
        added = ledger.added if self._model is not None else None
        # None until all changes are noted: if this is interrupted, a touch could be noted twice, or never.
        behind, jobs = self._behind, (self._fit, self._renewal)
        self._behind, self._fit, self._renewal = None, None, None
        self._version = ledger.version
        ledger.follow, ledger.added = True, []
        if added is not None:
            for job in jobs:
                if job is not None:
                    job.since = _with(job.since, added)
            self._behind, (self._fit, self._renewal) = _with(behind, added), jobs

    def _due(self, model: Model, memory: Memory) -> bool:
        """Whether the model is to be replaced: it is out of date, and the next is ready or worth waiting for."""
        late = abs(memory.statistics.touches - model.fitted_to) >= max(LEAST, ADOPT * model.fitted_to // 16)
        if late and model.fitted_to <= FEW:
            return True
        if self._fit is not None and self._fit.future.done() and not self._fit.ready:
            self._fit = None  # it failed, or too many touches came since: another is begun
        # Before the readouts are full: otherwise two models would be in memory most of the time.
        nearly_full = any(readout.nearly_full for readout in model.readouts.values())
        ready = nearly_full and self._renewal is not None and self._renewal.ready
        return ready or (late and self._fit is not None and self._fit.ready)

    def _next(self, memory: Memory, before: Model | None) -> Model:
        """The model that replaces the one before: fitted by a thread, or with its readouts solved again."""
        fit, renewal = self._fit, self._renewal
        if fit is not None and fit.ready:
            self._fit = None
            model, since = fit.future.result(), fit.since or []
            late = abs(memory.statistics.touches - model.fitted_to) >= LEAST and model.fitted_to <= FEW
            if not late and model.follow(memory, since):
                self._exact, self._renewal = fit.version == self._version, None
                return model
        if before is None or before.fitted_to <= FEW or not _has_all_of(memory, before):
            self._fit = self._renewal = None
            return self._fitted(memory)
        if renewal is not None and renewal.since is not None:
            self._renewal = None
            if renewal.future.exception() is None:  # may wait, but less long than solving them here takes
                model = renewal.future.result()
                if model.follow(memory, renewal.since):
                    self._exact = False
                    return model
        self._exact, self._renewal = False, None
        model = Renewal.of(before, memory).solve()
        return model if model.follow(memory, []) else self._fitted(memory)

    def _fitted(self, memory: Memory) -> Model:
        model = Draft.of(memory, self._kind).fit(self._reading)
        self._exact = True
        return model

    def composer(self, ledger: Ledger, model: Model) -> Composer:
        """The heads of all constituents that were described, over a model of this memory."""
        if model.fusion is not None and not model.held_out:  # a stored model has no held-out touches, which heads need
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


def _has_all_of(memory: Memory, model: Model) -> bool:
    """Whether all materials of a model are in the memory."""
    return model.known <= memory.statistics.materials.keys()


def _with(touches: list[Added] | None, more: Sequence[Added]) -> list[Added] | None:
    """The list extended by more touches; None if it would be too long."""
    if touches is None or len(touches) + len(more) > MOST_BEHIND:
        return None
    touches.extend(more)
    return touches
