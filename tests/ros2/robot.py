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
from live_touches import GEL, frames, shift, slide

from scroll_tactile import TactileLearner

TOPIC = "/finger/tactile"
ASKED = ("best_effort", "volatile", 0)  # of publishers
KIND = "sensor_msgs/msg/JointState"
ROBOT = Path(__file__)
EXAMPLES = ROBOT.parents[2] / "examples"


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
        for _ in range(12):
            for material in "abc":
                learner.observe(material, slide(material, 50, random))
    return path


def stream(kind, count):
    """What a finger's driver sends as a message of a kind: rests and touches, or of a camera one of the gel's."""
    if kind == "Image":
        return [np.asarray(frame) for frame in frames(GEL.materials[1], 5, 8)]
    rows, _ = shift("abcab", seed=3)
    return np.resize(rows, (count, rows.shape[1]))


def message_of(kind, reading, stamp):
    """A reading as a message of a kind that there are wheels of."""
    from sensor_msgs.msg import Image, JointState
    from std_msgs.msg import Float32MultiArray

    if kind == "Float32MultiArray":
        return Float32MultiArray(data=reading.astype(np.float32).tolist())
    if kind == "JointState":
        message = JointState(position=reading.tolist(), velocity=reading[::-1].tolist(), effort=reading.tolist())
    else:
        high = GEL.sensor.limits[1].max()
        pixels = np.round(reading * (255 / high)).astype(np.uint8)
        height, width, _ = pixels.shape
        pixels = np.ascontiguousarray(pixels[..., ::-1])
        message = Image(height=height, width=width, step=3 * width, encoding="bgr8", data=pixels.tobytes())
    message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), round(stamp % 1 * 1e9)
    return message


def publish(topic, count, rate, every, kind="JointState"):
    """Publish a stream at a rate, from when somebody listens; every: copies."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data

    rclpy.init()
    node = rclpy.create_node("finger")
    readings = stream(kind, count)
    publisher = node.create_publisher(type(message_of(kind, readings[0], 0)), topic, qos_profile_sensor_data)
    while not publisher.get_subscription_count():
        time.sleep(0.02)
    time.sleep(0.5)  # the other side may not have matched yet
    begin = time.time()
    clock = GEL.sensor.rate if kind == "Image" else 50.0  # the sensor's own, whose rate is the pad's
    for i, reading in enumerate(readings):
        time.sleep(max(0.0, begin + i // every * every / rate - time.time()))
        publisher.publish(message_of(kind, reading, 1000 + i / clock))
    time.sleep(0.5)
    rclpy.shutdown()


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


@contextmanager
def publishing(count, rate, every=1, kind="JointState", topic=TOPIC):
    with command(ROBOT, topic, count, rate, every, kind) as process:
        yield process
        assert process.wait(120) == 0


def ended(answers):
    """The materials of the touches that ended."""
    return [answer["material"] for answer in answers if answer["event"] == "ended"]


def ended_by_ctrl_c(process):
    """What a process wrote, where ctrl-C ended it in order."""
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    return output


if __name__ == "__main__":
    publish(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]), sys.argv[5])
