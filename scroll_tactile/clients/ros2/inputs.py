"""What the node is given: types of ROS by name, parameters, and messages of a topic, which may come late."""

from __future__ import annotations

import importlib
import os
import re
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from scroll_tactile.errors import FieldError, InputError, MissingLibraryError
from scroll_tactile.libraries import install_line
from scroll_tactile.recordings.paths import nearest

__all__ = ["DYNAMIC", "PARAMETERS", "Listener", "interface", "names_in", "quality", "require_rclpy"]

LOOKED = 0.2  # seconds between looks for a topic that is not there yet
MISSED = 5.0  # seconds until the first warning about a missing or silent topic; each next wait is twice as long
PICTURES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
DEEP, FEW = 2000, 120  # readings and pictures in the subscription's queue: two seconds at 1 kHz and at 60 Hz
WAITING = 10_000  # messages that wait for their taker: ten seconds at 1 kHz, some tens of MB; of pictures FEW
QUALITIES = {"reliability": ("best_effort", "reliable"), "durability": ("volatile", "transient_local")}
_NAME = re.compile(r"([A-Za-z]\w*)/(msg|srv)/([A-Za-z]\w*)")

Taker = Callable[[Any, float, int], object]
"""Takes a message, when it was published, in seconds, and how many were lost since the one before."""


def require_rclpy() -> Any:
    """Python's client of ROS 2. Raises MissingLibraryError, with how to get it, where it cannot be imported."""
    try:
        return importlib.import_module("rclpy")
    except ImportError as error:
        raise MissingLibraryError(
            f"a ROS 2 node needs rclpy, which cannot be imported here ({error}): source the robot's own ROS 2 "
            "(source /opt/ros/DISTRIBUTION/setup.bash) in the shell that starts this, with a Python of the same "
            f"version; where there is no ROS: {install_line('ros-rclpy', 'ros2')}"
        ) from error


def interface(name: str) -> Any:
    """The class of a message or service, such as std_msgs/msg/String.

    Raises InputError for a name that is none, MissingLibraryError where its package is not installed, with the line
    that installs it, and FieldError, with those nearest, where the package has none of this name.
    """
    match = _NAME.fullmatch(name)
    if match is None:
        raise InputError(f"expected a type as package/msg/Name, such as sensor_msgs/msg/JointState; came {name!r}")
    package, group, short = match.groups()
    try:
        module = importlib.import_module(f"{package}.{group}")
    except ImportError as error:
        distribution = os.environ.get("ROS_DISTRO", "DISTRIBUTION")
        raise MissingLibraryError(
            f"type {name} needs the Python package {package!r}, which cannot be imported ({error}): "
            f"sudo apt install ros-{distribution}-{package.replace('_', '-')}, or source the workspace it is built in"
        ) from error
    if not hasattr(module, short):
        names = [other for other in dir(module) if other[0].isupper() and "_" not in other]
        raise FieldError(f"package {package!r} has no {group} {short!r}{nearest(short, names)}")
    return getattr(module, short)


@dataclass(frozen=True)
class Parameter:
    """A parameter of the node: its default and what it is for, as ROS shows them.

    choices: the texts that it can be. bounds: of a number, both included.
    """

    default: Any
    about: str
    choices: tuple[str, ...] = ()
    bounds: tuple[float, float] | None = None

    def descriptor(self, name: str) -> Any:
        """What ROS shows of it under this name."""
        made = interface("rcl_interfaces/msg/ParameterDescriptor")(name=name, description=self.about)
        made.read_only, made.dynamic_typing = name == "autostart", name == "scene"
        made.additional_constraints = f"one of {', '.join(self.choices)}" if self.choices else ""
        if self.bounds is not None:
            short = "FloatingPoint" if isinstance(self.default, float) else "Integer"
            bounds = interface(f"rcl_interfaces/msg/{short}Range")(from_value=self.bounds[0], to_value=self.bounds[1])
            setattr(made, "floating_point_range" if short == "FloatingPoint" else "integer_range", [bounds])
        return made

    def refused(self, name: str, value: object) -> str:
        """Why it cannot have a value; "" where it can."""
        if self.choices and value not in self.choices:
            return f"expected parameter {name} as {' or '.join(self.choices)}; came {value!r}"
        if name == "risk" and not (isinstance(value, float) and 0 < value < 1):
            return f"expected parameter risk as a share of wrong answers between 0 and 1; came {value!r}"
        if name == "scene":
            try:
                names_in(value)
            except InputError as error:
                return f"parameter scene: {error}"
        return ""


