"""What comes in and goes out: drivers' messages, the examples' package, rosbridge, and sessions that were recorded."""

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
from live_touches import GEL, gel_learner, learner, shift, slide
from robot import TOPIC, publishing
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg
from touches import SMALL

from scroll_tactile import Sensor, TactileLearner
from scroll_tactile.clients.ros2 import Bridge
from scroll_tactile.clients.ros2.inputs import Quality
from scroll_tactile.recordings import PRESETS, read

MESSAGES = Path(__file__).parents[2] / "examples" / "ros2" / "scroll_tactile_msgs"
ROS2 = bags.typestore(2)
COUNTS = Sensor(name="counts", channels=2, rate=50.0, low=0.0, high=1000.0, unit="counts", duration=1.0)

# Of the parser that rosidl imports with the first message.
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")


def definition(folder, name):
    return (MESSAGES / folder / f"{name}.{folder}").read_text()


def taxels(values, stamp):
    kind = ROS2.types["sensor_msgs/msg/ChannelFloat32"]
    channels = [kind(name="tip", values=values.astype(np.float32))]
    return ROS2.types["tactile_msgs/msg/TactileState"](header=bags.header(ROS2, stamp), sensors=channels)


def static_data(values, stamp):
    kind = ROS2.types["robotiq_tsf/msg/Taxels"]
    sides = [kind(values=np.resize(values, 28).astype(np.uint16)) for _ in range(2)]
    return ROS2.types["robotiq_tsf/msg/StaticData"](taxels=sides)


DRIVERS = {
    "BioTac": (PRESETS["biotac"].field, lambda values, t: bags.biotac(ROS2, values.astype(np.int16), t)),
    "TactileState": ("sensors[*].values", taxels),
    "uSkin": (
        "sensors[0].taxels[*].{x,y}",
        lambda values, t: bags.uskin(ROS2, np.array([[*values, 0]]), round(50 * t), t),
    ),
    "PapillArray": (
        "pillars[*].{fX,fY}",
        lambda values, t: bags.papillarray(ROS2, np.array([[*values, 0.0]]), round(1e6 * t), t),
    ),
    "Robotiq": ("taxels[0].values[0:2]", static_data),
    "AnySkin": ("data", lambda values, t: bags.array(ROS2, values)),
}


@pytest.fixture(scope="module")
def counting():
    own = TactileLearner(sensor=COUNTS, embedding=SMALL)
    random = np.random.default_rng(1)
    for _ in range(6):
        for material in "abc":
            own.observe(material, 1000 * slide(material, 50, random))
    own.settle()
    return own


@pytest.mark.parametrize("driver", DRIVERS)
def test_messages_of_drivers_are_answered_as_they_were_serialized(driver, counting):
    """Of each driver in the table of messages; there are no wheels of these types but AnySkin's."""
    field, made = DRIVERS[driver]
    answers, warnings = [], []
    bridge = Bridge(counting, field, answer=answers.append, warn=warnings.append)
    for i, row in enumerate(shift("ab", seed=4)[0]):
        message = made(np.round(1000 * row), 100 + i / 50)
        sent = ROS2.deserialize_cdr(ROS2.serialize_cdr(message, message.__msgtype__), message.__msgtype__)
        bridge.receive(sent, 100 + i / 50)
    assert [answer["material"] for answer in answers if answer["event"] == "ended"] == ["a", "b"]
    assert not warnings and bridge.report.refused == 0


@pytest.mark.parametrize("kind", ["Float32MultiArray", "Image", "CompressedImage"])
def test_a_drivers_process_is_heard_in_each_type_that_there_are_wheels_of(kind, spinning, tactile):
    source = gel_learner() if "Image" in kind else learner()
    served = tactile(source, field="data", type="")
    count = 16 if "Image" in kind else 300
    with publishing(count, 50, kind=kind):
        spinning.until(lambda: served.bridge.report.messages == count, 120)
    assert served.bridge.status() | {"refused": 0, "dropped": 0, "messages": count} == served.bridge.status()
    if "Image" in kind:  # the others have no stamps, and their places in time are those of a busy machine
        assert [answer["material"] for answer in served.answers if answer["event"] == "ended"] == [GEL.materials[1]]


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
        assert [answer["material"] for answer in sent if answer["event"] == "ended"] == ["a", "b"]
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

        recorder.create_subscription(JointState, TOPIC, record, Quality().profile(""), raw=True)
        with publishing(460, 100):
            spinning.until(lambda: count >= 455, 120)
    words = ("--topic", TOPIC, "--field", "position", "--cut", "contact", "--label", "session")
    done = run("learn", own, tmp_path / "bag", *words)
    assert done.exit_code == 0, done.output
    with TactileLearner.open(own, mode="read") as learned:
        assert learned.materials["session"] == 2


def test_messages_that_a_node_serialized_are_read_from_a_bag(tmp_path):
    """Lists of any lengths, empty ones among them; the truth is what was put into the messages."""
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import JointState

    random = np.random.default_rng(4)
    store, kind = ROS2, "sensor_msgs/msg/JointState"
    truth = []
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/joints", kind, typestore=store)
        for i in range(60):
            names = ["x" * length for length in random.integers(0, 9, random.integers(0, 4)).tolist()]
            lists = [random.standard_normal(count).tolist() for count in (2, *random.integers(0, 3, 2).tolist())]
            message = JointState(name=names, position=lists[0], velocity=lists[1], effort=lists[2])
            message.header.stamp.sec, message.header.frame_id = 100 + i, "f" * (i % 9)
            writer.write(connection, 10**9 * i, serialize_message(message))
            truth.append(lists[0])
    recording = read(tmp_path / "bag", topic="/joints", field="position")
    assert recording.readings.tolist() == truth
    assert recording.times.tolist() == [100.0 + i for i in range(60)]
    assert not recording.report.notes
