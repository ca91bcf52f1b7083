"""The node: a subscription, a publisher of answers, diagnostics, and services, all of standard types."""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal

from scroll_tactile.errors import FieldError, InputError, MissingLibraryError, ScrollTactileError
from scroll_tactile.health.advice import advice, in_words
from scroll_tactile.learner import TactileLearner
from scroll_tactile.recordings.paths import nearest
from scroll_tactile.ros2.bridge import Answer, Bridge
from scroll_tactile.ros2.interfaces import interface, kind_of, require_rclpy
from store import StoreError

__all__ = ["TactileNode", "serve"]

HELD = 2.0  # seconds of readings that may wait
FASTEST = 1000.0  # Hz
LOOKED = 0.2  # seconds between looks for a topic that is not there yet
MISSED = 5.0  # seconds after which a topic that is not there, or silent, is named; then after twice as long, and so on
LONGEST = 600.0
SILENT = 1.0  # seconds without a reading


class TactileNode:
    """A learner at a topic, within a node of one's own; `serve` makes the node, too.

    topic, field, kind: where the readings are. Without a kind, such as sensor_msgs/msg/JointState, the type is what the
    topic is sent as, and it may appear later. risk, contact, of, watch: see `Bridge`. answered: called with each answer
    that is published, for what acts in the same process.

    Subscribes with the quality of service of sensor data, best effort and volatile, which any publisher can serve; but
    its queue holds two seconds of readings at 1 kHz, not five messages: while a touch is learned and its row reaches
    the disk no reading is taken, and a sensor at 1 kHz would overrun a queue of five in 5 ms.

    Publishes `~/answer`, std_msgs/String with the JSON of an answer (see `Bridge`), when something changed; the same as
    `~/material`, std_msgs/String, `~/probability` and `~/novelty`, std_msgs/Float64, and `~/known`, std_msgs/Bool,
    False where it cannot be told: for echo, plots and all that reads no JSON. Those who subscribe later get the last.
    Once a second what was met, as diagnostic_msgs/DiagnosticArray on `/diagnostics`, or where that package is missing
    as JSON on `~/diagnostics`.

    `/diagnostics` says as well when the sensor is no longer the one that learned (see `TactileLearner.health`): ERROR
    for a dead channel, WARN for any other change. Once that is mended, set the parameter `health_after` to the
    observation that it names, and only later touches count.

    Services, all std_srvs/Trigger, whose reply says what was done or why not: `~/learn` and `~/forget`, under the name
    that the parameter `material` has then; `~/undo`, of what was learned last; `~/materials`, whose reply is JSON, name
    → observations; `~/begin` and `~/end`, with contact="manual"; `~/again`, before the next touch of the same thing.

        ros2 param set /scroll_tactile material silk
        ros2 service call /scroll_tactile/learn std_srvs/srv/Trigger

    A wrong name, a full disk or a missing touch reaches whoever called, which a topic of names could not report.

    Raises MissingLibraryError where a package of ROS is missing, InputError for a type that is none, and what `Bridge`
    raises. A field that the first message does not have raises FieldError from the node's executor.
    """

    def __init__(
        self,
        node: Any,
        learner: TactileLearner,
        topic: str,
        field: str,
        *,
        kind: str | None = None,
        risk: float = 0.05,
        contact: Literal["auto", "manual"] = "auto",
        of: str | None = None,
        watch: bool = False,
        answered: Callable[[Answer], object] | None = None,
    ) -> None:
        self.node, self.kind = node, kind
        self.topic = node.resolve_topic_name(topic)
        message = None if kind is None else interface(kind)
        text, trigger = interface("std_msgs/msg/String"), interface("std_srvs/srv/Trigger")
        self._log = node.get_logger()
        how: dict[str, Any] = {"risk": risk, "contact": contact, "of": of, "watch": watch}
        self.bridge = Bridge(learner, field, **how, answer=self._publish, warn=self._log.warning)
        self._text, self._answered = text, answered
        self._answers = node.create_publisher(text, "~/answer", _kept(10))
        self._fields = _Fields(node, text)
        for name, default in (("material", ""), ("health_after", 0)):
            if not node.has_parameter(name):
                node.declare_parameter(name, default)
        self._diagnostics = _Diagnostics(node, self.bridge)
        for name, call in self._calls().items():
            node.create_service(trigger, f"~/{name}", _service(call))
        self._received = self._reported = time.monotonic()
        self._patience = MISSED
        self._numbers: dict[bytes, int] = {}  # of the last message of each publisher
        self.subscription: Any = None
        if message is not None:
            self._subscribe(message)
        else:
            self._looking = node.create_timer(LOOKED, self._look)
        node.create_timer(1.0, self._each_second)

    def _calls(self) -> dict[str, Callable[[], str]]:
        """What each service calls."""
        bridge = self.bridge
        return {
            "learn": lambda: bridge.learn(self._material()),
            "forget": lambda: bridge.forget(self._material()),
            "begin": bridge.begin,
            "end": bridge.end,
            "again": bridge.again,
            "undo": bridge.undo,
            "materials": bridge.materials,
        }

    def receive(self, message: Any, about: Mapping[str, Any]) -> None:
        """Take a message; about: what ROS says of it."""
        self._received, self._patience = time.monotonic(), MISSED
        published = about.get("source_timestamp") or about.get("received_timestamp") or time.time_ns()
        self._count(about)
        try:
            self.bridge.receive(message, published / 1e9)
        except FieldError as error:
            raise FieldError(f"topic {self.topic!r}, {self.kind}: {error}") from error

    def close(self) -> None:
        """End the touch under way, if any; node and learner stay."""
        if self.subscription is not None:
            self.node.destroy_subscription(self.subscription)
            self.subscription = None
        self.bridge.close()

    def _look(self) -> None:
        """Subscribe as soon as the topic is there."""
        kind = kind_of(self.topic, dict(self.node.get_topic_names_and_types()))
        if kind is not None:
            self.kind = kind
            self.node.destroy_timer(self._looking)
            self._subscribe(interface(kind))

    def _subscribe(self, message: Any) -> None:
        from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
        from rclpy.subscription import Subscription

        sensor = self.bridge.learner.sensor
        profile = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=math.ceil(HELD * (sensor.rate if sensor.camera else max(sensor.rate, FASTEST))),
            reliability=ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.VOLATILE,
        )
        # Humble does not say when a message was published; later distributions do.
        dated = hasattr(Subscription, "CallbackType")
        receive = self.receive if dated else lambda message: self.receive(message, {})
        self.subscription = self.node.create_subscription(message, self.topic, receive, profile)
        self._log.info(f"reading {self.bridge.field.text} of {self.topic}, {self.kind}")

    def _count(self, about: Mapping[str, Any]) -> None:
        """Count the messages that were lost since the last of the same publisher."""
        number = about.get("publication_sequence_number")
        if number is None:
            return
        publisher = bytes((about.get("publisher_gid") or {}).get("data") or b"")
        self.bridge.report.dropped += max(0, number - self._numbers.get(publisher, number - 1) - 1)
        self._numbers[publisher] = number

    def _publish(self, answer: Answer) -> None:
        self._answers.publish(self._text(data=json.dumps(answer)))
        self._fields.publish(answer)
        if self._answered is not None:
            self._answered(answer)

    def _material(self) -> str:
        name = str(self.node.get_parameter("material").value)
        if not name.strip():
            full = self.node.get_fully_qualified_name()
            raise InputError(f"expected a name in the parameter material: ros2 param set {full} material NAME")
        return name

    def _each_second(self) -> None:
        now = time.monotonic()
        silent = now - self._received
        if silent > MISSED and now - self._reported > self._patience:
            self._reported, self._patience = now, min(2 * self._patience, LONGEST)
            self._log.warning(self._absent(silent))
        self._diagnostics.publish(silent > SILENT)

    def _absent(self, silent: float) -> str:
        """Why nothing comes, as far as can be seen."""
        topics = [name for name, _ in self.node.get_topic_names_and_types()]
        count = self.node.count_publishers(self.topic)
        if count:
            kinds = sorted({about.topic_type for about in self.node.get_publishers_info_by_topic(self.topic)})
            other = f", which send {' and '.join(kinds)} and not {self.kind}" * (self.kind not in kinds)
            return f"no reading for {silent:.0f} s from the {count} publishers of {self.topic}{other}"
        return f"no reading for {silent:.0f} s: nobody publishes {self.topic}{nearest(self.topic, topics)}"


