"""`scroll-tactile memory adapt`: a changed skin taken over, from a few touches of known materials."""

from __future__ import annotations

from typing import Annotated

import typer

from scroll_tactile.clients.cli.options import (
    AsJson,
    Clock,
    Columns,
    CutBy,
    Field,
    Label,
    LabelBy,
    Labels,
    LabelTopic,
    MemoryFolder,
    Preset,
    Sources,
    Topic,
    source_options,
)
from scroll_tactile.clients.cli.terminal import opened_for_upkeep, progress_bar, say, say_json, say_refused

__all__ = ["adapt"]


def adapt(
    folder: MemoryFolder,
    sources: Sources,
    until: Annotated[
        int | None, typer.Option(min=0, help="The last observation of the skin before; health says since when.")
    ] = None,
    preset: Preset = None,
    topic: Topic = None,
    field: Field = None,
    clock: Clock = None,
    columns: Columns = None,
    label: Label = None,
    label_by: LabelBy = None,
    labels: Labels = None,
    label_topic: LabelTopic = None,
    cut: CutBy = None,
    as_json: AsJson = False,
) -> None:
    """Take over a changed skin, from about five touches of known materials felt with it; nothing is learned of them.

    Later touches are read through what was found; `memory retract` takes it back. The exit code is 1 where it was not
    kept, or a source was refused, which is named then.
    """
    from scroll_tactile.clients.learning.sources import Refused, find_sources, source_touches

    found, missing = find_sources(sources)
    how = topic, field, clock, columns, label, label_by, labels, label_topic, cut, None
    options = source_options(found, preset, *how)
    with opened_for_upkeep(folder) as learner, progress_bar() as progress:
        touches = [touch for address in found for touch in source_touches(learner, address, options)]
        refused = missing + [touch for touch in touches if isinstance(touch, Refused)]
        progress("adapting", 0, 1)
        known = [(str(touch.material), touch.stream) for touch in touches if not isinstance(touch, Refused)]
        done = learner.adapt(known, until=until)
    if as_json:
        say_json(vars(done))
    else:
        say((f"[green]adapted:[/] by row {done.sequence}; " if done.kept else "[yellow]not adapted:[/] ") + done.why)
        say(f"the touches lie {done.before:.2f} from what was learned, corrected {done.after:.2f}; 1 is usual")
    say_refused(refused)
    if refused or not done.kept:
        raise typer.Exit(1)
