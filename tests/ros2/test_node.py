"""The node over a real ROS 2: Fast DDS on this machine, publishers in other processes."""

import json
import subprocess

import numpy as np
import pytest
from commands import refused
from live_touches import shift
from readme import command_lines
from robot import ROBOT, TOPIC, command, ended_by_ctrl_c, publishing
from touches import PAD

from scroll_tactile import Health, TactileLearner, errors
from scroll_tactile.recordings import PRESETS, read

rclpy = pytest.importorskip("rclpy", reason="no ROS 2 here: its wheels are for Linux on x86_64")

from diagnostic_msgs.srv import AddDiagnostics  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_msgs.msg import Float32MultiArray, String  # noqa: E402

from scroll_tactile.clients.ros2 import TactileNode  # noqa: E402

# Of the parser that rosidl imports with the first message.
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")


def feed(node, rows, start=0.0):
    for i, row in enumerate(rows):
        stamp = 1000 + start + i / PAD.rate
        message = JointState(position=row.tolist())
        message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), round(stamp % 1 * 1e9)
        node.receive(message, {})


def test_every_reading_of_a_burst_arrives_and_is_answered(spinning, learner):
    """250 readings a second and, at its worst, 50 at once; all of them count."""
    count = 1000
    answers, texts = [], []
    served = TactileNode(spinning.node("scroll_tactile"), learner, TOPIC, "position", answered=answers.append)
    listener = spinning.node("arm")
    listener.create_subscription(String, "/scroll_tactile/answer", lambda text: texts.append(json.loads(text.data)), 50)
    with publishing(count, 250, every=50):
        spinning.until(lambda: served.bridge.report.messages == count, 120)
    status = served.bridge.status()
    assert (status["readings"], status["ticks"], status["lost"], status["dropped"]) == (count, count, 0, 0)
    ended = [answer for answer in answers if answer["event"] == "ended"]
    assert [answer["material"] for answer in ended][:5] == list("abcab")
    spinning.until(lambda: len(texts) == len(answers))
    assert texts == json.loads(json.dumps(answers))


def test_a_touch_between_the_services_begin_and_end(spinning, learner):
    node = spinning.node("scroll_tactile")
    kind = "sensor_msgs/msg/JointState"
    served = TactileNode(node, learner, TOPIC, "position", kind=kind, contact="manual")
    rows, [place] = shift("b")
    assert spinning.call(node, "/scroll_tactile/begin").success
    feed(served, rows[slice(*place)])
    reply = spinning.call(node, "/scroll_tactile/end")
    assert reply.success and reply.message.endswith(": b")
    assert spinning.call(node, "/scroll_tactile/again").success


def test_who_comes_late_is_told_the_last_answer_field_by_field_and_what_was_learned_is_taken_back(spinning, learner):
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import Bool, Float64

    node = spinning.node("scroll_tactile")
    answers = []
    kind = "sensor_msgs/msg/JointState"
    served = TactileNode(node, learner, TOPIC, "position", kind=kind, answered=answers.append)
    feed(served, shift("b", seed=8)[0])
    late, told = spinning.node("late"), {}
    profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    for name, of in {"answer": String, "material": String, "probability": Float64, "known": Bool}.items():
        place = f"/scroll_tactile/{name}"
        late.create_subscription(of, place, lambda got, name=name: told.update({name: got.data}), profile)
    spinning.until(lambda: len(told) == 4)
    last = answers[-1]
    assert told["material"] == last["material"] and told["probability"] == last["probability"]
    assert told["known"] is bool(last["known"]) and json.loads(told["answer"]) == json.loads(json.dumps(last))
    before = learner.digest()
    assert spinning.call(node, "/scroll_tactile/learn", "b").success
    assert learner.digest() != before
    reply = spinning.call(node, "/scroll_tactile/undo")
    assert reply.success and "was taken back" in reply.message
    assert learner.digest() == before
    assert not spinning.call(node, "/scroll_tactile/undo").success
    assert json.loads(spinning.call(node, "/scroll_tactile/materials").message) == learner.materials


