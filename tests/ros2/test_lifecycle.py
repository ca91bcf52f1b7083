"""The node scroll_tactile as ROS' users expect it: states, parameters, launch files, and what a crash leaves."""

import json
import signal
import subprocess
import threading
from pathlib import Path

import launching
import pytest
from robot import TOPIC, command, ended_by_ctrl_c, publishing
from scroll_tactile_store import DamageError

from scroll_tactile import TactileLearner, errors
from scroll_tactile.clients.ros2.fingers import Finger, fingers_of, new_sensor
from scroll_tactile.clients.ros2.parameters import DYNAMIC, refused, texts
from scroll_tactile.clients.ros2.serving import _node, _Served, _start, serve
from scroll_tactile.recordings import PRESETS

rclpy = pytest.importorskip("rclpy", reason="no ROS 2 here: its wheels are for Linux on x86_64")

from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState, GetState  # noqa: E402
from rcl_interfaces.srv import DescribeParameters, ListParameters, SetParameters  # noqa: E402
from std_msgs.msg import String  # noqa: E402

# Of the parser that rosidl imports with the first message.
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")

EXAMPLES = Path(__file__).parents[2] / "examples" / "ros2"
PLAIN = "import sys; sys.modules['rclpy.lifecycle'] = None; from scroll_tactile.clients.cli import main; main()"


class Remote:
    """A node in another process, from a node here."""

    def __init__(self, nodes, name="/scroll_tactile"):
        self.nodes, self.name = nodes, name
        self.node = nodes.node("operator")
        self.answers = []

    def listen(self, place="answer"):
        def take(text):
            self.answers.append(json.loads(text.data))

        self.node.create_subscription(String, f"{self.name}/{place}", take, 50)

    def ask(self, kind, name, **request):
        return self.nodes.ask(self.node, kind, f"{self.name}/{name}", **request)

    def call(self, name, argument=None):
        return self.nodes.call(self.node, f"{self.name}/{name}", argument)

    def state(self):
        return self.ask(GetState, "get_state").current_state.label

    def go(self, transition):
        number = getattr(Transition, f"TRANSITION_{transition.upper()}")
        return self.ask(ChangeState, "change_state", transition=Transition(id=number)).success

    def set(self, name, value):
        """Why a parameter cannot be set; "" where it was."""
        message = rclpy.Parameter(name, value=value).to_parameter_msg()
        [result] = self.ask(SetParameters, "set_parameters", parameters=[message]).results
        return "" if result.successful else result.reason or "no reason"

    def ended(self):
        return [answer for answer in self.answers if answer["event"] == "ended"]


@pytest.fixture
def own(memory, tmp_path):
    with TactileLearner.open(memory, mode="read") as source:
        source.backup(tmp_path / "own")
    return tmp_path / "own"


def node_command(memory, *words, **more):
    named = ("ros2", "--memory", memory, "--topic", TOPIC, "--field", "position")
    return command("-m", "scroll_tactile.clients.cli", *named, *words, stdout=subprocess.PIPE, **more)


def test_a_manager_takes_the_node_through_its_states_and_parameters_are_checked(spinning, own):
    with node_command(own, "--ros-args", "-p", "autostart:=false", "-p", "field:=effort") as process:
        remote = Remote(spinning)
        remote.listen()
        assert remote.state() == "unconfigured"
        names = remote.ask(ListParameters, "list_parameters").result.names
        described = remote.ask(DescribeParameters, "describe_parameters", names=names).descriptors
        ours = {each.name: each for each in described if not each.name.startswith(("use_sim", "start_type"))}
        assert {"memory", "topic", "field", "type", "risk", "scene", "qos.depth", "health_after"} <= ours.keys()
        assert all(each.description for each in ours.values()) and ours["autostart"].read_only
        assert ours["risk"].floating_point_range[0].to_value == 1.0
        assert "auto or manual" in remote.set("contact", "often") and not remote.set("contact", "auto")
        assert not remote.set("memory", str(own / "none"))
        assert not remote.go("configure") and remote.state() == "unconfigured"
        assert not remote.set("memory", str(own)) and not remote.set("field", ["position"])
        assert remote.go("configure") and remote.state() == "inactive"
        assert "deactivate and cleanup first" in remote.set("field", "velocity")
        assert remote.set("risk", 1.5) and remote.set("risk", 1.0) and not remote.set("risk", 0.02)
        assert "never observed" in remote.set("scene", ["a", "zinc"])
        assert not remote.set("scene", "a, b") and not remote.set("scene", "")
        assert remote.go("activate")
        with publishing(500, 250):
            spinning.until(lambda: len(remote.ended()) == 2, 300)
        assert json.loads(remote.call("predict").message)["material"] == "b"
        assert remote.go("deactivate") and remote.state() == "inactive"
        spinning.until(lambda: not remote.node.count_subscribers(TOPIC))
        assert remote.call("learn", "felt").success  # what was touched before
        assert remote.go("activate")
        spinning.until(lambda: remote.node.count_subscribers(TOPIC))
        assert remote.go("deactivate")
        assert remote.go("cleanup") and remote.state() == "unconfigured"
        with TactileLearner.open(own) as opened:  # it lets the memory go
            assert opened.materials["felt"] == 1
        assert remote.go("configure") and remote.go("activate") and remote.state() == "active"
        assert json.loads(remote.call("materials").message)["felt"] == 1
        ended_by_ctrl_c(process)


