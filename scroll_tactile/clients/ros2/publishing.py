"""What the node publishes: each answer in several forms, and once a second what was met."""

from __future__ import annotations

import json
import math
from typing import Any

from scroll_tactile_store import StoreError

from scroll_tactile.clients.ros2.answer_fields import Answer
from scroll_tactile.clients.ros2.bridge import RESTLESS, Bridge
from scroll_tactile.clients.ros2.interfaces import interface, kept
from scroll_tactile.errors import InputError, ScrollTactileError
from scroll_tactile.health.diagnosis import advice, in_words

__all__ = ["AnswerTopics", "Diagnostics", "stamp_of"]

KNOWN = {False: 0, True: 1, None: 2}  # as scroll_tactile_msgs/msg/TactileAnswer has it


def stamp_of(seconds: float) -> Any:
    """A time as builtin_interfaces/msg/Time has it, whose seconds are 32 bits."""
    whole = math.floor(seconds)
    if not 0 <= whole < 2**31:
        return interface("builtin_interfaces/msg/Time")()
    return interface("builtin_interfaces/msg/Time")(sec=whole, nanosec=min(round((seconds - whole) * 1e9), 10**9 - 1))


class AnswerTopics:
    """Publishes answers under `~/`, or `~/FINGER/`; see `TactileNode`. sensor: whose readings they rest on."""

    def __init__(self, node: Any, finger: str, sensor: str) -> None:
        self._node, self._sensor, self._finger = node, sensor, finger
        self._name = f"{node.get_name()}: {finger}" if finger else node.get_name()
        self.place = f"~/{finger}/" if finger else "~/"
        text, number, truth = (interface(f"std_msgs/msg/{name}") for name in ("String", "Float64", "Bool"))
        kinds = {"material": text, "probability": number, "novelty": number, "known": truth}
        self._text, array = text, interface("diagnostic_msgs/msg/DiagnosticArray")
        self._whole = node.create_publisher(text, f"{self.place}answer", kept(10))
        self._status = array, node.create_publisher(array, f"{self.place}status", kept(10))
        self._fields = {
            name: (kind, node.create_publisher(kind, f"{self.place}{name}", kept(1))) for name, kind in kinds.items()
        }
        self._typed: tuple[Any, Any] | None = None
        try:
            kind = interface("scroll_tactile_msgs/msg/TactileAnswer")
        except InputError:  # it is built from examples/ros2/scroll_tactile_msgs, or it is not there
            return
        self._typed = kind, node.create_publisher(kind, f"{self.place}tactile_answer", kept(10))

    @property
    def publishers(self) -> list[Any]:
        """All publishers, to be destroyed with their node's part."""
        more = [] if self._typed is None else [self._typed[1]]
        return [self._whole, self._status[1], *(publisher for _, publisher in self._fields.values()), *more]

    def publish(self, answer: Answer) -> None:
        """Publish an answer; nobody can have it any more once ROS has ended."""
        if not self._node.context.ok():
            return
        self._whole.publish(self._text(data=json.dumps(answer)))
        array, publisher = self._status
        publisher.publish(array(header=self._header(answer), status=[self._state(answer)]))
        if self._typed is not None:
            kind, publisher = self._typed
            publisher.publish(kind(header=self._header(answer), **_typed(answer)))
        if answer.get("material") is None:
            return
        values = {**answer, "known": bool(answer["known"]), "novelty": _number(answer["novelty"])}
        for name, (field, publisher) in self._fields.items():
            publisher.publish(field(data=values[name]))

    def _header(self, answer: Answer) -> Any:
        return interface("std_msgs/msg/Header")(stamp=stamp_of(answer["stamp"]), frame_id=self._finger)

    def _state(self, answer: Answer) -> Any:
        state, pair = interface("diagnostic_msgs/msg/DiagnosticStatus"), interface("diagnostic_msgs/msg/KeyValue")
        new = answer.get("known") is False and answer.get("material") is not None
        shown = [name for name in answer if name not in ("stamp", "estimates", "ranking")]
        values = {name: answer[name] for name in shown}
        values |= {f"ranking.{name}": chance for name, chance in answer.get("ranking", ())}
        for name, estimate in answer.get("estimates", {}).items():
            values |= {f"estimates.{name}.{part}": estimate[part] for part in ("value", "low", "high", "unit")}
        return state(
            level=state.WARN if new else state.OK,
            name=self._name,
            message="something new" if new else str(answer.get("material") or answer["event"]),
            hardware_id=self._sensor,
            values=[pair(key=key, value=_in_text(value)) for key, value in values.items()],
        )


