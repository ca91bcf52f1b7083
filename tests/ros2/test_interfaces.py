"""What is said where ROS, a package or a type is missing."""

import sys

import pytest
from commands import refused

from scroll_tactile import errors
from scroll_tactile.clients.ros2.interfaces import interface, kind_of, require_rclpy


def test_a_package_that_is_missing_is_named_with_what_installs_it(monkeypatch):
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    with pytest.raises(errors.MissingLibraryError, match="apt install ros-jazzy-sr-robot-msgs"):
        interface("sr_robot_msgs/msg/BiotacAll")


@pytest.mark.parametrize("name", ["BiotacAll", "a/b/C", "a/msg/", "os;x/msg/C", ""])
def test_a_name_that_is_no_type(name):
    with pytest.raises(errors.InputError, match="package/msg/Name"):
        interface(name)


def test_a_topic_of_two_types():
    topics = {"/t": ["a/msg/A", "b/msg/B"], "/s": ["a/msg/A"]}
    assert kind_of("/s", topics) == "a/msg/A"
    assert kind_of("/none", topics) is None
    with pytest.raises(errors.InputError, match="--type"):
        kind_of("/t", topics)


def test_without_rclpy(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(errors.MissingLibraryError, match=r"setup\.bash"):
        require_rclpy()
    assert "rclpy" in refused("ros2", "--memory", tmp_path / "none", "--topic", "/t", "--field", "data")


@pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")  # of the parser that rosidl imports
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--topic", "/t"], "expected --field"),
        (["--field", "data"], "expected --topic"),
        (["--preset", "anyskin"], "leaves the topic to the robot"),
        (["--preset", "biotak"], "nearest is 'biotac'"),
        (["--topic", "/t", "--field", "data["], "expected"),
        (["--topic", "/t", "--field", "data", "--contact", "often"], "contact as auto or manual"),
        (["--topic", "/t", "--field", "data", "--topics", "/u"], "no option '--topics'"),
        (["--topic", "/t", "--field", "data", "--sensor", "nose"], "expected a sensor"),
    ],
    ids=str,
)
def test_wrong_options(words, said, tmp_path):
    pytest.importorskip("rclpy", reason="no ROS 2 here: its wheels are for Linux on x86_64")
    assert said in refused("ros2", "--memory", tmp_path / "none", *words)
    assert not (tmp_path / "none").exists()
