"""What comes in and goes out: messages, the examples' package, rosbridge, and sessions that were recorded."""

import json
import math
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import bags
import numpy as np
import pytest
from commands import run
from live_touches import GEL, gel_learner, learner, shift
from robot import ASKED, TOPIC, ended, publishing
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg

from scroll_tactile import TactileLearner
from scroll_tactile.clients.ros2.inputs import quality

MESSAGES = Path(__file__).parents[2] / "examples" / "ros2" / "scroll_tactile_msgs"
ROS2 = bags.typestore(2)

# Of the parser that rosidl imports with the first message.
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")


def definition(folder, name):
    return (MESSAGES / folder / f"{name}.{folder}").read_text()


@pytest.mark.parametrize("kind", ["Float32MultiArray", "Image"])
def test_a_drivers_process_is_heard_in_each_type_that_there_are_wheels_of(kind, spinning, tactile):
    source = gel_learner() if kind == "Image" else learner()
    served = tactile(source, field="data", type="")
    count = 16 if kind == "Image" else 300
    with publishing(count, 50, kind=kind):
        spinning.until(lambda: served.bridge.report.messages == count, 120)
    assert served.bridge.status() | {"refused": 0, "dropped": 0, "messages": count} == served.bridge.status()
    if kind == "Image":  # the others have no stamps, and their places in time are those of a busy machine
        assert ended(served.answers) == [GEL.materials[1]]


def test_answers_fill_the_message_package_of_the_examples(tactile, monkeypatch):
    """Of the package's text, by another's parser: each field is one that the node fills, with values of its type."""
    name = "scroll_tactile_msgs/msg/TactileAnswer"
    store, sent = bags.typestore(2), []
    store.register(get_types_from_msg(definition("msg", "TactileAnswer"), name))
    kind, header = store.types[name], store.types["std_msgs/msg/Header"]
    package, messages = ModuleType("scroll_tactile_msgs"), ModuleType("scroll_tactile_msgs.msg")
    messages.TactileAnswer = kind
    monkeypatch.setitem(sys.modules, "scroll_tactile_msgs", package)
    monkeypatch.setitem(sys.modules, "scroll_tactile_msgs.msg", messages)
    served = tactile(learner(), field="data", type="std_msgs/msg/Float32MultiArray", start=False)
    create = served.create_publisher
    double = SimpleNamespace(publish=sent.append)
    monkeypatch.setattr(served, "create_publisher", lambda of, *how: double if of is kind else create(of, *how))
    served.start()
    bare = {"event": "began", "stamp": 3.25, "contact": True, "seconds": 0.0, "decided": False}
    estimate = {"value": 1.5, "low": None, "high": 2.0, "unit": "N"}
    full = bare | {"event": "ended", "end": "released", "touches": 2, "material": "oak", "probability": 0.9}
    full |= {"known": True, "novelty": None, "unusual": ("faster",), "candidates": ["oak"]}
    full |= {"ranking": (("oak", 0.9), ("cork", 0.1)), "estimates": {"force": estimate}}
    for answer in (bare, full):
        served._publish(answer)
    for message in sent:  # its serializer takes its own header, and lists of numbers as arrays, ROS' takes both
        stamp = store.types["builtin_interfaces/msg/Time"](message.header.stamp.sec, message.header.stamp.nanosec)
        message.header = header(stamp, "")
        for field in ("ranked_probability", "quantity_value", "quantity_low", "quantity_high"):
            setattr(message, field, np.array(getattr(message, field), np.float64))
    first, last = (store.deserialize_cdr(store.serialize_cdr(each, name), name) for each in sent)
    assert (first.known, first.material, first.header.stamp.sec) == (kind.UNTOLD, "", 3)
    assert (last.known, last.end, last.touches) == (kind.KNOWN, "released", 2) and math.isinf(last.novelty)
    assert list(last.ranked) == ["oak", "cork"] and last.ranked_probability.tolist() == [0.9, 0.1]
    assert last.quantity_value.tolist() == [1.5] and math.isnan(last.quantity_low[0]) and last.units == ["N"]


def test_the_service_of_the_message_package_has_what_the_node_fills():
    request, response = definition("srv", "Learn").split("---")
    types = get_types_from_msg(request, "a/msg/Request") | get_types_from_msg(response, "a/msg/Response")
    assert [field for field, _ in types["a/msg/Request"][1]] == ["material"]
    assert [field for field, _ in types["a/msg/Response"][1]] == ["success", "message", "observation"]
    cmake = (MESSAGES / "CMakeLists.txt").read_text()
    assert all(f'"{path.relative_to(MESSAGES)}"' in cmake for path in MESSAGES.glob("*/*.*"))


def test_over_rosbridge_a_process_of_another_python_answers_and_learns(own, monkeypatch):
    """With a double of roslibpy; messages come as dictionaries, as JSON has them."""
    places = {}

    class Place:
        def __init__(self, client, name, kind, **more):
            places[name], self.sent = self, []

        def advertise(self, call=None):
            self.call = call

        def subscribe(self, call):
            self.call = call

        def publish(self, message):
            self.sent.append(json.loads(message["data"]))

    double = ModuleType("roslibpy")
    double.Topic = double.Service = Place
    double.Message = double.Ros = dict
    monkeypatch.setitem(sys.modules, "roslibpy", double)
    example = runpy.run_path(str(MESSAGES.parent / "rosbridge.py"))
    with TactileLearner.open(own) as source:
        beside = example["Beside"](None, source, TOPIC, "sensor_msgs/JointState", "position")
        beside.learn({"load_namespace": "felt"}, early := {})
        assert not early["success"] and "none has ended yet" in early["message"]
        for i, row in enumerate(shift("ab", seed=7)[0]):
            stamp = {"sec": 1000 + i // 50, "nanosec": (i % 50) * 20_000_000}
            places[TOPIC].call({"header": {"stamp": stamp, "frame_id": ""}, "position": row.tolist(), "name": []})
        sent = places["/scroll_tactile/answer"].sent
        assert ended(sent) == ["a", "b"]
        places["/scroll_tactile/learn"].call({"load_namespace": "felt"}, done := {})
        assert done["success"] and source.materials["felt"] == 1


def test_a_session_that_was_recorded_is_learned_from_again(spinning, own, tmp_path):
    """What a subscriber got from a driver's process, as bytes, in a bag, and out of it by the command."""
    from sensor_msgs.msg import JointState

    recorder, count = spinning.node("recorder"), 0
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(TOPIC, "sensor_msgs/msg/JointState", typestore=ROS2)

        def record(data, about):
            nonlocal count
            count += 1
            writer.write(connection, about["received_timestamp"], data)

        recorder.create_subscription(JointState, TOPIC, record, quality("", *ASKED), raw=True)
        with publishing(460, 100):
            spinning.until(lambda: count >= 455, 120)
    words = ("--topic", TOPIC, "--field", "position", "--cut", "contact", "--label", "session")
    done = run("learn", own, tmp_path / "bag", *words)
    assert done.exit_code == 0, done.output
    with TactileLearner.open(own, mode="read") as learned:
        assert learned.materials["session"] == 2
