"""The predictor: it answers from one open memory, which other threads may change meanwhile."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal, Protocol, Self, TypeVar

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.protocol import capabilities_of
from scroll_tactile.errors import AnnotationError, InputError
from scroll_tactile.memory.descriptions import require_constituents
from scroll_tactile.memory.identity import FingerprintCheck
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import Codes
from scroll_tactile.memory.tuned import Tuned
from scroll_tactile.persistence.contents import ListedContents
from scroll_tactile.persistence.ledger import AxisLedger, Ledger
from scroll_tactile.persistence.replaying import exemplar_candidates, load
from scroll_tactile.prediction.composition import Composer
from scroll_tactile.prediction.current import CurrentModel
from scroll_tactile.prediction.features import Encoded, FeatureExtractor, Readings
from scroll_tactile.prediction.fitting import Draft
from scroll_tactile.prediction.judging import Touch, answer, estimates_of
from scroll_tactile.prediction.model import Model, enough_memory
from scroll_tactile.readouts.estimation import Estimator
from scroll_tactile.recipe import Recipe, RecipeRequest
from scroll_tactile.results import Composition, Constituent, Estimate, Prediction
from scroll_tactile.settings import candidates_of
from scroll_tactile.signals.correction import corrected_stream
from scroll_tactile.signals.stream import Stream
from scroll_tactile.signals.windows import Scale
from scroll_tactile.validation.gate import open_memory

__all__ = ["LogitsReader", "Predictor", "nothing_known"]

logger = logging.getLogger(__name__)

Answer = TypeVar("Answer")


class LogitsReader(Protocol):
    """What reads touches with a tuned model."""

    tuned: Tuned

    def logits_of(self, image: npt.NDArray[np.float32], candidates: Sequence[str]) -> Mapping[str, float] | None:
        """The logits of a touch; None where the tuned model cannot answer."""


class Predictor:
    """All objects of one open memory: its feature extractor, its ledger and its current model; it answers from them.

    recipe: of the memory. tuned_reader: made when a tuned model first answers. replaced: whether the memory was
    embedded again since; then another predictor has it.
    """

    def __init__(self, recipe: Recipe, extractor: FeatureExtractor, ledger: Ledger) -> None:
        self.recipe, self.extractor, self.ledger = recipe, extractor, ledger
        self.current = CurrentModel(recipe.settings)
        self.tuned_reader: LogitsReader | None = None
        self.replaced = False
        self._axes: dict[str, Predictor] = {}

    @classmethod
    def new(cls, recipe: Recipe) -> Self:
        """Of an empty memory without a path. Raises InputError for an embedding that does not read the sensor."""
        return cls(recipe, _extractor(recipe), Ledger(partial(Memory, recipe), contents=ListedContents()))

    @classmethod
    def open(
        cls, path: str | os.PathLike[str], request: RecipeRequest, mode: Literal["write", "read"] = "write"
    ) -> Self:
        """Of the memory in a folder. Raises as `TactileLearner.open`."""
        store, identity, recipe = open_memory(path, request, mode)
        try:
            extractor = _extractor(
                recipe, FingerprintCheck(identity, store.path) if request.embedding is None else None
            )
            bare = identity.embedding.bare
            encode = partial(_codes_of, extractor) if bare or capabilities_of(recipe.embedding).exact else None
            return cls(recipe, extractor, Ledger(partial(load, Memory(recipe, encode), store), store, bare))
        except BaseException:
            store.close()
            raise

    @classmethod
    def of_snapshot(cls, state: Mapping[str, Any]) -> Self:
        """Of the memory that `snapshot` described, in memory only."""
        recipe: Recipe = state["recipe"]
        ledger = Ledger(lambda: Memory(recipe).fill(*state["held"]), contents=state["contents"])
        return cls(recipe, _extractor(recipe, state["check"]), ledger)

    def snapshot(self) -> dict[str, Any]:
        """All that the memory knows at this moment, to be pickled."""
        with self.ledger.lock:
            memory = self.ledger.memory
            arrays, attributes = memory.to_arrays(candidates=exemplar_candidates(memory, self.ledger.store))
            held = arrays, attributes, memory.sequence
            made_with = {"recipe": self.recipe, "check": self.extractor.check}
            return made_with | {"held": held, "contents": self.ledger.copied_contents()}

    def of_axis(self, axis: str) -> Predictor:
        """The predictor of an axis of labels, made when it is first asked for.

        Raises AnnotationError where no touch has a label on it.
        """
        with self.ledger.lock:
            axes = self.ledger.memory.targets.axes
            if axis not in axes:
                raise AnnotationError(
                    f"expected an axis that touches have labels on, out of {sorted(axes)}; came {axis!r:.60}"
                )
            if axis not in self._axes:
                self._axes[axis] = Predictor(self.recipe, self.extractor, AxisLedger(self.ledger, axis))
            return self._axes[axis]

    def replace(self) -> None:
        """Note that the memory was embedded again, and another predictor has it."""
        for predictor in (self, *self._axes.values()):
            predictor.replaced = True

    def stream(self, readings: Readings) -> Stream:
        """The validated stream of some readings, read through the correction of the memory, if its skin changed.

        Raises as `FeatureExtractor.stream`.
        """
        return corrected_stream(self.extractor.stream(readings), self.ledger.correction)

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

        def begin(model: Model) -> Callable[[], Prediction]:
            reader = None if reader_of is None else reader_of(self)
            candidates = candidates_of(scene, model.names, model.known)
            if not candidates:
                return partial(nothing_known, math.fsum({touch.key: touch.seconds for touch in touches}.values()))

            def read(touch: Stream) -> Touch:
                encoded = self.extractor.encode(touch, model.longest, lambda steps: model.scales_for(candidates, steps))
                if reader is None or not model.is_last(encoded.steps):
                    return encoded, None
                return encoded, reader.logits_of(encoded.image, candidates)

            return lambda: self._answer(model, candidates, [read(touch) for touch in touches])

        return self._of_one_state(begin)

    def compose(self, readings: Readings, constituents: Sequence[str] | None, unfamiliar: float) -> Composition:
        """As `TactileLearner.compose`."""
        touch = self.stream(readings)

        def begin(model: Model) -> Callable[[], Composition]:
            wanted = require_constituents(self.ledger.memory.descriptions, constituents)
            if not model.names:
                nothing = tuple(
                    Constituent(name=name, presence=None, share=None, evidence=(), unlearned="nothing was observed yet")
                    for name in wanted
                )
                return lambda: Composition(nothing, 1.0, nothing_known(touch.seconds))
            composer = self.current.composer(self.ledger)
            model = composer.model
            scales_for = _scales_for([(model, model.names)], composer)

            def composed() -> Composition:
                encoded = self.extractor.encode(touch, model.longest, scales_for)
                prediction = self._answer(model, model.names, [(encoded, None)])
                made_of, new = composer.compose(wanted, dict(prediction.ranking), encoded, unfamiliar)
                return Composition(made_of, new, prediction)

            return composed

        return self._of_one_state(begin)

    def estimate(
        self,
        readings: Readings,
        wanted: Sequence[str] | None = None,
        risk: float = 0.1,
        known: bool | None = None,
        *,
        scene: Sequence[str] | None = None,
        axis: str | None = None,
    ) -> tuple[Prediction, dict[str, Estimate]]:
        """As `TactileLearner.predict` and `estimate`, of a touch that is encoded once.

        scene, axis: of the prediction alone; the estimates use a prediction among all materials.
        """
        touch = self.stream(readings)

        def begin(model: Model) -> Callable[[], tuple[Prediction, dict[str, Estimate]]]:
            estimator = self.current.estimator(self.ledger)
            names, by = estimator.wanted(wanted), self if axis is None else self.of_axis(axis)
            other = by.current.present(by.ledger)
            candidates = candidates_of(scene, other.names, other.known)
            scales_for = _scales_for([(model, model.names), (other, candidates)], estimator)

            def estimated() -> tuple[Prediction, dict[str, Estimate]]:
                nothing = nothing_known(touch.seconds)
                if not model.names:
                    return nothing, estimates_of(estimator, names, None, self.extractor, nothing, risk, known)
                encoded = self.extractor.encode(touch, model.longest, scales_for)
                prediction = self._answer(model, model.names, [(encoded, None)])
                found = estimates_of(estimator, names, encoded, self.extractor, prediction, risk, known)
                if by is not self or candidates != model.names:
                    if other.longest != model.longest:
                        encoded = self.extractor.encode(touch, other.longest, scales_for)
                    prediction = by.answer_of(other, candidates, [encoded]) if candidates else nothing
                return prediction, found

            return estimated

        return self._of_one_state(begin)

    def _of_one_state(self, begin: Callable[[Model], Callable[[], Answer]]) -> Answer:
        """An answer from one state of the memory, which others may change while a touch is embedded.

        begin: called with the lock held; reads from the memory, and returns a function that embeds the touch and
        answers, which is called without the lock.
        """
        with self.extractor.verifying(), enough_memory():
            with self.ledger.lock:
                answered = begin(self.current.present(self.ledger))
            return answered()

    def _answer(self, model: Model, candidates: Sequence[str], touches: Sequence[Touch]) -> Prediction:
        return answer(model, self.extractor, candidates, touches, self.recipe.settings.false_alarms)

    def estimator(self) -> Estimator | None:
        """What estimates quantities in the present memory; None where none was declared."""
        with self.ledger.lock:
            return self.current.estimator(self.ledger) if self.ledger.memory.quantities else None

    def present(self) -> Model:
        """The model of the present memory, which never changes."""
        with self.ledger.lock, enough_memory():
            return self.current.present(self.ledger)

    def rehearsed(self) -> Model:
        """As `present`, for live sessions: with what `fitting.rehearse` finds."""
        with self.ledger.lock, enough_memory():
            return self.current.rehearsed(self.ledger)

    def answer_of(self, model: Model, candidates: Sequence[str], touches: Sequence[Encoded]) -> Prediction:
        """The prediction of a model for touches of one thing."""
        with enough_memory():
            return self._answer(model, candidates, [(touch, None) for touch in touches])

    def settle(self) -> None:
        """As `TactileLearner.settle`."""
        with self.ledger.lock, enough_memory():
            self.ledger.memory.weighings.clear()  # an axis that is asked later is fitted, too
            for predictor in (self, *self._axes.values()):
                predictor.current.settle(predictor.ledger)

    def prepare(self) -> None:
        """Begin to fit models anew where enough touches came since the last fit; called after an observation."""
        with self.ledger.lock:
            for predictor in (self, *self._axes.values()):
                predictor.current.prepare(predictor.ledger)

    def close(self) -> None:
        """As `TactileLearner.close`."""
        with self.ledger.lock:
            predictors = {"": self, **self._axes}
            for predictor in predictors.values():
                predictor.current.close()
            texts = {axis: predictor.current.stored(predictor.ledger) for axis, predictor in predictors.items()}
            weighings = {axis: text for axis, text in texts.items() if text is not None}
            self.ledger.close(weighings)

    def fitted(self) -> Model:
        """As `TactileLearner.model`."""
        with self.ledger.lock, enough_memory():
            return Draft.of(self.ledger.memory, self.recipe.settings.readout).fit()


def _extractor(recipe: Recipe, check: FingerprintCheck | None = None) -> FeatureExtractor:
    return FeatureExtractor(recipe.sensor, recipe.embedding, recipe.plan, check)


def _codes_of(extractor: FeatureExtractor, readings: npt.NDArray[np.float32]) -> Codes:
    """The rows of codes of a touch, from readings that the memory stored."""
    return extractor.learned(Stream(extractor.sensor, readings))[1]


def _scales_for(
    queries: Sequence[tuple[Model, Sequence[str]]], beside: Composer | Estimator
) -> Callable[[int], Sequence[Scale]]:
    """Steps → the scales of a touch that models read to choose among candidates, and what rests on it beside them."""

    def scales_for(steps: int) -> list[Scale]:
        judging = (model.scales_for(candidates, steps) for model, candidates in queries if candidates)
        return sorted({*beside.scales_for(steps), *(scale for own in judging for scale in own)})

    return scales_for


def nothing_known(seconds: float) -> Prediction:
    """The prediction for so many seconds of touch without any candidate."""
    return Prediction(material=None, probability=0.0, ranking=(), novelty=math.inf, known=False, seconds=seconds)
