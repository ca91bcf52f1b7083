"""A memory as a ROS 2 node: readings from a topic, answers as they change, services to learn and to forget.

serve("memory", "/rh/tactile", "tactiles[0].electrodes")     # until ctrl-C

`TactileNode` does the same within a node of one's own, and its docstring lists topics, services and parameters.
`Bridge` is what both do with a message, and needs no ROS.
"""

import importlib
import typing

if typing.TYPE_CHECKING:
    from scroll_tactile.clients.ros2.bridge import Answer, Bridge, BridgeReport
    from scroll_tactile.clients.ros2.inputs import Listener, Quality
    from scroll_tactile.clients.ros2.node import TactileNode
    from scroll_tactile.clients.ros2.serving import serve

__all__ = ["Answer", "Bridge", "BridgeReport", "Listener", "Quality", "TactileNode", "serve"]

# Imported on first use: a topic should be heard before the libraries behind a learner are there.
_MODULES = {
    **dict.fromkeys(("Answer", "Bridge", "BridgeReport"), "bridge"),
    **dict.fromkeys(("Listener", "Quality"), "inputs"),
    "TactileNode": "node",
    "serve": "serving",
}


def __getattr__(name: str) -> typing.Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
