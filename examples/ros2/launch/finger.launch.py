"""One finger: ros2 launch finger.launch.py memory:=/home/robot/memory namespace:=/left topic:=/left/tactile

The node brings itself up to active. Other parameters are in params/finger.yaml; params:=FILE takes another file.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PARAMETERS = Path(__file__).resolve().parents[1] / "params" / "finger.yaml"


def generate_launch_description() -> LaunchDescription:
    """What ros2 launch asks for."""
    given = {name: LaunchConfiguration(name) for name in ("memory", "topic", "field")}
    return LaunchDescription(
        [
            DeclareLaunchArgument("memory", description="The folder of the memory."),
            DeclareLaunchArgument("topic", default_value="/rh/tactile", description="Where the readings are sent."),
            DeclareLaunchArgument("field", default_value="tactiles[0].electrodes", description="Their path."),
            DeclareLaunchArgument("namespace", default_value="", description="Of the node."),
            DeclareLaunchArgument("params", default_value=str(PARAMETERS), description="A file of parameters."),
            Node(
                executable="scroll-tactile",
                arguments=["ros2"],
                name="scroll_tactile",
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("params"), given],
                output="screen",
            ),
        ]
    )