def _kept(depth: int) -> Any:
    """The quality of service of what is kept for those who subscribe later; any subscriber can have it."""
    from rclpy.qos import DurabilityPolicy, QoSProfile

    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class _Fields:
    """The fields of answers, each on a topic of its own. text: the class of std_msgs/String."""

    def __init__(self, node: Any, text: Any) -> None:
        number, truth = interface("std_msgs/msg/Float64"), interface("std_msgs/msg/Bool")
        kinds = {"material": text, "probability": number, "novelty": number, "known": truth}
        self._kinds = {name: (kind, node.create_publisher(kind, f"~/{name}", _kept(1))) for name, kind in kinds.items()}

    def publish(self, answer: Answer) -> None:
        """Publish those that an answer has."""
        if answer.get("material") is None:
            return
        novelty = answer["novelty"]
        values = {**answer, "known": bool(answer["known"]), "novelty": math.inf if novelty is None else novelty}
        for name, (kind, publisher) in self._kinds.items():
            publisher.publish(kind(data=values[name]))


class _Diagnostics:
    """Says once a second what was met, in the terms that ROS has for it where they are installed."""

    def __init__(self, node: Any, bridge: Bridge) -> None:
        self._node, self._bridge, self._before = node, bridge, 0
        self._changed()  # reads a whole journal the first time, and what came since later
        try:
            self._array: Any = interface("diagnostic_msgs/msg/DiagnosticArray")
        except MissingLibraryError:
            self._array, self._text = None, interface("std_msgs/msg/String")
        name = "~/diagnostics" if self._array is None else "/diagnostics"
        self._publisher = node.create_publisher(self._array or self._text, name, 10)

    def _changed(self) -> tuple[str, str] | None:
        """The level and the text of a change of the sensor; None where none is seen, or where it cannot be told."""
        learner = self._bridge.learner
        if learner.path is None or learner.sensor.camera:
            return None
        try:
            found = learner.health(after=int(self._node.get_parameter("health_after").value))
        except (ScrollTactileError, StoreError) as error:
            return "WARN", f"the health of the sensor cannot be told: {error}"
        if found.since is None:
            return None
        what = advice(found).replace("--after", "parameter health_after")
        return "ERROR" if found.kind == "dead" else "WARN", f"{in_words(found)}: {what}"

    def publish(self, silent: bool) -> None:
        """Publish the state; silent: whether no reading came in the last second."""
        bridge, changed = self._bridge, self._changed()
        status = bridge.status()
        faults = bridge.report.refused + bridge.report.dropped
        level, text = ("OK", "reading") if faults == self._before else ("WARN", "messages were lost or refused")
        level, text = (level, text) if changed is None else changed
        level, text = ("STALE", "no readings") if silent else (level, text)
        self._before = faults
        if self._array is None:
            self._publisher.publish(self._text(data=json.dumps({"level": level, "message": text, **status})))
            return
        state, pair = interface("diagnostic_msgs/msg/DiagnosticStatus"), interface("diagnostic_msgs/msg/KeyValue")
        found = state(
            level=getattr(state, level),
            name=f"{self._node.get_name()}: touch",
            message=text,
            hardware_id=bridge.learner.sensor.name,
            values=[pair(key=key, value=str(value)) for key, value in status.items()],
        )
        array = self._array(status=[found])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


