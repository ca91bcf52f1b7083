"""An arm that acts on what its finger feels: the memory and the sensor's topic in a ROS 2 node, the arm in another.

With ROS 2 sourced:  python examples/ros2_node.py MEMORY /rh/tactile 'tactiles[0].electrodes'

It waits for the topic. To tell it what it touched last:
    ros2 service call /scroll_tactile/learn diagnostic_msgs/srv/AddDiagnostics "{load_namespace: silk}"
"""

import sys

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

from scroll_tactile.clients.ros2 import Answer, TactileNode


class Hand(TactileNode):
    """The memory's node, which acts in the same process."""

    def answered(self, answer: Answer) -> None:
        """Where an arm would move: as soon as it is safe to, not when the touch is over."""
        if answer["event"] == "decided":
            felt = "something new" if answer["known"] is False else answer["material"]
            self.get_logger().info(f"{felt} after {answer['seconds']:.2f} s of touch")
        elif answer["event"] == "ended" and not answer["decided"]:
            self.get_logger().info(f"not sure: {', '.join(answer['candidates']) or 'like nothing known'}")


def main() -> None:
    """Run the hand, and what else is in the executor, until ctrl-C."""
    rclpy.init()
    hand = Hand(*sys.argv[1:], risk=0.05)
    executor = SingleThreadedExecutor()
    executor.add_node(hand)  # and the arm's own node
    try:
        hand.start()
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        hand.clean_up()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
