"""A finger on a node: a live session at a topic, its answers, diagnostics, services and parameters."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal

from scroll_tactile_store import StoreError

from scroll_tactile.clients.ros2.bridge import RESTLESS, Answer, Bridge
from scroll_tactile.clients.ros2.inputs import DYNAMIC, Listener, Quality, declare, interface, names_in, verdict
from scroll_tactile.errors import FieldError, InputError, ScrollTactileError
from scroll_tactile.health.diagnosis import advice, in_words
from scroll_tactile.learner import TactileLearner

__all__ = ["TactileNode"]

SILENT = 1.0  # seconds without a reading
TOPICS = {  # the type, and how many messages a late subscriber gets, if it is transient_local, too
    "~/answer": ("std_msgs/msg/String", 10),
    "~/status": ("diagnostic_msgs/msg/DiagnosticArray", 10),
    "~/material": ("std_msgs/msg/String", 1),
    "~/probability": ("std_msgs/msg/Float64", 1),
    "~/novelty": ("std_msgs/msg/Float64", 1),
    "~/known": ("std_msgs/msg/Bool", 1),
    "~/tactile_answer": ("scroll_tactile_msgs/msg/TactileAnswer", 10),
    "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", 0),
}
BY_NAME = ("learn", "forget", "retract", "save")  # services that take a name
PLAIN = ("undo", "materials", "predict", "begin", "end", "again")
OWN = "scroll_tactile_msgs/"  # types that are built from examples/ros2/scroll_tactile_msgs, or are not there


class TactileNode:
    """A learner at a topic, on a node of one's own, lifecycle or not; `serve` makes the node, too.

    A node has one; a hand is a node for each finger, each in a namespace and with a memory of its own.

    topic, field, kind: where the readings are, see `Listener`. risk, contact, of, scene, watch: see `Bridge`. quality:
    of the subscription. listener: one that hears the topic already; topic, kind and quality are its own. answered:
    called with each answer that is published, for what acts in the same process. active: whether readings are taken at
    once; otherwise `activate` does, and `deactivate` ends it: in a lifecycle node call them from on_activate and
    on_deactivate. `close` ends all.

    Topics. A late subscriber that is transient_local gets the last values, and of answers up to ten:

    - `~/answer`, std_msgs/String: an answer as JSON (see `Bridge`), when something changed.
    - `~/status`, diagnostic_msgs/DiagnosticArray: the same by name; its header has the stamp of the last reading.
    - `~/material`, std_msgs/String; `~/probability`, `~/novelty`, std_msgs/Float64; `~/known`, std_msgs/Bool, False
      where it cannot be told: for plots, and all that reads one number.
    - `~/tactile_answer`, scroll_tactile_msgs/TactileAnswer, with a header, where that package was built
      (examples/ros2/scroll_tactile_msgs).
    - `/diagnostics`, once a second: what was met; ERROR for a dead channel, WARN for another change of the sensor (see
      `TactileLearner.health`), and while it does not come to rest.

    Services, whose reply says what was done or why not. With a name, as load_namespace of
    diagnostic_msgs/AddDiagnostics: `~/learn`, the last touch under it; `~/forget`, a material; `~/retract`, an
    observation by its number; `~/save`, the memory as one file beside its folder. Of std_srvs/Trigger: `~/undo`, of
    what was learned last; `~/materials`, JSON of name → observations; `~/predict`, the last touch by the memory as it
    is now, as JSON; `~/begin` and `~/end`, with contact="manual"; `~/again`, before another touch of the same thing.
    Where scroll_tactile_msgs was built `~/tactile_learn`, its Learn, gives the observation's number.

    Parameters, all dynamic: `risk` and `scene`, from the next touch on, with the arguments as defaults, and
    `health_after`: set it to the observation that `/diagnostics` names once a sensor was mended, and only later touches
    count. Where the node has one of them already its value counts. `close` undeclares the others.

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
        scene: Sequence[str] | None = None,
        watch: bool = False,
        quality: Quality | None = None,
        listener: Listener | None = None,
        answered: Callable[[Answer], object] | None = None,
        active: bool = True,
    ) -> None:
        self.node, self.active, self._answered = node, False, answered
        # It hears the topic from here on: what comes meanwhile waits.
        self.listener = Listener(node, topic, kind, quality) if listener is None else listener
        if listener is None and not active:
            self.listener.stop()
        self._declared = declare(node, DYNAMIC, {"risk": float(risk), "scene": list(scene or ()) or ""})
        try:
            how: dict[str, Any] = {"contact": contact, "of": of, "watch": watch, **self._wanted({})}
            self.bridge = Bridge(learner, field, **how, answer=self._publish, warn=node.get_logger().warning)
        except BaseException:
            self._undeclare()
            raise
        self._publishers = {name: self._publisher(name, *how) for name, how in TOPICS.items() if _is_there(how[0])}
        self._services = self._offered()
        self._faults = 0  # that /diagnostics spoke of
        self._changed()  # reads a whole journal the first time, and what came since later
        self._timer = node.create_timer(1.0, self._each_second)
        node.add_on_set_parameters_callback(self._checked)
        node.add_post_set_parameters_callback(self._adjusted)
        if active:
            self.activate()

    def activate(self) -> None:
        """Take readings, those first that waited. Nothing happens where they are taken already."""
        if not self.active:
            if self.bridge.paused:
                self.bridge.resume()
            self.active = True
            self.listener.start(self._take)

    def deactivate(self) -> None:
        """Take no more readings; a touch under way ends, and can be learned."""
        if self.active:
            self.active = False
            self.listener.stop()
            self.bridge.pause()

    def receive(self, message: Any, about: Mapping[str, Any]) -> None:
        """Take a message, as from the topic; about: what ROS says of it."""
        self.listener.receive(message, about)

    def close(self) -> None:
        """End the touch under way, if any, and take all of it off the node, which stays, as does the learner."""
        self.deactivate()
        self.listener.stop()
        self.node.remove_on_set_parameters_callback(self._checked)
        self.node.remove_post_set_parameters_callback(self._adjusted)
        self.node.destroy_timer(self._timer)
        for service in self._services:
            self.node.destroy_service(service)
        for _, publisher in self._publishers.values():
            self.node.destroy_publisher(publisher)
        self._undeclare()

    def _undeclare(self) -> None:
        for name in self._declared:
            self.node.undeclare_parameter(name)

    def _take(self, message: Any, published: float, lost: int) -> None:
        self.bridge.report.dropped += lost
        try:
            self.bridge.receive(message, published)
        except FieldError as error:
            raise FieldError(f"topic {self.listener.topic!r}, {self.listener.kind}: {error}") from error

    # Topics

    def _publisher(self, name: str, kind: str, kept: int) -> tuple[Any, Any]:
        """A topic's type and its publisher. kept: messages that a late subscriber gets."""
        from rclpy.qos import DurabilityPolicy, QoSProfile

        profile = QoSProfile(depth=kept, durability=DurabilityPolicy.TRANSIENT_LOCAL) if kept else 10
        return interface(kind), self.node.create_publisher(interface(kind), name, profile)

    def _send(self, name: str, **fields: Any) -> None:
        kind, publisher = self._publishers[name]
        publisher.publish(kind(**fields))

    def _publish(self, answer: Answer) -> None:
        """Publish an answer in all its forms; nobody can have it any more once ROS has ended."""
        if self.node.context.ok():
            header = interface("std_msgs/msg/Header")(stamp=_time_of(answer["stamp"]))
            material = answer.get("material")
            self._send("~/answer", data=json.dumps(answer))
            self._send("~/status", header=header, status=[self._status(*_standing(answer), _by_key(answer))])
            if "~/tactile_answer" in self._publishers:
                self._send("~/tactile_answer", header=header, **_typed(answer))
            if material is not None:
                self._send("~/material", data=material)
                self._send("~/probability", data=answer["probability"])
                self._send("~/novelty", data=_number(answer["novelty"]))
                self._send("~/known", data=bool(answer["known"]))
        if self._answered is not None:
            self._answered(answer)

    def _status(self, level: str, text: str, values: Mapping[str, str], name: str = "") -> Any:
        kind, pair = interface("diagnostic_msgs/msg/DiagnosticStatus"), interface("diagnostic_msgs/msg/KeyValue")
        said = {"level": getattr(kind, level), "name": f"{self.node.get_name()}{name}", "message": text}
        pairs = [pair(key=key, value=value) for key, value in values.items()]
        return kind(**said, hardware_id=self.bridge.learner.sensor.name, values=pairs)

    def _each_second(self) -> None:
        """Say on /diagnostics what was met, and whether the sensor is still the one that learned."""
        values = {name: str(value) for name, value in self.bridge.status().items()}
        header = interface("std_msgs/msg/Header")(stamp=self.node.get_clock().now().to_msg())
        self._send("/diagnostics", header=header, status=[self._status(*self._state(), values, ": touch")])

    def _state(self) -> tuple[str, str]:
        """The level and the text of what matters most now."""
        before, self._faults = self._faults, self.bridge.report.refused + self.bridge.report.dropped
        changed = self._changed()
        if not self.active:
            return "OK", "inactive"
        if time.monotonic() - self.listener.received > SILENT:
            return "STALE", "no readings"
        if changed is not None:
            return changed
        if self.bridge.session.report.restless:
            return "WARN", RESTLESS
        return ("OK", "reading") if self._faults == before else ("WARN", "messages were lost or refused")

    def _changed(self) -> tuple[str, str] | None:
        """The level and the text of a change of the sensor; None where none is seen, or where it cannot be told."""
        if not self.bridge.learner.has_health:
            return None
        try:
            found = self.bridge.learner.health(after=int(self.node.get_parameter("health_after").value))
        except (ScrollTactileError, StoreError) as error:
            return "WARN", f"the health of the sensor cannot be told: {error}"
        if found.since is None:
            return None
        what = advice(found).replace("--after", "parameter health_after")
        return "ERROR" if found.kind == "dead" else "WARN", f"{in_words(found)}: {what}"

    # Services and parameters

    def _offered(self) -> list[Any]:
        named, plain = interface("diagnostic_msgs/srv/AddDiagnostics"), interface("std_srvs/srv/Trigger")
        kinds = dict.fromkeys(BY_NAME, (named, "load_namespace")) | dict.fromkeys(PLAIN, (plain, ""))
        calls: dict[str, tuple[Any, Callable[..., Any]]] = {
            name: (kind, partial(_reply, getattr(self.bridge, name), field)) for name, (kind, field) in kinds.items()
        }
        if _is_there(f"{OWN}srv/Learn"):
            calls["tactile_learn"] = interface(f"{OWN}srv/Learn"), self._learn
        return [self.node.create_service(kind, f"~/{name}", call) for name, (kind, call) in calls.items()]

    def _learn(self, request: Any, response: Any) -> Any:
        """Serve scroll_tactile_msgs/srv/Learn."""
        _reply(self.bridge.learn, "material", request, response)
        if response.success and self.bridge.receipt is not None:
            response.observation = self.bridge.receipt.sequence
        return response

    def _wanted(self, changed: Mapping[str, Any]) -> dict[str, Any]:
        """Risk and scene by the parameters, of which some change."""
        risk, scene = (changed.get(name, self.node.get_parameter(name).value) for name in ("risk", "scene"))
        return {"risk": float(risk), "scene": names_in(scene) or None}

    def _checked(self, parameters: Sequence[Any]) -> Any:
        """Whether parameters can have these values; ROS sets them where nobody else says no."""
        values = {each.name: each.value for each in parameters}
        refused = verdict(DYNAMIC, values)
        if refused.successful and "scene" in values:
            try:
                self.bridge.check(self._wanted(values)["scene"])
            except InputError as error:
                return verdict((), {}, str(error))
        return refused

    def _adjusted(self, parameters: Sequence[Any]) -> None:
        """Answer by what the parameters are now."""
        if {each.name for each in parameters} & {"risk", "scene"}:
            self.bridge.adjust(**self._wanted({}))


