"""What the commands share of arguments and options: each is written once, and commands take them in groups."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

from typer import Argument, Option

from scroll_tactile.errors import InputError

if TYPE_CHECKING:
    from scroll_tactile.clients.learning.sources import SourceOptions
    from scroll_tactile.sensors import Sensor

__all__ = [
    "AsCsv",
    "AsJson",
    "Axis",
    "Columns",
    "MemoryFolder",
    "Named",
    "Noted",
    "Reading",
    "Risk",
    "Scene",
    "SensorName",
    "Sources",
    "StreamFile",
    "materials_of",
    "sensor_for",
    "with_options",
]


LabelSource = StrEnum("LabelSource", ["file", "folder", "topic", "task"])
Cut = StrEnum("Cut", ["episodes", "intervals", "none", "contact"])

MemoryFolder = Annotated[Path, Argument(help="The folder of the memory.", show_default=False)]
StreamFile = Annotated[
    Path, Argument(help="A recording of one touch, such as a .npy or .csv: a row a reading.", show_default=False)
]
Sources = Annotated[
    list[str],
    Argument(
        help="Recordings, or folders of them: .npy, .csv, .bag, .db3, .mcap, .h5, .zarr, LeRobot data sets, "
        "and addresses such as s3://…",
        show_default=False,
    ),
]
SensorName = Annotated[
    str | None, Option(help="Whose readings they are, as for observe; or give --preset. For a new memory.")
]
Columns = Annotated[str | None, Option(help="Of wider arrays and tables, by places from 0: 25:44, or 0,3,5:9.")]
Axis = Annotated[str | None, Option(help="An axis of labels, such as slip, to answer by in place of materials.")]
Scene = Annotated[
    str | None, Option(help="The materials that can be here, separated by commas; all of them otherwise.")
]
Risk = Annotated[float, Option(help="The share of wrong answers among those that are decided.")]
AsCsv = Annotated[bool, Option("--csv", help="Print CSV, a line for each touch.")]
AsJson = Annotated[bool, Option("--json", help="Print JSON.")]


@dataclass(frozen=True)
class Reading:
    """How a recording is read: the fields are arguments of `recordings.read`."""

    preset: Annotated[
        str | None,
        Option(
            help="A known sensor under its driver, in place of sensor, topic and field: biotac, biotac-sp, xela-uskin, "
            "papillarray, anyskin, robotiq-tsf, digit, gelsight."
        ),
    ] = None
    topic: Annotated[str | None, Option(help="The topic that has the readings, in a recording of several.")] = None
    field: Annotated[str | None, Option(help="The path to the numbers, such as 'tactiles[0].electrodes'.")] = None
    clock: Annotated[str | None, Option(help="device, header, publish or log; or a field, column or array.")] = None
    columns: Columns = None


@dataclass(frozen=True)
class Named(Reading):
    """How recordings are read, cut into touches and named: the fields of `SourceOptions`, as they are typed."""

    material: Annotated[str | None, Option("--label", help="What all of them are touches of.")] = None
    by: Annotated[LabelSource | None, Option("--label-by", help="What names each touch.")] = None
    intervals: Annotated[
        Path | None,
        Option(
            "--labels",
            help="A .csv of touches, with columns file, begin, end (in seconds) and material; what is under 'force [N] "
            "0..10 step 0.01' (or 'force [N]', once declared) and 'slip \\[label]' is learned as values and labels.",
        ),
    ] = None
    labels: Annotated[
        str | None,
        Option("--label-topic", help="A topic with texts, or a column, that says what is touched from then on."),
    ] = None
    cut: Annotated[
        Cut | None,
        Option(help="Where touches begin and end; without it by intervals or episodes if there are any."),
    ] = None

    def of(self, found: Sequence[str]) -> SourceOptions:
        """How these recordings are read, cut and named. Raises InputError for options that do not fit together."""
        from scroll_tactile.clients.learning.sources import SourceOptions
        from scroll_tactile.recordings import declared_quantities, read_intervals

        given = {name: getattr(value, "value", value) for name, value in vars(self).items() if value is not None}
        given["annotate"] = tuple(given.get("annotate", ()))
        if self.intervals is not None:
            if self.labels is not None:
                raise InputError("give --labels or --label-topic: both say where touches begin")
            given["intervals"] = tuple(read_intervals(self.intervals, found))
            given["quantities"] = tuple(declared_quantities(self.intervals))
            if not given["intervals"]:
                raise InputError(f"expected touches in {self.intervals}, one row each; there are none")
        return SourceOptions(**given)


@dataclass(frozen=True)
class Noted(Named):
    """The same, with what was measured of touches."""

    annotate: Annotated[
        list[str] | None,
        Option(
            help="A column of LeRobot data sets that is learned as a value or a label of each touch: 'force [N] 0..10 "
            "step 0.01' (or 'force [N]', once declared), 'slip \\[label]', and 'force [N] from observation.wrench[2]' "
            "where the column is called otherwise; several times. A value is the mean over the touch."
        ),
    ] = None


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """A command that has the fields of its dataclasses as options, and gets the dataclasses filled with what was typed.

    The help text of a field is in its annotation, as that of any other option of typer's is.
    """
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {name: kind for name, kind in hints.items() if is_dataclass(kind)}
    taken = []
    for each in signature(command).parameters.values():
        kind = groups.get(each.name)
        own = hints if kind is None else get_type_hints(kind, include_extras=True)
        taken += [(one.name, own[one.name], one.default) for one in ([each] if kind is None else fields(kind))]

    def gathered(**typed: Any) -> None:
        for name, kind in groups.items():
            typed[name] = kind(**{field.name: typed.pop(field.name) for field in fields(kind)})
        command(**typed)

    whole = [Parameter(name, Parameter.KEYWORD_ONLY, default=value, annotation=kind) for name, kind, value in taken]
    gathered.__signature__ = Signature(whole)  # type: ignore[attr-defined]
    gathered.__name__, gathered.__doc__, gathered.__module__ = command.__name__, command.__doc__, command.__module__
    return gathered


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
