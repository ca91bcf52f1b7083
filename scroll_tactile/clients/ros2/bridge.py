"""Turns messages into readings of a live session, and what changed into answers. It needs no ROS."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import FieldError, InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.live.answers import LiveState, LiveTouch
from scroll_tactile.live.session import HealthNotes
from scroll_tactile.persistence.observations import refusal
from scroll_tactile.recordings.paths import FieldPath
from scroll_tactile.recordings.reader import reported
from scroll_tactile.recordings.rosbag import picture
from scroll_tactile.results import Estimate, Prediction, Receipt
from scroll_tactile.settings import candidates_of
from scroll_tactile.signals.facts import all_clipped, fact_warnings
from scroll_tactile.signals.stream import Stream

__all__ = ["Answer", "Bridge", "BridgeReport"]

Answer = Mapping[str, Any]
"""An answer by name, as JSON has it; `Bridge` lists what is in it."""

RESTLESS = "the sensor is not at rest, or something touches it: nothing is found until it is left alone for two seconds"
MEASURED = 200  # messages, by whose stamps the topic's rate is known
RANKED = 5  # materials of an answer's ranking
_FILE = re.compile(r"\w[\w.-]{0,99}", re.ASCII)  # a name that leads to no other folder
_NUMBER = re.compile(r"[0-9]{1,19}")  # of a row: no journal has more, and int() refuses thousands of digits


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

    field: the path to a message's numbers, see `recordings.paths`; for a camera's pictures "data". risk, contact, of,
    scene: see `learner.live`. watch: note the sensor at rest before each touch, and touches that were decided and are
    known, for `learner.health`: some hundred bytes each. answer: called with each answer, when something changed. warn:
    called with each kind of fault once.

    An answer has event ("began", "prediction", "decided", "ended", "brief" for a contact too short for a touch, or
    "paused" for a touch that `pause` ended), stamp (of the reading after which it is given), contact, seconds (since
    the touch began), decided, material, probability, known, novelty (None where nothing was ever observed), unusual,
    candidates and ranking (the five likeliest); "ended" also has end, why it did, and touches, of how many of the same
    thing the answer is. All but event, stamp and contact may be missing where nothing was predicted yet. estimates, by
    quantity, is there where any was declared: of each what an `Estimate` has. By an axis each answer has its name as
    of, a label as material, and no estimates.

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
        scene: Sequence[str] | None = None,
        watch: bool = False,
        answer: Callable[[Answer], object],
        warn: Callable[[str], object],
    ) -> None:
        self.field = FieldPath(field)
        self.learner = learner
        self._how: dict[str, Any] = {"risk": risk, "contact": contact, "scene": scene, "of": of}
        self.session = learner.live(**self._how)
        self.report = BridgeReport()
        self.state = LiveState()
        self.stamp = 0.0
        self.paused = False
        self.receipt: Receipt | None = None  # of the last `learn`, also of a touch that was learned before
        self._learned: list[Receipt] = []  # by this bridge; the last may be taken back, see `learned`
        self._touch: Stream | None = None  # the last of the session before this one
        self._met: dict[str, int] = {}  # by the sessions before this one
        self._answer, self._warn = answer, warn
        self._notes = HealthNotes(learner, None, warn, materials=of is None) if watch else None
        self._by: dict[str, Any] = {} if of is None else {"of": of}
        self._pictures = learner.sensor.camera and self.field.text == "data"
        self._header: FieldPath | None = FieldPath("header.stamp.{sec,nanosec}")
        self._ahead = 0.0  # of when a message is published, by its stamp
        self._warned: set[type[Exception]] = set()
        self._restless = False
        self._stamps: list[float] = []  # the first

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
            self.report.refused += 1
            if type(error) not in self._warned:
                self._warned.add(type(error))
                self._warn(f"{error}. Further messages like it are left out and counted, without a word")
            return self.state
        self.stamp = stamp
        if len(self._stamps) < MEASURED:
            self._stamps.append(stamp)
            self._measure()
        self._publish(state)
        if self.session.report.restless != self._restless:
            self._restless = self.session.report.restless
            self._warn(RESTLESS if self._restless else "the sensor was at rest: touches are found from now on")
        return state

    def _measure(self) -> None:
        """Warn where the first stamps say another rate than the sensor has."""
        if len(self._stamps) < MEASURED:
            return
        report = reported(np.array(self._stamps), "header", {}, np.empty(0, np.int64), 0)
        for fact in report.facts(self.learner.sensor, "the topic"):
            if fact.kind == "rate":
                self._warn(f"the topic: {fact.text}. Its readings are brought to the sensor's rate")

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

    def _publish(self, now: LiveState) -> None:
        """Answer what is new."""
        before, self.state = self.state, now
        for touch in now.touches:
            self._say_ended(touch)
            if self._notes is not None:
                self._notes.take(touch)
        if now.contact:
            fresh = not before.contact or bool(now.touches)
            if now.decided and (fresh or not before.decided):
                self._say("decided", now)
            elif fresh or now.prediction is not before.prediction:
                self._say("began" if fresh else "prediction", now)
        elif before.contact and not now.touches:
            self._say("brief", now)

    def _say(self, event: str, now: LiveState) -> None:
        """Give the answer to a touch under way."""
        said = {"event": event, "stamp": self.stamp, **self._by}
        said |= {"contact": now.contact, "seconds": now.seconds, "decided": now.decided}
        self._answer(said if now.prediction is None else said | _told(now.prediction, now.estimates))

    def _say_ended(self, touch: LiveTouch) -> None:
        said = {"event": "ended", "stamp": self.stamp, **self._by}
        said |= {"contact": False, "seconds": touch.stream.seconds, "decided": touch.decided, "end": touch.end}
        self._answer(said | {"touches": 1 + len(touch.earlier)} | _told(touch.prediction, touch.estimates))

    def check(self, scene: Sequence[str] | None) -> None:
        """Raise what `adjust` raises for a scene; nothing changes."""
        axis = self._how["of"]
        names = self.learner.materials if axis is None else self.learner.axes.get(axis, {})
        candidates_of(scene, sorted(names), names.keys())

    def adjust(self, *, risk: float, scene: Sequence[str] | None) -> None:
        """Answer by another risk and scene from the next touch on. Raises what `LiveSession.adjust` raises."""
        if not self.paused:
            self.session.adjust(risk=risk, scene=scene)
        self._how |= {"risk": risk, "scene": scene}

    def pause(self) -> None:
        """End the touch under way, if any, as after a gap; it can still be learned, and `resume` begins anew."""
        self.close()
        self._touch, self.paused = self.touch, True
        if self.state.contact:
            self._say("paused", self.state._replace(contact=False))
        self.state = LiveState()

    def resume(self) -> None:
        """Take readings again, after `pause`; rest is learned anew. Raises what `learner.live` raises."""
        session = self.learner.live(**self._how)
        self._met = self._counts()
        self.session, self.paused, self._restless = session, False, False

    def close(self) -> None:
        """End the touch under way, if any; the learner stays open."""
        self.session.close()
        if self._notes is not None:
            self._notes.take(None)

    def status(self) -> dict[str, int | bool]:
        """What the bridge and its sessions met, by name; of states that of the last session."""
        return {**asdict(self.report), **self._counts()}

    def _counts(self) -> dict[str, int | bool]:
        """What this session met, and those before it."""
        met = asdict(self.session.report).items()
        return {name: value if isinstance(value, bool) else value + self._met.get(name, 0) for name, value in met}

    @property
    def touch(self) -> Stream | None:
        """The last touch that ended; None before."""
        return self._touch if self.session.touch is None else self.session.touch

    @property
    def learned(self) -> Receipt | None:
        """What this bridge learned last, and nobody took back."""
        left = [receipt for receipt in self._learned if receipt.sequence not in self.learner.memory.retracted]
        return left[-1] if left else None

    # What services ask for. Each says what was done, is durable when it returns, and raises what the learner raises.

    def learn(self, material: str) -> str:
        """Learn the last touch that ended under this name.

        Raises InputError where no touch has ended, or the memory has it under another name.
        """
        touch = self._ended_touch("to learn")
        if (why := refusal(self.learner.names_of(touch), material, all_clipped(touch))) is not None:
            raise InputError(f"{why}, or touch it again")
        with fact_warnings() as facts:
            receipt = self.receipt = self.learner.observe(material, touch)
        for fact in facts:
            self._warn(f"{receipt.material}: {fact}")
        if receipt.repeated:
            return f"{receipt.material}: the last touch was learned already, as observation {receipt.sequence}"
        self._learned.append(receipt)
        count = self.learner.materials[receipt.material]
        return (
            f"{receipt.material}: {receipt.seconds:g} s learned as observation {receipt.sequence}; "
            f"observed {count} time{'s' * (count != 1)}"
        )

    def undo(self) -> str:
        """Take back what was learned last. Raises InputError where nothing is left to be taken back."""
        receipt = self.learned
        if receipt is None:
            raise InputError(
                "expected a touch that was learned since the node began, and was not taken back; there is none"
            )
        self.learner.retract(receipt)
        left = self.learner.materials.get(receipt.material, 0)
        return f"{receipt.material}: observation {receipt.sequence} was taken back; {left} are left"

    def retract(self, observation: str) -> str:
        """Take back an observation, by its number. Raises InputError for what is none, and for an adaptation's."""
        if not _NUMBER.fullmatch(observation):
            raise InputError(f"expected the number of an observation, as learn gave it; came {observation!r:.60}")
        number = int(observation)
        if number in self.learner.memory.corrections:
            raise InputError(
                f"expected the number of an observation; {number} is that of an adaptation to a changed skin, which "
                f"`scroll-tactile memory retract MEMORY {number}` takes back once the node has ended"
            )
        self.learner.retract(number)
        return f"observation {number} was taken back"

    def forget(self, material: str) -> str:
        """Forget a material."""
        count = self.learner.forget(material)
        return f"{material}: {count} observation{'s' * (count != 1)} forgotten"

    def save(self, name: str) -> str:
        """Pack the memory as a file of this name beside its folder, for `learner.merge`. Says where it lies.

        Raises InputError for a name with a folder in it, and where there is such a file.
        """
        if not _FILE.fullmatch(name):
            raise InputError(f"expected a file's name of letters, digits, '_', '-' and '.'; came {name!r:.60}")
        if self.learner.path is None:
            raise InputError("expected a memory on disk to be saved; it has no path")
        path = self.learner.path.absolute().with_name(name if name.endswith(".zip") else f"{name}.zip")
        if path.exists():
            raise InputError(f"{path.name} is there already: choose another name")
        self.learner.pack(path)
        return str(path)

    def materials(self) -> str:
        """The materials with their observations, as JSON."""
        return json.dumps(dict(self.learner.materials))

    def predict(self) -> str:
        """The last touch that ended, by the memory as it is now, as JSON. Raises InputError where none has ended."""
        touch = self._ended_touch("to predict")
        prediction = self.learner.predict(touch, scene=self._how["scene"], of=self._how["of"])
        said = {"event": "predicted", "stamp": self.stamp, "contact": self.state.contact, "seconds": touch.seconds}
        return json.dumps(said | self._by | _told(prediction, {}))

    def begin(self) -> str:
        """A touch begins. Raises InputError in a session that finds contacts itself, and while paused."""
        self._require_running()
        self._publish(self.session.begin())
        return "a touch begins with the next reading"

    def end(self) -> str:
        """The touch is over. Raises InputError in a session that finds contacts itself, and while paused."""
        self._require_running()
        touching = self.state.contact
        state = self.session.end()
        self._publish(state)
        if not state.touches:
            return "the touch was too short to be one" if touching else "no touch was under way"
        touch = state.touches[-1]
        return f"touched for {touch.stream.seconds:g} s: {touch.prediction.material or 'nothing was ever observed'}"

    def again(self) -> str:
        """The next touch is of the same thing as the last. Raises InputError before any touch, and while paused."""
        self._require_running()
        self.session.again()
        return "the next touch is of the same thing as the last: what they say adds up"

    def _require_running(self) -> None:
        if self.paused:
            raise InputError("no readings are taken, and the touch under way has ended: activate the node first")

    def _ended_touch(self, what: str) -> Stream:
        if self.touch is None:
            raise InputError(f"expected a touch {what}; none has ended yet")
        return self.touch


def _told(prediction: Prediction, estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    """What a prediction says, and estimates by quantity."""
    told: dict[str, Any] = {**prediction.as_json()}
    if estimates:
        told["estimates"] = {name: own.as_json() for name, own in estimates.items()}
    ranking = prediction.ranking_as_json(RANKED)
    return told | {"unusual": prediction.unusual, "candidates": prediction.candidates(), "ranking": ranking}
