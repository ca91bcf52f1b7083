"""What a robot would have known at each frame of an episode: the answers of a live session to the readings up to it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError, NotFiniteError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.live.answers import LiveState
from scroll_tactile.live.clock import FEWEST_LOST, GAP
from scroll_tactile.live.session import LiveSession
from scroll_tactile.quantities import Quantity
from scroll_tactile.results import Prediction

__all__ = ["EVENT", "Episodes", "FrameAnswers", "Log", "in_words"]

EVENT = "felt: "  # how the words of an event begin
FARTHEST = 2  # times the sensor's rate, or this part of it: the rate of frames that are taken for its readings

Cut = Literal["episodes", "contact"]


class Log(Protocol):
    """Something that takes what a session says at a time in seconds, such as an `AnswerLog`."""

    def note(self, state: LiveState, time: float, /) -> None:
        """Take the state after the reading of this time."""


class _NoLog:
    def note(self, state: LiveState, time: float, /) -> None:
        pass


@dataclass(eq=False)
class FrameAnswers:
    """What was known at each of T frames.

    material: its place among `names`, −1 where there is no answer, int64 of shape (T,). probability: float32 (T,), 0
    without an answer. known: int64 (T,), 1 for what was learned, 0 for what was never observed, −1 where that cannot be
    told. quantities: by name value, low and high, float32 (T, 3); without an estimate the middle of the quantity's
    range and its ends, which hold any value. events: frame → what happened at it, in words. touches: that ended.
    left_out: readings that no session takes, NaN or infinite.
    """

    names: Sequence[str]
    material: npt.NDArray[np.int64]
    probability: npt.NDArray[np.float32]
    known: npt.NDArray[np.int64]
    quantities: dict[str, npt.NDArray[np.float32]]
    events: dict[int, list[str]] = field(default_factory=dict)
    touches: int = 0
    left_out: int = 0

    @classmethod
    def nothing(cls, frames: int, names: Sequence[str], quantities: Mapping[str, Quantity]) -> FrameAnswers:
        """No answer at any of so many frames."""
        middles = {
            name: np.tile(np.array([(one.low + one.high) / 2, one.low, one.high], np.float32), (frames, 1))
            for name, one in quantities.items()
        }
        none = np.full(frames, -1, np.int64)
        return cls(names, none, np.zeros(frames, np.float32), none.copy(), middles)

    def note(self, frame: int, state: LiveState) -> None:
        """Keep what a session says after a frame."""
        prediction = state.prediction
        if prediction is None or prediction.material is None:
            return
        self.material[frame] = self.names.index(prediction.material)
        self.probability[frame] = prediction.probability
        self.known[frame] = -1 if prediction.known is None else int(prediction.known)
        for name, estimate in state.estimates.items():
            if estimate.value is not None and estimate.interval is not None:
                self.quantities[name][frame] = (estimate.value, *estimate.interval)


class Episodes:
    """Answers episodes of readings, each by itself: the same readings give the same answers, whatever came before.

    cut: "episodes" takes each whole one as a touch, of which a gap in time makes two; "contact" finds touches in it by
    the sensor's noise at rest, with which it has to begin. risk, scene: as of `TactileLearner.live`.

    Raises what `TactileLearner.live` raises.
    """

    def __init__(
        self, learner: TactileLearner, *, cut: Cut = "episodes", risk: float = 0.05, scene: Sequence[str] | None = None
    ) -> None:
        if cut not in ("episodes", "contact"):
            raise InputError(f"expected cut as 'episodes' or 'contact'; came {cut!r}")
        self._learner, self._cut = learner, cut
        self._how: dict[str, Any] = {"risk": risk, "scene": scene}
        self.sensor, self.names, self.quantities = learner.sensor, sorted(learner.materials), dict(learner.quantities)
        self._session().close()

    def _session(self) -> LiveSession:
        return self._learner.live(contact="manual" if self._cut == "episodes" else "auto", **self._how)

    def answered(
        self,
        readings: npt.NDArray[Any],
        times: npt.NDArray[np.float64],
        episodes: npt.NDArray[np.int64],
        log_of: Callable[[int], AbstractContextManager[Log]] = lambda _: nullcontext(_NoLog()),
    ) -> FrameAnswers:
        """What was known at each frame of some episodes that follow each other.

        readings: (T, …), as of the sensor. times: (T,), in seconds. episodes: (T,), which one each is of. log_of: makes
        a log of an episode, which is told the states at its frames.

        Raises InputError for times that are no seconds, or too far from each other for this sensor, and what a log
        raises.
        """
        found = FrameAnswers.nothing(len(readings), self.names, self.quantities)
        if not np.isfinite(times).all():
            raise InputError("expected a time for each frame; some are NaN or infinite: give another clock=")
        borders = np.flatnonzero(np.diff(episodes)) + 1
        for begin, end in pairwise([0, *borders.tolist(), len(readings)]):
            if end > begin:
                self._require_near(times[begin:end])
                part = times[begin:end]
                with log_of(int(episodes[begin])) as log:
                    _Episode(found, begin, log).run(self._session(), readings[begin:end], part, self._touches(part))
        return found

    def _require_near(self, times: npt.NDArray[np.float64]) -> None:
        steps, rate = np.diff(times), self._learner.sensor.rate
        if len(steps) and not 1 / FARTHEST <= round(float(np.median(steps)) * rate, 2) <= FARTHEST:
            raise InputError(
                f"expected frames at about the sensor's {rate:g} readings a second, half as many to twice as many; "
                f"these come every {np.median(steps):.4g} s, and most of what is felt would be made up between them, "
                "or left out. Take a memory of a sensor that has their rate, or give another clock="
            )

    def _touches(self, times: npt.NDArray[np.float64]) -> set[int] | None:
        """Where touches begin; None where contacts are to be found."""
        if self._cut == "contact":
            return None
        steps = np.diff(times) * self._learner.sensor.rate
        longest = _longest(self._learner.sensor.rate)
        return {0, *(np.flatnonzero((steps > longest + 1) | (steps < -longest)) + 1).tolist()}


def _longest(rate: float) -> int:
    """The periods without a reading from which on a live session's clock has a gap."""
    return max(FEWEST_LOST, math.ceil(GAP * rate))


