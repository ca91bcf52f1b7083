"""ROS 2's interfaces by name: rclpy, messages and services, imported when first used."""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from scroll_tactile.errors import FieldError, InputError, MissingLibraryError
from scroll_tactile.libraries import install_line
from scroll_tactile.recordings.paths import nearest

__all__ = ["Quality", "interface", "kept", "kind_of", "require_rclpy"]

_NAME = re.compile(r"([A-Za-z]\w*)/(msg|srv)/([A-Za-z]\w*)")

PICTURES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
DEEP, FEW = 2000, 120  # readings and pictures that may wait: two seconds at 1 kHz and at 60 Hz
RELIABILITIES, DURABILITIES = ("best_effort", "reliable"), ("volatile", "transient_local")


@dataclass(frozen=True)
class Quality:
    """The quality of service of a subscription.

    As it is, best effort and volatile, which any publisher can serve; but its queue holds two seconds of readings at
    1 kHz, not five messages: while a touch is learned and its row reaches the disk no reading is taken, and a sensor at
    1 kHz would overrun a queue of five in 5 ms. depth: messages that may wait; 0 as said, or 120 pictures.
    """

    reliability: str = "best_effort"
    durability: str = "volatile"
    depth: int = 0

    def profile(self, kind: str) -> Any:
        """The same in rclpy's terms, for messages of a kind. Raises InputError for a word that is none of them."""
        from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

        for name, words in (("reliability", RELIABILITIES), ("durability", DURABILITIES)):
            if getattr(self, name) not in words:
                raise InputError(f"expected {name} as {' or '.join(words)}; came {getattr(self, name)!r}")
        return QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=self.depth or (FEW if kind in PICTURES else DEEP),
            reliability=ReliabilityPolicy[self.reliability.upper()],
            durability=DurabilityPolicy[self.durability.upper()],
        )


def kept(depth: int) -> Any:
    """The quality of service of topics whose last messages a late subscriber gets, if it is transient_local, too."""
    from rclpy.qos import DurabilityPolicy, QoSProfile

    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)


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


def kind_of(topic: str, topics: Mapping[str, Sequence[str]]) -> str | None:
    """The type of a topic among those there are, by name; None where it is not there yet.

    Raises InputError where it is sent in several types: one of them has to be named.
    """
    kinds = topics.get(topic, ())
    if len(kinds) > 1:
        raise InputError(f"topic {topic!r} is sent as {' and as '.join(kinds)}: say which, with --type")
    return kinds[0] if kinds else None
