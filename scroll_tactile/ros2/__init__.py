"""A memory as a ROS 2 node: readings from a topic, answers as they change, services to learn and to forget.

with TactileLearner.open("memory") as learner:
    serve(learner, "/rh/tactile", "tactiles[0].electrodes")     # until ctrl-C

`TactileNode` does the same within a node of one's own. `Bridge` is what both do with a message, and needs no ROS.
"""

from scroll_tactile.ros2.bridge import Answer, Bridge, BridgeReport
from scroll_tactile.ros2.node import TactileNode, serve

__all__ = ["Answer", "Bridge", "BridgeReport", "TactileNode", "serve"]