class _Episode:
    """One episode, whose first frame is `begin` of all."""

    def __init__(self, found: FrameAnswers, begin: int, log: Log) -> None:
        self._found, self._begin, self._log = found, begin, log
        self._noted = False  # whether the touch under way was decided on

    def run(
        self,
        session: LiveSession,
        readings: npt.NDArray[Any],
        times: npt.NDArray[np.float64],
        begins: set[int] | None,
    ) -> None:
        """Push frame by frame, and keep what the session says after each. begins: as of `Episodes._touches`."""
        with session:
            state = LiveState()
            for frame, (reading, time) in enumerate(zip(readings, times.tolist(), strict=True)):
                if begins is not None and (frame in begins or not state.contact):
                    state = session.begin()
                try:
                    state = session.push(reading, time)
                    self._happened(frame, state)
                except NotFiniteError:
                    self._found.left_out += 1
                    state = state._replace(touches=(), ended=False)
                if begins is not None and (frame + 1 in begins or frame + 1 == len(times)):
                    state = session.end()
                    self._happened(frame, state)
                self._found.note(self._begin + frame, state)
                self._log.note(state, time)

    def _happened(self, frame: int, state: LiveState) -> None:
        """Note what a push decided, or ended."""
        found = self._found
        for touch in state.touches:
            found.touches += 1
            if touch.revised is not None or not self._noted:
                how = "revised" if touch.revised is not None else "decided" if touch.decided else "undecided"
                self._say(frame, touch.prediction, how)
            self._noted = False
        if state.contact and state.decided and not self._noted and state.prediction is not None:
            self._say(frame, state.prediction, "decided")
            self._noted = True

    def _say(self, frame: int, prediction: Prediction, how: str) -> None:
        self._found.events.setdefault(self._begin + frame, []).append(in_words(prediction, how))


def in_words(prediction: Prediction, how: str) -> str:
    """An answer and how sure it is, such as "felt: oak, 0.97, decided"."""
    if prediction.material is None:
        return f"{EVENT}nothing learned yet, {how}"
    if prediction.known is False:
        return f"{EVENT}unknown, nearest {prediction.material}, {how}"
    return f"{EVENT}{prediction.material}, {prediction.probability:.2f}, {how}"
