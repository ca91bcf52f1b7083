"""`scroll-tactile annotate`: answers written into a data set, beside what a robot recorded."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scroll_tactile.clients.cli.options import AsJson, Clock, Columns, Field, materials_of
from scroll_tactile.clients.cli.terminal import opened, progress_bar, say, say_json, shown
from scroll_tactile.clients.cli.wording import counted

if TYPE_CHECKING:
    from scroll_tactile.clients.learning.annotating.annotation_run import Annotated as Done

__all__ = ["annotate"]


class TouchCut(StrEnum):
    """Where touches begin and end in an episode."""

    EPISODES = "episodes"
    CONTACT = "contact"


NO_TOUCH = {
    TouchCut.EPISODES: "the episodes are too short, or their readings not finite",
    TouchCut.CONTACT: "with --cut contact each episode has to begin with two seconds at rest",
}


def annotate(
    dataset: Annotated[Path, typer.Argument(help="The folder of a LeRobot data set, v3.", show_default=False)],
    memory: Annotated[Path, typer.Option(help="The folder of the memory that answers.", show_default=False)],
    output: Annotated[
        Path | None, typer.Option(help="A new folder for the data set with answers; DATASET-annotated without it.")
    ] = None,
    in_place: Annotated[
        bool, typer.Option("--in-place", help="Change the data set itself; meta.before keeps its meta/ as it was.")
    ] = False,
    forms: Annotated[str, typer.Option("--as", help="numbers, language, mcap, with commas between.")] = (
        "numbers,language"
    ),
    replace: Annotated[
        bool, typer.Option("--replace", help="Answer anew where answers are there; events of others stay.")
    ] = False,
    field: Field = None,
    columns: Columns = None,
    clock: Clock = None,
    cut: Annotated[
        TouchCut, typer.Option(help="Each episode is one touch; or they are found by contact, after 2 s at rest in it.")
    ] = TouchCut.EPISODES,
    risk: Annotated[float, typer.Option(help="The share of wrong answers among those that are decided.")] = 0.05,
    scene: Annotated[
        str | None, typer.Option(help="The materials that can be here, separated by commas; all of them otherwise.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write into a LeRobot data set what the memory answers at each frame, knowing no more than the frames before it.

    Columns observation.touch.material (a number; meta/info.json has the names), .probability, .known and .QUANTITY, and
    events in language_events; with --as mcap a log of each episode in mcap/, for Foxglove and Rerun. All else stays as
    it is. Interrupt it, type it again, and it goes on.
    """
    from scroll_tactile.clients.learning.annotating.annotation_run import annotate as annotated

    with opened(memory, mode="read") as learner, progress_bar() as progress:
        done = annotated(
            learner,
            dataset,
            output=output,
            in_place=in_place,
            replace=replace,
            forms=[form.strip() for form in forms.split(",")],
            field=field,
            columns=columns,
            clock=clock,
            cut=cut.value,
            risk=risk,
            scene=materials_of(scene),
            progress=progress,
        )
    _report(done, cut, as_json)


def _report(done: Done, cut: TouchCut, as_json: bool) -> None:
    if as_json:
        kept = None if done.kept is None else str(done.kept)
        say_json(vars(done) | {"output": str(done.output), "kept": kept})
        return
    touches, frames = counted(done.touches, "touch"), counted(done.frames, "frame")
    say(
        f"[bold]annotated:[/] {counted(done.episodes, 'episode')}, {touches}; of {frames} {done.answered} have an "
        f"answer, {done.events} an event"
    )
    if not done.touches:
        say(f"[yellow]no touch was found:[/] {NO_TOUCH[cut]}")
    if done.left_out:
        say(f"[bold]left out:[/] {counted(done.left_out, 'frame')} whose readings are NaN or infinite")
    say(f"written: {shown(done.output)}" + (f"; as it was before: {shown(done.kept)}" if done.kept else ""))