def test_readings_that_come_while_the_memory_opens_are_all_taken_and_what_was_acknowledged_outlives_a_kill(
    spinning, own
):
    """The publisher begins as soon as somebody listens; the node is killed within a touch, and started again."""
    remote = Remote(spinning)
    remote.listen()
    with publishing(500, 250) as publisher, node_command(own) as process:
        spinning.silent_after(publisher)
        reply = remote.call("learn", "felt")
        assert reply.success and "learned as observation" in reply.message
        remote.answers.clear()
        with publishing(200, 100):  # its first touch begins after 120 readings
            spinning.until(lambda: any(answer["contact"] for answer in remote.answers), 300)
            process.send_signal(signal.SIGKILL)
            process.wait()
    with TactileLearner.open(own, mode="read") as kept:
        digest = kept.digest()
        assert kept.materials["felt"] == 1
    # By another name: for some seconds a client still finds the services of what was killed, which answer nobody.
    with node_command(own, "--ros-args", "-r", "__node:=again") as process:
        remote = Remote(spinning, "/again")
        assert json.loads(remote.call("materials").message)["felt"] == 1
        assert remote.call("save", "monday").success
        assert "is there already" in remote.call("save", "monday.zip").message
        assert "expected a file's name" in remote.call("save", "../monday").message
        assert (own.parent / "monday.zip").is_file()
        assert remote.call("retract", reply.message.split("observation ")[1].split(";")[0]).success
        assert "felt" not in json.loads(remote.call("materials").message)
        output = ended_by_ctrl_c(process)
    assert "own: 3 materials" in output
    with TactileLearner.open(own, mode="read") as kept:
        assert kept.digest() != digest and kept.materials == {"a": 6, "b": 6, "c": 6}


def test_every_reading_since_the_topic_was_heard_is_counted(spinning, own):
    with publishing(500, 250) as publisher, node_command(own) as process:
        spinning.silent_after(publisher)
        output = ended_by_ctrl_c(process)
    assert "messages: 500" in output and "dropped" not in output


