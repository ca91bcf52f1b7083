"""Nodes of a real ROS 2 in this process, where its wheels are, and a memory that they share."""

import os
import time

import pytest
from robot import KIND, TOPIC, taught
from touches import PAD, SMALL

from scroll_tactile import TactileLearner
from scroll_tactile.clients.ros2 import TactileNode


@pytest.fixture(autouse=True)
def alone(monkeypatch):
    """A domain of this process's own, and no other machine."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(10 + os.getpid() % 90))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


@pytest.fixture(scope="module")
def memory(tmp_path_factory):
    return taught(tmp_path_factory.mktemp("ros2") / "memory", PAD, SMALL)


@pytest.fixture
def own(memory, tmp_path):
    """The folder of a copy of the memory."""
    with TactileLearner.open(memory, mode="read") as source:
        source.backup(tmp_path / "own")
    return tmp_path / "own"


@pytest.fixture(scope="module")
def learner(memory, tmp_path_factory):
    folder = tmp_path_factory.mktemp("learning") / "own"
    with TactileLearner.open(memory, mode="read") as source:
        source.backup(folder)
    with TactileLearner.open(folder) as made:
        yield made


@pytest.fixture
def spinning(alone):
    """A context; gives nodes in it, and spins all until something is there."""
    rclpy = pytest.importorskip("rclpy", reason="no ROS 2 here: its wheels are for Linux on x86_64")
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
    from diagnostic_msgs.srv import AddDiagnostics
    from rclpy.executors import SingleThreadedExecutor
    from std_srvs.srv import Trigger

    context = rclpy.Context()
    rclpy.init(context=context)
    executor = SingleThreadedExecutor(context=context)

    class Nodes:
        def add(self, make, *given, **how):
            made = make(*given, context=context, **how)
            executor.add_node(made)
            return made

        def node(self, name):
            return self.add(rclpy.create_node, name)

        def until(self, there, seconds=60.0):
            end = time.monotonic() + seconds
            while not there():
                assert time.monotonic() < end, "it never came"
                executor.spin_once(timeout_sec=0.05)

        def silent_after(self, publisher, seconds=300):
            """Wait until a process has published all it had and the node says that nothing comes any more."""
            heard, monitor = [], self.node("monitor")
            monitor.create_subscription(DiagnosticArray, "/diagnostics", heard.append, 10)
            self.until(lambda: publisher.poll() is not None, seconds)
            heard.clear()  # what is said from here on is said after the last message
            self.until(lambda: any(array.status[0].level == DiagnosticStatus.STALE for array in heard), seconds)

        def ask(self, node, kind, name, **request):
            client = node.create_client(kind, name)
            self.until(client.service_is_ready, 300)
            future = client.call_async(kind.Request(**request))
            self.until(future.done, 300)
            node.destroy_client(client)
            return future.result()

        def call(self, node, name, argument=None):
            if argument is None:
                return self.ask(node, Trigger, name)
            return self.ask(node, AddDiagnostics, name, load_namespace=argument)

    yield Nodes()
    for node in executor.get_nodes():  # the next test would still hear its publishers
        node.destroy_node()
    rclpy.try_shutdown(context=context)


class Answering(TactileNode):
    """A node that keeps its answers."""

    def answered(self, answer):
        vars(self).setdefault("answers", []).append(answer)


@pytest.fixture
def tactile(spinning):
    """Makes the node, and starts it unless it is told not to; it is cleaned up at the end."""
    made = []

    def node(memory, *, topic=TOPIC, field="position", start=True, **parameters):
        one = spinning.add(Answering, memory, topic, field, **{"type": KIND} | parameters)
        made.append(one)
        if start:
            one.start()
        return one

    yield node
    for each in made:
        each.clean_up()
