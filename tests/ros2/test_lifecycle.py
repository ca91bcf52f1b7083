"""The node scroll_tactile as ROS' users expect it: states, parameters, launch files, and what a crash leaves."""

import json
import signal
import subprocess
import sys
import threading

import pytest
from commands import refused
from launching import launched
from readme import command_lines
from robot import EXAMPLES, TOPIC, command, ended, ended_by_ctrl_c, publishing
from scroll_tactile_store import DamageError

from scroll_tactile import TactileLearner, errors
from scroll_tactile.clients.ros2 import Bridge, TactileNode, serve
from scroll_tactile.clients.ros2.inputs import interface, names_in, require_rclpy
from scroll_tactile.recordings import PRESETS

rclpy = pytest.importorskip("rclpy", reason="no ROS 2 here: its wheels are for Linux on x86_64")

from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState, GetState  # noqa: E402
from rcl_interfaces.srv import DescribeParameters, ListParameters, SetParameters  # noqa: E402
from std_msgs.msg import String  # noqa: E402

# Of the parser that rosidl imports with the first message.
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")


class Remote:
    """A node in another process, from a node here, which hears its answers."""

    def __init__(self, nodes, name="/scroll_tactile"):
        self.nodes, self.name = nodes, name
        self.node = nodes.node("operator")
        self.answers = []
        self.node.create_subscription(
            String, f"{name}/answer", lambda text: self.answers.append(json.loads(text.data)), 50
        )

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
        return ended(self.answers)


def node_command(memory, *words, **more):
    named = ("ros2", "--memory", memory, "--topic", TOPIC, "--field", "position")
    return command("-m", "scroll_tactile.clients.cli", *named, *words, stdout=subprocess.PIPE, **more)


def test_a_manager_takes_the_node_through_its_states_and_parameters_are_checked(spinning, own):
    with node_command(own, "--ros-args", "-p", "autostart:=false", "-p", "field:=effort") as process:
        remote = Remote(spinning)
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
        assert not remote.set("memory", str(own)) and not remote.set("field", "position")
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
        assert kept.digest() != digest and kept.materials == {"a": 12, "b": 12, "c": 12}


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


def test_a_manager_that_configures_while_the_memory_opens_waits_for_it(own, tactile, opening):
    node, (go, paths) = tactile(own, start=False), opening

    def running():
        """What else the node is asked meanwhile."""
        if not go.is_set():
            [refused] = node.set_parameters([rclpy.Parameter("memory", value="other")])
            assert not refused.successful and "deactivate and cleanup first" in refused.reason
            go.set()
            assert node.trigger_configure() and node.error is None
        return True

    node.start(running)
    assert paths == [own] and node.bridge is not None and not node.active
    node.clean_up()


def test_a_node_that_is_ended_while_the_memory_opens_lets_it_go(own, tactile, opening):
    node = tactile(own, start=False)
    node.start(lambda: False)
    opening[0].set()
    node.clean_up()
    assert node.met["materials"] == 3 and node.bridge is None


@pytest.mark.parametrize(("what", "step"), [(Bridge, "__init__"), (TactileNode, "activate")])
def test_whatever_hinders_a_transition_ends_the_start(what, step, own, tactile, monkeypatch):
    """rclpy makes a result of an exception, without a word."""
    node, logged = tactile(own, start=False), []

    def fail(self, *_, **__):
        raise ZeroDivisionError("of all things")

    monkeypatch.setattr(node.get_logger(), "error", logged.append)
    with monkeypatch.context() as patched, pytest.raises(ZeroDivisionError):
        patched.setattr(what, step, fail)
        node.start()
    assert "of all things" in logged[0] and "Traceback" in logged[0]


def test_a_transition_that_ros_refuses_ends_the_start(own, tactile, monkeypatch):
    from rclpy.lifecycle import TransitionCallbackReturn

    node = tactile(own, start=False)
    monkeypatch.setattr(node, "trigger_activate", lambda: TransitionCallbackReturn.ERROR)
    with pytest.raises(errors.ScrollTactileError, match="did not activate the node"):
        node.start()


def test_a_damaged_row_is_no_reason_not_to_start(own, tactile, monkeypatch):
    asked = []

    def health(self, *, after=0):
        asked.append(after)
        raise DamageError("row 7 is damaged", path=self.path)

    monkeypatch.setattr(TactileLearner, "health", health)
    node = tactile(own, health_after=5)
    assert node.active and set(asked) == {5}


