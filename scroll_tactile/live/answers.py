"""What a live session gives back: its state after a push, the touches that ended, and a report of the stream."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal, NamedTuple

from scroll_tactile.results import Estimate, Prediction
from scroll_tactile.signals.stream import Stream

__all__ = ["End", "LiveReport", "LiveState", "LiveTouch"]

End = Literal["released", "end", "gap", "time went back", "still", "closed"]


@dataclass(frozen=True)
class LiveTouch:
    """A touch that ended.

    stream: its readings, as a file would hold them, for `learner.observe`. prediction: that of all of it, equal to
    `learner.predict(stream)` of the memory as it was when the touch began. decided: whether it was safe to act on
    before the touch ended, or is now; False says that it stayed undecided. likely: as of `LiveState`, of all of it. at:
    when it began, by the readings' times; without any, in seconds since the session began. end: why it ended:
    "released", by `end()`, by a "gap" in time, as "time went back", as nothing moved for long ("still"), or because the
    session was "closed". earlier: the touches of the same thing before it that the prediction weighs with it, as
    `learner.predict(*earlier, stream)`; none unless `LiveSession.again` said so. revised: the prediction that was
    decided on before the touch ended, where the whole touch says otherwise, or cannot tell; None where it agrees.
    estimates: by quantity, those of all of it, equal to `learner.estimate(stream, risk=…)`; none where no quantity was
    declared. rest: the half second before it, for `learner.sense`; None where less than that was at rest, of a camera,
    and where the session is told of contacts.
    """

    stream: Stream
    prediction: Prediction
    decided: bool
    at: float
    end: End
    earlier: tuple[Stream, ...] = ()
    revised: Prediction | None = None
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    rest: Stream | None = None
    likely: bool = False


class LiveState(NamedTuple):
    """Where a live session stands after a push.

    contact: whether something is touched. seconds: since the touch began. prediction: that of the touch's beginning,
    and of the touches of the same thing before it where `LiveSession.again` was called, made at the last of the moments
    at which it may change; None before the first. decided: act when decided: it is of a known material, or of something
    that was never felt (`prediction.known` is True or False); then both stay until the touch ends. likely: whether its
    probability is enough and it is not called new; where `known` is None it is undecided all the same, for nothing
    tells whether the material is a learned one. ended: whether a touch ended in this push. touches: all that ended in
    it, in order; a block of readings can hold several. estimates: by quantity, of the last milestone that the touch
    came to; see `learner.estimate`. settled: whether every interval was as narrow as the session's `widths` ask: a
    robot need touch no longer for their sake. age: how many seconds of touch came since the readings of the prediction.

    Where a touch ended and none began after it in the same push, all of these but contact and touches are those of the
    touch that ended. At rest they are 0, None, False and empty.
    """

    contact: bool = False
    seconds: float = 0.0
    prediction: Prediction | None = None
    decided: bool = False
    ended: bool = False
    touches: tuple[LiveTouch, ...] = ()
    estimates: Mapping[str, Estimate] = MappingProxyType({})
    settled: bool = False
    likely: bool = False
    age: float = 0.0


@dataclass
class LiveReport:
    """What a live session met, counted from its beginning.

    readings: that came. ticks: at the sensor's rate, which they became. lost: ticks of which no reading came, filled by
    the line between their neighbours. repeated: readings that came twice, left out. late: that came behind a later one,
    left out. surplus: more than the sensor's rate has room for, left out. untimed: whose stamp stood still, taken as
    they came. gaps, steps_back: in time; each ends a touch. missing: values that were NaN or infinite. touches: that
    ended. undecided: of them. revised: of them, decided on before they ended, and whose end says otherwise, or cannot
    tell. truncated: that went on beyond what is kept of a touch. brief: contacts too short for a touch. relearned: how
    often the sensor turned out to be much quieter than what was learned as its rest: it was touched from the first
    reading on, and that touch was not found. learning: whether rest is still being learned; nothing is found until
    then. restless: whether it is not learned yet because what came is no rest.
    """

    readings: int = 0
    ticks: int = 0
    lost: int = 0
    repeated: int = 0
    late: int = 0
    surplus: int = 0
    untimed: int = 0
    gaps: int = 0
    steps_back: int = 0
    missing: int = 0
    touches: int = 0
    undecided: int = 0
    revised: int = 0
    truncated: int = 0
    brief: int = 0
    relearned: int = 0
    learning: bool = False
    restless: bool = False
