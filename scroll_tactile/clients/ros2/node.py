"""The node scroll_tactile: a lifecycle node with one finger, its topics, services and parameters."""

from __future__ import annotations

import json
import math
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from scroll_tactile_store import StoreError

from scroll_tactile.clients.ros2.bridge import RESTLESS, Answer, Bridge
from scroll_tactile.clients.ros2.inputs import DYNAMIC, PARAMETERS, Listener, interface, names_in, require_rclpy
from scroll_tactile.errors import FieldError, InputError, ScrollTactileError
from scroll_tactile.health.diagnosis import advice, in_words
from scroll_tactile.learner import TactileLearner
from scroll_tactile.recordings import presets
from scroll_tactile.recordings.paths import FieldPath, nearest
from scroll_tactile.sensors import Sensor, read_sensor

try:
    from rclpy.lifecycle import LifecycleNode
except ImportError:  # a node that is made says how to get it
    LifecycleNode = object

__all__ = ["TactileNode", "serve"]

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
OWN = "scroll_tactile_msgs/"  # types that are built from examples/ros2/scroll_tactile_msgs, or are not there
SERVICES = {  # the type, and the field of its request that is the call's argument; "" for none
    **dict.fromkeys(("learn", "forget", "retract", "save"), ("diagnostic_msgs/srv/AddDiagnostics", "load_namespace")),
    **dict.fromkeys(("undo", "materials", "predict", "begin", "end", "again"), ("std_srvs/srv/Trigger", "")),
    "tactile_learn": ("scroll_tactile_msgs/srv/Learn", "material"),
}