def _number(value: float | None) -> float:
    return math.inf if value is None else value


def _in_text(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: ""}[value]
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _typed(answer: Answer) -> dict[str, Any]:
    """The fields of scroll_tactile_msgs/msg/TactileAnswer but its header."""
    found = answer.get("material") is not None
    ranking, estimates = answer.get("ranking", ()), answer.get("estimates", {})
    texts = {name: str(answer.get(name) or "") for name in ("event", "end", "of", "material")}
    lists = {name: [str(each) for each in answer.get(name, ())] for name in ("unusual", "candidates")}
    numbers = {
        part: [math.nan if each[part] is None else float(each[part]) for each in estimates.values()]
        for part in ("value", "low", "high")
    }
    return {
        **texts,
        **lists,
        "contact": bool(answer["contact"]),
        "seconds": float(answer.get("seconds", 0.0)),
        "decided": bool(answer.get("decided", False)),
        "known": KNOWN[answer.get("known") if found else None],
        "probability": float(answer["probability"]) if found else 0.0,
        "novelty": _number(answer["novelty"]) if found else math.inf,
        "touches": int(answer.get("touches", 1)),
        "ranked": [str(name) for name, _ in ranking],
        "ranked_probability": [float(chance) for _, chance in ranking],
        "quantities": list(estimates),
        "units": [str(each["unit"]) for each in estimates.values()],
        **{f"quantity_{part}": values for part, values in numbers.items()},
    }


class Diagnostics:
    """Says once a second on /diagnostics what was met, and whether the sensor is still the one that learned."""

    def __init__(self, node: Any, bridge: Bridge, finger: str) -> None:
        self._node, self._bridge, self._before = node, bridge, 0
        self._name = f"{node.get_name()}: touch" + f" of {finger}" * bool(finger)
        self._changed()  # reads a whole journal the first time, and what came since later
        self._array = interface("diagnostic_msgs/msg/DiagnosticArray")
        self.publisher = node.create_publisher(self._array, "/diagnostics", 10)

    def _changed(self) -> tuple[str, str] | None:
        """The level and the text of a change of the sensor; None where none is seen, or where it cannot be told."""
        learner = self._bridge.learner
        if not learner.has_health:
            return None
        try:
            found = learner.health(after=int(self._node.get_parameter("health_after").value))
        except (ScrollTactileError, StoreError) as error:
            return "WARN", f"the health of the sensor cannot be told: {error}"
        if found.since is None:
            return None
        what = advice(found).replace("--after", "parameter health_after")
        return "ERROR" if found.kind == "dead" else "WARN", f"{in_words(found)}: {what}"

    def publish(self, *, active: bool, silent: bool) -> None:
        """Publish the state. active: whether readings are taken. silent: whether none came in the last second."""
        bridge, changed = self._bridge, self._changed()
        status = bridge.status()
        faults = bridge.report.refused + bridge.report.dropped
        level, text = ("OK", "reading") if faults == self._before else ("WARN", "messages were lost or refused")
        level, text = ("WARN", RESTLESS) if bridge.session.report.restless else (level, text)
        level, text = (level, text) if changed is None else changed
        level, text = ("STALE", "no readings") if silent else (level, text)
        level, text = (level, text) if active else ("OK", "inactive")
        self._before = faults
        state, pair = interface("diagnostic_msgs/msg/DiagnosticStatus"), interface("diagnostic_msgs/msg/KeyValue")
        found = state(
            level=getattr(state, level),
            name=self._name,
            message=text,
            hardware_id=bridge.learner.sensor.name,
            values=[pair(key=key, value=str(value)) for key, value in status.items()],
        )
        array = self._array(status=[found])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self.publisher.publish(array)
