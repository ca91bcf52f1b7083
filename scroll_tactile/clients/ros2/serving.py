"""The node scroll_tactile: a lifecycle node with one finger, from its parameters to its end."""

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

from scroll_tactile.clients.ros2.inputs import DYNAMIC, PARAMETERS, Listener, Quality, declare, require_rclpy, verdict
from scroll_tactile.errors import InputError, ScrollTactileError
from scroll_tactile.recordings import presets
from scroll_tactile.recordings.paths import FieldPath, nearest
from scroll_tactile.sensors import Sensor, read_sensor

if TYPE_CHECKING:
    from scroll_tactile.learner import TactileLearner

__all__ = ["serve"]


def _place(topic: str, field: str, preset: str) -> tuple[str, str]:
    """The topic, and the path to the numbers in its messages; a preset gives what is empty.

    Raises InputError where one is missing; FieldError for an unknown preset, and for a field that is no path.
    """
    known = presets.find(preset) if preset else None
    if known is not None:
        topic, field = topic or known.topic or "", field or known.field
    if missing := " and ".join(f"{name}=" for name, given in {"topic": topic, "field": field}.items() if not given):
        raise InputError(
            f"expected {missing}: where the readings are, such as topic='/rh/tactile' field='tactiles[0].electrodes'"
            + (f". Preset {preset!r} leaves the topic to the robot" if known else "; or preset= of a known sensor")
        )
    FieldPath(field)
    return topic, field


def _new_sensor(memory: str, sensor: str, preset: str) -> Sensor | None:
    """The sensor that is named, "" for none; where there is no memory yet also that of a preset.

    Raises InputError for an unknown sensor, and where there is neither a memory nor a sensor to make one for.
    """
    if not memory:
        raise InputError("expected memory=: the folder of the memory")
    if sensor:
        return read_sensor(sensor)
    if Path(memory).exists():
        return None
    if preset:
        return presets.find(preset).sensor
    raise InputError(f"there is no memory in {memory}; to make one, say which sensor it is for: sensor= or preset=")


class _States:
    """What the node does in each of its states; the rest of it is rclpy's LifecycleNode, see `_node`.

    own: a learner that is open already, and stays so; None: the parameter memory says where it is. finger: the
    `TactileNode`, where the node is configured. opening: of the memory, from its beginning until it is let go; None
    before and after. error: why the last transition failed. met: what was met, when it was cleaned up.
    """

    add_on_set_parameters_callback: Any
    get_fully_qualified_name: Any
    get_logger: Any
    get_parameter: Any

    def prepare(self, own: TactileLearner | None, values: Mapping[str, Any]) -> None:
        """Declare the parameters. values: their defaults in this node, by name. Raises what `declare` raises."""
        self.own = own
        self.finger: Any = None
        self.opening: Future[TactileLearner] | None = None
        self.listener: Listener | None = None
        self.error: Exception | None = None
        self.met: dict[str, int | bool] = {}
        declare(self, PARAMETERS, values)
        self.add_on_set_parameters_callback(self.checked)

    def on_configure(self, state: Any) -> Any:
        return self._taken(self.configure, self.clean_up)

    def on_activate(self, state: Any) -> Any:
        return self._taken(self.finger.activate, self.finger.deactivate)

    def on_deactivate(self, state: Any) -> Any:
        return self._taken(self.finger.deactivate)

    def on_cleanup(self, state: Any) -> Any:
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

    def value(self, name: str) -> Any:
        """A parameter's value."""
        return self.get_parameter(name).value

    def listen(self) -> tuple[str, str]:
        """Check the parameters, and hear the topic: what comes waits. Returns the topic and the field.

        Raises InputError and FieldError for parameters that cannot be, MissingLibraryError for an absent type.
        """
        topic, field = _place(self.value("topic").strip(), self.value("field").strip(), self.value("preset"))
        if self.own is None:
            _new_sensor(*(self.value(name) for name in ("memory", "sensor", "preset")))
        if self.listener is None:
            quality = Quality(*(self.value(f"qos.{name}") for name in ("reliability", "durability", "depth")))
            self.listener = Listener(self, topic, self.value("type") or None, quality)
        return topic, field

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

        learner = self.own
        if learner is None:
            sensor = _new_sensor(values["memory"], values["sensor"], values["preset"])
            learner = TactileLearner.open(Path(values["memory"]), sensor=sensor, mode=values["mode"])
        try:
            learner.live(risk=values["risk"], contact="manual", of=values["of"] or None).close()
            self._read_health(learner, values["health_after"])
        except BaseException:
            if learner is not self.own:
                learner.close()
            raise
        return learner

    def _read_health(self, learner: TactileLearner, after: int) -> None:
        """Read the rows that /diagnostics will ask about; a damaged one is no reason not to answer."""
        try:
            if learner.has_health:
                learner.health(after=after)
        except (ScrollTactileError, StoreError) as error:
            self.get_logger().warning(f"the health of the sensor cannot be told: {error}")

    def configure(self) -> None:
        """Open the memory, or wait until it is open, and offer topics and services. Raises what hinders it."""
        from scroll_tactile.clients.ros2.node import TactileNode

        topic, field = self.listen()
        learner = self.open().result()
        how: dict[str, Any] = {name: self.value(name) for name in ("contact", "watch")}
        how |= {"of": self.value("of") or None, "listener": self.listener, "active": False}
        self.finger = TactileNode(self, learner, topic, field, **how)

    def clean_up(self) -> None:
        """Let all go, the memory, too; a second call does nothing."""
        if self.finger is not None:
            self.finger.close()
            for name, count in self.finger.bridge.status().items():
                before = self.met.get(name, 0)
                self.met[name] = bool(before or count) if isinstance(count, bool) else before + count
        if self.listener is not None:
            self.listener.stop()
        self.finger = self.listener = None
        opening, self.opening = self.opening, None
        if opening is not None and opening.exception() is None:  # waits for it
            self.met["materials"] = len(opening.result().materials)
            if opening.result() is not self.own:
                opening.result().close()

    def checked(self, parameters: Sequence[Any]) -> Any:
        """Whether parameters can have these values now."""
        values = {each.name: each.value for each in parameters}
        fixed = [each.name for each in PARAMETERS if each.name in values and each not in DYNAMIC]
        if not fixed or self.opening is None:
            return verdict(PARAMETERS, values)
        return verdict(
            PARAMETERS,
            values,
            f"parameter {fixed[0]} is read when the node is configured: ros2 lifecycle set "
            f"{self.get_fully_qualified_name()} deactivate and cleanup first, then configure and activate",
        )