class TactileNode(LifecycleNode):  # type: ignore[misc]  # rclpy's, which may not be here
    """The lifecycle node scroll_tactile, for an executor of one's own; `serve` makes it and runs it.

    memory: a learner, which stays open, or the folder of a memory, which is opened to learn, and closed. context: of
    rclpy; None: its default. All others are defaults of the node's parameters, as `ros2 param describe` lists them
    (`type`, `preset`, `risk`, `scene`, …): what ROS is given wins, by `--ros-args -p risk:=0.02`, `--params-file` or a
    launch file. The how-to page on ROS 2 lists topics, services and parameters.

    configure opens the memory and offers topics and services, activate takes readings, deactivate ends a touch under
    way, cleanup closes the memory. `start` does the first two, and `clean_up` ends all. `answered` is for a subclass
    that acts in the same process. bridge: the `Bridge`, where the node is configured. error: why the last transition
    failed. met: what was met, by name, when it was cleaned up.

    A node has one finger; a hand is a node for each, each in a namespace and with a memory of its own.

    Raises MissingLibraryError without rclpy, and InputError for parameters that there are not or that cannot be. A
    field that the first message does not have raises FieldError from the node's executor.
    """

    def __init__(
        self,
        memory: TactileLearner | str | Path | None = None,
        topic: str = "",
        field: str = "",
        *,
        context: Any = None,
        **parameters: Any,
    ) -> None:
        for name in parameters:
            if name not in PARAMETERS:
                raise InputError(f"there is no parameter {name!r}{nearest(name, list(PARAMETERS))}")
        require_rclpy()
        super().__init__("scroll_tactile", context=context)
        self._own = None if memory is None or isinstance(memory, str | Path) else memory
        self.bridge: Any = None
        self.active = False
        self.listener: Any = None
        self._kind: str | None = None  # of the topic when it was last heard: a publisher may be gone meanwhile
        self.opening: Future[TactileLearner] | None = None  # until the memory is let go
        self.error: Exception | None = None
        self.met: dict[str, int | bool] = {}
        self._sent: dict[str, tuple[Any, Any]] = {}  # by topic its type and its publisher
        self._served: list[Any] = []
        self._timer: Any = None
        self._faults = 0  # that /diagnostics spoke of
        path = str(memory or "") if self._own is None else ""
        defaults = {"memory": path, "topic": topic, "field": field} | parameters
        for name, each in PARAMETERS.items():
            default = defaults.get(name, each.default)
            try:
                self.declare_parameter(name, default or type(each.default)(), each.descriptor(name))
            except Exception as error:  # rclpy's own, whose place has changed from release to release
                raise InputError(f"parameter {name}: {error}") from error
            if why := each.refused(name, self.value(name)):
                raise InputError(why)
        self.add_on_set_parameters_callback(self._checked)
        self.add_post_set_parameters_callback(self._adjusted)

    def answered(self, answer: Answer) -> None:
        """Called with each answer when it was published, see `Bridge`; here nothing is done."""

    def value(self, name: str) -> Any:
        """A parameter's value."""
        return self.get_parameter(name).value

    def start(self, running: Callable[[], bool] | None = None) -> None:
        """Configure and activate, and hear the topic while the memory is opened. Raises what hinders it.

        running: called until the memory is open, to spin; where it returns False the node is left as it is.
        """
        self.listen()
        opening = self.open()
        while running is not None and not opening.done():
            if not running():
                return
        opening.result()
        if self.bridge is not None or self.opening is not opening:
            self.get_logger().info("somebody else configured the node meanwhile: to activate it is left to them")
            return
        for name in ("configure", "activate"):
            done = getattr(self, f"trigger_{name}")()
            if done != type(done).SUCCESS:
                raise self.error or ScrollTactileError(f"ROS did not {name} the node, and gave no reason: see its log")

    def on_configure(self, state: Any) -> Any:
        """Called by ROS."""
        return self._taken(self.configure, self.clean_up)

    def on_activate(self, state: Any) -> Any:
        """Called by ROS."""
        return self._taken(self.activate, self.deactivate)

    def on_deactivate(self, state: Any) -> Any:
        """Called by ROS."""
        return self._taken(self.deactivate)

    def on_cleanup(self, state: Any) -> Any:
        """Called by ROS."""
        return self._taken(self.clean_up)

    on_shutdown = on_error = on_cleanup

    def _taken(self, *steps: Callable[[], None]) -> Any:
        """Take the first step; where anything hinders it, which rclpy would drop without a word, log it and go on."""
        from rclpy.lifecycle import TransitionCallbackReturn

        self.error = None
        for step in steps:
            try:
                step()
                break
            except Exception as error:
                self.error = self.error or error
                expected = isinstance(error, ScrollTactileError | StoreError | OSError)
                self.get_logger().error(str(error) if expected else traceback.format_exc())
        return TransitionCallbackReturn.SUCCESS if self.error is None else TransitionCallbackReturn.FAILURE

    def listen(self) -> str:
        """Check the parameters, and hear the topic: what comes waits. Returns the path to the numbers in a message.

        Raises InputError and FieldError for parameters that cannot be, MissingLibraryError for an absent type.
        """
        preset = self.value("preset")
        known = presets.find(preset) if preset else None
        topic = self.value("topic").strip() or getattr(known, "topic", None) or ""
        field: str = self.value("field").strip() or getattr(known, "field", "")
        if missing := " and ".join(f"{name}=" for name, given in (("topic", topic), ("field", field)) if not given):
            raise InputError(
                f"expected {missing}: where the readings are, such as topic='/rh/tactile' "
                "field='tactiles[0].electrodes'"
                + (f". Preset {preset!r} leaves the topic to the robot" if known else "; or preset= of a known sensor"),
                argument="topic field preset",
            )
        FieldPath(field)
        if self._own is None:
            self._new_sensor()
        if self.listener is None:
            asked = tuple(self.value(f"qos.{name}") for name in ("reliability", "durability", "depth"))
            self.listener = Listener(self, topic, self.value("type") or self._kind, asked)
        return field

    def _new_sensor(self) -> Sensor | None:
        """The sensor that is named, if any; without a memory also that of a preset, or raises InputError."""
        memory, sensor, preset = (self.value(name) for name in ("memory", "sensor", "preset"))
        if not memory:
            raise InputError("expected memory=: the folder of the memory", argument="memory")
        if sensor or Path(memory).exists():
            return read_sensor(sensor) if sensor else None
        if preset:
            return presets.find(preset).sensor
        raise InputError(
            f"there is no memory in {memory}; to make one, say which sensor it is for: sensor= or preset=",
            argument="sensor preset",
        )

    def open(self) -> Future[TactileLearner]:
        """Have a thread open the memory, and do what takes seconds the first time, unless one does or did."""
        if self.opening is None:
            pool = ThreadPoolExecutor(1)
            self.opening = pool.submit(self._opened)
            pool.shutdown(wait=False)
        return self.opening

    def _opened(self) -> TactileLearner:
        learner = self._own
        if learner is None:
            sensor = self._new_sensor()
            learner = TactileLearner.open(Path(self.value("memory")), sensor=sensor, mode=self.value("mode"))
        try:
            learner.live(risk=self.value("risk"), contact="manual", of=self.value("of") or None).close()
            self._changed(learner)  # reads a whole journal the first time
        except BaseException:
            if learner is not self._own:
                learner.close()
            raise
        return learner

    def configure(self) -> None:
        """Open the memory, or wait until it is open, and offer topics and services. Raises what hinders it."""
        from rclpy.qos import DurabilityPolicy, QoSProfile

        field = self.listen()
        learner = self.open().result()
        how = {"contact": self.value("contact"), "of": self.value("of") or None, "watch": self.value("watch")}
        warn = self.get_logger().warning
        self.bridge = Bridge(learner, field, **how, **self._wanted(), answer=self._publish, warn=warn)
        for name, (of, kept) in TOPICS.items():
            if (kind := _built(of)) is not None:
                profile = QoSProfile(depth=kept, durability=DurabilityPolicy.TRANSIENT_LOCAL) if kept else 10
                self._sent[name] = kind, self.create_publisher(kind, name, profile)
        for name, (of, argument) in SERVICES.items():
            if (kind := _built(of)) is not None:
                call = partial(self._reply, getattr(self.bridge, name.removeprefix("tactile_")), argument)
                self._served.append(self.create_service(kind, f"~/{name}", call))
        self._timer = self.create_timer(1.0, self._each_second)

    def activate(self) -> None:
        """Take readings, those first that waited."""
        if self.bridge.paused:
            self.bridge.resume()
        self.listen()
        self.active = True
        self.listener.give(self.take)

    def deactivate(self) -> None:
        """Take no more readings; a touch under way ends, and can be learned."""
        self.active = False
        if self.listener is not None:
            self.listener.stop()
            self.listener, self._kind = None, self.listener.kind
        if self.bridge is not None and not self.bridge.paused:
            self.bridge.pause()

    def clean_up(self) -> None:
        """Let all go, the memory, too; a second call does nothing."""
        self.deactivate()
        if self.bridge is not None:
            for name, count in self.bridge.status().items():
                before = self.met.get(name, 0)
                self.met[name] = bool(before or count) if isinstance(count, bool) else before + count
        if self._timer is not None:
            self.destroy_timer(self._timer)
        for service in self._served:
            self.destroy_service(service)
        for _, publisher in self._sent.values():
            self.destroy_publisher(publisher)
        self.bridge, self._timer, self._kind, self._served, self._sent = None, None, None, [], {}
        opening, self.opening = self.opening, None
        if opening is not None and opening.exception() is None:  # waits for it
            self.met["materials"] = len(opening.result().materials)
            if opening.result() is not self._own:
                opening.result().close()

    def take(self, message: Any, published: float, lost: int) -> None:
        """Take a message of the topic, published at this time in seconds; lost: how many were before it."""
        self.bridge.report.dropped += lost
        try:
            self.bridge.receive(message, published)
        except FieldError as error:
            raise FieldError(f"topic {self.listener.topic!r}, {self.listener.kind}: {error}") from error

    def _send(self, name: str, **fields: Any) -> None:
        kind, publisher = self._sent[name]
        publisher.publish(kind(**fields))

    def _publish(self, answer: Answer) -> None:
        """Publish an answer in all its forms; nobody can have it any more once ROS has ended."""
        if self.context.ok():
            header = interface("std_msgs/msg/Header")(stamp=_time_of(answer["stamp"]))
            material = answer.get("material")
            self._send("~/answer", data=json.dumps(answer))
            new = material is not None and answer["known"] is False
            standing = ("WARN", "something new") if new else ("OK", str(material or answer["event"]))
            self._send("~/status", header=header, status=[self._status(*standing, _by_key(answer))])
            if "~/tactile_answer" in self._sent:
                self._send("~/tactile_answer", header=header, **_typed(answer))
            if material is not None:
                self._send("~/material", data=material)
                self._send("~/probability", data=answer["probability"])
                self._send("~/novelty", data=_number(answer["novelty"]))
                self._send("~/known", data=bool(answer["known"]))
        self.answered(answer)

    def _status(self, level: str, text: str, values: Mapping[str, str], name: str = "") -> Any:
        kind, pair = interface("diagnostic_msgs/msg/DiagnosticStatus"), interface("diagnostic_msgs/msg/KeyValue")
        said = {"level": getattr(kind, level), "name": f"{self.get_name()}{name}", "message": text}
        pairs = [pair(key=key, value=value) for key, value in values.items()]
        return kind(**said, hardware_id=self.bridge.learner.sensor.name, values=pairs)

    def _each_second(self) -> None:
        """Say on /diagnostics what was met, and whether the sensor is still the one that learned."""
        values = {name: str(value) for name, value in self.bridge.status().items()}
        header = interface("std_msgs/msg/Header")(stamp=self.get_clock().now().to_msg())
        self._send("/diagnostics", header=header, status=[self._status(*self._state(), values, ": touch")])

    def _state(self) -> tuple[str, str]:
        """The level and the text of what matters most now."""
        before, self._faults = self._faults, self.bridge.report.refused + self.bridge.report.dropped
        changed = self._changed(self.bridge.learner)
        if not self.active:
            return "OK", "inactive"
        if time.monotonic() - self.listener.received > SILENT:
            return "STALE", "no readings"
        if changed is not None:
            return changed
        if self.bridge.session.report.restless:
            return "WARN", RESTLESS
        return ("OK", "reading") if self._faults == before else ("WARN", "messages were lost or refused")

    def _changed(self, learner: TactileLearner) -> tuple[str, str] | None:
        """The level and the text of a change of the sensor; None where none is seen, or where it cannot be told."""
        if not learner.has_health:
            return None
        try:
            found = learner.health(after=self.value("health_after"))
        except (ScrollTactileError, StoreError) as error:
            return "WARN", f"the health of the sensor cannot be told: {error}"
        if found.since is None:
            return None
        what = advice(found).replace("--after", "parameter health_after")
        return "ERROR" if found.kind == "dead" else "WARN", f"{in_words(found)}: {what}"

    def _reply(self, call: Callable[..., str], argument: str, request: Any, response: Any) -> Any:
        """Serve a call: success, and what was done or why not. argument: the request's field that has it, or ""."""
        try:
            given = [getattr(request, argument)] if argument else []
            if given and not given[0].strip():
                raise InputError(f"expected a name, in the request's {argument}; came none")
            response.message, response.success = call(*given), True
            if hasattr(response, "observation"):
                response.observation = self.bridge.receipt.sequence
        except (ScrollTactileError, StoreError, OSError) as error:
            response.message, response.success = str(error), False
        return response

    def _wanted(self) -> dict[str, Any]:
        """Risk and scene by the parameters."""
        return {"risk": self.value("risk"), "scene": names_in(self.value("scene")) or None}

    def _checked(self, parameters: Sequence[Any]) -> Any:
        """Whether parameters can have these values now; ROS sets them where nobody else says no."""
        values = {each.name: each.value for each in parameters if each.name in PARAMETERS}
        why = "; ".join(filter(None, (PARAMETERS[name].refused(name, value) for name, value in values.items())))
        fixed = [name for name in values if name not in DYNAMIC]
        if not why and fixed and self.opening is not None:
            why = (
                f"parameter {fixed[0]} is read when the node is configured: ros2 lifecycle set "
                f"{self.get_fully_qualified_name()} deactivate and cleanup first, then configure and activate"
            )
        if not why and "scene" in values and self.bridge is not None:
            try:
                self.bridge.check(names_in(values["scene"]) or None)
            except InputError as error:
                why = str(error)
        return interface("rcl_interfaces/msg/SetParametersResult")(successful=not why, reason=why)

    def _adjusted(self, parameters: Sequence[Any]) -> None:
        """Answer by what the parameters are now."""
        if self.bridge is not None and {each.name for each in parameters} & {"risk", "scene"}:
            self.bridge.adjust(**self._wanted())