DYNAMIC = ("risk", "scene", "health_after")
"""The parameters that are free to change at any time; risk and scene count from the next touch on."""

PARAMETERS = {
    "memory": Parameter("", "The folder of the memory."),
    "topic": Parameter("", "Where the readings are sent."),
    "field": Parameter("", "The path to a message's numbers."),
    "type": Parameter("", "The messages' type, as package/msg/Name; empty: what the topic says."),
    "preset": Parameter("", "A known sensor, which gives sensor, topic and field: biotac, anyskin, digit …"),
    "sensor": Parameter("", "Whose readings they are; needed only to make a new memory."),
    "mode": Parameter("write", "Whether touches can be learned.", choices=("write", "read")),
    "contact": Parameter("auto", "Who finds touches: auto, or the services begin and end.", choices=("auto", "manual")),
    "of": Parameter("", "An axis of labels to answer by, in place of materials."),
    "watch": Parameter(False, "Note rest and known touches for the sensor's health, some hundred bytes each."),
    **{f"qos.{name}": Parameter(of[0], "Asked of the publishers.", choices=of) for name, of in QUALITIES.items()},
    "qos.depth": Parameter(0, "Messages that may wait; 0: 2000, of pictures 120.", bounds=(0, 1_000_000)),
    "autostart": Parameter(True, "Configure and activate when the node starts."),
    "risk": Parameter(0.05, "The share of wrong answers among those that are decided.", bounds=(0.0, 1.0)),
    "scene": Parameter("", "The materials that can be here, a list of texts or one with commas; empty: all."),
    "health_after": Parameter(0, "Count for the sensor's health only later observations.", bounds=(0, 2**62)),
}
"""All of the node, by name. Those that are not dynamic are read when it is configured; autostart once."""


def names_in(value: object) -> list[str]:
    """The names in a list of texts, or in a text with commas. Raises InputError for anything else."""
    found = [value] if isinstance(value, str) else value
    if not isinstance(found, list | tuple) or not all(isinstance(text, str) for text in found):
        raise InputError(f"expected a text or a list of texts; came {value!r:.60}")
    return [name.strip() for text in found for name in text.split(",") if name.strip()]


def quality(kind: str, reliability: str, durability: str, depth: int) -> Any:
    """The quality of service of a subscription to messages of a kind, in rclpy's terms.

    depth: messages that may wait; 0: 2000, or 120 pictures, two seconds of readings at 1 kHz and not five messages:
    while a touch is learned and its row reaches the disk no reading is taken, and five are overrun in 5 ms.
    """
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        depth=depth or (FEW if kind in PICTURES else DEEP),  # of the last that came
        reliability=ReliabilityPolicy[reliability.upper()],
        durability=DurabilityPolicy[durability.upper()],
    )


