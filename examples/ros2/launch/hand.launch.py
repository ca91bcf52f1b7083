"""A hand of several fingers, managed from outside: ros2 launch hand.launch.py memory:=/home/robot/memory

params/hand.yaml names the fingers and leaves the node unconfigured; here the launch system configures and activates it
(`autostart` of a LifecycleNode: ROS 2 Jazzy or later). A lifecycle manager of one's own, or
`ros2 lifecycle set /scroll_tactile configure`, does so as well.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode

PARAMETERS = Path(__file__).resolve().parents[1] / "params" / "hand.yaml"


def generate_launch_description() -> LaunchDescription:
    """What ros2 launch asks for."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("memory", description="The folder of the memory."),
            DeclareLaunchArgument("namespace", default_value="", description="Of the node."),
            DeclareLaunchArgument("params", default_value=str(PARAMETERS), description="A file of parameters."),
            LifecycleNode(
                executable="scroll-tactile",
                arguments=["ros2"],
                name="scroll_tactile",
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("params"), {"memory": LaunchConfiguration("memory")}],
                autostart=True,
                output="screen",
            ),
        ]
    )
