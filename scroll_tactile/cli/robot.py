"""`scroll-tactile ros2` and `mcp`: a memory as a ROS 2 node, and as tools for planners."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, cast

import typer

from scroll_tactile.cli.options import Axis, MemoryFolder, sensor_for
from scroll_tactile.cli.terminal import opened, say, shown
from scroll_tactile.errors import InputError

__all__ = ["PASSED_ON", "mcp", "ros2"]

PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True}
"""What the command is made with, so that --ros-args and what follows reach ROS."""


def ros2(
    context: typer.Context,
    memory: Annotated[Path, typer.Option(help="The folder of the memory.", show_default=False)],
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
    """Run the ROS 2 node scroll_tactile until ctrl-C: readings from a topic, answers on ~/answer as they change.

    To learn the last touch: ros2 param set /scroll_tactile material silk, then ros2 service call /scroll_tactile/learn
    std_srvs/srv/Trigger; likewise undo, forget, materials, again before another touch of the same thing, and begin and
    end with --contact manual. Answers are on ~/material, ~/probability, ~/novelty and ~/known, too, to be plotted.
    Options of ROS follow --ros-args.
    """
    if context.args and context.args[0] != "--ros-args":
        raise InputError(f"there is no option {context.args[0]!r}: see --help. Options of ROS follow --ros-args")
    topic, field = _place(topic, field, preset)
    if contact not in ("auto", "manual"):
        raise InputError(f"expected contact as 'auto' or 'manual'; came {contact!r}")
    from scroll_tactile.recordings.paths import FieldPath
    from scroll_tactile.ros2.interfaces import interface, require_rclpy
    from scroll_tactile.ros2.node import serve

    FieldPath(field)
    require_rclpy()
    if kind is not None:
        interface(kind)
    chosen = sensor_for(memory, sensor, preset)  # what is refused makes no memory
    with opened(memory, sensor=chosen) as learner:
        way = cast(Literal["auto", "manual"], contact)
        how: dict[str, Any] = {"risk": risk, "contact": way, "of": of, "watch": watch}
        met = serve(learner, topic, field, kind=kind, arguments=context.args, **how)
        count = len(learner.materials)
    counted = ", ".join(f"{name.replace('_', ' ')}: {value}" for name, value in met.items() if value)
    say(f"{shown(memory)}: {count} materials. {counted}")


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
    from scroll_tactile.planner.server import serve

    with opened(memory, mode="write" if learn else "read") as learner:
        serve(learner, learn=learn, files=files)


def _place(topic: str | None, field: str | None, preset: str | None) -> tuple[str, str]:
    """Topic and field, of a preset where they were not given."""
    from scroll_tactile.recordings import presets

    known = None if preset is None else presets.find(preset)
    if known is not None:
        topic, field = topic or known.topic, field or known.field
    if not topic or not field:
        what = " and ".join(name for name, given in (("--topic", topic), ("--field", field)) if not given)
        raise InputError(
            f"expected {what}: where the readings are, such as --topic /rh/tactile --field tactiles[0].electrodes"
            + (f". Preset {preset!r} leaves the topic to the robot" if known else "; or --preset of a known sensor")
        )
    return topic, field
