"""The node scroll_tactile: a lifecycle node where ROS has one, from its parameters to its end."""

from __future__ import annotations

import signal
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scroll_tactile_store import StoreError

from scroll_tactile.clients.ros2.fingers import Finger, fingers_of, new_sensor
from scroll_tactile.clients.ros2.interfaces import Quality, interface, require_rclpy
from scroll_tactile.clients.ros2.listening import Listener
from scroll_tactile.clients.ros2.parameters import DYNAMIC, STATIC, declare, refused, require_known, texts
from scroll_tactile.errors import InputError, ScrollTactileError

if TYPE_CHECKING:
    from scroll_tactile.clients.ros2.node import TactileNode
    from scroll_tactile.learner import TactileLearner

__all__ = ["serve"]

_EXPECTED = (ScrollTactileError, StoreError, OSError)


class _Served:
    """What the node does in each of its states.

    own: a learner that is open already, and stays so; None: the parameter memory says where it is. values: defaults of
    parameters. managed: whether the node has a lifecycle. opening: of the memory, from its beginning until it is let
    go; None before and after. error: why the last transition failed. met: what was met, when it was cleaned up.
    """

    def __init__(self, node: Any, own: TactileLearner | None, values: Mapping[str, Any], managed: bool) -> None:
        self.node, self._own, self.managed = node, own, managed
        self.opening: Future[TactileLearner] | None = None
        self.fingers: list[TactileNode] = []
        self.met: dict[str, int | bool] = {}
        self.error: Exception | None = None
        self._listeners: dict[str, Listener] = {}
        declare(node, [*STATIC, *DYNAMIC], values)
        node.add_on_set_parameters_callback(self._checked)

    def value(self, name: str) -> Any:
        """A parameter's value."""
        return self.node.get_parameter(name).value

    def listen(self) -> list[Finger]:
        """Check the parameters, and hear the topics: what comes waits. Returns the fingers.

        Raises InputError and FieldError for parameters that cannot be, MissingLibraryError for an absent type.
        """
        topics, fields, names = (texts(self.value(name)) for name in ("topic", "field", "finger"))
        fingers = fingers_of(topics, fields, names, self.value("preset"))
        if self._own is None:
            if not self.value("memory"):
                raise InputError("expected memory=: the folder of the memory")
            new_sensor(Path(self.value("memory")), self.value("sensor"), self.value("preset"))
        kind = self.value("type") or None
        quality = Quality(*(self.value(f"qos.{name}") for name in ("reliability", "durability", "depth")))
        for topic in {finger.topic for finger in fingers}:
            if topic in self._listeners:
                self._listeners[topic].start()
            else:
                self._listeners[topic] = Listener(self.node, topic, kind, quality)
        return fingers

    def open(self) -> Future[TactileLearner]:
        """Have a thread open the memory, and do what takes seconds the first time, unless one does or did."""
        if self.opening is None:
            names = ("memory", "sensor", "preset", "mode", "risk", "of", "health_after")
            pool = ThreadPoolExecutor(1)
            self.opening = pool.submit(self._opened, {name: self.value(name) for name in names})
            pool.shutdown(wait=False)
        return self.opening

    def _opened(self, values: Mapping[str, Any]) -> TactileLearner:
        from scroll_tactile.learner import TactileLearner

        learner = self._own
        if learner is None:
            path = Path(values["memory"])
            sensor = new_sensor(path, values["sensor"], values["preset"])
            learner = TactileLearner.open(path, sensor=sensor, mode=values["mode"])
        try:
            learner.live(risk=values["risk"], contact="manual", of=values["of"] or None).close()
            if learner.has_health:
                self._warm_health(learner, values["health_after"])
        except BaseException:
            if learner is not self._own:
                learner.close()
            raise
        return learner

    def _warm_health(self, learner: TactileLearner, after: int) -> None:
        """Read the rows that /diagnostics will ask about; a damaged one is no reason not to answer."""
        try:
            learner.health(after=after)
        except (ScrollTactileError, StoreError) as error:
            self.node.get_logger().warning(f"the health of the sensor cannot be told: {error}")

    def configure(self) -> None:
        """Open the memory, or wait until it is open, and offer topics and services. Raises what hinders it."""
        from scroll_tactile.clients.ros2.node import TactileNode

        fingers = self.listen()
        learner = self.open().result()
        how = {name: self.value(name) for name in ("contact", "watch")}
        for each in fingers:
            more: dict[str, Any] = {"listener": self._listeners[each.topic], "finger": each.name, "active": False}
            of = self.value("of") or None
            self.fingers.append(TactileNode(self.node, learner, each.topic, each.field, of=of, **how, **more))

    def activate(self) -> None:
        """Take readings. Raises what the first of them raises."""
        self.listen()
        for finger in self.fingers:
            finger.activate()

    def deactivate(self) -> None:
        """Take no more readings; touches under way end. What was not yet taken is gone."""
        for finger in self.fingers:
            finger.deactivate()
        for listener in self._listeners.values():
            listener.stop()

    def clean_up(self) -> None:
        """Let all go, the memory, too; a second call does nothing."""
        self.deactivate()
        for finger in self.fingers:
            for name, count in finger.bridge.status().items():
                before = self.met.get(name, 0)
                self.met[name] = bool(before or count) if isinstance(count, bool) else before + count
            finger.close()
        self.fingers, self._listeners = [], {}
        opening, self.opening = self.opening, None
        if opening is not None and opening.exception() is None:  # waits for it
            learner = opening.result()
            self.met["materials"] = len(learner.materials)
            if learner is not self._own:
                learner.close()

    def tried(self, step: Callable[[], None], otherwise: Callable[[], None] | None = None) -> bool:
        """Take a step of a transition; whether it could be taken. What hinders it is logged, and is `error` then.

        otherwise: what is done then.
        """
        self.error = self._hindered(step)
        if self.error is not None and otherwise is not None:
            self._hindered(otherwise)
        return self.error is None

    def _hindered(self, step: Callable[[], None]) -> Exception | None:
        """What hinders a step. Any exception: rclpy would drop it without a word."""
        try:
            step()
        except Exception as error:
            said = str(error) if isinstance(error, _EXPECTED) else traceback.format_exc()
            self.node.get_logger().error(said)
            return error
        return None

    def _checked(self, parameters: Sequence[Any]) -> Any:
        result = interface("rcl_interfaces/msg/SetParametersResult")
        for parameter in parameters:
            known = next((each for each in (*STATIC, *DYNAMIC) if each.name == parameter.name), None)
            why = "" if known is None else refused(known, parameter.value)
            if known in STATIC and self.opening is not None and not why:
                why = f"parameter {parameter.name} is read when the node {self._how_to_change(parameter)}"
            if why:
                return result(successful=False, reason=why)
        return result(successful=True)

    def _how_to_change(self, parameter: Any) -> str:
        if not self.managed:
            return f"starts: end it, and start it with --ros-args -p {parameter.name}:=VALUE"
        node = self.node.get_fully_qualified_name()
        return f"is configured: ros2 lifecycle set {node} deactivate and cleanup first, then configure and activate"


