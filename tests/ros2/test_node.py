"""The node over a real ROS 2: Fast DDS on this machine, publishers in other processes."""

import json
import re

import pytest
from live_touches import shift
from robot import ASKED, KIND, TOPIC, ended, publishing
from touches import PAD

from scroll_tactile import Health, TactileLearner, errors
from scroll_tactile.clients.ros2 import inputs
from scroll_tactile.clients.ros2.inputs import Listener

rclpy = pytest.importorskip("rclpy", reason="no ROS 2 here: its wheels are for Linux on x86_64")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_msgs.msg import Float32MultiArray, String  # noqa: E402

# Of the parser that rosidl imports with the first message.
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")


def feed(node, rows, start=0.0):
    for i, row in enumerate(rows):
        stamp = 1000 + start + i / PAD.rate
        message = JointState(position=row.tolist())
        message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), round(stamp % 1 * 1e9)
        node.listener.receive(message, {})


def test_every_reading_of_a_burst_arrives_and_is_answered(spinning, tactile, learner):
    """250 readings a second and, at its worst, 50 at once; all of them count."""
    count = 1000
    texts = []
    served = tactile(learner, type="")
    listener = spinning.node("arm")
    listener.create_subscription(String, "/scroll_tactile/answer", lambda text: texts.append(json.loads(text.data)), 50)
    with publishing(count, 250, every=50):
        spinning.until(lambda: served.bridge.report.messages == count, 120)
    status = served.bridge.status()
    assert (status["readings"], status["ticks"], status["lost"], status["dropped"]) == (count, count, 0, 0)
    assert ended(served.answers)[:5] == list("abcab")
    spinning.until(lambda: len(texts) == len(served.answers))
    assert texts == json.loads(json.dumps(served.answers))


def test_a_touch_between_the_services_begin_and_end(spinning, tactile, learner):
    node = tactile(learner, contact="manual")
    rows, [place] = shift("b")
    assert spinning.call(node, "/scroll_tactile/begin").success
    feed(node, rows[slice(*place)])
    reply = spinning.call(node, "/scroll_tactile/end")
    assert reply.success and reply.message.endswith(": b")
    assert spinning.call(node, "/scroll_tactile/again").success


def test_who_comes_late_is_told_the_last_answer_in_each_form_and_what_was_learned_is_taken_back(
    spinning, tactile, learner
):
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import Bool, Float64

    node = tactile(learner)
    feed(node, shift("b", seed=8)[0])
    late, told = spinning.node("late"), {}
    profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    kinds = {"answer": String, "material": String, "probability": Float64, "known": Bool, "status": DiagnosticArray}
    for name, of in kinds.items():
        place = f"/scroll_tactile/{name}"
        late.create_subscription(of, place, lambda got, name=name: told.update({name: got}), profile)
    spinning.until(lambda: len(told) == 5 and '"ended"' in told["answer"].data)
    last = node.answers[-1]
    assert told["material"].data == last["material"] and told["probability"].data == last["probability"]
    assert told["known"].data is bool(last["known"])
    assert json.loads(told["answer"].data) == json.loads(json.dumps(last))
    spinning.until(lambda: told["status"].status[0].values[0].value == "ended")
    stamp, [state] = told["status"].header.stamp, told["status"].status
    assert stamp.sec + stamp.nanosec / 1e9 == pytest.approx(last["stamp"], abs=1e-6)
    assert (state.name, state.message, state.hardware_id) == ("scroll_tactile", "b", "pad")
    assert {pair.key: pair.value for pair in state.values}["probability"] == str(last["probability"])
    assert json.loads(spinning.call(node, "/scroll_tactile/predict").message)["material"] == "b"
    before = learner.digest()
    assert spinning.call(node, "/scroll_tactile/learn", "b").success
    assert learner.digest() != before
    reply = spinning.call(node, "/scroll_tactile/undo")
    assert reply.success and "was taken back" in reply.message
    assert learner.digest() == before
    assert not spinning.call(node, "/scroll_tactile/undo").success
    assert "came none" in spinning.call(node, "/scroll_tactile/learn", " ").message
    assert json.loads(spinning.call(node, "/scroll_tactile/materials").message) == learner.materials


def test_diagnostics_say_what_was_met(spinning, tactile, learner):
    node = tactile(learner)
    heard = []
    spinning.node("monitor").create_subscription(DiagnosticArray, "/diagnostics", heard.append, 10)
    feed(node, shift("a")[0])
    node.listener.receive(JointState(position=[1.0]), {})
    spinning.until(lambda: any(array.status[0].level == DiagnosticStatus.STALE for array in heard))
    last = {pair.key: pair.value for pair in heard[-1].status[0].values}
    assert last["refused"] == "1" and last["readings"] == str(len(shift("a")[0]))
    assert last["touches"] == "1"
    assert heard[-1].header.stamp.sec > 0