def _built(name: str) -> Any:
    """The class of a type; None for one of scroll_tactile_msgs where that was not built."""
    try:
        return interface(name)
    except InputError:
        if name.startswith(OWN):
            return None
        raise


def _time_of(seconds: float) -> Any:
    """A time as builtin_interfaces/msg/Time has it, whose seconds are 32 bits."""
    whole = math.floor(seconds)
    if not 0 <= whole < 2**31:
        return interface("builtin_interfaces/msg/Time")()
    return interface("builtin_interfaces/msg/Time")(sec=whole, nanosec=min(round((seconds - whole) * 1e9), 10**9 - 1))


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


def serve(
    memory: TactileLearner | str | Path | None = None,
    topic: str = "",
    field: str = "",
    *,
    arguments: Sequence[str] = (),
    **parameters: Any,
) -> dict[str, int | bool]:
    """Run a `TactileNode` until ctrl-C or SIGTERM, or until ROS ends; returns what it met, by name.

    arguments: of ROS; the others are those of the node. It brings itself up to active, unless the parameter `autostart`
    is False or a manager configures it while the memory opens, and hears the topic before the memory is open: what
    comes meanwhile waits. At ctrl-C a callback under way is finished first; a second ctrl-C interrupts it.

    Raises what `TactileNode` and `TactileLearner.open` raise, FieldError for a field that the first message does not
    have, and InputError for arguments that ROS refuses.
    """
    rclpy = require_rclpy()
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    context = rclpy.Context()
    node: Any = None
    with _interruptible() as ended:
        try:
            try:
                rclpy.init(args=list(arguments), context=context, signal_handler_options=SignalHandlerOptions.NO)
                node = TactileNode(memory, topic, field, context=context, **parameters)
            except RuntimeError as error:  # rclpy's own, or one that its C library raises
                how = " ".join(arguments) or "no arguments"
                raise InputError(f"ROS refuses to start with {how}: {error}") from error
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)

            def running() -> bool:
                if not ended.is_set() and context.ok():
                    executor.spin_once(timeout_sec=0.1)
                return not ended.is_set() and bool(context.ok())

            if node.value("autostart"):
                node.start(running)
            while running():
                pass
        except ExternalShutdownException:
            pass
        finally:
            if node is not None:
                node.clean_up()
            rclpy.try_shutdown(context=context)
    return dict(node.met)


@contextmanager
def _interruptible() -> Iterator[threading.Event]:
    """An event that the first SIGINT or SIGTERM sets; the handlers before are back after it. In other threads none."""
    ended, main = threading.Event(), threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM) if main}

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
