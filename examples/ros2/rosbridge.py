"""A memory beside a robot whose Python is too old for it, such as the 3.10 of ROS 2 Humble, over rosbridge.

On the robot:     sudo apt install ros-humble-rosbridge-suite
                  ros2 launch rosbridge_server rosbridge_websocket_launch.xml
Beside it, or on another machine, in a Python from 3.11 on, in a clone:    pip install . roslibpy
    python examples/ros2/rosbridge.py MEMORY /rh/tactile sr_robot_msgs/BiotacAll 'tactiles[0].electrodes' [HOST]

Answers come on /scroll_tactile/answer, and what was touched last is learned as by the node:
    ros2 service call /scroll_tactile/learn diagnostic_msgs/srv/AddDiagnostics "{load_namespace: silk}"
"""

import json
import logging
import sys
import threading
import time
from typing import Any

import roslibpy
from scroll_tactile_store import StoreError

from scroll_tactile import TactileLearner
from scroll_tactile.clients.ros2 import Answer, Bridge
from scroll_tactile.errors import ScrollTactileError

PORT = 9090


class Beside:
    """A bridge between rosbridge and a memory. What comes in comes in threads, one at a time from here on."""

    def __init__(self, client: Any, learner: TactileLearner, topic: str, kind: str, field: str) -> None:
        self.turn = threading.Lock()
        self.answers = roslibpy.Topic(client, "/scroll_tactile/answer", "std_msgs/String", latch=True)
        self.answers.advertise()
        self.bridge = Bridge(learner, field, answer=self.publish, warn=logging.warning)
        self.learning = roslibpy.Service(client, "/scroll_tactile/learn", "diagnostic_msgs/AddDiagnostics")
        self.learning.advertise(self.learn)
        self.readings = roslibpy.Topic(client, topic, kind, queue_length=2000)
        self.readings.subscribe(self.take)

    def take(self, message: dict[str, Any]) -> None:
        """Take a message; rosbridge does not say when it was published, so one without a stamp counts from now."""
        with self.turn:
            self.bridge.receive(message, time.time())

    def publish(self, answer: Answer) -> None:
        """Publish an answer, and show those that are final."""
        self.answers.publish(roslibpy.Message({"data": json.dumps(answer)}))
        if answer["event"] in ("decided", "ended"):
            print(answer["event"], answer.get("material"), answer.get("probability"), flush=True)

    def learn(self, request: dict[str, Any], response: dict[str, Any]) -> bool:
        """Serve /scroll_tactile/learn."""
        with self.turn:
            try:
                response["success"], response["message"] = True, self.bridge.learn(request["load_namespace"])
            except (ScrollTactileError, StoreError, OSError) as error:
                response["success"], response["message"] = False, str(error)
        return True


def main() -> None:
    """Run until ctrl-C."""
    memory, topic, kind, field, *host = sys.argv[1:]
    client = roslibpy.Ros(host=host[0] if host else "localhost", port=PORT)
    client.run()
    with TactileLearner.open(memory) as learner:
        beside = Beside(client, learner, topic, kind, field)
        print("listening", flush=True)
        try:
            while client.is_connected:
                time.sleep(0.2)
        except KeyboardInterrupt:
            pass
        finally:
            beside.readings.unsubscribe()
            with beside.turn:
                beside.bridge.close()
            client.terminate()


if __name__ == "__main__":
    main()
