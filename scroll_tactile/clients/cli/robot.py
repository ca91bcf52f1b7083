"""`scroll-tactile ros2`: a memory as a ROS 2 node."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from scroll_tactile.clients.cli.options import Axis, MemoryFolder
from scroll_tactile.clients.cli.terminal import opened, say, shown
from scroll_tactile.clients.cli.wording import counted
from scroll_tactile.errors import InputError

__all__ = ["PASSED_ON", "mcp", "ros2"]

PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True}
"""What the command is made with, so that --ros-args and what follows reach ROS."""


def ros2(
    context: typer.Context,
    memory: Annotated[
        Path | None, typer.Option(help="The folder of the memory; here or as the parameter memory.")
    ] = None,
    topic: Annotated[str | None, typer.Option(help="Where the readings are sent; a preset may know it.")] = None,
    field: Annotated[
        str | None, typer.Option(help="The path to a message's numbers, such as tactiles[0].electrodes.")
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(help="A known sensor, which gives sensor, topic and field: biotac, xela-uskin, anyskin, …"),
    ] = None,
    kind: Annotated[
        str | None, typer.Option("--type", help="The messages' type, as package/msg/Name; else what the topic says.")
    ] = None,
    risk: Annotated[float, typer.Option(help="The share of wrong answers among those that are decided.")] = 0.05,
    scene: Annotated[
        str | None, typer.Option(help="The materials that can be here, with commas between; else all.")
    ] = None,
    contact: Annotated[
        str, typer.Option(help="auto finds touches, after 2 s at rest; manual waits for the services begin and end.")
    ] = "auto",
    of: Axis = None,
    watch: Annotated[
        bool,
        typer.Option("--watch", help="Note rest and known touches for the sensor's health, some hundred bytes each."),
    ] = False,
    sensor: Annotated[
        str | None, typer.Option(help="As for observe: whose readings they are. Needed only to make a new memory.")
    ] = None,
) -> None:
    """Run the ROS 2 lifecycle node scroll_tactile until ctrl-C: readings from a topic, answers on ~/answer.

    It comes up active. What follows --ros-args is ROS': -r __ns:=/left, --params-file FILE, -p autostart:=false. Each
    option is a parameter, too, and so are mode, qos.reliability, qos.durability and qos.depth; `ros2 param describe`
    explains them. risk, scene and health_after can be set while it runs, the others before it is configured.

    Topics, of which late subscribers get the last: ~/answer (JSON), ~/status (by name, with a header), ~/material,
    ~/probability, ~/novelty and ~/known (plain numbers, for plots), ~/tactile_answer (where scroll_tactile_msgs is
    built), and /diagnostics.

    Services that take a name, as load_namespace of diagnostic_msgs/srv/AddDiagnostics: ~/learn, ~/forget, ~/retract
    (an observation's number), ~/save (a file beside the memory). Services of std_srvs/srv/Trigger: ~/undo, ~/materials,
    ~/predict, ~/again (before another touch of the same thing), ~/begin and ~/end (with --contact manual).

    ros2 service call /scroll_tactile/learn diagnostic_msgs/srv/AddDiagnostics "{load_namespace: silk}"
    """
    if context.args and context.args[0] != "--ros-args":
        raise InputError(f"there is no option {context.args[0]!r}: see --help. Options of ROS follow --ros-args")
    from scroll_tactile.clients.ros2.serving import serve

    how: dict[str, Any] = {"preset": preset, "type": kind, "risk": risk, "scene": scene}
    how |= {"contact": contact, "of": of, "watch": watch, "sensor": sensor}
    met = serve(memory, topic or "", field or "", arguments=context.args, **how)
    count = met.pop("materials", 0)
    met_in_words = ", ".join(f"{name.replace('_', ' ')}: {value}" for name, value in met.items() if value)
    say(f"{shown(memory or 'the memory')}: {counted(count, 'material')}. {met_in_words}")


def mcp(
    memory: MemoryFolder,
    learn: Annotated[
        bool, typer.Option("--learn", help="Let it observe and retract, too; without it the memory stays as it is.")
    ] = False,
    files: Annotated[
        Path | None, typer.Option(help="A folder whose recordings it may name in place of readings.")
    ] = None,
) -> None:
    """Serve a memory to a planner over standard input and output, by the Model Context Protocol, until it hangs up.

    Its tools: what_is_felt, what_is_known, what_to_touch_again; with --learn observe and retract.
    """
    from scroll_tactile.clients.planner.server import serve

    with opened(memory, mode="write" if learn else "read") as learner:
        serve(learner, learn=learn, files=files)
