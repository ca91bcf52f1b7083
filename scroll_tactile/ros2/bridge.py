"""Between messages and a live session: a reading and its time out of each, and what there is to say after it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import FieldError, InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.live.answers import LiveState, LiveTouch
from scroll_tactile.live.watching import HealthNotes
from scroll_tactile.persistence.contents import refusal
from scroll_tactile.recordings.paths import FieldPath
from scroll_tactile.recordings.ros.rosbag import picture
from scroll_tactile.results import Estimate, Prediction, Receipt
from scroll_tactile.signals.ranges import all_clipped

__all__ = ["Answer", "Bridge", "BridgeReport"]

Answer = Mapping[str, Any]
"""What JSON can hold; see `Bridge`."""

RANKED = 5  # materials of an answer's ranking


@dataclass
class BridgeReport:
    """What came, counted from the beginning.

    messages: that were received. dropped: that were lost on their way, where the transport counts them. refused:
    without a reading of the sensor, or not finite. unstamped: whose header's stamp was zero.
    """

    messages: int = 0
    dropped: int = 0
    refused: int = 0
    unstamped: int = 0


class Bridge:
    """A live session of a learner, fed with messages.

    field: the path to a message's numbers, see `recordings.paths`; for a camera's pictures "data". risk, contact, of:
    see `learner.live`. watch: note the sensor at rest before each touch, and touches that were decided and are known,
    for `learner.health`: some hundred bytes each. answer: called with each answer, when something changed. warn: called
    with each kind of fault once.

    An answer has event ("began", "prediction", "decided", "ended", or "brief" for a contact too short for a touch),
    stamp (of the reading after which it is given), contact, seconds (since the touch began), decided, material,
    probability, known, novelty (None where nothing was ever observed), unusual, candidates and ranking (the five
    likeliest); "ended" also has end, why it did, and touches, of how many of the same thing the answer is. All but
    event, stamp and contact may be missing where nothing was predicted yet. estimates, by quantity, is there where any
    was declared: of each what an `Estimate` has. By an axis each answer has its name as of, a label as material, and
    no estimates.

    A message's time is its header's stamp. One without, or with a stamp of zero, counts by when it was published, on
    the clock of the stamps before it.

    Raises FieldError for a field that is no path, and InputError as `learner.live` does, and with watch as
    `learner.health` does. Not for several threads at once.
    """

    def __init__(
        self,
        learner: TactileLearner,
        field: str,
        *,
        risk: float = 0.05,
        contact: Literal["auto", "manual"] = "auto",
        of: str | None = None,
        watch: bool = False,
        answer: Callable[[Answer], object],
        warn: Callable[[str], object],
    ) -> None:
        self.field = FieldPath(field)
        self.learner = learner
        self.session = learner.live(risk=risk, contact=contact, of=of)
        self.report = BridgeReport()
        self.state = LiveState()
        self.stamp = 0.0
        self._learned: list[Receipt] = []  # by this bridge, and not taken back
        self._answer, self._warn = answer, warn
        self._notes = HealthNotes(learner, None, warn, materials=of is None) if watch else None
        self._by: dict[str, Any] = {} if of is None else {"of": of}
        self._pictures = learner.sensor.camera and self.field.text == "data"
        self._header: FieldPath | None = FieldPath("header.stamp.{sec,nanosec}")
        self._ahead = 0.0  # of when a message is published, by its stamp
        self._warned: set[type[Exception]] = set()

    def receive(self, message: object, published: float) -> LiveState:
        """Take the reading of a message, published at this time in seconds, and say where the session stands.

        A message without a reading of the sensor is refused and counted, and the session goes on.
        Raises FieldError where it is the first and has no such field.
        """
        self.report.messages += 1
        try:
            reading = self._reading(message)
            stamp = self._time(message, published)
            state = self.session.push(reading, stamp)
        except InputError as error:
            if isinstance(error, FieldError) and self.report.messages == 1:
                raise
            self._refuse(error)
            return self.state
        self.stamp = stamp
        self._publish(state)
        return state

    def learn(self, material: str) -> str:
        """Learn the last touch that ended under this name; durable when this returns. Says what was done.

        Raises InputError where no touch has ended, or the memory has it under another name, and what `learner.observe`
        raises.
        """
        touch = self.session.touch
        if touch is None:
            raise InputError("expected a touch to learn; none has ended yet")
        if (why := refusal(self.learner.names_of(touch), material, all_clipped(touch))) is not None:
            raise InputError(f"{why}, or touch it again")
        receipt = self.learner.observe(material, touch)
        if receipt.repeated:
            return f"{receipt.material}: the last touch was learned already, as observation {receipt.sequence}"
        self._learned.append(receipt)
        count = self.learner.materials[receipt.material]
        return (
            f"{receipt.material}: {receipt.seconds:g} s learned as observation {receipt.sequence}; "
            f"observed {count} time{'s' * (count != 1)}"
        )

    def undo(self) -> str:
        """Take back what was learned last; durable when this returns. Says what was done.

        Raises InputError where nothing is left to be taken back, and what `learner.retract` raises.
        """
        if not self._learned:
            raise InputError(
                "expected a touch that was learned since the node began, and was not taken back; there is none"
            )
        receipt = self._learned[-1]
        self.learner.retract(receipt)
        self._learned.pop()
        left = self.learner.materials.get(receipt.material, 0)
        return f"{receipt.material}: observation {receipt.sequence} was taken back; {left} are left"

    def materials(self) -> str:
        """The materials with their observations, as JSON."""
        return json.dumps(dict(self.learner.materials))

    def forget(self, material: str) -> str:
        """Forget a material; durable when this returns. Says what was done; raises what `learner.forget` raises."""
        count = self.learner.forget(material)
        return f"{material}: {count} observation{'s' * (count != 1)} forgotten"

    def begin(self) -> str:
        """A touch begins. Raises InputError in a session that finds contacts itself."""
        self._publish(self.session.begin())
        return "a touch begins with the next reading"

    def end(self) -> str:
        """The touch is over. Raises InputError in a session that finds contacts itself."""
        touching = self.state.contact
        state = self.session.end()
        self._publish(state)
        if not state.touches:
            return "the touch was too short to be one" if touching else "no touch was under way"
        touch = state.touches[-1]
        return f"touched for {touch.stream.seconds:g} s: {touch.prediction.material or 'nothing was ever observed'}"

    def again(self) -> str:
        """The next touch is of the same thing as the last. Raises InputError before any touch."""
        self.session.again()
        return "the next touch is of the same thing as the last: what they say adds up"

    def status(self) -> dict[str, int | bool]:
        """What the bridge and its session met, by name."""
        return {**asdict(self.report), **asdict(self.session.report)}

    def close(self) -> None:
        """End the touch under way, if any; the learner stays open."""
        self.session.close()
        if self._notes is not None:
            self._notes.take(None)

    def _reading(self, message: object) -> npt.NDArray[Any]:
        found = picture(message) if self._pictures else None
        if found is not None:
            return found
        reading = self.field.reading(message)
        return reading if self.learner.sensor.camera else reading.astype(np.float64, copy=False)

    def _time(self, message: object, published: float) -> float:
        if self._header is None:
            return published
        try:
            seconds, nanoseconds = self._header.values(message)
        except FieldError:
            self._header = None
            return published
        if seconds == 0 == nanoseconds:
            self.report.unstamped += 1
            return published + self._ahead
        stamp = float(seconds + nanoseconds / 1e9)
        self._ahead = stamp - published
        return stamp

    def _refuse(self, error: InputError) -> None:
        self.report.refused += 1
        self._warn_once(error, f"{error}. Further messages like it are left out and counted, without a word")

    def _warn_once(self, error: Exception, text: str) -> None:
        """Warn of the first error of each kind."""
        if type(error) not in self._warned:
            self._warned.add(type(error))
            self._warn(text)

    def _publish(self, now: LiveState) -> None:
        """Answer what is new."""
        before, self.state = self.state, now
        for touch in now.touches:
            self._answer(self._ended(touch))
            if self._notes is not None:
                self._notes.take(touch)
        if now.contact:
            fresh = not before.contact or bool(now.touches)
            if now.decided and (fresh or not before.decided):
                self._answer(self._now("decided", now))
            elif fresh or now.prediction is not before.prediction:
                self._answer(self._now("began" if fresh else "prediction", now))
        elif before.contact and not now.touches:
            self._answer(self._now("brief", now))

    def _now(self, event: str, now: LiveState) -> Answer:
        answer = {} if now.prediction is None else _answer_of(now.prediction, now.estimates)
        here = {"contact": now.contact, "seconds": now.seconds, "decided": now.decided}
        return {"event": event, "stamp": self.stamp} | self._by | here | answer

    def _ended(self, touch: LiveTouch) -> Answer:
        over = {"contact": False, "seconds": touch.stream.seconds, "decided": touch.decided, "end": touch.end}
        over |= {"touches": 1 + len(touch.earlier)}
        return {"event": "ended", "stamp": self.stamp} | self._by | over | _answer_of(touch.prediction, touch.estimates)


def _answer_of(prediction: Prediction, estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    measured = {"estimates": {name: own.as_json() for name, own in estimates.items()}} if estimates else {}
    return (
        prediction.as_json()
        | measured
        | {
            "unusual": prediction.unusual,
            "candidates": prediction.candidates(),
            "ranking": prediction.ranking[:RANKED],
        }
    )
