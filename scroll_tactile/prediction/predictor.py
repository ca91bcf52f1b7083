"""The predictor: it answers from one open memory, which other threads may change meanwhile.

After a fit class means, kept touches and materials follow at once; scatter and weighing stay as they were: measured
right as often as a fit of all touches. When the memory has changed by an eighth, a thread fits again, from a copy of
the sums. In memories of at most FEW touches, and where touches came much faster than fits, a call waits.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol, Self

import numpy as np
import numpy.typing as npt
from scroll_tactile_store import Store

from scroll_tactile.embeddings.protocol import Embedding, capabilities_of
from scroll_tactile.embeddings.registry import configuration_of
from scroll_tactile.errors import AnnotationError, InputError
from scroll_tactile.memory.descriptions import require_constituents
from scroll_tactile.memory.gate import MemoryStore, finish_interrupted, open_memory
from scroll_tactile.memory.identity import Identity
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import Codes
from scroll_tactile.memory.tuned import Tuned
from scroll_tactile.persistence.ledger import Ledger
from scroll_tactile.persistence.ram_store import AnyStore, RamStore
from scroll_tactile.persistence.reembed import Reembedding
from scroll_tactile.persistence.replaying import exemplar_candidates
from scroll_tactile.prediction.composition import Composer
from scroll_tactile.prediction.features import Encoded, FeatureExtractor, Readings
from scroll_tactile.prediction.fitting import Draft
from scroll_tactile.prediction.judging import answer, estimates_of
from scroll_tactile.prediction.model import Model, enough_memory
from scroll_tactile.prediction.stored import read_weighing, weighing_text
from scroll_tactile.readouts.estimation import Estimator
from scroll_tactile.recipe import Recipe, RecipeRequest, default_kept_touches
from scroll_tactile.results import Composition, Constituent, Estimate, Prediction
from scroll_tactile.settings import Settings, candidates_of
from scroll_tactile.signals.stream import Stream
from scroll_tactile.signals.windows import Scale

__all__ = ["LogitsReader", "Predictor", "embed_again", "nothing_known", "reembed_memory"]

logger = logging.getLogger(__name__)

GROWTH = 8  # a fit begins when the memory has changed by one in so many touches
LEAST = 2  # touches by which it has changed at least
FEW = 16  # touches: in a memory with no more, a call waits for the fit
FASTER = 2  # times the touches of the last fit: where there are more, or fewer than their share, a call waits


@dataclass
class _Fit:
    """A model, and what changed since its fit began; beside a fit in a thread the model before it.

    version, retractions: of the memory then. changed: the materials that changed since; None where any may have.
    """

    model: Model
    version: int
    retractions: int
    changed: set[str] | None = field(default_factory=set)


class LogitsReader(Protocol):
    """What reads touches with a tuned model."""

    tuned: Tuned

    def logits_of(self, image: npt.NDArray[np.float32], candidates: Sequence[str]) -> Mapping[str, float] | None:
        """The logits of a touch; None where the tuned model cannot answer."""


class Predictor:
    """All objects of one open memory: its feature extractor, its ledger and its model; it answers from them.

    recipe: of the memory. axis: of labels, by which it answers; "" for materials. tuned_reader: made when a tuned model
    first answers. replaced: whether the memory was embedded again since; then another predictor has it.
    """

    def __init__(self, recipe: Recipe, extractor: FeatureExtractor, ledger: Ledger, axis: str = "") -> None:
        self.recipe, self.extractor, self.ledger, self.axis = recipe, extractor, ledger, axis
        self.tuned_reader: LogitsReader | None = None
        self.replaced = False
        self._axes: dict[str, Predictor] = {}
        self._fit: _Fit | None = None  # its model follows the memory
        self._job: tuple[Future[Model], _Fit] | None = None  # in the thread
        self._version = -1  # of the memory up to which changes are noted
        self._worker: ThreadPoolExecutor | None = None
        self._process = os.getpid()
        self._composer: tuple[Model, int, Composer] | None = None
        self._estimator: Estimator | None = None

    @classmethod
    def new(cls, recipe: Recipe) -> Self:
        """Of an empty memory without a path. Raises InputError for an embedding that does not read the sensor."""
        return cls._of(recipe, _extractor(recipe), RamStore(recipe))

    @classmethod
    def open(
        cls, path: str | os.PathLike[str], request: RecipeRequest, mode: Literal["write", "read"] = "write"
    ) -> Self:
        """Of the memory in a folder. Raises as `TactileLearner.open`."""
        store, identity, recipe = open_memory(path, request, mode)
        try:
            check = partial(identity.require_embedding, store.path) if request.embedding is None else None
            return cls._of(recipe, _extractor(recipe, check), store, identity.embedding.configuration is not None)
        except BaseException:
            store.close()
            raise

    @classmethod
    def of_snapshot(cls, state: Mapping[str, Any]) -> Self:
        """Of the memory that `snapshot` described, in memory only."""
        return cls._of(state["recipe"], _extractor(state["recipe"], state["check"]), state["store"])

    @classmethod
    def _of(cls, recipe: Recipe, extractor: FeatureExtractor, store: AnyStore, known: bool | None = None) -> Self:
        """Of the memory in a store. known: whether the memory says how its embedding is made; None: it is asked."""

        def encode(readings: npt.NDArray[np.float32]) -> Codes:
            return extractor.learned(Stream(recipe.sensor, readings))[1]

        exact = capabilities_of(recipe.embedding).exact
        bare = exact and (configuration_of(recipe.embedding) is not None if known is None else known)
        return cls(recipe, extractor, Ledger(Memory(recipe, encode if exact else None), store, bare))

    def snapshot(self) -> dict[str, Any]:
        """All that the memory knows at this moment, to be pickled; its touches are compacted there."""
        with self.ledger.lock:
            store, memory = self.ledger.store, self.ledger.memory
            arrays, attributes = memory.to_arrays(memory.sequence, exemplar_candidates(memory, store))
            held = RamStore(self.recipe, store.heads())
            held.compact(arrays, last_sequence=memory.sequence, attributes=attributes)
            return {"store": held, "recipe": self.recipe, "check": self.extractor.check}

    def of_axis(self, axis: str) -> Predictor:
        """The predictor of an axis, made when first asked for. Raises AnnotationError where no touch has a label."""
        with self.ledger.lock:
            axes = self.ledger.memory.targets.axes
            if axis not in axes:
                raise AnnotationError(
                    f"expected an axis that touches have labels on, out of {sorted(axes)}; came {axis!r:.60}"
                )
            if axis not in self._axes:
                self._axes[axis] = Predictor(self.recipe, self.extractor, self.ledger, axis)
            return self._axes[axis]

    @property
    def memory(self) -> Memory:
        """The memory that it answers from, as it is now; of an axis that of its labels."""
        return self.ledger.memory_of(self.axis)

    def stream(self, readings: Readings) -> Stream:
        """The validated stream of readings, through the correction of a changed skin; raises as the extractor's."""
        stream, correction = self.extractor.stream(readings), self.ledger.correction
        return stream if correction is None else correction.applied(stream)

    def predict(
        self,
        streams: Sequence[Readings],
        scene: Sequence[str] | None,
        reader_of: Callable[[Predictor], LogitsReader | None] | None = None,
    ) -> Prediction:
        """As `TactileLearner.predict`. reader_of: makes the reader of f*; None if f* is not to answer."""
        if not streams:
            raise InputError("expected a stream to predict, or several of one thing; came none")
        touches = [self.stream(stream) for stream in streams]
        with enough_memory():
            model = self.present()
            reader = None if reader_of is None else reader_of(self)
            candidates = candidates_of(scene, model.names, model.known)
            if not candidates:
                return nothing_known(math.fsum({touch.key: touch.seconds for touch in touches}.values()))
            encoded = []
            for touch in touches:
                own = self.extractor.encode(touch, model.longest, partial(model.scales_for, candidates))
                if reader is not None and model.is_last(own.steps):
                    own = replace(own, logits=reader.logits_of(own.image, candidates))
                encoded.append(own)
            return self.answer_of(model, candidates, encoded)

    def compose(self, readings: Readings, constituents: Sequence[str] | None, unfamiliar: float) -> Composition:
        """As `TactileLearner.compose`."""
        touch = self.stream(readings)
        with enough_memory():
            model = self.present()
            with self.ledger.lock:
                wanted = require_constituents(self.ledger.memory.descriptions, constituents)
                composer = self._composed_by() if model.names else None
            if composer is None:
                nothing = Constituent("", presence=None, share=None, evidence=(), unlearned="nothing was observed yet")
                parts = tuple(replace(nothing, name=name) for name in wanted)
                return Composition(parts, 1.0, nothing_known(touch.seconds))
            encoded, prediction = self._among_all(composer.model, touch, composer)
            made_of, new = composer.compose(wanted, dict(prediction.ranking), encoded, unfamiliar)
            return Composition(made_of, new, prediction)

    def estimate(
        self, readings: Readings, wanted: Sequence[str] | None, risk: float, known: bool | None
    ) -> dict[str, Estimate]:
        """As `TactileLearner.estimate`."""
        touch = self.stream(readings)
        with enough_memory():
            model = self.present()
            estimator, encoded, prediction = self.estimator(), None, nothing_known(touch.seconds)
            names = estimator.wanted(wanted)
            if model.names:
                encoded, prediction = self._among_all(model, touch, estimator)
            return estimates_of(estimator, names, encoded, self.extractor, prediction, risk, known)

    def _among_all(self, model: Model, touch: Stream, beside: Composer | Estimator) -> tuple[Encoded, Prediction]:
        """A touch, and its prediction among all materials. beside: what else reads some scales of it."""

        def scales_for(steps: int) -> list[Scale]:
            return sorted({*beside.scales_for(steps), *model.scales_for(model.names, steps)})

        encoded = self.extractor.encode(touch, model.longest, scales_for)
        return encoded, self.answer_of(model, model.names, [encoded])

    def estimator(self) -> Estimator:
        """What estimates quantities in the present memory; it keeps its heads while the sampled touches stay."""
        with self.ledger.lock:
            memory = self.memory
            least = max(1, memory.statistics.fifth_percentile_length)
            self._estimator = Estimator.of(memory.plan, memory.sample, memory.quantities, least, self._estimator)
            return self._estimator

    def present(self) -> Model:
        """The model of the present memory, which never changes. Raises EmbeddingMismatchError."""
        self.extractor.verified()
        with self.ledger.lock, enough_memory():
            memory = self.memory  # first: after an interrupted change this reads the memory again, a new version
            self._note_changes()
            fit = self._fit
            if self._job is not None and self._job[0].done():
                (future, job), self._job = self._job, None
                if future.exception() is None and job.changed is not None:
                    job.model, fit = future.result(), job
            elif fit is None:
                fit = self._restored()
            elif fit.changed == set():
                return fit.model
            self._fit = None  # an interrupted call leaves no model
            if fit is None or (model := _followed(fit, memory)) is None:
                return self._fit_now(None if fit is None else fit.model)
            self._fit = _Fit(model, fit.version, fit.retractions)
            self._begin_fit()
            return model

    def answer_of(self, model: Model, candidates: Sequence[str], touches: Sequence[Encoded]) -> Prediction:
        """The prediction of a model for touches of one thing."""
        with enough_memory():
            return answer(model, self.extractor, candidates, touches, self.recipe.settings.false_alarms)

    def settle(self) -> None:
        """As `TactileLearner.settle`."""
        with self.ledger.lock, enough_memory():
            self.ledger.memory.weighings.clear()  # an axis that is asked later is fitted, too
            for predictor in (self, *self._axes.values()):
                predictor._settled()

    def _settled(self) -> Model:
        """The model fitted to the present memory: a function of the set of observations alone."""
        self._note_changes()
        if self._fit is None or self._fit.version != self._version:
            return self._fit_now(None if self._fit is None else self._fit.model)
        return self._fit.model

    def prepare(self) -> None:
        """Begin to fit models anew where enough touches came since the last fit; called after an observation."""
        with self.ledger.lock:
            for predictor in (self, *self._axes.values()):
                predictor._note_changes()
                predictor._begin_fit()

    def _note_changes(self) -> None:
        """Have the model and the fit under way know what changed since the last call."""
        if self._process != os.getpid():  # a forked process has not the thread
            self._process, self._worker, self._job = os.getpid(), None, None
        if self.ledger.version == self._version:
            return
        changed = self.ledger.changed_since(self._version, self.axis)
        for fit in (self._fit, self._job and self._job[1]):
            if fit is not None:
                fit.changed = None if fit.changed is None or changed is None else fit.changed | changed
        self._version = self.ledger.version  # last: cut short before, they are noted again

    def _begin_fit(self) -> None:
        """Begin a fit if enough touches came or went. A lack of memory or threads raises nothing here."""
        if self._fit is None or self._job is not None:
            return
        model, memory = self._fit.model, self.memory
        fitted = 0 if model.weighing is None else model.weighing.touches
        if abs(memory.statistics.touches - fitted) < max(LEAST, fitted // GROWTH):
            return
        # Lack of memory or threads, or too many materials for the ridge: the next prediction raises the error.
        with suppress(MemoryError, InputError, RuntimeError):
            draft = Draft.of(memory, self.recipe.settings.readout, model)
            self._worker = self._worker or ThreadPoolExecutor(1, "scroll-tactile fit")
            self._job = self._worker.submit(draft.fit), _Fit(model, self._version, memory.retractions)

    def _restored(self) -> _Fit | None:
        """The model by the weighing of the checkpoint that the memory was read from, if it has one that fits."""
        if (text := self.ledger.memory.weighings.pop(self.axis, None)) is None:
            return None
        memory = self.memory
        try:
            model = read_weighing(text, Draft.of(memory, self.recipe.settings.readout).solved())
        except ValueError as error:
            logger.warning("the weighing in the memory's checkpoint is not used, and fitted anew: %.300s", error)
            return None
        return _Fit(model, -1, memory.retractions)

    def _fit_now(self, before: Model | None) -> Model:
        self._fit, self._job, memory = None, None, self.memory
        model = Draft.of(memory, self.recipe.settings.readout, before).fit()
        self._fit = _Fit(model, self._version, memory.retractions)
        return model

    def _composed_by(self) -> Composer:
        """The heads of all constituents that were described, over a model of the present memory."""
        model = self.present()
        if not model.knows_sample:
            model = self._settled()
        if self._composer is None or self._composer[:2] != (model, self.ledger.version):
            self._composer = model, self.ledger.version, Composer.of(model, self.ledger.memory)
        return self._composer[2]

    def close(self) -> None:
        """As `TactileLearner.close`."""
        with self.ledger.lock:
            weighings = {}
            for axis, predictor in {"": self, **self._axes}.items():
                worker, predictor._worker = predictor._worker, None
                if worker is not None:
                    worker.shutdown()
                # Where something was retracted since, what it was fitted to counts no more.
                fit, now = predictor._fit, self.ledger.memory.retractions
                if fit is not None and fit.retractions == now and (text := weighing_text(fit.model)):
                    weighings[axis] = text
            self.ledger.close(weighings)

    def fitted(self) -> Model:
        """As `TactileLearner.model`."""
        with self.ledger.lock, enough_memory():
            return Draft.of(self.memory, self.recipe.settings.readout).fit()


def _followed(fit: _Fit, memory: Memory) -> Model | None:
    """A fit's model with what changed since; None where a call waits for another fit."""
    weighing, now = fit.model.weighing, memory.statistics.touches
    fitted = 0 if weighing is None else weighing.touches
    outgrown = not fitted <= FASTER * now <= FASTER * FASTER * fitted
    if fitted <= FEW:
        outgrown = abs(now - fitted) >= min(LEAST, fitted + 1)
    return None if outgrown or fit.changed is None else fit.model.followed(memory, fit.changed)


def reembed_memory(
    path: str | os.PathLike[str],
    embedding: Embedding | None = None,
    *,
    progress: Callable[[str, int, int], object] | None = None,
) -> Path:
    """As `TactileLearner.reembed`, with the memory in a folder, also where its own embedding is not at hand."""
    finish_interrupted(Path(path))
    with MemoryStore.open(path) as store:
        carried = _reembedding(store, embedding)
        try:
            carried.copy(progress or (lambda what, done, of: None))
            return carried.put_in_place()
        finally:
            carried.close()


def embed_again(
    predictor: Predictor, embedding: Embedding | None, progress: Callable[[str, int, int], object]
) -> tuple[Path, Predictor]:
    """As `TactileLearner.reembed`; also returns the predictor of the new memory."""
    ledger = predictor.ledger
    with ledger.lock:  # not in the midst of another thread's batch
        store = ledger.require_folder("be embedded again")
        ledger.require_writing()
    carried = _reembedding(store, embedding)
    try:
        carried.copy(progress)
        with ledger.lock:
            ledger.require_writing()
            carried.copy(progress)
            ledger.saves = False  # nothing more is written to the old one, which a full disk could stop half-way
            predictor.close()
            before = carried.put_in_place()
            for each in (predictor, *predictor._axes.values()):
                each.replaced = True
            settings = predictor.recipe.settings.model_copy(update={"exemplars": None, "kept_touches": None})
            return before, Predictor.open(store.path, RecipeRequest(None, carried.recipe.embedding, settings))
    finally:
        carried.close()


def _reembedding(store: Store, embedding: Embedding | None) -> Reembedding:
    """The re-embedding of the memory in a store. embedding: None for its own, made again."""
    made = Identity.read(store)
    chosen = made.own_embedding(store.path) if embedding is None else embedding
    # As many kept touches as the memory was made with, also none; for the default the new recipe's default.
    default = made.kept_touches == default_kept_touches(made.sensor, views=bool(made.views))
    kept = Settings(exemplars=made.exemplars, kept_touches=None if default else made.kept_touches)
    recipe = Recipe.of(made.sensor, chosen, kept)
    extractor = _extractor(recipe)
    return Reembedding(store, recipe, lambda readings: extractor.learned(Stream(recipe.sensor, readings)))


def _extractor(recipe: Recipe, check: Callable[..., None] | None = None) -> FeatureExtractor:
    return FeatureExtractor(recipe.sensor, recipe.embedding, recipe.plan, check)


def nothing_known(seconds: float) -> Prediction:
    """The prediction for so many seconds of touch without any candidate."""
    return Prediction(material=None, probability=0.0, ranking=(), novelty=math.inf, known=False, seconds=seconds)
