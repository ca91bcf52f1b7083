"""Readings of a robot to the ROS 2 node: how many arrive, and how long each takes from publish to state.

The publisher is a process of its own, `python -m examples.benchmarks.node_latency TOPIC SECONDS`, which sends readings
of simulated touches as sensor_msgs/JointState with the time at which each was published in its effort.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import numpy as np
import typer

from examples.paper.runs.options import Json
from examples.paper.runs.results import show, write
from scroll_tactile import TactileLearner, sensors
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.clients.ros2 import TactileNode
from scroll_tactile.clients.ros2.inputs import interface, require_rclpy
from scroll_tactile.errors import InputError
from scroll_tactile.simulation.scene import Scene
from scroll_tactile.simulation.shift import simulated_shift

__all__ = ["ros2", "run_node"]

Record = dict[str, Any]

TO_REACH = {"lost": 0, "p99": 5.0}
SCENE = Scene(sensor=sensors.BIOTAC)
NAMES = SCENE.materials[:10]
LEARNED = 6  # touches of each
TOPIC = "/rh/tactile"
WAITED = 60.0  # seconds for what is still to come


def run_node(seconds: float, note: Callable[[str], None]) -> Record:
    """The result of so many seconds. Raises RecordingError without rclpy, InputError where nothing came."""
    require_rclpy()
    os.environ.setdefault("ROS_DOMAIN_ID", str(10 + os.getpid() % 90))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    note("learning")
    learner = TactileLearner(sensor=sensors.BIOTAC)
    for repetition in range(LEARNED):
        for name in NAMES:
            learner.observe(name, SCENE.touch(name, repetition))
    learner.live().close()  # what a session opens with is made once
    note(f"{seconds:g} s of readings")
    count = round(seconds * sensors.BIOTAC.rate)
    line = [sys.executable, "-m", "examples.benchmarks.node_latency", TOPIC, str(seconds)]
    with subprocess.Popen(line) as publisher:
        latencies, status = _received(learner, count)
        publisher.wait(WAITED)
    if publisher.returncode or not latencies:
        raise InputError(f"the publisher ended with {publisher.returncode}, and {len(latencies)} readings came")
    taken = 1e3 * np.array(latencies)
    record = {
        "case": "simulated biotac at 100 Hz, Fast DDS",
        "readings": count,
        "lost": count - int(status["readings"]),
        "touches": status["touches"],
        "median_milliseconds": float(np.median(taken)),
        "p99_milliseconds": float(np.percentile(taken, 99)),
        "max_milliseconds": float(taken.max()),
        "to_reach": TO_REACH,
    }
    return {"bench": "ros2", "records": [record]}


class _Timed(TactileNode):
    """A node that notes how long after its message each state is known."""

    latencies: list[float]

    def take(self, message: Any, published: float, lost: int) -> None:
        super().take(message, published, lost)
        self.latencies.append(time.time() - message.effort[0])


def _received(learner: TactileLearner, count: int) -> tuple[list[float], Mapping[str, Any]]:
    rclpy = require_rclpy()
    from rclpy.executors import SingleThreadedExecutor

    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        timed = _Timed(learner, TOPIC, "position", context=context)
        timed.latencies = []
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(timed)
        timed.start()
        end = time.monotonic() + WAITED + count / sensors.BIOTAC.rate
        while len(timed.latencies) < count and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.1)
        timed.clean_up()
        return timed.latencies, timed.met
    finally:
        rclpy.try_shutdown(context=context)


def ros2(
    context: typer.Context,
    seconds: Annotated[float, typer.Option(min=10.0, help="How long readings are sent.")] = 60.0,
    json: Json = None,
) -> None:
    """Send BioTac's readings at 100 Hz from another process to the ROS 2 node."""
    with progress_bar() as progress:
        result = run_node(seconds, note=lambda what: progress(what, 0, 1))
    columns = {name: f"{{./{name}}}" for name in ("readings", "lost", "touches")}
    columns |= {f"ms, {name}": f"{{./{name}_milliseconds|.2f}}" for name in ("median", "p99", "max")}
    show("BioTac's 19 electrodes from another process, from publish to state", columns, result["records"])
    write(context, result)


def _publish(topic: str, seconds: float) -> None:
    """Publish readings at the sensor's rate from when somebody listens."""
    rclpy = require_rclpy()
    from rclpy.qos import qos_profile_sensor_data

    state = interface("sensor_msgs/msg/JointState")
    count = round(seconds * sensors.BIOTAC.rate)
    rows = simulated_shift(SCENE, NAMES, seconds=seconds + 10).readings[:count]
    rclpy.init()
    publisher = rclpy.create_node("finger").create_publisher(state, topic, qos_profile_sensor_data)
    while not publisher.get_subscription_count():
        time.sleep(0.02)
    time.sleep(1.0)  # until both sides have matched
    begin = time.time()
    for i, row in enumerate(rows):
        due = begin + i / sensors.BIOTAC.rate
        time.sleep(max(0.0, due - time.time()))
        message = state(position=row.tolist())
        message.header.stamp.sec, message.header.stamp.nanosec = int(due), round(due % 1 * 1e9) % 10**9
        message.effort = [time.time()]
        publisher.publish(message)
    time.sleep(1.0)  # until the last has left
    rclpy.shutdown()


if __name__ == "__main__":
    _publish(sys.argv[1], float(sys.argv[2]))
