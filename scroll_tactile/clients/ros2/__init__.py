"""A memory as a ROS 2 node: readings from a topic, answers as they change, services to learn and to forget.

serve("memory", "/rh/tactile", "tactiles[0].electrodes")     # until ctrl-C

`TactileNode` is that node, for an executor of one's own. `Bridge` is what it does with a message, and needs no ROS.
"""

from scroll_tactile.clients.ros2.bridge import Answer, Bridge, BridgeReport
from scroll_tactile.clients.ros2.node import TactileNode, serve

__all__ = ["Answer", "Bridge", "BridgeReport", "TactileNode", "serve"]