def test_a_client_without_lifecycle_makes_a_plain_node(spinning, own):
    words = ("ros2", "--memory", own, "--topic", TOPIC, "--field", "position", "--ros-args", "-r", "__node:=plain")
    with command("-c", PLAIN, *words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        remote = Remote(spinning, "/plain")
        assert json.loads(remote.call("materials").message) == {"a": 6, "b": 6, "c": 6}
        assert "read when the node starts: end it" in remote.set("topic", "/other")
        assert f"{remote.name}/get_state" not in dict(remote.node.get_service_names_and_types())
        process.send_signal(signal.SIGINT)
        _, logged = process.communicate(timeout=60)
    assert process.returncode == 0 and "no lifecycle here" in logged


def served_by(node, memory, **values):
    named = {"memory": str(memory), "topic": TOPIC, "field": "position", "type": "sensor_msgs/msg/JointState"}
    return _Served(node, None, named | values, managed=True)


@pytest.fixture
def opening(own, monkeypatch):
    """Has memories open only when the event is set; what was opened."""
    go, paths, before = threading.Event(), [], TactileLearner.open

    def slow(path, **how):
        paths.append(path)
        assert go.wait(60)
        return before(path, **how)

    monkeypatch.setattr(TactileLearner, "open", slow)
    yield go, paths
    monkeypatch.undo()
    TactileLearner.open(own).close()  # it was let go


def test_a_manager_that_configures_while_the_memory_opens_waits_for_it(spinning, own, opening):
    node, (go, paths) = spinning.node("scroll_tactile"), opening
    served = served_by(node, own)

    def running():
        """What else the node is asked meanwhile."""
        if not go.is_set():
            [refused] = node.set_parameters([rclpy.Parameter("memory", value="other")])
            assert not refused.successful and "deactivate and cleanup first" in refused.reason
            go.set()
            assert served.tried(served.configure), served.error
        return True

    _start(served, running)
    assert paths == [own] and len(served.fingers) == 1 and not served.fingers[0].active
    served.clean_up()


def test_a_node_that_is_ended_while_the_memory_opens_lets_it_go(spinning, own, opening):
    served = served_by(spinning.node("scroll_tactile"), own)
    _start(served, lambda: False)
    opening[0].set()
    served.clean_up()
    assert served.met["materials"] == 3 and not served.fingers


def test_whatever_hinders_a_transition_ends_the_start(spinning, own, monkeypatch):
    """rclpy makes a result of an exception, without a word."""
    from rclpy.lifecycle import TransitionCallbackReturn

    context, logged = spinning.node("operator").context, []

    def fail(self):
        raise ZeroDivisionError("of all things")

    for step in ("configure", "activate"):
        node, _ = _node(rclpy, context)
        node.served = served_by(node, own)
        monkeypatch.setattr(node.get_logger(), "error", logged.append)
        with monkeypatch.context() as patched, pytest.raises(ZeroDivisionError):
            patched.setattr(_Served, step, fail)
            _start(node.served, lambda: True)
        assert "of all things" in logged[-1] and "Traceback" in logged[-1]
        node.served.clean_up()
    node, _ = _node(rclpy, context)
    node.served = served_by(node, own)
    monkeypatch.setattr(node, "trigger_activate", lambda: TransitionCallbackReturn.ERROR)
    with pytest.raises(errors.ScrollTactileError, match="did not activate the node"):
        _start(node.served, lambda: True)
    node.served.clean_up()


def test_a_damaged_row_is_no_reason_not_to_start(spinning, own, monkeypatch):
    asked = []

    def health(self, *, after=0):
        asked.append(after)
        raise DamageError("row 7 is damaged", path=self.path)

    monkeypatch.setattr(TactileLearner, "health", health)
    served = served_by(spinning.node("scroll_tactile"), own, health_after=5)
    served.configure()
    assert len(served.fingers) == 1 and set(asked) == {5}
    served.clean_up()


def test_a_parameter_that_there_is_not_is_named_with_the_nearest(own):
    with pytest.raises(errors.InputError, match="no parameter 'rsk'; nearest is 'risk'"):
        serve(own, TOPIC, "position", rsk=0.01)


@pytest.mark.parametrize("name", ["finger", "hand"])
def test_launch_files_start_what_they_say(name, spinning, own, tmp_path, monkeypatch):
    launching.doubles(monkeypatch)
    given = {"topic": TOPIC, "field": "position"} if name == "finger" else {}
    if name == "hand":  # there is no wheel of the message that its file names
        text = (EXAMPLES / "params" / "hand.yaml").read_text()
        text = text.replace("sr_robot_msgs/msg/BiotacAll", "sensor_msgs/msg/JointState")
        for i, field in enumerate(("position", "velocity", "effort")):
            text = text.replace(f"tactiles[{i}].electrodes", field)
        (tmp_path / "hand.yaml").write_text(text.replace("/rh/tactile", TOPIC))
        given = {"params": str(tmp_path / "hand.yaml")}
    file = EXAMPLES / "launch" / f"{name}.launch.py"
    words, transitions = launching.launched(file, tmp_path, memory=str(own), namespace="/left", **given)
    assert words.pop(0) == "scroll-tactile"
    with command("-m", "scroll_tactile.clients.cli", *words, stdout=subprocess.PIPE) as process:
        remote = Remote(spinning, "/left/scroll_tactile")
        if transitions:
            assert remote.state() == "unconfigured"
        for transition in transitions:
            assert remote.ask(ChangeState, "change_state", transition=Transition(id=transition)).success
        spinning.until(lambda: remote.state() == "active", 300)  # it brings itself up
        place = "" if name == "finger" else "thumb/"
        remote.listen(f"{place}answer")
        with publishing(500, 250):
            spinning.until(lambda: len(remote.ended()) == 2, 300)
        assert [answer["material"] for answer in remote.ended()] == ["a", "b"]
        assert remote.call(f"{place}learn", "felt").success
        if name == "hand":
            assert remote.call("index/materials").success and "felt" in remote.call("index/materials").message
        ended_by_ctrl_c(process)


def test_a_memory_that_is_there_has_its_sensor_and_parameters_are_what_they_can_be(memory, tmp_path):
    assert new_sensor(memory, "", "biotac") is None  # a preset may give topic and field alone
    assert new_sensor(tmp_path / "none", "", "biotac") == PRESETS["biotac"].sensor
    with pytest.raises(errors.InputError, match="say which sensor"):
        new_sensor(tmp_path / "none", "", "")
    assert texts([" a", "", "  ", "b "]) == ["a", "b"] and texts(" ") == []
    risk = next(each for each in DYNAMIC if each.name == "risk")
    assert [bool(refused(risk, value)) for value in (0.0, 0.05, 1.0, True, "x")] == [True, False, True, True, True]


def test_fingers_by_topics_fields_and_names():
    assert fingers_of(["/t"], ["a"], [], "") == [Finger("", "/t", "a")]
    assert fingers_of([], [], [], "biotac") == [Finger("", "/rh/tactile", "tactiles[0].electrodes")]
    assert fingers_of(["/t"], ["a", "b"], [], "") == [Finger("finger0", "/t", "a"), Finger("finger1", "/t", "b")]
    assert fingers_of(["/t", "/u"], ["a"], ["l", "r"], "") == [Finger("l", "/t", "a"), Finger("r", "/u", "a")]
    for wrong, said in (
        ((["/t"], [], []), "expected field="),
        ((["/t", "/u"], ["a", "b", "c"], []), "for each of 3 fingers"),
        ((["/t"], ["a", "b"], ["l"]), "for each of 2 fingers"),
        ((["/t"], ["a", "b"], ["l", "l"]), "each once"),
        ((["/t"], ["a"], ["left/hand"]), "letters, digits"),
        ((["/t"], ["a["], []), "expected"),
    ):
        with pytest.raises(errors.InputError, match=said):
            fingers_of(*wrong, "")
