"""What comes in and goes out: drivers' messages, several fingers, answers by name, and sessions that were recorded."""

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

from scroll_tactile import Sensor, TactileLearner, errors
from scroll_tactile.clients.ros2 import Bridge
from scroll_tactile.recordings import PRESETS

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
def test_a_drivers_process_is_heard_in_each_type_that_there_are_wheels_of(kind, spinning):
    pytest.importorskip("rclpy")
    from scroll_tactile.clients.ros2 import TactileNode

    answers = []
    source = gel_learner() if "Image" in kind else learner()
    served = TactileNode(spinning.node("scroll_tactile"), source, TOPIC, "data", answered=answers.append)
    count = 16 if "Image" in kind else 300
    with publishing(count, 50, kind=kind):
        spinning.until(lambda: served.bridge.report.messages == count, 120)
    assert served.bridge.status() | {"refused": 0, "dropped": 0, "messages": count} == served.bridge.status()
    if "Image" in kind:  # the others have no stamps, and their places in time are those of a busy machine
        assert [answer["material"] for answer in answers if answer["event"] == "ended"] == [GEL.materials[1]]


def test_fingers_of_one_message_have_answers_and_services_of_their_own(spinning):
    pytest.importorskip("rclpy")
    from diagnostic_msgs.msg import DiagnosticArray
    from sensor_msgs.msg import JointState

    from scroll_tactile.clients.ros2 import Listener, TactileNode

    node, answers = spinning.node("hand"), {"thumb": [], "index": []}
    listener = Listener(node, TOPIC, "sensor_msgs/msg/JointState")
    fingers = {
        name: TactileNode(node, learner(), TOPIC, field, finger=name, listener=listener, answered=answers[name].append)
        for name, field in {"thumb": "position", "index": "velocity"}.items()
    }
    states = []
    spinning.node("monitor").create_subscription(DiagnosticArray, "/hand/index/status", states.append, 50)
    (one, _), (other, _) = shift("ab", seed=5), shift("cb", seed=6)
    for i, (left, right) in enumerate(zip(one, other, strict=True)):
        message = JointState(position=left.tolist(), velocity=right.tolist())
        message.header.stamp.sec, message.header.stamp.nanosec = 1000 + i // 50, (i % 50) * 20_000_000
        listener.receive(message, {})
    found = {name: [a["material"] for a in each if a["event"] == "ended"] for name, each in answers.items()}
    assert found == {"thumb": ["a", "b"], "index": ["c", "b"]}
    assert "nothing is left" not in spinning.call(node, "/hand/thumb/predict").message
    assert json.loads(spinning.call(node, "/hand/index/predict").message)["material"] == "b"
    last = answers["index"][-1]
    spinning.until(lambda: states and states[-1].header.stamp.sec == int(last["stamp"]))
    spinning.until(lambda: states[-1].status[0].values[0].value == "ended")
    stamp, [state] = states[-1].header.stamp, states[-1].status
    assert math.isclose(stamp.sec + stamp.nanosec / 1e9, last["stamp"], abs_tol=1e-6)
    assert states[-1].header.frame_id == "index" and state.message == "b" and state.hardware_id == "pad"
    assert {pair.key: pair.value for pair in state.values}["probability"] == str(last["probability"])
    for finger in fingers.values():
        finger.close()
    listener.stop()
    spinning.until(
        lambda: not [name for name, _ in node.get_service_names_and_types() if name.startswith("/hand/thumb")]
    )


def test_messages_wait_for_who_takes_them_and_the_oldest_make_room(spinning, monkeypatch):
    pytest.importorskip("rclpy")
    from scroll_tactile.clients.ros2 import Listener, listening

    monkeypatch.setattr(listening, "WAITING", 5)
    listener, taken = Listener(spinning.node("hand"), TOPIC, "sensor_msgs/msg/JointState"), []
    for i in range(8):
        listener.receive(i, {"source_timestamp": (i + 1) * 10**9})
    listener.give(lambda *message: taken.append(message))
    listener.receive(8, {"source_timestamp": 9 * 10**9})
    assert [message for message, *_ in taken] == [3, 4, 5, 6, 7, 8]
    assert taken[0] == (3, 4.0, 3) and [lost for *_, lost in taken[1:]] == [0] * 5


