"""A finger on a node: a live session at a topic, its answers, its diagnostics, and services, all of standard types."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

from scroll_tactile_store import StoreError

from scroll_tactile.clients.ros2.answer_fields import Answer
from scroll_tactile.clients.ros2.bridge import Bridge
from scroll_tactile.clients.ros2.interfaces import Quality, interface
from scroll_tactile.clients.ros2.listening import Listener
from scroll_tactile.clients.ros2.parameters import DYNAMIC, names_in, refused, release, share
from scroll_tactile.clients.ros2.publishing import AnswerTopics, Diagnostics
from scroll_tactile.errors import FieldError, InputError, ScrollTactileError
from scroll_tactile.learner import TactileLearner

__all__ = ["TactileNode"]

SILENT = 1.0  # seconds without a reading
_REFUSALS = (ScrollTactileError, StoreError, OSError)


class TactileNode:
    """A learner at a topic, within a node of one's own, lifecycle or not; `serve` makes the node, too.

    topic, field, kind: where the readings are, see `Listener`. risk, contact, of, scene, watch: see `Bridge`. finger:
    a name; then all below lies under `~/FINGER/`, and a node can have several, of one learner. quality: of the
    subscription. listener: one that hears the topic already, for several fingers; topic, kind and quality are its own.
    answered: called with each answer that is published, for what acts in the same process. active: whether readings are
    taken at once; otherwise `activate` does, and `deactivate` ends it: in a lifecycle node call them from on_activate
    and on_deactivate. `close` ends all.

    Topics. A late subscriber that is transient_local gets the last values, and of answers up to ten; of `/diagnostics`
    it gets the next, within a second:

    - `~/answer`, std_msgs/String: an answer as JSON (see `Bridge`), when something changed.
    - `~/status`, diagnostic_msgs/DiagnosticArray: the same by name; its header has the stamp of the last reading.
    - `~/material`, std_msgs/String; `~/probability`, `~/novelty`, std_msgs/Float64; `~/known`, std_msgs/Bool, False
      where it cannot be told: for plots, and all that reads one number.
    - `~/tactile_answer`, scroll_tactile_msgs/TactileAnswer, with a header, where that package was built
      (examples/ros2/scroll_tactile_msgs).
    - `/diagnostics`, once a second: what was met; ERROR for a dead channel, WARN for another change of the sensor (see
      `TactileLearner.health`), and while it does not come to rest.

    Services that take a name, diagnostic_msgs/AddDiagnostics with it as load_namespace; the reply says what was done or
    why not: `~/learn`, the last touch under it; `~/forget`, a material; `~/retract`, an observation by its number;
    `~/save`, the memory as one file beside its folder. Services of std_srvs/Trigger: `~/undo`, of what was learned
    last; `~/materials`, JSON of name → observations; `~/predict`, the last touch by the memory as it is now, as JSON;
    `~/begin` and `~/end`, with contact="manual"; `~/again`, before another touch of the same thing. Where
    scroll_tactile_msgs was built there is `~/tactile_learn`, its Learn, which gives the observation's number.

        ros2 service call /scroll_tactile/learn diagnostic_msgs/srv/AddDiagnostics "{load_namespace: silk}"

    A wrong name, a full disk or a missing touch reaches whoever called, which a topic of names could not report.

    Parameters, all dynamic: `risk` and `scene`, from the next touch on, and `health_after`: set it to the observation
    that `/diagnostics` names once a sensor was mended, and only later touches count. They are the node's, for all its
    fingers: risk and scene are their defaults, 0.05 and all materials where left out, and the last `close` undeclares
    them.

    Raises MissingLibraryError where a package of ROS is missing, InputError for a type that is none, and for a risk or
    scene that is not that of the fingers before, and what `Bridge` raises. A field that the first message does not have
    raises FieldError from the node's executor.
    """

    def __init__(
        self,
        node: Any,
        learner: TactileLearner,
        topic: str,
        field: str,
        *,
        kind: str | None = None,
        risk: float | None = None,
        contact: Literal["auto", "manual"] = "auto",
        of: str | None = None,
        scene: Sequence[str] | None = None,
        watch: bool = False,
        finger: str = "",
        quality: Quality | None = None,
        listener: Listener | None = None,
        answered: Callable[[Answer], object] | None = None,
        active: bool = True,
    ) -> None:
        self.node, self.finger, self.active = node, finger, False
        self._own = listener is None  # heard from here on: what comes meanwhile waits
        self.listener = Listener(node, topic, kind, quality) if listener is None else listener
        if self._own and not active:
            self.listener.stop()
        self._log, self._answered = node.get_logger(), answered
        given = {"risk": None if risk is None else float(risk), "scene": list(scene or ()) or None}
        share(node, {name: value for name, value in given.items() if value is not None})
        try:
            how: dict[str, Any] = {"contact": contact, "of": of, "watch": watch, **self._wanted({})}
            self.bridge = Bridge(learner, field, **how, answer=self._publish, warn=self._warn)
        except BaseException:
            release(node)
            raise
        self._answers = AnswerTopics(node, finger, learner.sensor.name)
        self._diagnostics = Diagnostics(node, self.bridge, finger)
        self._services = self._offered()
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
            if self._own:
                self.listener.start()
            self.listener.give(self._take)

    def deactivate(self) -> None:
        """Take no more readings; a touch under way ends, and can be learned."""
        if self.active:
            self.active = False
            self.listener.leave(self._take)
            if self._own:
                self.listener.stop()
            self.bridge.pause()

    def receive(self, message: Any, about: Mapping[str, Any]) -> None:
        """Take a message, as from the topic; about: what ROS says of it."""
        self.listener.receive(message, about)

    def close(self) -> None:
        """End the touch under way, if any, and take all of it off the node, which stays, as does the learner."""
        self.deactivate()
        self.node.remove_on_set_parameters_callback(self._checked)
        self.node.remove_post_set_parameters_callback(self._adjusted)
        self.node.destroy_timer(self._timer)
        for service in self._services:
            self.node.destroy_service(service)
        for publisher in [*self._answers.publishers, self._diagnostics.publisher]:
            self.node.destroy_publisher(publisher)
        release(self.node)

    def _offered(self) -> list[Any]:
        """The services."""
        bridge = self.bridge
        named = {"learn": bridge.learn, "forget": bridge.forget, "retract": bridge.retract, "save": bridge.save}
        plain = {name: getattr(bridge, name) for name in ("undo", "materials", "predict", "begin", "end", "again")}
        by_name, trigger = interface("diagnostic_msgs/srv/AddDiagnostics"), interface("std_srvs/srv/Trigger")
        made = [self._service(by_name, name, _by_name(call)) for name, call in named.items()]
        made += [self._service(trigger, name, _plain(call)) for name, call in plain.items()]
        try:
            typed = interface("scroll_tactile_msgs/srv/Learn")
        except InputError:  # it is built from examples/ros2/scroll_tactile_msgs, or it is not there
            return made
        return [*made, self._service(typed, "tactile_learn", self._learn)]

    def _service(self, kind: Any, name: str, call: Callable[[Any, Any], Any]) -> Any:
        return self.node.create_service(kind, f"{self._answers.place}{name}", call)

    def _learn(self, request: Any, response: Any) -> Any:
        """Serve scroll_tactile_msgs/srv/Learn."""
        _answer(response, lambda: self.bridge.learn(request.material))
        if response.success and self.bridge.receipt is not None:
            response.observation = self.bridge.receipt.sequence
        return response

    def _take(self, message: Any, published: float, lost: int) -> None:
        self.bridge.report.dropped += lost
        try:
            self.bridge.receive(message, published)
        except FieldError as error:
            raise FieldError(f"topic {self.listener.topic!r}, {self.listener.kind}: {error}") from error

    def _publish(self, answer: Answer) -> None:
        self._answers.publish(answer)
        if self._answered is not None:
            self._answered(answer)

    def _warn(self, text: str) -> None:
        self._log.warning(f"{self.finger}: {text}" if self.finger else text)

    def _each_second(self) -> None:
        self._diagnostics.publish(active=self.active, silent=time.monotonic() - self.listener.received > SILENT)

    def _wanted(self, changed: Mapping[str, Any]) -> dict[str, Any]:
        """Risk and scene by the parameters, of which some change."""
        risk, scene = (changed.get(name, self.node.get_parameter(name).value) for name in ("risk", "scene"))
        return {"risk": float(risk), "scene": names_in(scene) or None}

    def _checked(self, parameters: Sequence[Any]) -> Any:
        """Whether parameters can have these values; ROS sets them where nobody else says no."""
        result = interface("rcl_interfaces/msg/SetParametersResult")
        values = {each.name: each.value for each in parameters}
        why = "; ".join(filter(None, (refused(each, values[each.name]) for each in DYNAMIC if each.name in values)))
        if not why and values.keys() & {"risk", "scene"}:
            try:
                self.bridge.check(self._wanted(values)["scene"])
            except InputError as error:
                why = str(error)
        return result(successful=not why, reason=why)

    def _adjusted(self, parameters: Sequence[Any]) -> None:
        """Answer by what the parameters are now."""
        if {each.name for each in parameters} & {"risk", "scene"}:
            self.bridge.adjust(**self._wanted({}))


def _answer(response: Any, call: Callable[[], str]) -> Any:
    """A response with success and message: what was done, or the error."""
    try:
        response.message, response.success = call(), True
    except _REFUSALS as error:
        response.message, response.success = str(error), False
    return response


def _plain(call: Callable[[], str]) -> Callable[[Any, Any], Any]:
    return lambda request, response: _answer(response, call)


def _by_name(call: Callable[[str], str]) -> Callable[[Any, Any], Any]:
    def answered(request: Any, response: Any) -> Any:
        return _answer(response, lambda: call(_named(request.load_namespace)))

    return answered


def _named(name: str) -> str:
    if not name.strip():
        raise InputError("expected a name, in the request's load_namespace; came none")
    return name
