"""The model of a memory as it is now: followed from touch to touch, and fitted again beside, so that no call waits.

Right after an observation the readouts are those of all that was observed (see `readouts.readout`). They can follow so
many touches; before that many have come a thread solves them again, from the integers. What else is fitted, the
shrinkage and the table, follows when the memory has grown by three sixteenths: a sixteenth before, another thread
begins to fit it. No call waits for that one, but in the smallest of memories, where each touch counts: touches that
come faster than it fits have an earlier calibration a little longer.

A writer keeps the model beside its last checkpoint, and who opens the memory then reads it. It cannot follow (see
`prediction.stored`): when touches come or go its readouts are solved again.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any
from weakref import ReferenceType, ref

import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import Added
from scroll_tactile.persistence.ledger import Ledger
from scroll_tactile.persistence.open_memory import give_back_scratch
from scroll_tactile.prediction.composition import Composer
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.fitting import Draft, Renewal
from scroll_tactile.prediction.model import Model
from scroll_tactile.prediction.stored import NAME, banks_to_arrays, model_from, model_to_arrays, with_banks
from scroll_tactile.settings import Settings
from scroll_tactile.validation.gate import WRONG
from store import StoreError

logger = logging.getLogger(__name__)

__all__ = ["CurrentModel", "FrozenModel"]

BEGIN, ADOPT = 2, 3  # sixteenths of the touches that a model was fitted to: then the next is begun, and answers
LEAST = 2  # touches, in the smallest of memories
FEW = 16  # touches: of a memory with no more the calibration is worth waiting for
MOST_BEHIND = 256  # touches: their codes are kept, and more of them could hardly be followed


class FrozenModel:
    """Holds a model as it is, whatever is observed meanwhile: a copy is followed, for as long as somebody has this."""

    def __init__(self, model: Model) -> None:
        self.model = model


@dataclass
class _Job:
    """A model that a thread makes, and what came since it was begun; None where that was too much to be followed."""

    future: Future[Model]
    since: list[Added] | None = field(default_factory=list)

    @property
    def ready(self) -> bool:
        """Whether it is there, and can be followed to the memory as it is."""
        return self.since is not None and self.future.done() and self.future.exception() is None


class CurrentModel:
    """The model of one memory. Whoever calls holds the ledger's lock."""

    def __init__(self, settings: Settings, extractor: FeatureExtractor) -> None:
        self._kind, self._extractor, self._reading = settings.readout, extractor, extractor
        self._version = -1
        self._model: Model | None = None
        self._stored: Model | None = None  # the model as it was read
        self._looked = False  # whether there is any
        self._exact = False  # whether the model was fitted to the memory as it is, here, and not followed
        self._behind: list[Added] | None = []  # what came since the model; None where it cannot be followed
        self._fit: _Job | None = None
        self._renewal: _Job | None = None
        self._workers: dict[str, ThreadPoolExecutor] = {}
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
        present = self._present(ledger)
        self.prepare(ledger)
        return present

    def _present(self, ledger: Ledger) -> Model:
        memory = ledger.memory  # first: reading it again after a change that was cut short counts as a version
        self._look(ledger)
        self.take_in(ledger)
        # Until the model is whole again: following that is cut short leaves it between two states.
        (model, behind), (self._model, self._behind) = (self._model, self._behind), (None, None)
        before = model
        if model is not None and (behind is None or self._due(model, memory)):
            model = None
        if model is not None and behind:
            self._exact = False
            # In place where nobody holds it: to copy one takes as long as half a prediction.
            model = model.copy() if self._holder(model) is not None else model
            if not model.follow(memory, behind):
                model = None
        present = self._next(memory, before) if model is None else model
        self._model, self._behind = present, []
        return present

    def reading(self, ledger: Ledger) -> FeatureExtractor:
        """The extractor that reads the touches to be predicted: it may have its banks from the disk."""
        self._look(ledger)
        self.take_in(ledger)
        return self._reading

    def disbelieve(self) -> None:
        """Let go what was read: its banks give other features than the memory was made with."""
        self._reading, self._model, self._stored = self._extractor, None, None
        self._fit = self._renewal = None

    def _look(self, ledger: Ledger) -> None:
        """Begin with the model that was kept of the memory, where there is one."""
        if self._looked or self._model is not None:
            return
        self._looked, memory = True, ledger.memory
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

    def kept(self, ledger: Ledger) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]] | None:
        """What `prediction.stored` writes of the model that would answer now; None where there is none.

        None, too, where one was read and nothing has changed since, and of a small memory that has no present one.
        """
        memory, model = ledger.memory, self._model
        self.close()  # what the threads make is there then
        self.take_in(ledger)
        if model is None or (model is self._stored and self._behind == [] and not ledger.saved_since(memory)):
            return None
        if self._behind != [] and model.fitted_to <= FEW:
            return None
        if (made := model_to_arrays(self._present(ledger))) is None:
            return None
        return made[0] | banks_to_arrays(self._reading.embedding), made[1]

    def prepare(self, ledger: Ledger) -> None:
        """Begin to make the next model where enough has come since the last. Raises nothing: an observation is kept."""
        self.take_in(ledger)
        model, memory = self._model, ledger.memory
        if model is None:
            return
        lag = abs(memory.statistics.touches - model.fitted_to)
        # Where there is no memory or no thread for it, or the ridge has too many materials, a prediction says so.
        with suppress(MemoryError, InputError, RuntimeError):
            if self._fit is None and lag >= max(LEAST // 2, BEGIN * model.fitted_to // 16):
                self._fit = _Job(self._worker("fit").submit(Draft.of(memory, self._kind).fit, self._reading))
            if self._renewal is None and self._behind and model.crowded(self._behind) and _has_all_of(memory, model):
                self._renewal = _Job(self._worker("renewal").submit(Renewal.of(model, memory).solve))

    def _worker(self, name: str) -> ThreadPoolExecutor:
        if name not in self._workers:
            self._workers[name] = ThreadPoolExecutor(1, f"scroll-tactile {name}")
        return self._workers[name]

    def settle(self, ledger: Ledger) -> Model:
        """The model that is fitted to the memory as it is: a function of what was observed, and of nothing else."""
        memory = ledger.memory
        self.take_in(ledger)
        if self._model is None or self._behind != [] or not self._exact:
            self._model, self._fit, self._renewal = None, None, None
            self._reading = self._extractor  # nothing of it rests on what was read
            self._model, self._behind = self._fitted(memory), []
        return self._model

    def close(self) -> None:
        """End the threads; a later prediction begins others where it needs them."""
        workers, self._workers = self._workers, {}
        for worker in workers.values():
            worker.shutdown()

    def take_in(self, ledger: Ledger) -> None:
        """Note what has changed since it was last noted."""
        if self._process != os.getpid():  # a forked process has not the threads
            self._process, self._workers, self._fit, self._renewal = os.getpid(), {}, None, None
        if ledger.version == self._version:
            return
        if self._model is not None and self._holder(self._model) is None:
            self._model.read(ledger.memory.statistics)  # lets a snapshot go, which would keep all that changes
        added = ledger.added if self._model is not None else None
        # Until all is noted nothing can be followed: cut short in between, it would be noted twice, or never.
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
        """Whether another model takes its place: it is late, and the next is there or worth waiting for."""
        late = abs(memory.statistics.touches - model.fitted_to) >= max(LEAST, ADOPT * model.fitted_to // 16)
        if late and model.fitted_to <= FEW:
            return True
        if self._fit is not None and self._fit.future.done() and not self._fit.ready:
            self._fit = None  # it cannot be followed: another is begun
        # Not only where it can follow no further: until then two models would be held most of the time.
        pressed = any(readout.pressed for readout in model.readouts.values())
        ready = pressed and self._renewal is not None and self._renewal.ready
        return ready or (late and self._fit is not None and self._fit.ready)

    def _next(self, memory: Memory, before: Model | None) -> Model:
        """The model that takes the place of the one before: as a thread fitted it, or with readouts solved again."""
        fit, renewal = self._fit, self._renewal
        if fit is not None and fit.ready:
            self._fit = None
            model, since = fit.future.result(), fit.since or []
            late = abs(memory.statistics.touches - model.fitted_to) >= LEAST and model.fitted_to <= FEW
            if not late and model.follow(memory, since):
                self._exact, self._renewal = not since, None
                return model
        if before is None or before.fitted_to <= FEW or not _has_all_of(memory, before):
            self._fit = self._renewal = None
            return self._fitted(memory)
        if renewal is not None and renewal.since is not None:
            self._renewal = None
            if renewal.future.exception() is None:  # it waits, for a part of what solving them here takes
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
        if model.fusion is not None and not model.held_out:  # it was read, and heads rest on touches held out
            model = self.settle(ledger)
        state = model, ledger.version, ledger.described
        if self._composer is None or self._composer[:3] != state:
            self._composer = *state, Composer.of(model, ledger.memory)
        return self._composer[3]


def _has_all_of(memory: Memory, model: Model) -> bool:
    """Whether all materials of a model are in the memory."""
    return model.known <= memory.statistics.materials.keys()


def _with(touches: list[Added] | None, more: Sequence[Added]) -> list[Added] | None:
    """The list with some more in it; None where it would be too long."""
    if touches is None or len(touches) + len(more) > MOST_BEHIND:
        return None
    touches.extend(more)
    return touches