class Listener:
    """Hears a topic, and gives its messages to one taker.

    topic, kind: where the messages are. Without a kind, such as sensor_msgs/msg/JointState, the type is what the topic
    is sent as, and it may appear later. The subscription begins with the listener: what comes before there is a taker
    waits, the last 10 000 messages, or 120 pictures, so that a memory can be opened meanwhile.

    A topic that is not there, or silent, is named in a warning after 5, 10, 20 … seconds; one that appears later with
    two types, or with one of a package that is missing, once. asked: reliability, durability and depth, see `quality`.

    Raises MissingLibraryError where a package of ROS is missing, and InputError for a kind that is none and for a topic
    of two types.
    """

    def __init__(self, node: Any, topic: str, kind: str | None, asked: tuple[str, str, int]) -> None:
        self.node, self.kind, self._asked = node, kind, asked
        self.topic = node.resolve_topic_name(topic)
        self.received = time.monotonic()
        self.subscription: Any = None
        self._taker: Taker | None = None
        self._waiting: deque[tuple[Any, float, int]] = deque()
        self._left_out = 0  # of what waited
        self._numbers: dict[bytes, int] = {}  # of the last message of each publisher
        self._patience = MISSED
        self._said: set[str] = set()  # why there is no subscription yet
        self._look()
        self._timer: Any = node.create_timer(LOOKED, self._look_again)

    def give(self, taker: Taker) -> None:
        """Give a taker what waited, and from now on each message."""
        self._taker = taker
        while self._waiting:
            message, published, lost = self._waiting.popleft()
            lost, self._left_out = lost + self._left_out, 0
            taker(message, published, lost)

    def stop(self) -> None:
        """Hear no more, and give no more: what is on its way is dropped."""
        self._waiting.clear()
        self._taker = lambda message, published, lost: None
        self.node.destroy_timer(self._timer)
        if self.subscription is not None:
            self.node.destroy_subscription(self.subscription)

    def receive(self, message: Any, about: Mapping[str, Any]) -> None:
        """Take a message; about: what ROS says of it."""
        self.received, self._patience = time.monotonic(), MISSED
        published = about.get("source_timestamp") or about.get("received_timestamp") or time.time_ns()
        came = message, published / 1e9, self._lost(about)
        if self._taker is not None:
            self._taker(*came)
            return
        self._waiting.append(came)
        if len(self._waiting) > (FEW if self.kind in PICTURES else WAITING):
            self._left_out += 1 + self._waiting.popleft()[2]

    def _lost(self, about: Mapping[str, Any]) -> int:
        """How many messages were lost since the last of the same publisher, where the transport counts them."""
        number = about.get("publication_sequence_number")
        if number is None:
            return 0
        publisher = bytes((about.get("publisher_gid") or {}).get("data") or b"")
        lost = max(0, int(number) - self._numbers.get(publisher, int(number) - 1) - 1)
        self._numbers[publisher] = number
        return lost

    def _look(self) -> None:
        """Subscribe, without a kind as soon as the topic is there. Raises what the class does."""
        kinds = [self.kind] if self.kind else dict(self.node.get_topic_names_and_types()).get(self.topic, [])
        if len(kinds) > 1:
            raise InputError(f"topic {self.topic!r} is sent as {' and as '.join(kinds)}: say which, with --type")
        for kind in kinds:
            message, self.kind = interface(kind), kind
            profile = quality(kind, *self._asked)
            self.subscription = self.node.create_subscription(message, self.topic, self.receive, profile)
            self.node.get_logger().info(f"reading {self.topic}, {kind}")
            self.received = time.monotonic()  # it is silent from now on

    def _look_again(self) -> None:
        """Look until the topic is there, and warn of what hinders it, once, and of silence."""
        if self.subscription is None:
            try:
                self._look()
            except InputError as error:  # out of a timer it would end the executor
                if str(error) not in self._said:
                    self._said.add(str(error))
                    self.node.get_logger().warning(f"{error}; it is not heard until then")
        if time.monotonic() - self.received > self._patience:
            self._patience *= 2
            self.node.get_logger().warning(self.absent())

    def absent(self) -> str:
        """Why nothing comes, as far as can be seen."""
        silent = f"no reading for {time.monotonic() - self.received:.0f} s"
        about = self.node.get_publishers_info_by_topic(self.topic)
        if not about:
            own = f"{self.node.get_fully_qualified_name()}/"
            heard = [name for name, _ in self.node.get_topic_names_and_types()]
            topics = [name for name in heard if name != self.topic and not name.startswith(own)]  # those of others
            return f"{silent}: nobody publishes {self.topic}{nearest(self.topic, topics)}"
        kinds = sorted({each.topic_type for each in about})
        who, send = ("the publisher", "sends") if len(about) == 1 else (f"the {len(about)} publishers", "send")
        other = f", which {send} {' and '.join(kinds)} and not {self.kind}" * (self.kind not in kinds)
        return f"{silent} from {who} of {self.topic}{other}"