@pytest.mark.parametrize("name", ["finger", "hand"])
def test_launch_files_start_what_they_say(name, spinning, own, tmp_path, monkeypatch):
    """Of the hand's five nodes one runs; there is no wheel of the message that its file names."""
    given = {"memory": str(own), "field": "position"} if name == "finger" else {"memories": str(tmp_path)}
    file = EXAMPLES / "ros2" / "launch" / f"{name}.launch.py"
    nodes = launched(monkeypatch, file, tmp_path, topic=TOPIC, namespace="/left", **given)
    words, place = nodes[-1], "/left/scroll_tactile"
    if name == "hand":
        files = [(tmp_path / f"launch_{i}_1.yaml").read_text() for i in range(5)]
        for i, finger in enumerate(("thumb", "index", "middle", "ring", "little")):
            assert f"__ns:=/left/{finger}" in nodes[i] and f"tactiles[{i}].electrodes" in files[i]
            assert json.dumps(str(tmp_path / finger)) in files[i]
        own.rename(tmp_path / "little")
        (tmp_path / "launch_4_1.yaml").write_text(files[4].replace("tactiles[4].electrodes", "position"))
        place = "/left/little/scroll_tactile"
    assert words[0] == "scroll-tactile"
    with command("-m", "scroll_tactile.clients.cli", *words[1:], stdout=subprocess.PIPE) as process:
        remote = Remote(spinning, place)
        spinning.until(lambda: remote.state() == "active", 300)  # it brings itself up
        with publishing(500, 250):
            spinning.until(lambda: len(remote.ended()) == 2, 300)
        assert remote.ended() == ["a", "b"] and remote.call("learn", "felt").success
        ended_by_ctrl_c(process)


def test_the_command_from_start_to_ctrl_c(spinning, own):
    """Every reading since the topic was heard counts, a second node is refused, and what was learned is there."""
    remote, named = Remote(spinning, "/left/scroll_tactile"), ("--ros-args", "-r", "__ns:=/left")
    with node_command(own, *named) as process:
        spinning.until(lambda: remote.state() == "active", 300)  # then it is heard, too
        with publishing(500, 250) as publisher:
            spinning.silent_after(publisher)
        assert f"is being written by process {process.pid}" in refused(
            "ros2", "--memory", own, "--topic", TOPIC, "--field", "position"
        )
        assert len(remote.ended()) == 2 and remote.call("learn", "felt").success
        output = ended_by_ctrl_c(process)
    assert "4 materials" in output and "messages: 500" in output and "dropped" not in output
    with TactileLearner.open(own, mode="read") as kept:
        assert kept.materials["felt"] == 1


def test_readmes_line_runs_as_it_stands(spinning, tmp_path):
    TactileLearner.open(tmp_path / "memory", sensor=PRESETS["biotac"].sensor).close()
    words = next(words for words in command_lines() if words[1] == "ros2")
    with command("-m", "scroll_tactile.clients.cli", *words[1:], cwd=tmp_path, stdout=subprocess.PIPE) as process:
        assert Remote(spinning).call("materials").success
        assert "memory: 0 materials" in ended_by_ctrl_c(process)


def test_the_example_acts_on_what_it_feels(own):
    with command(EXAMPLES / "ros2_node.py", own, TOPIC, "position", stderr=subprocess.PIPE) as process:
        with publishing(360, 250):
            said = [next(text for text in process.stderr if f"{name} after" in text) for name in "ab"]
        ended_by_ctrl_c(process)
    assert len(said) == 2


@pytest.mark.parametrize(("topic", "field"), [("/t", "a"), ("", "")])
def test_a_preset_says_where_readings_are_and_whose_where_nothing_else_does(topic, field, tactile, tmp_path):
    node = tactile(tmp_path / "none", topic=topic, field=field, preset="biotac", start=False)
    assert node.listen() == (field or "tactiles[0].electrodes")
    assert node.listener.topic == (topic or "/rh/tactile")
    assert node.open().result().sensor == PRESETS["biotac"].sensor


def test_names_are_a_list_or_a_text_with_commas():
    assert names_in([" a", "", "  ", "b, c"]) == ["a", "b", "c"] and names_in(" ") == []


def test_a_parameter_that_there_is_not_is_named_with_the_nearest(own):
    with pytest.raises(errors.InputError, match="no parameter 'rsk'; nearest is 'risk'"):
        serve(own, TOPIC, "position", rsk=0.01)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--topic /t", "expected --field"),
        ("--field data", "expected --topic"),
        ("--preset anyskin", "leaves the topic to the robot"),
        ("--preset biotak", "nearest is 'biotac'"),
        ("--topic /t --field data[", "expected"),
        ("--topic /t --field data", "to make one, say which sensor"),
        ("--topic /t --field data --contact often", "contact as auto or manual"),
        ("--topic /t --field data --topics /u", "no option '--topics'"),
        ("--topic /t --field data --sensor nose", "expected a sensor"),
        ("--topic /t --field data --risk 1.0", "between 0 and 1"),
        ("--topic /t --field data --ros-args -p risk:=x", "parameter risk"),
    ],
    ids=str,
)
def test_wrong_options(words, said, tmp_path):
    assert said in refused("ros2", "--memory", tmp_path / "none", *words.split())
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("name", "error", "said"),
    [
        ("sr_robot_msgs/msg/BiotacAll", errors.MissingLibraryError, "apt install ros-jazzy-sr-robot-msgs"),
        ("std_msgs/msg/Strin", errors.FieldError, "nearest is 'String'"),
        *((name, errors.InputError, "package/msg/Name") for name in ("BiotacAll", "a/b/C", "a/msg/", "os;x/msg/C", "")),
    ],
)
def test_a_type_that_cannot_be_had(name, error, said, monkeypatch):
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    with pytest.raises(error, match=said):
        interface(name)


def test_without_rclpy(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(errors.MissingLibraryError, match=r"setup\.bash"):
        require_rclpy()
    assert "rclpy" in refused("ros2", "--memory", tmp_path / "none", "--topic", "/t", "--field", "data")
