"""An arm that acts on what its finger feels: the memory, the sensor's topic and the arm in one ROS 2 node.

With ROS 2 sourced:  python examples/ros2_node.py MEMORY /rh/tactile 'tactiles[0].electrodes'

It waits for the topic. To tell it what it touched last:
    ros2 service call /hand/learn diagnostic_msgs/srv/AddDiagnostics "{load_namespace: silk}"
"""

import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from scroll_tactile import TactileLearner
from scroll_tactile.clients.ros2 import Answer, TactileNode


class Hand(Node):  # type: ignore[misc]  # of ROS 2, which may not be here
    """A node of one's own with a memory in it."""

    def __init__(self, learner: TactileLearner, topic: str, field: str) -> None:
        super().__init__("hand")
        self.touch = TactileNode(self, learner, topic, field, risk=0.05, answered=self.act)

    def act(self, answer: Answer) -> None:
        """Where an arm would move: as soon as it is safe to, not when the touch is over."""
        if answer["event"] == "decided":
            felt = "something new" if answer["known"] is False else answer["material"]
            self.get_logger().info(f"{felt} after {answer['seconds']:.2f} s of touch")
        elif answer["event"] == "ended" and not answer["decided"]:
            self.get_logger().info(f"not sure: {', '.join(answer['candidates']) or 'like nothing known'}")


def main() -> None:
    """Run the hand until ctrl-C."""
    memory, topic, field = sys.argv[1:]
    rclpy.init()
    with TactileLearner.open(memory) as learner:
        hand = Hand(learner, topic, field)
        try:
            rclpy.spin(hand)
        except (KeyboardInterrupt, ExternalShutdownException):
            pass
        finally:
            hand.touch.close()
            rclpy.try_shutdown()


if __name__ == "__main__":
    main()
