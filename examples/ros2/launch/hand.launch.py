"""A hand of several fingers, managed from outside: ros2 launch hand.launch.py memory:=/home/robot/memory

params/hand.yaml names the fingers and leaves the node unconfigured; here the launch system configures it as soon as it
runs, and activates it once it is configured. A lifecycle manager of one's own, or `ros2 lifecycle set /scroll_tactile
configure`, does so as well.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.events import matches_action
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from lifecycle_msgs.msg import Transition

PARAMETERS = Path(__file__).resolve().parents[1] / "params" / "hand.yaml"


def generate_launch_description() -> LaunchDescription:
    """What ros2 launch asks for."""
    node = LifecycleNode(
        executable="scroll-tactile",
        arguments=["ros2"],
        name="scroll_tactile",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params"), {"memory": LaunchConfiguration("memory")}],
        output="screen",
    )

    def change(transition: int) -> EmitEvent:
        return EmitEvent(event=ChangeState(lifecycle_node_matcher=matches_action(node), transition_id=transition))

    return LaunchDescription(
        [
            DeclareLaunchArgument("memory", description="The folder of the memory."),
            DeclareLaunchArgument("namespace", default_value="", description="Of the node."),
            DeclareLaunchArgument("params", default_value=str(PARAMETERS), description="A file of parameters."),
            RegisterEventHandler(
                OnStateTransition(
                    target_lifecycle_node=node,
                    start_state="configuring",
                    goal_state="inactive",
                    entities=[change(Transition.TRANSITION_ACTIVATE)],
                )
            ),
            node,
            change(Transition.TRANSITION_CONFIGURE),
        ]
    )
