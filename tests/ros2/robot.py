"""A small robot: a memory of a pad, messages of its readings, and a process that publishes them."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from live_touches import shift, slide

from scroll_tactile import TactileLearner

TOPIC = "/finger/tactile"
ROBOT = Path(__file__)


@dataclass
class Time:
    sec: int = 0
    nanosec: int = 0


@dataclass
class Header:
    stamp: Time


@dataclass
class Touched:
    header: Header
    values: np.ndarray


@dataclass
class Bare:
    data: list[float] = field(default_factory=list)


def stamped(values, seconds):
    return Touched(Header(Time(int(seconds), round(seconds % 1 * 1e9))), np.asarray(values))


def taught(path, sensor, embedding):
    """A memory on disk of three materials."""
    random = np.random.default_rng(1)
    with TactileLearner.open(path, sensor=sensor, embedding=embedding) as learner, learner.batch():
        for _ in range(6):
            for material in "abc":
                learner.observe(material, slide(material, 50, random))
    return path


def publish(topic, count, rate, every):
    """Publish rests and touches at a rate as sensor_msgs/JointState, from when somebody listens; every: copies."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import JointState

    rclpy.init()
    node = rclpy.create_node("finger")
    publisher = node.create_publisher(JointState, topic, qos_profile_sensor_data)
    rows, _ = shift("abcab", seed=3)
    rows = np.resize(rows, (count, rows.shape[1]))
    while not publisher.get_subscription_count():
        time.sleep(0.02)
    time.sleep(0.5)  # the other side may not have matched yet
    begin = time.time()
    for i, row in enumerate(rows):
        time.sleep(max(0.0, begin + i // every * every / rate - time.time()))
        message = JointState(position=row.tolist())
        stamp = 1000 + i / 50.0  # by the sensor's own clock, whose rate is the pad's
        message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), round(stamp % 1 * 1e9)
        publisher.publish(message)
    time.sleep(0.5)
    rclpy.shutdown()


@contextmanager
def publishing(count, rate, every=1):
    words = [sys.executable, ROBOT, TOPIC, str(count), str(rate), str(every)]
    paths = os.pathsep.join([str(ROBOT.parents[1]), *sys.path])
    with subprocess.Popen(list(map(str, words)), env=os.environ | {"PYTHONPATH": paths}) as process:
        yield process
        process.wait(60)
    assert process.returncode == 0


@contextmanager
def command(*words, **options):
    """A process that is killed at the end, where it has not ended before."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROBOT.parents[2]), *sys.path])}
    line = list(map(str, [sys.executable, *words]))
    with subprocess.Popen(line, env=environment, text=True, **options) as process:
        try:
            yield process
        finally:
            process.kill()


def ended_by_ctrl_c(process):
    """What a process wrote, where ctrl-C ended it in order."""
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    return output


if __name__ == "__main__":
    publish(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]))
