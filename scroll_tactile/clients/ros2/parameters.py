"""The node's parameters: what each is for, what it can be, and when it can change."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

from scroll_tactile.clients.ros2.interfaces import DURABILITIES, RELIABILITIES, interface
from scroll_tactile.errors import InputError
from scroll_tactile.recordings.paths import nearest

__all__ = [
    "DYNAMIC",
    "STATIC",
    "Parameter",
    "declare",
    "names_in",
    "refused",
    "release",
    "require_known",
    "share",
    "texts",
]


@dataclass(frozen=True)
class Parameter:
    """A parameter of the node.

    name, default, about: as ROS shows them. choices: the texts that it can be. bounds: of a number, both included.
    several: a text, or a list of them. fixed: read once, when the node starts.
    """

    name: str
    default: Any
    about: str
    choices: tuple[str, ...] = ()
    bounds: tuple[float, float] | None = None
    several: bool = False
    fixed: bool = False


STATIC = (
    Parameter("memory", "", "The folder of the memory."),
    Parameter(
        "topic", "", "Where the readings are sent; of several fingers a list, or one that has all.", several=True
    ),
    Parameter("field", "", "The path to a message's numbers; of several fingers a list, or one.", several=True),
    Parameter("finger", "", "Names of several fingers, each a namespace of answers and services.", several=True),
    Parameter("type", "", "The messages' type, as package/msg/Name; empty: what the topic says."),
    Parameter("preset", "", "A known sensor, which gives sensor, topic and field: biotac, anyskin, digit …"),
    Parameter("sensor", "", "Whose readings they are; needed only to make a new memory."),
    Parameter("mode", "write", "Whether touches can be learned.", choices=("write", "read")),
    Parameter("contact", "auto", "Who finds touches: auto, or the services begin and end.", choices=("auto", "manual")),
    Parameter("of", "", "An axis of labels to answer by, in place of materials."),
    Parameter("watch", False, "Note rest and known touches for the sensor's health, some hundred bytes each."),
    Parameter("qos.reliability", "best_effort", "What is asked of the topic's publishers.", choices=RELIABILITIES),
    Parameter("qos.durability", "volatile", "What is asked of the topic's publishers.", choices=DURABILITIES),
    Parameter("qos.depth", 0, "Messages that may wait; 0: 2000, of pictures 120.", bounds=(0, 1_000_000)),
    Parameter("autostart", True, "Configure and activate when the node starts.", fixed=True),
)
"""Read when the node is configured, and until then free to change."""

DYNAMIC = (
    Parameter("risk", 0.05, "The share of wrong answers among those that are decided.", bounds=(0.0, 1.0)),
    Parameter("scene", "", "The materials that can be here, a list or with commas; empty: all.", several=True),
    Parameter("health_after", 0, "Count for the sensor's health only later observations.", bounds=(0, 2**62)),
)
"""Free to change at any time; risk and scene count from the next touch on."""


def declare(node: Any, parameters: Iterable[Parameter], values: Mapping[str, Any]) -> None:
    """Declare those that the node does not have yet. values: defaults of this node, by name.

    Raises InputError where ROS was started with a value of another type, or out of bounds.
    """
    for each in parameters:
        if node.has_parameter(each.name):
            continue
        try:
            node.declare_parameter(each.name, values.get(each.name, each.default), _descriptor(each))
        except Exception as error:  # rclpy's own, whose place has changed from release to release
            raise InputError(f"parameter {each.name}: {error}") from error
        why = refused(each, node.get_parameter(each.name).value)
        if why:
            raise InputError(why)


@dataclass
class _Shared:
    """What parts of one node have in common. own: the names that they declared. values: what the first was given."""

    own: list[str]
    values: dict[str, Any]
    parts: int = 0


_SHARED: WeakKeyDictionary[Any, _Shared] = WeakKeyDictionary()


def share(node: Any, values: Mapping[str, Any]) -> None:
    """Declare the dynamic ones for one more part of a node. values: what it is given, by name; `release` ends it.

    Raises InputError where the node has another value already, for all its parts, and what `declare` raises.
    """
    shared = _SHARED.get(node)
    if shared is None:
        own = [each.name for each in DYNAMIC if not node.has_parameter(each.name)]
        # What ROS is given wins over both, so that the parts' own words are compared, not what became of them.
        said = {each.name: values.get(each.name, each.default) for each in DYNAMIC}
        said |= {name: node.get_parameter(name).value for name in said if name not in own}
        shared = _Shared(own, said)
    for name, value in values.items():
        there = shared.values[name]
        same = sorted(names_in(there)) == sorted(names_in(value)) if name == "scene" else there == value
        if not same:
            raise InputError(
                f"the node has parameter {name} as {there!r} already, for all that is on it; came {name}={value!r}: "
                "leave it out, or set the parameter"
            )
    declare(node, DYNAMIC, shared.values)
    shared.parts += 1
    _SHARED[node] = shared


def release(node: Any) -> None:
    """Undeclare, with the last part of a node, what its parts declared."""
    shared = _SHARED[node]
    shared.parts -= 1
    if not shared.parts:
        del _SHARED[node]
        for name in shared.own:
            node.undeclare_parameter(name)


def require_known(names: Iterable[str]) -> None:
    """Raise InputError for a name that is no parameter's."""
    known = [each.name for each in (*STATIC, *DYNAMIC)]
    for name in names:
        if name not in known:
            raise InputError(f"there is no parameter {name!r}{nearest(name, known)}")


def refused(each: Parameter, value: object) -> str:
    """Why a value cannot be; "" where it can."""
    if each.choices and value not in each.choices:
        return f"expected parameter {each.name} as {' or '.join(each.choices)}; came {value!r}"
    if each.several:
        try:
            texts(value)
        except InputError as error:
            return f"parameter {each.name}: {error}"
    if each.name == "risk" and not (isinstance(value, float) and 0 < value < 1):
        return f"expected parameter risk as a share of wrong answers between 0 and 1; came {value!r}"
    return ""


def texts(value: object) -> list[str]:
    """A parameter that is a text or a list of them as a list, without the empty ones.

    Raises InputError for anything else.
    """
    found = [value] if isinstance(value, str) else value
    # rclpy has an empty list as an array of bytes.
    if not isinstance(found, list | tuple) or not all(isinstance(text, str) for text in found):
        raise InputError(f"expected a text or a list of texts; came {value!r:.60}")
    return [text.strip() for text in found if text.strip()]


def names_in(value: object) -> list[str]:
    """The names in a parameter that is a list of them or a text with commas. Raises InputError for anything else."""
    return [name.strip() for text in texts(value) for name in text.split(",") if name.strip()]


def _descriptor(each: Parameter) -> Any:
    of = {name: interface(f"rcl_interfaces/msg/{name}") for name in ("FloatingPointRange", "IntegerRange")}
    made = interface("rcl_interfaces/msg/ParameterDescriptor")(
        name=each.name, description=each.about, read_only=each.fixed, dynamic_typing=each.several
    )
    if each.choices:
        made.additional_constraints = f"one of {', '.join(each.choices)}"
    elif each.several:
        made.additional_constraints = "a text, or a list of texts"
    if each.bounds is not None and isinstance(each.default, float):
        made.floating_point_range = [of["FloatingPointRange"](from_value=each.bounds[0], to_value=each.bounds[1])]
    elif each.bounds is not None:
        made.integer_range = [of["IntegerRange"](from_value=int(each.bounds[0]), to_value=int(each.bounds[1]), step=1)]
    return made