def _service(call: Callable[[], str]) -> Callable[[Any, Any], Any]:
    """The callback of a Trigger service: what was done, or the error."""

    def answered(request: Any, response: Any) -> Any:
        try:
            response.message, response.success = call(), True
        except (ScrollTactileError, StoreError, OSError) as error:
            response.message, response.success = str(error), False
        return response

    return answered


def serve(
    learner: TactileLearner,
    topic: str,
    field: str,
    *,
    kind: str | None = None,
    risk: float = 0.05,
    contact: Literal["auto", "manual"] = "auto",
    of: str | None = None,
    watch: bool = False,
    arguments: Sequence[str] = (),
) -> dict[str, int | bool]:
    """Run the node `scroll_tactile` until ctrl-C or SIGTERM, or until ROS ends; returns what it met, by name.

    arguments: of ROS, such as --ros-args -r __ns:=/left. The others are those of `TactileNode`. A callback under way
    is finished first; a second ctrl-C interrupts it. The learner stays open.

    Raises what `TactileNode` raises, FieldError for a field that the first message does not have, and InputError for
    arguments that ROS refuses.
    """
    rclpy = require_rclpy()
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    context = rclpy.Context()
    with _interruptible() as ended:
        try:
            rclpy.init(args=list(arguments), context=context, signal_handler_options=SignalHandlerOptions.NO)
        except Exception as error:  # one of rclpy's own, whose place has changed from release to release
            raise InputError(f"ROS refuses to start with {' '.join(arguments) or 'no arguments'}: {error}") from error
        try:
            executor = SingleThreadedExecutor(context=context)
            node = rclpy.create_node("scroll_tactile", context=context)
            how: dict[str, Any] = {"risk": risk, "contact": contact, "of": of, "watch": watch}
            served = TactileNode(node, learner, topic, field, kind=kind, **how)
            executor.add_node(node)
            try:
                while not ended.is_set() and context.ok():
                    executor.spin_once(timeout_sec=0.1)
            except ExternalShutdownException:
                pass
            served.close()
            return served.bridge.status()
        finally:
            rclpy.try_shutdown(context=context)


@contextmanager
def _interruptible() -> Iterator[threading.Event]:
    """An event that the first SIGINT or SIGTERM sets; the handlers before are back after it. In other threads none."""
    ended = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield ended
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def end(number: int, frame: Any) -> None:
        ended.set()
        signal.signal(number, before[signal.Signals(number)])

    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, end)
    try:
        yield ended
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
