"""A live session: readings go in as they come, and out come contacts, predictions and touches."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from numbers import Real
from types import TracebackType
from typing import Any, Literal, Self
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
from scroll_tactile_store import StoreError

from scroll_tactile.embeddings.protocol import canary, capabilities_of
from scroll_tactile.errors import InputError, ScrollTactileError, StreamError
from scroll_tactile.live.answers import End, LiveReport, LiveState, LiveTouch
from scroll_tactile.live.clock import Clock
from scroll_tactile.live.decision import DecisionRule, decision_rule
from scroll_tactile.live.detector import ContactDetector, Event, PressDetector
from scroll_tactile.prediction.features import Encoded, FeatureExtractor, WindowCache
from scroll_tactile.prediction.fitting import rehearse
from scroll_tactile.prediction.judging import estimates_of
from scroll_tactile.prediction.model import Model, Weighing
from scroll_tactile.prediction.predictor import Predictor, nothing_known
from scroll_tactile.readouts.estimation import Estimator
from scroll_tactile.results import Estimate, Health, Prediction
from scroll_tactile.settings import candidates_of
from scroll_tactile.signals.contact import MOST_FRAMES
from scroll_tactile.signals.correction import Correction, corrected_stream
from scroll_tactile.signals.stream import Stream, as_rows, fewest_readings, validate
from scroll_tactile.signals.windows import Scale

__all__ = ["HealthNotes", "LiveSession"]

Array = npt.NDArray[Any]

REMEMBERED = 2.0  # seconds before a contact is noticed in which it may have begun
RESTED = 0.5  # seconds of rest that a touch tells, always as many: noise of fewer readings scatters otherwise
KEPT = 60.0  # seconds of a touch, or four times the longest that was learned
MOST_EARLIER = 7  # touches of one thing before a touch: more hardly say more, each has its price in every prediction


class HealthNotes:
    """Notes the rest before each touch, and touches that were decided, are known and were not learned.

    learner: the `TactileLearner` whose memory it is; it stands above this module. changed: called once with what
    `health` says, when it sees a change; again only after it saw none. warn: called with a text for each kind of
    failure once: a full disk must not end a session. materials: whether answers are by materials, without which touches
    have no name.

    A memory with a damaged row is warned of. Raises InputError as `TactileLearner.health` does.
    """

    def __init__(
        self,
        learner: Any,
        changed: Callable[[Health], object] | None,
        warn: Callable[[str], object],
        *,
        materials: bool = True,
    ) -> None:
        self._learner, self._changed, self._warn, self._materials = learner, changed, warn, materials
        self._warned: set[type[Exception]] = set()
        self._last: LiveTouch | None = None  # until another ended: meanwhile it may be learned
        self._told = False
        try:
            learner.health()
        except StoreError as error:  # a damaged row is no reason to feel nothing: what comes is noted behind it
            self._warn_once(error)

    def take(self, ended: LiveTouch | None) -> None:
        """Take the touch that ended; None where the session did: note the touch before it and the rest, and look."""
        touch, self._last = self._last, ended
        try:
            certain = touch is not None and self._materials and touch.decided and touch.prediction.known
            if touch is not None and certain and not self._learner.names_of(touch.stream):  # its row has channels, too
                self._learner.sense(touch.stream, touch.prediction.material)
            if ended is not None and ended.rest is not None:
                self._learner.sense(ended.rest)
            if self._changed is None:
                return
            found = self._learner.health()
        except (ScrollTactileError, StoreError) as error:
            self._warn_once(error)
            return
        before, self._told = self._told, found.since is not None
        if self._told and not before:
            self._changed(found)

    def _warn_once(self, error: Exception) -> None:
        if type(error) not in self._warned:
            self._warned.add(type(error))
            self._warn(f"the health of the sensor cannot be told: {error}")


@dataclass
class GrowingTouch:
    """The touch under way, and what is predicted of it with the model of the memory as it was when it began.

    candidates: the materials that it may be of. rows: its readings, of a camera behind the resting image, and at most
    `limit` of them; came: how many there were; told: of them at the prediction. at: when it began. moments: that are to
    come, in readings; the next is the last of them. earlier: the touches of the same thing before it; encoded: they, as
    its model reads them. estimator: None where no quantity was declared. widths: quantity → how narrow its interval is
    to be. rest: readings before it. correction: through which they are read: that of the memory when the touch began.
    estimates: by quantity, as of `stage`; settled: whether every interval was as narrow as it is to be, False where
    none is asked to be.
    """

    predictor: Predictor
    extractor: FeatureExtractor
    candidates: list[str]
    rows: list[Array]
    limit: int
    at: float
    model: Model
    rule: DecisionRule
    moments: list[int]
    earlier: tuple[Stream, ...]
    estimator: Estimator | None
    widths: Mapping[str, float]
    rest: Array | None
    correction: Correction | None
    came: int = 0
    told: int = 0
    cache: WindowCache = field(default_factory=WindowCache)
    encoded: list[Encoded] = field(default_factory=list)
    prediction: Prediction | None = None
    decided: bool = False
    likely: bool = False
    estimates: dict[str, Estimate] = field(default_factory=dict)
    stage: int | None = None
    settled: bool = False

    def add(self, rows: Array) -> None:
        """Add readings (k, …), as far as there is room within the limit."""
        self.came += len(rows)
        self.rows.extend(np.array(rows[: self.limit - len(self.rows)]))  # of its own, and not the caller's

    def predict_in_time(self) -> None:
        """Predict at the last moment that the touch has come to, if any is new, until both are what was asked for."""
        moment = 0
        while self.moments and self.moments[-1] <= self.came:
            moment = self.moments.pop()
        if moment:
            with suppress(StreamError):  # too few frames in contact, or all values missing: no prediction yet
                stream = self.beginning(moment)
                if self.prediction is None or not self.decided:
                    self.predict(stream)
                    self.told = moment
                else:  # the prediction stays; what is asked of intervals is not reached yet
                    self._estimate(self._encoded(stream, self.cache), self.prediction)
        if self.decided and (self.settled or not self.widths):
            self.moments.clear()

    def beginning(self, count: int) -> Stream:
        """The stream of its first readings, corrected. Raises StreamError where they make none."""
        return corrected_stream(self.extractor.stream(np.array(self.rows[:count])), self.correction)

    def predict(self, stream: Stream) -> Prediction:
        """The prediction for the beginning of it, as `learner.predict` gives it."""
        if not self.candidates:
            seconds = math.fsum({each.key: each.seconds for each in (*self.earlier, stream)}.values())
            self.prediction = nothing_known(seconds)
            return self.prediction
        self.encoded = self.encoded or [self._encoded(each, WindowCache()) for each in self.earlier]
        current = self._encoded(stream, self.cache)
        self.prediction = self.predictor.answer_of(self.model, self.candidates, [*self.encoded, current])
        reached = self.prediction, current.steps
        self.decided |= self.rule.decided(*reached, several=bool(self.earlier))
        self.likely = self.rule.likely(*reached, several=bool(self.earlier))
        self._estimate(current, self.prediction)
        return self.prediction

    def _encoded(self, stream: Stream, cache: WindowCache) -> Encoded:
        model, estimator = self.model, self.estimator

        def scales_for(steps: int) -> list[Scale]:
            own = model.scales_for(self.candidates, steps)
            return own if estimator is None else sorted({*own, *estimator.scales_for(steps)})

        return self.extractor.encode(stream, model.longest, scales_for, cache)

    def _estimate(self, encoded: Encoded, prediction: Prediction) -> None:
        """Estimate where the touch has come to another of its milestones, or has ended complete."""
        estimator = self.estimator
        if estimator is None:
            return
        stage = estimator.stage(encoded.steps)
        if stage != self.stage or stage == estimator.last:
            self.estimates = estimates_of(
                estimator, estimator.wanted(None), encoded, self.extractor, prediction, self.rule.risk, known=None
            )
            self.stage = stage
            widths = ((self.estimates[name].width, width) for name, width in self.widths.items())
            narrow = [own is not None and own <= width for own, width in widths]
            self.settled = self.settled or (bool(narrow) and all(narrow))


class LiveSession:
    """Readings as they come, and an answer as soon as it is safe to act on; made by `TactileLearner.live`.

    touch: the last touch that ended, None before. report: what the session met. Not for several threads at once; of
    one learner there may be any number of sessions.
    """

    def __init__(
        self,
        predictor: Predictor,
        *,
        risk: float,
        contact: Literal["auto", "manual"],
        false_contacts: float,
        scene: Sequence[str] | None,
        widths: Mapping[str, float] | None,
        notes: HealthNotes | None,
    ) -> None:
        if contact not in ("auto", "manual"):
            raise InputError(f"expected contact as 'auto' or 'manual'; came {contact!r}")
        if not 0 < false_contacts < math.inf:
            raise InputError(f"expected false_contacts an hour above 0 and finite; came {false_contacts!r}")
        self._predictor, self._extractor, self._risk = predictor, predictor.extractor.verified(), risk
        self.sensor = sensor = predictor.recipe.sensor
        rest = capabilities_of(self._extractor.embedding).rest
        self._before = int(sensor.camera and isinstance(rest, str))  # frames that are no part of a touch
        model = rehearse(predictor.present())
        candidates_of(scene, model.names, model.known)
        self._scene, self._widths = scene, _checked(predictor, widths)
        self._manual, self._notes = contact == "manual", notes
        self._detector: ContactDetector | PressDetector | None = None
        if not self._manual:
            self._detector = (
                PressDetector(sensor, rest)
                if sensor.camera
                else ContactDetector(sensor, false_contacts, partial(_is_touch, predictor))
            )
        self.report = LiveReport(learning=not self._manual and not sensor.camera)
        self._clock = Clock(sensor.rate, self.report)
        self._dtype = np.dtype(np.float32 if sensor.camera else np.float64)
        self._remembered = 4 if sensor.camera else max(8, round(REMEMBERED * sensor.rate))
        self._recent: deque[Array] = deque(maxlen=self._remembered)
        self._since, self._came = 0.0, 0  # a time, and the readings that came from then on
        self._under_way: GrowingTouch | None = None
        self._ended: list[LiveTouch] = []
        self._thing: tuple[Stream, ...] = ()  # the touches of what was touched last
        self._again = False  # whether the next touch is one more of them
        self._closed = self._settled = False
        self.touch: Stream | None = None
        rule = self._rule(model, risk)
        if model.names and not sensor.camera:
            self._warm_up(model, rule)

    def push(self, reading: npt.ArrayLike, time: Any = None) -> LiveState:
        """Take a reading (n,) or a block (k, n), k of 0 or more, and say where the session stands after it.

        time: in seconds since any moment, one for each reading: of shape (k,) for a block. Left out, the readings come
        at the sensor's rate. With times they are put in their places at that rate, see `live.clock`; a gap and a step
        back end a touch.

        Nothing that happened within a block is lost: `LiveState.touches` holds every touch that ended in it, with its
        prediction and whether it was decided, and `ended` says whether there are any.

        Raises StreamError for readings that are not this sensor's, or not finite where it refuses them; InputError for
        times that are no seconds, and after `close`. Nothing was taken then, and the session goes on. InputError also
        where the memory was embedded again: then only `close` is left, which ends the touch under way.
        """
        self._require_open()
        rows = self._rows(reading)
        stamps = None if time is None else self._clock.checked(time, len(rows))
        self._ended = []
        self.report.readings += len(rows)
        if stamps is None:
            self._advance(rows)
        else:
            for part in self._clock.places(rows, stamps):
                if part.breaks:
                    self._break(part.breaks)
                else:
                    self._since, self._came = part.time, 0
                    self._advance(part.rows)
        return self._state()

    def begin(self) -> LiveState:
        """Say that a touch begins with the next reading; of a session with contact="manual".

        A touch that is under way ends. Raises InputError in a session that finds contacts itself.
        """
        self._require_manual("begin")
        self.end()
        self._begin(np.empty((0, *self.sensor.shape), self._dtype))
        return self._state()

    def end(self) -> LiveState:
        """Say that the touch is over; of a session with contact="manual". Nothing happens where there is none.

        Raises InputError in a session that finds contacts itself.
        """
        self._require_manual("end")
        self._ended = []
        self._end("end")
        return self._state()

    def again(self) -> None:
        """Say that the next touch to begin is of the same thing as the last; one that is under way is then the last.

        What the touches say adds up, as in `learner.predict(first, second, …)`, from the next one's first prediction
        on; a third adds up where again() is called once more. It is used up by the touch that begins next, and without
        it a touch counts by itself. Contacts too brief for a touch, gaps and steps back in time change nothing of it.
        Of more than eight touches of one thing the last eight count, so that what a session holds is bounded. One that
        was observed meanwhile speaks for what it was observed as.

        Raises InputError before any touch, and after `close`.
        """
        self._require_open()
        if self._under_way is None and not self._thing:
            raise InputError(
                "again() says that the next touch is of the same thing as the last, and none has ended yet: call it "
                "between two touches"
            )
        self._again = True

    def adjust(self, *, risk: float, scene: Sequence[str] | None) -> None:
        """Decide by another risk, and among another scene, from the next touch on; a new risk may take seconds.

        Raises what `TactileLearner.live` raises for these, and InputError after `close`. Then nothing has changed.
        """
        self._require_open()
        model = rehearse(self._predictor.present())
        candidates_of(scene, model.names, model.known)
        self._rule(model, risk)
        self._scene, self._risk = scene, risk

    def close(self) -> None:
        """End the touch under way, if any; a second call does nothing. `touch` and `report` stay."""
        if self._closed:
            return
        self._closed = True
        with suppress(StreamError):
            self._end("closed")
        if self._notes is not None:
            self._notes.take(None)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _require_open(self) -> None:
        if self._closed:
            raise InputError("the live session is closed: begin another with learner.live()")
        if self._predictor.replaced:
            raise InputError("the memory was embedded again: close this session, and begin another with learner.live()")

    def _require_manual(self, what: str) -> None:
        self._require_open()
        if not self._manual:
            raise InputError(f'the session finds contacts itself: for {what}() take learner.live(contact="manual")')

    def _rows(self, reading: npt.ArrayLike) -> Array:
        """The readings (k, …) that came, in the type they are kept in."""
        if isinstance(reading, np.ndarray) and reading.dtype == np.float64 and reading.shape == self.sensor.shape:
            rows: Array = reading[None]
            if not math.isfinite(rows.sum()):
                rows = as_rows(reading, self.sensor)
        else:
            rows = as_rows(reading, self.sensor)
        if self.sensor.non_finite == "missing":
            self.report.missing += int(rows.size - np.count_nonzero(np.isfinite(rows)))
        return rows.astype(self._dtype, copy=False)

    def _advance(self, rows: Array) -> None:
        """Take readings that follow each other at the sensor's rate."""
        self.report.ticks += len(rows)
        while len(rows):
            touch, part = self._under_way, rows
            if touch is not None and touch.moments:
                part = part[: max(1, touch.moments[-1] - touch.came)]
            used, event = (len(part), None) if self._detector is None else self._detector.feed(part)
            self._take(part[:used], event)
            rows = rows[used:]

    def _take(self, rows: Array, event: Event | None) -> None:
        """Take readings at whose last something may have happened."""
        touch = self._under_way
        self._came += len(rows)
        if self._detector is not None:
            self.report.learning, self.report.restless = self._detector.learning, self._detector.restless
        if touch is None:
            self._recent.extend(np.array(rows[-self._remembered :]))
            if event is not None and event.kind == "began":
                rested = max(3, round(RESTED * self.sensor.rate))
                recent = np.array(self._recent)[-rested - event.readings :]
                place = max(0, len(recent) - event.readings)
                self._begin(recent[place:], recent[:place] if place == rested else None)
        else:
            touch.add(rows)
            if event is None:
                touch.predict_in_time()
            elif event.kind == "relearned":  # it was no touch: the next is of what it would have been of
                self._under_way, self._again = None, bool(touch.earlier)
            else:
                touch.came -= event.readings
                del touch.rows[touch.came :]
                self._end("still" if event.kind == "still" else "released")
        if event is not None and event.kind == "relearned":
            self.report.relearned += 1
            self._recent.clear()

    def _begin(self, rows: Array, rest: Array | None = None) -> None:
        """A touch began with these readings, after those at rest."""
        self._recent.clear()
        model, scene = rehearse(self._predictor.present()), self._scene
        rule = self._rule(model, self._risk)
        prefix = None if self._detector is None else self._detector.prefix
        before, frame, limit = self._before, 1, max(round(KEPT * self.sensor.rate), 4 * model.longest)
        if self.sensor.camera:
            frame, limit = model.plan.widths[0], MOST_FRAMES + before
        if prefix is not None:
            rows = np.concatenate([prefix, rows]).astype(self._dtype)
        earlier, self._again = self._thing if self._again else (), False
        self._under_way = GrowingTouch(
            predictor=self._predictor,
            extractor=self._extractor,
            candidates=model.names if scene is None else sorted({name for name in scene if name in model.known}),
            rows=[],
            limit=limit,
            at=self._since + (self._came - max(0, len(rows) - before)) / self.sensor.rate,
            model=model,
            rule=rule,
            moments=sorted({-(-moment // frame) + before for moment in rule.moments}, reverse=True),
            earlier=earlier,
            estimator=self._predictor.estimator() if self._predictor.memory.quantities else None,
            widths=self._widths,
            rest=rest,
            correction=self._predictor.ledger.correction,
        )
        self._under_way.add(rows)
        self._under_way.predict_in_time()

    def _rule(self, model: Model, risk: float) -> DecisionRule:
        """When predictions are made with a model, and when they are decided; found once for each fit."""
        known = {} if model.weighing is None else _RULES.setdefault(model.weighing, {})
        if risk not in known:
            known[risk] = decision_rule(model, risk)
        return known[risk]

    def _warm_up(self, model: Model, rule: DecisionRule) -> None:
        """Predict a made-up touch as a real one will be: the first time takes ten times as long."""
        low, high = self.sensor.limits
        image, cache = canary(self.sensor.channels, max(2, *rule.moments, model.longest)), WindowCache()
        for moment in [*rule.moments, image.shape[1]]:
            stream = self._extractor.stream(low + (high - low) * (image[:, : max(2, moment)].T + 1) / 2)
            encoded = self._extractor.encode(
                stream, model.longest, lambda steps: model.scales_for(model.names, steps), cache
            )
            self._predictor.answer_of(model, model.names, [encoded])

    def _end(self, end: End) -> None:
        """The touch under way, if any, is over."""
        touch, self._under_way = self._under_way, None
        if touch is None:
            return
        try:
            if len(touch.rows) - self._before < fewest_readings(self.sensor):
                raise StreamError
            stream = touch.beginning(touch.limit)
        except StreamError:  # nothing that could be observed
            self.report.brief += 1
            self._again = bool(touch.earlier)  # the next is of what it would have been of
            return
        before = touch.prediction if touch.decided else None
        prediction = touch.predict(stream)
        revised = before if before is not None and _says(before) != _says(prediction) else None
        self.touch, self._thing = stream, (*touch.earlier, stream)[-MOST_EARLIER:]
        self.report.touches += 1
        self.report.undecided += not touch.decided
        self.report.revised += revised is not None
        self.report.truncated += touch.came > touch.limit
        rest = None
        with suppress(StreamError):  # nothing but missing values
            rest = None if touch.rest is None else corrected_stream(validate(touch.rest, self.sensor), touch.correction)
        ended = LiveTouch(
            stream=stream,
            prediction=prediction,
            decided=touch.decided,
            likely=touch.likely,
            at=touch.at,
            end=end,
            earlier=touch.earlier,
            revised=revised,
            estimates=touch.estimates,
            rest=rest,
        )
        self._ended.append(ended)
        self._settled = touch.settled
        if self._notes is not None:
            self._notes.take(ended)

    def _break(self, why: str) -> None:
        """Time begins anew; a touch that has no reading yet begins after it."""
        if self._under_way is None or self._under_way.came:
            self._end("gap" if why == "gap" else "time went back")
        self._recent.clear()
        if self._detector is not None:
            self._detector.interrupt()

    def _state(self) -> LiveState:
        touch, ended = self._under_way, tuple(self._ended)
        of = touch or (ended[-1] if ended else None)
        if of is None:
            return LiveState()
        rate, last = self.sensor.rate, 0.0 if touch else ended[-1].stream.seconds
        return LiveState(
            contact=touch is not None,
            seconds=last if touch is None else max(0, touch.came - self._before) / rate,
            prediction=of.prediction,
            decided=of.decided,
            ended=bool(ended),
            touches=ended,
            estimates=of.estimates,
            settled=self._settled if touch is None else touch.settled,
            likely=of.likely,
            age=0.0 if touch is None or touch.prediction is None else (touch.came - touch.told) / rate,
        )


def _is_touch(predictor: Predictor, rows: Array) -> bool:
    """Whether readings (k, n) that came while rest was to be learned are a touch, or hold a part of one.

    They are judged as far as a learned touch lasts, the last and the first of them: shorter parts, which look like the
    beginning of one, were touches in 12 of 60 rests of RoboSkin, these in none. What is like a learned touch but for
    its level, or through noise alone, is rest: it has no features but noise.
    """
    model = predictor.present()
    if not model.names:
        return False
    n = model.longest
    parts = (rows[-n:], rows[:n]) if len(rows) > n else (rows,)
    found = (predictor.predict((part,), None) for part in parts)
    return any(each.known is True and not {"noisy", "zero moved"} & set(each.unusual) for each in found)


def _checked(predictor: Predictor, widths: Mapping[str, float] | None) -> dict[str, float]:
    """The requested widths, of quantities that were declared; the heads that estimate them are fitted."""
    estimator, requested = predictor.estimator(), dict(widths or {})
    for name, width in requested.items():
        if not (isinstance(width, Real) and 0 < float(width) < math.inf):
            raise InputError(f"expected the width of {name!r} as a number above 0; came {width!r:.60}")
    if requested and not estimator.quantities:
        why = "none was declared, or answers are by labels"
        raise InputError(f"expected widths of declared quantities; came {sorted(requested)}, and {why}")
    if not estimator.quantities:
        return {}
    estimator.wanted(list(requested))
    for stage in range(estimator.last + 1):
        estimator.heads(stage)  # a touch under way should not wait for them
    return requested


def _says(prediction: Prediction) -> str | bool | None:
    """What is acted on: the material if it is known, False of what was never felt, None where that cannot be told."""
    return prediction.known and prediction.material


_RULES: WeakKeyDictionary[Weighing, dict[float, DecisionRule]] = WeakKeyDictionary()  # by risk
