"""What the commands share of arguments and options, and what is read with them."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scroll_tactile.errors import InputError

if TYPE_CHECKING:
    from scroll_tactile.clients.learning.sources import SourceOptions
    from scroll_tactile.sensors import Sensor

__all__ = [
    "Annotate",
    "AsJson",
    "Axis",
    "Clock",
    "Columns",
    "CutBy",
    "Field",
    "Label",
    "LabelBy",
    "LabelTopic",
    "Labels",
    "MemoryFolder",
    "Preset",
    "Sources",
    "StreamFile",
    "Topic",
    "materials_of",
    "sensor_for",
    "source_options",
]


class LabelSource(StrEnum):
    """What names a touch."""

    FILE = "file"
    FOLDER = "folder"
    TOPIC = "topic"
    TASK = "task"


class Cut(StrEnum):
    """How a recording is cut into touches."""

    EPISODES = "episodes"
    INTERVALS = "intervals"
    NONE = "none"
    CONTACT = "contact"


MemoryFolder = Annotated[Path, typer.Argument(help="The folder of the memory.", show_default=False)]
StreamFile = Annotated[
    Path, typer.Argument(help="A recording of one touch, such as a .npy or .csv: a row a reading.", show_default=False)
]

Sources = Annotated[
    list[str],
    typer.Argument(
        help="Recordings, or folders of them: .npy, .csv, .bag, .db3, .mcap, .h5, .zarr, LeRobot data sets, "
        "and addresses such as s3://…",
        show_default=False,
    ),
]
Topic = Annotated[str | None, typer.Option(help="The topic that has the readings, in a recording of several.")]
Field = Annotated[str | None, typer.Option(help="The path to the numbers, such as 'tactiles[0].electrodes'.")]
Clock = Annotated[str | None, typer.Option(help="device, header, publish or log; or a field, column or array.")]
Columns = Annotated[str | None, typer.Option(help="Of wider arrays and tables, by places from 0: 25:44, or 0,3,5:9.")]
Preset = Annotated[
    str | None,
    typer.Option(
        help="A known sensor under its driver, in place of sensor, topic and field: biotac, biotac-sp, xela-uskin, "
        "papillarray, anyskin, robotiq-tsf, digit, gelsight."
    ),
]
Label = Annotated[str | None, typer.Option(help="What all of them are touches of.")]
LabelBy = Annotated[LabelSource | None, typer.Option(help="What names each touch.")]
Labels = Annotated[
    Path | None,
    typer.Option(
        help="A .csv of touches, with columns file, begin, end (in seconds) and material; what is under 'force [N] "
        "0..10 step 0.01' (or 'force [N]', once declared) and 'slip \\[label]' is learned as values and labels."
    ),
]
LabelTopic = Annotated[
    str | None, typer.Option(help="A topic with texts, or a column, that says what is touched from then on.")
]
Annotate = Annotated[
    list[str] | None,
    typer.Option(
        help="A column of LeRobot data sets that is learned as a value or a label of each touch: 'force [N] 0..10 step "
        "0.01' (or 'force [N]', once declared), 'slip \\[label]', and 'force [N] from observation.wrench[2]' where the "
        "column is called otherwise; several times. A value is the mean over the touch."
    ),
]
CutBy = Annotated[
    Cut | None, typer.Option(help="Where touches begin and end; without it by intervals or episodes if there are any.")
]
Axis = Annotated[str | None, typer.Option(help="An axis of labels, such as slip, to answer by in place of materials.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def sensor_for(memory: Path, sensor: str | None, preset: str | None) -> Sensor | None:
    """The sensor that was named; for a new memory also that of a preset."""
    from scroll_tactile.recordings import presets
    from scroll_tactile.sensors import read_sensor

    if sensor is None and preset is not None and not memory.exists():
        return presets.find(preset).sensor
    return None if sensor is None else read_sensor(sensor)


def materials_of(scene: str | None) -> list[str] | None:
    """The materials that an option names with commas between; None where it was not given."""
    return None if scene is None else [name.strip() for name in scene.split(",") if name.strip()]


def source_options(
    found: Sequence[str],
    preset: str | None,
    topic: str | None,
    field: str | None,
    clock: str | None,
    columns: str | None,
    label: str | None,
    label_by: LabelSource | None,
    labels: Path | None,
    label_topic: str | None,
    cut: Cut | None,
    annotate: Sequence[str] | None,
) -> SourceOptions:
    """How these recordings are cut and named, by the options of a command."""
    from scroll_tactile.clients.learning.sources import SourceOptions
    from scroll_tactile.recordings import declared_quantities, read_intervals

    if labels is not None and label_topic is not None:
        raise InputError("give intervals= or labels=: both say where touches begin")
    intervals = None if labels is None else tuple(read_intervals(labels, found))
    if intervals == ():
        raise InputError(f"expected touches in {labels}, one row each; there are none")
    return SourceOptions(
        topic=topic,
        field=field,
        clock=clock,
        columns=columns,
        preset=preset,
        labels=label_topic,
        annotate=tuple(annotate or ()),
        cut=None if cut is None else cut.value,
        material=label,
        by=None if label_by is None else label_by.value,
        intervals=intervals,
        quantities=() if labels is None else tuple(declared_quantities(labels)),
    )