def _node(name: str, context: Any) -> Any:
    """A node with a lifecycle and `_States`; its class is made here, for rclpy may be missing."""
    from rclpy.lifecycle import LifecycleNode

    return type("ScrollTactile", (_States, LifecycleNode), {})(name, context=context)


def serve(
    memory: TactileLearner | str | Path | None = None,
    topic: str = "",
    field: str = "",
    *,
    arguments: Sequence[str] = (),
    **parameters: Any,
) -> dict[str, int | bool]:
    """Run the node scroll_tactile until ctrl-C or SIGTERM, or until ROS ends; returns what it met, by name.

    memory: a learner, which stays open, or the folder of a memory, which is opened to learn, and closed. All are
    defaults of the node's parameters, those by name, too, as `ros2 param describe` lists them (`type`, `preset`,
    `risk`, `scene`, `autostart`, …): what ROS is given wins, by `--ros-args -p risk:=0.02`, `--params-file` or a launch
    file. arguments: of ROS. Topics and services: see `TactileNode`.

    The node has a lifecycle: configure opens the memory and offers services, activate takes readings, deactivate ends a
    touch under way, cleanup closes the memory. It brings itself up to active, unless `autostart` is False or a manager
    configures it while the memory opens, and hears the topic before the memory is open: what comes meanwhile waits.
    At ctrl-C a callback under way is finished first; a second ctrl-C interrupts it.

    Raises what `TactileNode` and `TactileLearner.open` raise, FieldError for a field that the first message does not
    have, and InputError for parameters that there are not or that cannot be, and for arguments that ROS refuses.
    """
    known = [each.name for each in PARAMETERS]
    for name in parameters:
        if name not in known:
            raise InputError(f"there is no parameter {name!r}{nearest(name, known)}")
    rclpy = require_rclpy()
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    own = None if memory is None or isinstance(memory, str | Path) else memory
    values = {"topic": topic, "field": field} | parameters | ({"memory": str(memory or "")} if own is None else {})
    context = rclpy.Context()
    with _interruptible() as ended:
        try:
            rclpy.init(args=list(arguments), context=context, signal_handler_options=SignalHandlerOptions.NO)
            node: Any = _node("scroll_tactile", context)
        except Exception as error:  # one of rclpy's own, whose place has changed from release to release
            raise InputError(f"ROS refuses to start with {' '.join(arguments) or 'no arguments'}: {error}") from error
        try:
            node.prepare(own, {name: _listed(value) for name, value in values.items()})
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)

            def running() -> bool:
                if not ended.is_set() and context.ok():
                    executor.spin_once(timeout_sec=0.1)
                return not ended.is_set() and bool(context.ok())

            if node.value("autostart"):
                _start(node, running)
            while running():
                pass
        except ExternalShutdownException:
            pass
        finally:
            node.clean_up()
            rclpy.try_shutdown(context=context)
        return dict(node.met)


def _start(node: Any, running: Callable[[], bool]) -> None:
    """Bring the node up to active, and hear its topic while the memory is opened. Raises what hinders it."""
    node.listen()
    opening = node.open()
    while not opening.done():
        if not running():
            return
    opening.result()
    if node.finger is not None or node.opening is not opening:
        node.get_logger().info("somebody else configured the node meanwhile: to activate it is left to them")
        return
    for name in ("configure", "activate"):
        done = getattr(node, f"trigger_{name}")()
        if done != type(done).SUCCESS:
            raise node.error or ScrollTactileError(f"ROS did not {name} the node, and gave no reason: see its log")


def _listed(value: object) -> object:
    """A parameter's default as ROS has it."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [str(each) for each in value] or ""
    return "" if value is None else value


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
