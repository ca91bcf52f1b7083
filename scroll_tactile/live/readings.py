"""The readings of a live session: the last few seconds, and those of the touch under way, with its predictions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import StreamError
from scroll_tactile.live.decision import DecisionRule
from scroll_tactile.prediction.current import FrozenModel
from scroll_tactile.prediction.features import Encoded, FeatureExtractor, WindowCache
from scroll_tactile.prediction.judging import estimates_of
from scroll_tactile.prediction.predictor import Predictor, nothing_known
from scroll_tactile.readouts.estimation import Estimator
from scroll_tactile.results import Estimate, Prediction
from scroll_tactile.signals.correction import Correction, corrected_stream
from scroll_tactile.signals.stream import Stream, validate
from scroll_tactile.signals.windows import Scale

__all__ = ["GrowingTouch", "Recent", "TouchRows", "is_touch"]

Array = npt.NDArray[Any]


class Recent:
    """The last readings, in a ring of so many. shape, dtype: of a reading."""

    def __init__(self, count: int, shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self._ring: Array = np.empty((count, *shape), dtype)
        self._came = 0

    def add(self, rows: Array) -> None:
        """Add readings (k, …)."""
        ring, count = self._ring, len(self._ring)
        place = self._came % count
        self._came += len(rows)
        if len(rows) > count:
            rows, place = rows[-count:], self._came % count
        before_edge = min(len(rows), count - place)
        ring[place : place + before_edge] = rows[:before_edge]
        ring[: len(rows) - before_edge] = rows[before_edge:]

    def clear(self) -> None:
        """Forget them."""
        self._came = 0

    def last(self, wanted: int) -> Array:
        """The last so many, or as many as there are, in their order."""
        count = len(self._ring)
        wanted = min(wanted, self._came, count)
        return self._ring[np.arange(self._came - wanted, self._came) % count]


class TouchRows:
    """The readings of a touch, up to a limit; those beyond it are counted."""

    def __init__(self, first: Array, limit: int) -> None:
        self._room: Array = np.empty((max(64, 2 * len(first)), *first.shape[1:]), first.dtype)
        self._limit = limit
        self.kept = self.came = 0
        self.add(first)

    def add(self, rows: Array) -> None:
        """Add readings (k, …), as far as there is room within the limit."""
        self.came += len(rows)
        kept = min(self.kept + len(rows), self._limit)
        if kept > len(self._room):
            room = np.empty((max(2 * len(self._room), kept), *self._room.shape[1:]), self._room.dtype)
            room[: self.kept] = self._room[: self.kept]
            self._room = room
        self._room[self.kept : kept] = rows[: kept - self.kept]
        self.kept = kept

    def drop(self, count: int) -> None:
        """Take the last so many out again."""
        self.came -= count
        self.kept = min(self.kept, self.came)

    def first(self, count: int) -> Array:
        """The first so many, to be read."""
        return self._room[: min(count, self.kept)]


@dataclass
class GrowingTouch:
    """The touch under way, and what is predicted of it with the model of the memory as it was when it began.

    rows: its readings, of a camera behind the resting image. at: when it began. moments: that are to come, in readings;
    the next is the last of them. before: readings that are no part of it, such as a camera's resting image. earlier:
    the touches of the same thing before it; encoded: they, as its model reads them. estimator: None where no quantity
    was declared. widths: quantity → how narrow its interval is to be. estimates: by quantity, as of `stage`; settled:
    whether every interval was as narrow as it is to be, False where none is asked to be. rest: readings before it.
    correction: through which they are read: that of the memory when the touch began.
    """

    predictor: Predictor
    extractor: FeatureExtractor
    scene: Sequence[str] | None
    rows: TouchRows
    at: float
    frozen: FrozenModel
    rule: DecisionRule
    moments: list[int]
    before: int
    earlier: tuple[Stream, ...] = ()
    estimator: Estimator | None = None
    widths: Mapping[str, float] = field(default_factory=dict)
    cache: WindowCache = field(default_factory=WindowCache)
    encoded: list[Encoded] = field(default_factory=list)
    prediction: Prediction | None = None
    decided: bool = False
    estimates: dict[str, Estimate] = field(default_factory=dict)
    stage: int | None = None
    settled: bool = False
    rest: Array | None = None
    correction: Correction | None = None

    def predict_in_time(self) -> None:
        """Predict at the last moment that the touch has come to, if any is new, until both are what was asked for."""
        moment = 0
        while self.moments and self.moments[-1] <= self.rows.came:
            moment = self.moments.pop()
        if moment:
            with suppress(StreamError):  # too few frames in contact, or all values missing: no prediction yet
                stream = self.beginning(moment)
                if self.prediction is None or not self.decided:
                    self.predict(stream)
                else:  # the prediction stays; what is asked of intervals is not reached yet
                    self._estimate(self._encoded(stream), self.prediction)
        if self.decided and (self.settled or not self.widths):
            self.moments.clear()

    def beginning(self, count: int) -> Stream:
        """The stream of its first readings, corrected. Raises StreamError where they make none."""
        return corrected_stream(self.extractor.stream(self.rows.first(count)), self.correction)

    def rest_before(self) -> Stream | None:
        """What was read at rest before it, corrected; None where that is too little, or nothing but missing values."""
        try:
            rest = None if self.rest is None else validate(self.rest, self.predictor.recipe.sensor)
        except StreamError:
            return None
        return None if rest is None else corrected_stream(rest, self.correction)

    def predict(self, stream: Stream) -> Prediction:
        """The prediction for the beginning of it, as `learner.predict` gives it."""
        model, candidates = self.frozen.model, self._candidates()
        if not candidates:
            seconds = math.fsum({each.key: each.seconds for each in (*self.earlier, stream)}.values())
            self.prediction = nothing_known(seconds)
            return self.prediction
        self.encoded = self.encoded or [self._encoded(each, WindowCache()) for each in self.earlier]
        current = self._encoded(stream)
        self.prediction = self.predictor.answer_of(model, self.extractor, candidates, [*self.encoded, current])
        self.decided |= self.rule.decided(self.prediction, current.steps, several=bool(self.earlier))
        self._estimate(current, self.prediction)
        return self.prediction

    def _candidates(self) -> list[str]:
        model = self.frozen.model
        if self.scene is None:
            return model.names
        return sorted({name for name in self.scene if name in model.known})

    def _encoded(self, stream: Stream, cache: WindowCache | None = None) -> Encoded:
        model, candidates, estimator = self.frozen.model, self._candidates(), self.estimator

        def scales_for(steps: int) -> list[Scale]:
            own = model.scales_for(candidates, steps)
            return own if estimator is None else sorted({*own, *estimator.scales_for(steps)})

        return self.extractor.encode(stream, model.longest, scales_for, self.cache if cache is None else cache)

    def _estimate(self, encoded: Encoded, prediction: Prediction) -> None:
        """Estimate where the touch has come to another of its milestones, or has ended complete."""
        estimator = self.estimator
        if estimator is None:
            return
        stage = estimator.stage(encoded.steps)
        if stage != self.stage or stage == estimator.last:
            names = estimator.wanted(None)
            self.estimates = estimates_of(
                estimator, names, encoded, self.extractor, prediction, self.rule.risk, known=None
            )
            self.stage = stage
            widths = ((self.estimates[name].width, width) for name, width in self.widths.items())
            narrow = [own is not None and own <= width for own, width in widths]
            self.settled = self.settled or (bool(narrow) and all(narrow))


def is_touch(predictor: Predictor, rows: Array) -> bool:
    """Whether readings (k, n) that came while rest was to be learned are a touch, or hold a part of one.

    They are judged as far as a learned touch lasts, the last and the first of them: shorter parts, which look like the
    beginning of one, were touches in 12 of 60 rests of RoboSkin, these in none. What is like a learned touch but for
    its level, or through noise alone, is rest: it has no features but noise.
    """
    model = predictor.frozen().model
    if not model.names:
        return False
    n = model.longest
    parts = (rows[-n:], rows[:n]) if len(rows) > n else (rows,)
    found = (predictor.predict((part,), None) for part in parts)
    return any(each.known is True and not {"noisy", "zero moved"} & set(each.unusual) for each in found)
