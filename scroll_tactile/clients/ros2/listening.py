"""A topic's messages: the subscription, which may have to wait for the topic, and what is met on the way."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from scroll_tactile.clients.ros2.interfaces import PICTURES, Quality, interface, kind_of
from scroll_tactile.errors import InputError
from scroll_tactile.recordings.paths import nearest

__all__ = ["Listener"]

LOOKED = 0.2  # seconds between looks for a topic that is not there yet
MISSED = 5.0  # seconds until the first warning about a missing or silent topic; each next wait is twice as long
LONGEST = 600.0
WAITING = 10_000  # messages that wait for the first who takes them: ten seconds at 1 kHz, some tens of MB
PICTURED = 120  # of pictures, which are large

Taker = Callable[[Any, float, int], object]
"""Takes a message, when it was published, in seconds, and how many were lost since the one before."""


class Listener:
    """A topic, heard once for all who take its messages.

    topic, kind: where the messages are. Without a kind, such as sensor_msgs/msg/JointState, the type is what the topic
    is sent as, and it may appear later. The subscription begins with the listener: what comes before anybody takes it
    waits, the last 10 000 messages, or 120 pictures, so that a memory can be opened meanwhile. All who take messages
    before the next one comes get what waited. Nothing waits once the last of them left.

    A topic that is not there, or silent, is named in a warning after 5, 10, 20 … seconds; one that appears later with
    two types, or with one of a package that is missing, once.

    Raises MissingLibraryError where a package of ROS is missing, InputError for a kind that is none, for a topic of two
    types and for a quality that is none.
    """

    def __init__(self, node: Any, topic: str, kind: str | None = None, quality: Quality | None = None) -> None:
        self.node, self.kind, self._quality = node, kind, quality or Quality()
        self._quality.profile("")  # or raises
        self.topic = node.resolve_topic_name(topic)
        self.received = self._reported = 0.0
        self._patience = MISSED
        self._numbers: dict[bytes, int] = {}  # of the last message of each publisher
        self._takers: list[Taker] = []
        self._waiting: deque[tuple[Any, float, int]] = deque()
        self._early = True  # whether nobody has taken messages and left
        self._left_out = 0  # of what waited
        self._said: set[str] = set()  # why there is no subscription yet
        self._looking: Any = None
        self._timer: Any = None
        self.subscription: Any = None
        self.start()

    def start(self) -> None:
        """Hear the topic, as from the beginning on, after `stop`. Nothing happens where it is heard."""
        if self._timer is not None:
            return
        if self.kind is not None:
            self._subscribe(interface(self.kind))
        elif not self._look():
            self._looking = self.node.create_timer(LOOKED, self._look_again)
        self.received, self._reported, self._numbers = time.monotonic(), time.monotonic(), {}
        self._early, self._left_out = not self._takers, 0
        self._timer = self.node.create_timer(1.0, self._each_second)

    def give(self, taker: Taker) -> None:
        """Give messages to a taker, too, those that wait first; they wait for further takers until the next comes."""
        self._takers.append(taker)
        left_out = self._left_out
        for message, published, lost in list(self._waiting):
            if taker not in self._takers:  # it left meanwhile
                return
            taker(message, published, lost + left_out)
            left_out = 0

    def leave(self, taker: Taker) -> None:
        """Give a taker no more."""
        self._takers = [each for each in self._takers if each != taker]
        if not self._takers:
            self._early, self._left_out = False, 0
            self._waiting.clear()

    def receive(self, message: Any, about: Mapping[str, Any]) -> None:
        """Take a message; about: what ROS says of it."""
        self.received, self._patience = time.monotonic(), MISSED
        published = about.get("source_timestamp") or about.get("received_timestamp") or time.time_ns()
        came = message, published / 1e9, self._lost(about)
        if self._takers:
            self._waiting.clear()
            self._left_out = 0
            for taker in list(self._takers):
                taker(*came)
        elif self._early:
            self._waiting.append(came)
            if len(self._waiting) > (PICTURED if self.kind in PICTURES else WAITING):
                self._left_out += 1 + self._waiting.popleft()[2]

    def stop(self) -> None:
        """Hear no more; what waited is gone."""
        for timer in filter(None, (self._looking, self._timer)):
            self.node.destroy_timer(timer)
        if self.subscription is not None:
            self.node.destroy_subscription(self.subscription)
        self._looking = self._timer = self.subscription = None
        self._waiting.clear()

    def absent(self) -> str:
        """Why nothing comes, as far as can be seen."""
        silent = time.monotonic() - self.received
        count = self.node.count_publishers(self.topic)
        if not count:
            own = f"{self.node.get_fully_qualified_name()}/"
            heard = [name for name, _ in self.node.get_topic_names_and_types()]
            topics = [name for name in heard if name != self.topic and not name.startswith(own)]  # those of others
            return f"no reading for {silent:.0f} s: nobody publishes {self.topic}{nearest(self.topic, topics)}"
        about = self.node.get_publishers_info_by_topic(self.topic)
        kinds = sorted({each.topic_type for each in about})
        who, send = ("the publisher", "sends") if count == 1 else (f"the {count} publishers", "send")
        other = f", which {send} {' and '.join(kinds)} and not {self.kind}" * (self.kind not in kinds)
        return f"no reading for {silent:.0f} s from {who} of {self.topic}{other}{self._unfit(about)}"

    def _unfit(self, about: Any) -> str:
        """Whether the publishers promise less than is asked of them; then nothing is ever delivered."""
        asked, less = self._quality.profile(self.kind or ""), []
        for name in ("reliability", "durability"):
            wanted = getattr(asked, name)
            if wanted.name in ("RELIABLE", "TRANSIENT_LOCAL") and all(
                getattr(each.qos_profile, name) != wanted for each in about
            ):
                less.append(f"{name} {wanted.name.lower()}")
        return f": qos asks for {' and '.join(less)}, and less is promised" if less else ""

    def _look(self) -> bool:
        """Subscribe as soon as the topic is there; whether it is."""
        kind = kind_of(self.topic, dict(self.node.get_topic_names_and_types()))
        if kind is None:
            return False
        message = interface(kind)
        self.kind = kind
        self.received = time.monotonic()  # it is silent from now on
        if self._looking is not None:
            self.node.destroy_timer(self._looking)
            self._looking = None
        self._subscribe(message)
        return True

    def _look_again(self) -> None:
        """Look from a timer, out of which an error would end the executor: warn of each once, and go on looking."""
        try:
            self._look()
        except InputError as error:
            if str(error) not in self._said:
                self._said.add(str(error))
                self.node.get_logger().warning(f"{error}; it is not heard until then")

    def _subscribe(self, message: Any) -> None:
        from rclpy.subscription import Subscription

        # A client that does not say when a message was published, and of which publisher's it is, gives it alone.
        dated = hasattr(Subscription, "CallbackType")
        receive = self.receive if dated else lambda message: self.receive(message, {})
        profile = self._quality.profile(str(self.kind))
        self.subscription = self.node.create_subscription(message, self.topic, receive, profile)
        self.node.get_logger().info(f"reading {self.topic}, {self.kind}")

    def _lost(self, about: Mapping[str, Any]) -> int:
        """How many messages were lost since the last of the same publisher, where the transport counts them."""
        number = about.get("publication_sequence_number")
        if number is None:
            return 0
        publisher = bytes((about.get("publisher_gid") or {}).get("data") or b"")
        lost = max(0, int(number) - self._numbers.get(publisher, int(number) - 1) - 1)
        self._numbers[publisher] = number
        return lost

    def _each_second(self) -> None:
        now = time.monotonic()
        if now - self.received > MISSED and now - self._reported > self._patience:
            self._reported, self._patience = now, min(2 * self._patience, LONGEST)
            self.node.get_logger().warning(self.absent())