def test_diagnostics_say_what_was_met(spinning, learner):
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

    node = spinning.node("scroll_tactile")
    served = TactileNode(node, learner, TOPIC, "position", kind="sensor_msgs/msg/JointState")
    heard = []
    spinning.node("monitor").create_subscription(DiagnosticArray, "/diagnostics", heard.append, 10)
    feed(served, shift("a")[0])
    served.receive(JointState(position=[1.0]), {})
    spinning.until(lambda: any(array.status[0].level == DiagnosticStatus.STALE for array in heard))
    last = {pair.key: pair.value for pair in heard[-1].status[0].values}
    assert last["refused"] == "1" and last["readings"] == str(len(shift("a")[0]))
    assert last["touches"] == "1"
    assert heard[-1].header.stamp.sec > 0


def test_diagnostics_name_a_changed_channel_until_later_touches_alone_count(spinning, learner, monkeypatch):
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

    asked = []

    def health(self, *, after):
        asked.append(after)
        if after:
            return Health(None, None, (), "", 1.0, 0.01, 0, None, (), ())
        return Health(7, 0.0, (3,), "dead", 200.0, 0.01, 40, 12, ("a",), ((12, 2.3),))

    monkeypatch.setattr(TactileLearner, "health", health)
    node = spinning.node("scroll_tactile")
    served = TactileNode(node, learner, TOPIC, "position", kind="sensor_msgs/msg/JointState")
    heard = []
    spinning.node("monitor").create_subscription(DiagnosticArray, "/diagnostics", heard.append, 10)
    feed(served, shift("a")[0])
    spinning.until(lambda: any(array.status[0].level == DiagnosticStatus.ERROR for array in heard))
    told = next(array for array in heard if array.status[0].level == DiagnosticStatus.ERROR).status[0].message
    assert "channels 3" not in told and "channel 3: says nothing any more" in told
    assert "parameter health_after 12 asks about later touches" in told
    node.set_parameters([rclpy.parameter.Parameter("health_after", value=12)])
    spinning.until(lambda: 12 in asked)


def test_a_type_of_no_installed_package_and_a_topic_that_sends_another(spinning, learner):
    node = spinning.node("scroll_tactile")
    with pytest.raises(errors.MissingLibraryError, match="sr-robot-msgs"):
        TactileNode(node, learner, TOPIC, "position", kind="sr_robot_msgs/msg/BiotacAll")
    TactileNode(node, learner, "/other", "position")
    other = spinning.node("other")
    publisher = other.create_publisher(Float32MultiArray, "/other", 10)

    def refusing():
        publisher.publish(Float32MultiArray(data=[0.1, 0.1]))
        return False

    with pytest.raises(errors.FieldError, match=r"'/other', std_msgs/msg/Float32MultiArray.*layout, data"):
        spinning.until(refusing)


def test_messages_that_were_lost_on_their_way_are_counted(spinning, learner):
    served = TactileNode(spinning.node("scroll_tactile"), learner, TOPIC, "position", kind="sensor_msgs/msg/JointState")
    for publisher, number in ((b"a", 7), (b"a", 8), (b"b", 1), (b"a", 11), (b"b", 2), (b"a", 12)):
        about = {"publication_sequence_number": number, "publisher_gid": {"data": publisher}}
        served.receive(JointState(position=[0.1, 0.1]), about)
    assert served.bridge.report.dropped == 2


def test_a_topic_that_never_comes_is_said_with_those_nearest(spinning, learner):
    node = spinning.node("scroll_tactile")
    served = TactileNode(node, learner, "/finger/tactil", "position", kind="sensor_msgs/msg/JointState")
    assert "nobody publishes /finger/tactil" in served.listener.absent()
    assert "nearest" not in served.listener.absent()  # what is heard here is a topic, too
    other = spinning.node("finger")
    other.create_publisher(JointState, TOPIC, 10)
    spinning.until(lambda: f"nearest is {TOPIC!r}" in served.listener.absent())


def test_fingers_of_a_node_have_one_risk_and_scene_until_the_last_is_closed(spinning, learner):
    node = spinning.node("hand")
    kind = "sensor_msgs/msg/JointState"

    def finger(name, **how):
        return TactileNode(node, learner, TOPIC, "position", kind=kind, finger=name, active=False, **how)

    with pytest.raises(errors.InputError, match="never observed"):
        finger("thumb", scene=["zinc"])
    assert not node.has_parameter("scene")
    fingers = [finger("thumb", risk=0.02, scene=["a", "b"]), finger("index"), finger("ring", risk=0.02, scene=["b, a"])]
    with pytest.raises(errors.InputError, match=r"risk as 0.02 already.*came risk=0.05: leave it out"):
        finger("little", risk=0.05)
    with pytest.raises(errors.InputError, match=r"came scene=\['c'\]"):
        finger("little", scene=["c"])
    for each in fingers:
        assert each.bridge._how["risk"] == 0.02 and sorted(each.bridge._how["scene"]) == ["a", "b"]
        assert node.get_parameter("risk").value == 0.02
        each.close()
    assert not any(map(node.has_parameter, ("risk", "scene", "health_after")))
    again = finger("thumb", risk=0.1)
    assert again.bridge._how["risk"] == 0.1
    again.close()