def _node(rclpy: Any, context: Any) -> tuple[Any, bool]:
    """The node scroll_tactile, and whether it has a lifecycle; its attribute `served` does what its states are for."""
    try:
        from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
    except ImportError:  # of a client without it, or without lifecycle_msgs
        return rclpy.create_node("scroll_tactile", context=context), False
    results = {True: TransitionCallbackReturn.SUCCESS, False: TransitionCallbackReturn.FAILURE}

    class Node(LifecycleNode):  # type: ignore[misc]  # of ROS 2, which may not be here
        served: _Served

        def on_configure(self, state: Any) -> Any:
            return results[self.served.tried(self.served.configure, self.served.clean_up)]

        def on_activate(self, state: Any) -> Any:
            return results[self.served.tried(self.served.activate, self.served.deactivate)]

        def on_deactivate(self, state: Any) -> Any:
            return results[self.served.tried(self.served.deactivate)]

        def on_cleanup(self, state: Any) -> Any:
            return results[self.served.tried(self.served.clean_up)]

        on_shutdown = on_error = on_cleanup

    return Node("scroll_tactile", context=context), True


def serve(
    memory: TactileLearner | str | Path | None = None,
    topic: str | Sequence[str] = "",
    field: str | Sequence[str] = "",
    *,
    arguments: Sequence[str] = (),
    **parameters: Any,
) -> dict[str, int | bool]:
    """Run the node scroll_tactile until ctrl-C or SIGTERM, or until ROS ends; returns what it met, by name.

    memory: a learner, which stays open, or the folder of a memory, which is opened to learn, and closed. All are
    defaults of the node's parameters, those by name, too, as `ros2 param describe` lists them (`type`, `preset`,
    `risk`, `scene`, `finger`, `autostart`, …): what ROS is given wins, by `--ros-args -p risk:=0.02`, `--params-file`
    or a launch file. arguments: of ROS. Topics and services: see `TactileNode`.

    The node has a lifecycle (https://design.ros2.org/articles/node_lifecycle.html): configure opens the memory and
    offers services, activate takes readings, deactivate ends a touch under way, cleanup closes the memory. It brings
    itself up to active, unless `autostart` is False or a manager configures it while the memory opens, and hears the
    topics before the memory is open: what comes meanwhile waits. Where rclpy has no lifecycle it is a plain node, which
    is active until it ends.

    A callback under way is finished first; a second ctrl-C interrupts it.

    Raises what `TactileNode` and `TactileLearner.open` raise, FieldError for a field that the first message does not
    have, and InputError for parameters that there are not or that cannot be, and for arguments that ROS refuses.
    """
    require_known(parameters)
    rclpy = require_rclpy()
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    own = None if memory is None or isinstance(memory, str | Path) else memory
    named = {"memory": str(memory or "")} if own is None else {}
    values = named | {"topic": topic, "field": field} | parameters
    context = rclpy.Context()
    with _interruptible() as ended:
        try:
            rclpy.init(args=list(arguments), context=context, signal_handler_options=SignalHandlerOptions.NO)
            node, managed = _node(rclpy, context)
        except Exception as error:  # one of rclpy's own, whose place has changed from release to release
            raise InputError(f"ROS refuses to start with {' '.join(arguments) or 'no arguments'}: {error}") from error
        served: _Served | None = None
        try:
            served = node.served = _Served(node, own, {name: _listed(value) for name, value in values.items()}, managed)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)

            def running() -> bool:
                if not ended.is_set() and context.ok():
                    executor.spin_once(timeout_sec=0.1)
                return not ended.is_set() and bool(context.ok())

            if served.value("autostart") or not managed:
                _start(served, running)
            while running():
                pass
        except ExternalShutdownException:
            pass
        finally:
            if served is not None:
                served.clean_up()
            rclpy.try_shutdown(context=context)
        return {} if served is None else served.met


def _start(served: _Served, running: Callable[[], bool]) -> None:
    """Bring the node up to active, and hear its topics while the memory is opened. Raises what hinders it."""
    served.listen()
    opening, node = served.open(), served.node
    while not opening.done():
        if not running():
            return
    opening.result()
    if served.fingers or served.opening is not opening:
        node.get_logger().info(
            "somebody else configured the node while the memory opened: to activate it is left to them"
        )
    elif served.managed:
        for name in ("configure", "activate"):
            done = getattr(node, f"trigger_{name}")()
            if done != type(done).SUCCESS:
                raise served.error or ScrollTactileError(
                    f"ROS did not {name} the node, and gave no reason: see its log"
                )
    else:
        node.get_logger().warning("rclpy has no lifecycle here: a plain node, active until it ends")
        served.configure()
        served.activate()


def _listed(value: object) -> object:
    """A parameter's default as ROS has it."""
    if value is None:
        return ""
    if isinstance(value, str | bool | float | int):
        return value
    return [str(each) for each in value] or "" if isinstance(value, Sequence) else value


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