def test_diagnostics_name_a_changed_channel_until_later_touches_alone_count(spinning, tactile, learner, monkeypatch):
    asked = []

    def health(self, *, after):
        asked.append(after)
        if after:
            return Health(None, None, (), "", 1.0, 0.01, 0, None, (), ())
        return Health(7, 0.0, (3,), "dead", 200.0, 0.01, 40, 12, ("a",), ((12, 2.3),))

    monkeypatch.setattr(TactileLearner, "health", health)
    node = tactile(learner)
    heard = []
    spinning.node("monitor").create_subscription(DiagnosticArray, "/diagnostics", heard.append, 10)
    feed(node, shift("a")[0])
    spinning.until(lambda: any(array.status[0].level == DiagnosticStatus.ERROR for array in heard))
    told = next(array for array in heard if array.status[0].level == DiagnosticStatus.ERROR).status[0].message
    assert "channels 3" not in told and "channel 3: says nothing any more" in told
    assert "parameter health_after 12 asks about later touches" in told
    node.set_parameters([rclpy.parameter.Parameter("health_after", value=12)])
    spinning.until(lambda: 12 in asked)


def test_a_type_of_no_installed_package_and_a_topic_that_sends_another(spinning, tactile, learner):
    with pytest.raises(errors.MissingLibraryError, match="sr-robot-msgs"):
        tactile(learner, type="sr_robot_msgs/msg/BiotacAll")
    tactile(learner, topic="/other", type="")
    other = spinning.node("other")
    publisher = other.create_publisher(Float32MultiArray, "/other", 10)

    def refusing():
        publisher.publish(Float32MultiArray(data=[0.1, 0.1]))
        return False

    with pytest.raises(errors.FieldError, match=r"'/other', std_msgs/msg/Float32MultiArray.*layout, data"):
        spinning.until(refusing)


def test_a_topic_that_never_comes_is_said_with_those_nearest_of_others(spinning, tactile, learner):
    node = tactile(learner, topic="/finger/tactil")
    assert "nobody publishes /finger/tactil" in node.listener.absent()
    assert "nearest" not in node.listener.absent()  # what is heard here is a topic, too
    spinning.until(lambda: "/scroll_tactile/known" in dict(node.get_topic_names_and_types()))
    assert "/scroll_tactile/" not in node.listener.absent()
    spinning.node("finger").create_publisher(JointState, TOPIC, 10)
    spinning.until(lambda: f"nearest is {TOPIC!r}" in node.listener.absent())


def test_a_topic_that_comes_late_is_silent_from_then_on_and_one_in_a_type_that_cannot_be_read_is_said_once(
    spinning, monkeypatch
):
    monkeypatch.setattr(inputs, "LOOKED", 0.02)
    node, kinds, warned, looks = spinning.node("hand"), [], [], []
    monkeypatch.setattr(node, "get_topic_names_and_types", lambda: looks.append(1) or [(TOPIC, kinds)])
    monkeypatch.setattr(node.get_logger(), "warning", warned.append)
    listener = Listener(node, TOPIC, None, ASKED)
    listener.received -= 100  # it waited that long
    for kinds[:] in (["std_msgs/msg/String", KIND], ["sr_robot_msgs/msg/BiotacAll"]):
        looks.clear()
        spinning.until(lambda: len(looks) > 3)
        assert listener.subscription is None
    warned = [text for text in warned if "it is not heard until then" in text]  # others name the silence
    assert len(warned) == 2 and "say which" in warned[0] and "sr-robot-msgs" in warned[1]
    kinds[:] = [KIND]
    spinning.until(lambda: listener.subscription is not None)
    assert listener.kind == KIND and listener.subscription.msg_type is JointState
    spinning.node("finger").create_publisher(JointState, TOPIC, 10)
    spinning.until(lambda: re.match(f"no reading for [0-9]+ s from the publisher of {TOPIC}", listener.absent()))


def test_messages_wait_for_their_taker_and_the_oldest_make_room(spinning, monkeypatch):
    monkeypatch.setattr(inputs, "WAITING", 3)
    listener, taken = Listener(spinning.node("hand"), TOPIC, KIND, ASKED), []

    def take(*message):
        taken.append(message)

    def receive(*numbers):
        for i in numbers:
            listener.receive(i, {"source_timestamp": i * 10**9, "publication_sequence_number": i})

    receive(1, 2, 3, 5, 6)  # 4 was lost on its way, 1 and 2 had to make room
    listener.give(take)
    receive(7)
    assert taken == [(3, 3.0, 2), (5, 5.0, 1), (6, 6.0, 0), (7, 7.0, 0)]
    other = {"source_timestamp": 10**9, "publisher_gid": {"data": b"b"}}
    for number in (1, 4):  # of another publisher
        listener.receive(number, other | {"publication_sequence_number": number})
    receive(8)
    listener.stop()
    receive(10)  # nobody hears it
    assert taken[4:] == [(1, 1.0, 0), (4, 1.0, 2), (8, 8.0, 0)]


def test_a_node_that_is_cleaned_up_or_not_configured_offers_what_it_did_before(tactile, learner):
    node = tactile(learner, start=False, scene=["zinc"], risk=0.02)

    def stands():
        return {each.srv_name for each in node.services}, {each.topic_name for each in node.publishers}

    before = stands()
    with pytest.raises(errors.InputError, match="never observed"):
        node.start()
    assert stands() == before
    node.set_parameters([rclpy.parameter.Parameter("scene", value=["a", "b"])])
    node.start()
    assert node.get_parameter("risk").value == 0.02 and stands() != before
    node.clean_up()
    assert stands() == before