def _is_there(name: str) -> bool:
    """Whether a type can be had; one of another's package is, or its absence is an error where it is used."""
    try:
        return not name.startswith(OWN) or interface(name) is not None
    except InputError:
        return False


def _reply(call: Callable[..., str], field: str, request: Any, response: Any) -> Any:
    """Serve a call: success, and what was done or why not. field: of the request, the call's argument; "" for none."""
    try:
        given = [getattr(request, field)] if field else []
        if given and not given[0].strip():
            raise InputError(f"expected a name, in the request's {field}; came none")
        response.message, response.success = call(*given), True
    except (ScrollTactileError, StoreError, OSError) as error:
        response.message, response.success = str(error), False
    return response


def _time_of(seconds: float) -> Any:
    """A time as builtin_interfaces/msg/Time has it, whose seconds are 32 bits."""
    whole = math.floor(seconds)
    if not 0 <= whole < 2**31:
        return interface("builtin_interfaces/msg/Time")()
    return interface("builtin_interfaces/msg/Time")(sec=whole, nanosec=min(round((seconds - whole) * 1e9), 10**9 - 1))


def _standing(answer: Answer) -> tuple[str, str]:
    """An answer's level and its text, in ~/status."""
    material = answer.get("material")
    if answer.get("known") is False and material is not None:
        return "WARN", "something new"
    return "OK", str(material or answer["event"])