def test_all_fingers_of_a_topic_get_what_waited_and_nothing_waits_once_they_left(spinning, monkeypatch):
    from scroll_tactile.clients.ros2 import Listener, listening

    monkeypatch.setattr(listening, "WAITING", 3)
    listener, taken = Listener(spinning.node("hand"), TOPIC, "sensor_msgs/msg/JointState"), {"thumb": [], "index": []}
    takers = [lambda *message, name=name: taken[name].append(message) for name in taken]
    for i in (1, 2, 3, 5, 6):  # 4 was lost on its way, 1 and 2 had to make room
        listener.receive(i, {"source_timestamp": i * 10**9, "publication_sequence_number": i})
    for taker in takers:
        listener.give(taker)
    listener.receive(7, {"source_timestamp": 7 * 10**9, "publication_sequence_number": 7})
    assert taken["thumb"] == taken["index"] == [(3, 3.0, 2), (5, 5.0, 1), (6, 6.0, 0), (7, 7.0, 0)]
    for taker in takers:
        listener.leave(taker)
    listener.receive(8, {"source_timestamp": 8 * 10**9})
    listener.give(takers[0])
    assert taken["thumb"][-1][0] == 7
    listener.leave(takers[0])
    listener.stop()
    listener.start()  # it is heard anew, and what comes waits again
    listener.receive(9, {"source_timestamp": 9 * 10**9})
    listener.give(takers[0])
    assert taken["thumb"][-1][0] == 9


def test_a_topic_that_comes_late_in_a_type_that_cannot_be_read_is_looked_for_on_and_said_once(spinning, monkeypatch):
    from sensor_msgs.msg import JointState

    from scroll_tactile.clients.ros2 import Listener, listening

    monkeypatch.setattr(listening, "LOOKED", 0.02)
    node, kinds, warned, looks = spinning.node("hand"), [], [], []
    monkeypatch.setattr(node, "get_topic_names_and_types", lambda: looks.append(1) or [(TOPIC, kinds)])
    monkeypatch.setattr(node.get_logger(), "warning", warned.append)
    listener = Listener(node, TOPIC)
    for kinds[:] in (["std_msgs/msg/String", "sensor_msgs/msg/JointState"], ["sr_robot_msgs/msg/BiotacAll"]):
        looks.clear()
        spinning.until(lambda: len(looks) > 3)
        assert listener.subscription is None
    assert len(warned) == 2 and "say which" in warned[0] and "sr-robot-msgs" in warned[1]
    kinds[:] = ["sensor_msgs/msg/JointState"]
    spinning.until(lambda: listener.subscription is not None)
    assert listener.kind == "sensor_msgs/msg/JointState" and listener.subscription.msg_type is JointState


def test_a_quality_that_publishers_do_not_promise_is_named(spinning):
    pytest.importorskip("rclpy")
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import JointState

    from scroll_tactile.clients.ros2 import Listener, Quality

    node = spinning.node("hand")
    with pytest.raises(errors.InputError, match="reliability as best_effort or reliable"):
        Listener(node, TOPIC, quality=Quality(reliability="perfect"))
    listener = Listener(node, TOPIC, "sensor_msgs/msg/JointState", Quality(reliability="reliable", depth=7))
    spinning.node("driver").create_publisher(JointState, TOPIC, qos_profile_sensor_data)
    spinning.until(lambda: "qos asks for reliability reliable, and less is promised" in listener.absent())