def test_no_topic_of_its_own_is_named_as_the_nearest(spinning, learner):
    node = spinning.node("scroll_tactile")
    served = TactileNode(node, learner, "/rh/tactile", "position", kind="sensor_msgs/msg/JointState")
    spinning.until(lambda: "/scroll_tactile/known" in dict(node.get_topic_names_and_types()))
    assert "/scroll_tactile/" not in served.listener.absent()


def test_a_topic_that_comes_late_is_silent_from_then_on(spinning, learner):
    served = TactileNode(spinning.node("scroll_tactile"), learner, "/finger/late", "position")
    served.listener.received -= 100  # it waited that long
    spinning.node("finger").create_publisher(JointState, "/finger/late", 10)
    spinning.until(lambda: served.listener.subscription is not None)
    assert "no reading for 0 s from the publisher of /finger/late" in served.listener.absent()


def test_the_command_from_start_to_ctrl_c(spinning, memory, tmp_path):
    """A name is learned, ctrl-C ends it in order, a second node is refused, and the memory has it."""
    with TactileLearner.open(memory, mode="read") as source:
        source.backup(tmp_path / "own")
    words = ["ros2", "--memory", tmp_path / "own", "--topic", TOPIC, "--field", "position"]
    ended = []
    arm = spinning.node("arm")
    arm.create_subscription(String, "/left/scroll_tactile/answer", lambda text: ended.append(json.loads(text.data)), 50)
    named = ("--ros-args", "-r", "__ns:=/left")
    with command("-m", "scroll_tactile.clients.cli", *words, *named, stdout=subprocess.PIPE) as process:
        client = arm.create_client(AddDiagnostics, "/left/scroll_tactile/learn")
        spinning.until(client.service_is_ready, 60)
        assert f"is being written by process {process.pid}" in refused(*words)
        with publishing(500, 250) as publisher:
            spinning.silent_after(publisher)
        assert sum(answer["event"] == "ended" for answer in ended) == 2
        assert spinning.call(arm, "/left/scroll_tactile/learn", "felt").success
        output = ended_by_ctrl_c(process)
    assert "4 materials" in output and "readings: 500" in output
    with TactileLearner.open(tmp_path / "own", mode="read") as kept:
        assert kept.materials["felt"] == 1


def test_readmes_line_runs_as_it_stands(spinning, tmp_path):
    TactileLearner.open(tmp_path / "memory", sensor=PRESETS["biotac"].sensor).close()
    words = next(words for words in command_lines() if words[1] == "ros2")
    with command("-m", "scroll_tactile.clients.cli", *words[1:], cwd=tmp_path, stdout=subprocess.PIPE) as process:
        client = spinning.node("arm").create_client(AddDiagnostics, "/scroll_tactile/learn")
        spinning.until(client.service_is_ready, 60)
        assert "memory: 0 materials" in ended_by_ctrl_c(process)


def test_the_example_acts_on_what_it_feels(memory, tmp_path):
    with TactileLearner.open(memory, mode="read") as source:
        source.backup(tmp_path / "own")
    script = ROBOT.parents[2] / "examples" / "ros2_node.py"
    with command(script, tmp_path / "own", TOPIC, "position", stderr=subprocess.PIPE) as process:
        with publishing(360, 250):
            said = [next(text for text in process.stderr if f"{name} after" in text) for name in "ab"]
        ended_by_ctrl_c(process)
    assert len(said) == 2


def test_messages_that_a_node_serialized_are_read_from_a_bag(tmp_path):
    """Lists of any lengths, empty ones among them; the truth is what was put into the messages."""
    from rclpy.serialization import serialize_message
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    random = np.random.default_rng(4)
    store, kind = get_typestore(Stores.ROS2_HUMBLE), "sensor_msgs/msg/JointState"
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