def _by_key(answer: Answer) -> dict[str, str]:
    """An answer as texts by name; what has parts has a name for each."""
    values = {name: value for name, value in answer.items() if name not in ("stamp", "estimates", "ranking")}
    values |= {f"ranking.{name}": chance for name, chance in answer.get("ranking", ())}
    for name, estimate in answer.get("estimates", {}).items():
        values |= {f"estimates.{name}.{part}": estimate[part] for part in ("value", "low", "high", "unit")}
    return {name: _in_text(value) for name, value in values.items()}


def _in_text(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: ""}[value]
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _number(value: float | None) -> float:
    return math.inf if value is None else value


def _typed(answer: Answer) -> dict[str, Any]:
    """The fields of scroll_tactile_msgs/msg/TactileAnswer but its header."""
    found = answer.get("material") is not None
    ranking, estimates = answer.get("ranking", ()), answer.get("estimates", {})
    typed: dict[str, Any] = {name: str(answer.get(name) or "") for name in ("event", "end", "of", "material")}
    typed |= {name: [str(each) for each in answer.get(name, ())] for name in ("unusual", "candidates")}
    for part in ("value", "low", "high"):
        numbers = [each[part] for each in estimates.values()]
        typed[f"quantity_{part}"] = [math.nan if number is None else float(number) for number in numbers]
    return typed | {
        "contact": bool(answer["contact"]),
        "seconds": float(answer.get("seconds", 0.0)),
        "decided": bool(answer.get("decided", False)),
        "known": {False: 0, True: 1, None: 2}[answer.get("known") if found else None],
        "probability": float(answer["probability"]) if found else 0.0,
        "novelty": _number(answer["novelty"]) if found else math.inf,
        "touches": int(answer.get("touches", 1)),
        "ranked": [str(name) for name, _ in ranking],
        "ranked_probability": [float(chance) for _, chance in ranking],
        "quantities": list(estimates),
        "units": [str(each["unit"]) for each in estimates.values()],
    }
