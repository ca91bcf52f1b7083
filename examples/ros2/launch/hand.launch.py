"""Five fingers, a node for each: ros2 launch hand.launch.py memories:=/home/robot/memories namespace:=/left

Each finger has a namespace and a memory of its own: /left/thumb/scroll_tactile/answer is what the thumb feels, and
/home/robot/memories/thumb is what it has learned. All read one topic, whose messages have an entry for each finger.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PARAMETERS = Path(__file__).resolve().parents[1] / "params" / "finger.yaml"
FINGERS = ("thumb", "index", "middle", "ring", "little")


def generate_launch_description() -> LaunchDescription:
    """What ros2 launch asks for."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("memories", description="The folder with a memory for each finger."),
            DeclareLaunchArgument("topic", default_value="/rh/tactile", description="Where the readings are sent."),
            DeclareLaunchArgument("namespace", default_value="", description="Of the hand."),
            DeclareLaunchArgument("params", default_value=str(PARAMETERS), description="A file of parameters."),
            *(_node(finger, f"tactiles[{i}].electrodes") for i, finger in enumerate(FINGERS)),
        ]
    )


def _node(finger: str, field: str) -> Node:
    given = {
        "memory": [LaunchConfiguration("memories"), f"/{finger}"],
        "topic": LaunchConfiguration("topic"),
        "field": field,
        "preset": "biotac",  # the sensor of a memory that is not there yet
    }
    return Node(
        executable="scroll-tactile",
        arguments=["ros2"],
        name="scroll_tactile",
        namespace=[LaunchConfiguration("namespace"), f"/{finger}"],
        parameters=[LaunchConfiguration("params"), given],
        output="screen",
    )