def test_answers_fill_the_message_package_of_the_examples(monkeypatch):
    """Of the package's text, by another's parser: each field is one that the node fills, with values of its type."""
    pytest.importorskip("rclpy")
    from scroll_tactile.clients.ros2 import publishing as said

    store = bags.typestore(2)
    store.register(get_types_from_msg(definition("msg", "TactileAnswer"), "scroll_tactile_msgs/msg/TactileAnswer"))
    kind = store.types["scroll_tactile_msgs/msg/TactileAnswer"]
    header, stamp = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    package, messages = ModuleType("scroll_tactile_msgs"), ModuleType("scroll_tactile_msgs.msg")
    messages.TactileAnswer = kind
    monkeypatch.setitem(sys.modules, "scroll_tactile_msgs", package)
    monkeypatch.setitem(sys.modules, "scroll_tactile_msgs.msg", messages)
    sent = {}

    def publisher(kind, place, profile):
        return SimpleNamespace(publish=lambda message: sent.setdefault(place, []).append(message))

    node = SimpleNamespace(
        get_name=lambda: "scroll_tactile", create_publisher=publisher, context=SimpleNamespace(ok=lambda: True)
    )
    answers = said.AnswerTopics(node, "thumb", "pad")
    answers._header = lambda answer: header(stamp(*divmod(round(answer["stamp"] * 1e9), 10**9)), "thumb")
    bare = {"event": "began", "stamp": 3.25, "contact": True, "seconds": 0.0, "decided": False}
    estimate = {"value": 1.5, "low": None, "high": 2.0, "unit": "N"}
    full = bare | {"event": "ended", "end": "released", "touches": 2, "material": "oak", "probability": 0.9}
    full |= {"known": True, "novelty": None, "unusual": ("faster",), "candidates": ["oak"]}
    full |= {"ranking": (("oak", 0.9), ("cork", 0.1)), "estimates": {"force": estimate}}
    monkeypatch.setattr(answers, "_state", lambda answer: None)
    monkeypatch.setattr(answers, "_status", (SimpleNamespace, answers._status[1]))
    for answer in (bare, full):
        answers.publish(answer)
    name = "scroll_tactile_msgs/msg/TactileAnswer"
    for message in sent["~/thumb/tactile_answer"]:  # its serializer takes lists of numbers as arrays, ROS' takes both
        for field in ("ranked_probability", "quantity_value", "quantity_low", "quantity_high"):
            setattr(message, field, np.array(getattr(message, field), np.float64))
    first, last = (
        store.deserialize_cdr(store.serialize_cdr(each, name), name) for each in sent["~/thumb/tactile_answer"]
    )
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


def test_over_rosbridge_a_process_of_another_python_answers_and_learns(memory, tmp_path, monkeypatch):
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
    with TactileLearner.open(memory, mode="read") as source:
        source.backup(tmp_path / "own")
    with TactileLearner.open(tmp_path / "own") as own:
        beside = example["Beside"](None, own, TOPIC, "sensor_msgs/JointState", "position")
        beside.learn({"load_namespace": "felt"}, early := {})
        assert not early["success"] and "none has ended yet" in early["message"]
        for i, row in enumerate(shift("ab", seed=7)[0]):
            stamp = {"sec": 1000 + i // 50, "nanosec": (i % 50) * 20_000_000}
            places[TOPIC].call({"header": {"stamp": stamp, "frame_id": ""}, "position": row.tolist(), "name": []})
        sent = places["/scroll_tactile/answer"].sent
        assert [answer["material"] for answer in sent if answer["event"] == "ended"] == ["a", "b"]
        places["/scroll_tactile/learn"].call({"load_namespace": "felt"}, done := {})
        assert done["success"] and own.materials["felt"] == 1


def test_a_session_that_was_recorded_is_learned_from_again(spinning, memory, tmp_path):
    """What a subscriber got from a driver's process, as bytes, in a bag, and out of it by the command."""
    pytest.importorskip("rclpy")
    from sensor_msgs.msg import JointState

    from scroll_tactile.clients.ros2 import Quality

    with TactileLearner.open(memory, mode="read") as source:
        source.backup(tmp_path / "own")
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
    done = run("learn", tmp_path / "own", tmp_path / "bag", *words)
    assert done.exit_code == 0, done.output
    with TactileLearner.open(tmp_path / "own", mode="read") as learned:
        assert learned.materials["session"] == 2
