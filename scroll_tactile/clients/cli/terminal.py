"""What the commands share: options, how they print, how errors end them, and how they show progress."""

from __future__ import annotations

import csv
import io
import json
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from scroll_tactile_store import NotAStoreError, StoreError
from typer import Argument, Option
from typer.core import TyperGroup

from scroll_tactile import __version__, native
from scroll_tactile.clients.cli import INTERRUPTED
from scroll_tactile.errors import FactWarning, InputError, ScrollTactileError, plain_cell, printable
from scroll_tactile.results import Estimate, Prediction
from scroll_tactile.settings import GONE

if TYPE_CHECKING:
    from scroll_tactile.clients.learning.sources import Refused, SourceOptions
    from scroll_tactile.learner import TactileLearner
    from scroll_tactile.sensors import Sensor
    from scroll_tactile.signals.facts import Fact

MOST_REFUSED = 20

Mode = Literal["write", "read"]

_options: ContextVar[dict[str, str]] = ContextVar("_options")  # of the command that was typed, by their names in Python


Rate = StrEnum("Rate", ["keep", "resample"])
Cut = StrEnum("Cut", ["episodes", "intervals", "none", "contact"])

MemoryFolder = Annotated[Path, Argument(help="The folder of the memory.", show_default=False)]
StreamFile = Annotated[
    Path, Argument(help="A recording of one touch, such as a .npy or .csv: a row a reading.", show_default=False)
]
Sources = Annotated[
    list[str],
    Argument(
        help="Recordings, or folders of them: .npy, .npz, .mat, .csv, .json, .parquet, .bag, .db3, .mcap, .h5, .zarr, "
        "LeRobot data sets, and addresses such as s3://…",
        show_default=False,
    ),
]
SensorName = Annotated[
    str | None, Option(help="Whose readings they are, as for observe; or give --preset. For a new memory.")
]
Columns = Annotated[str | None, Option(help="Of wider arrays and tables, by places from 0: 25:44, or 0,3,5:9.")]
ByTimes = Annotated[
    Rate | None,
    Option(
        help="Of recordings that have another rate than the sensor by their times: keep takes the numbers as they are, "
        "resample a reading each step of the sensor's. Without it they are refused from a fifth on."
    ),
]
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
    definitions: Annotated[
        Path | None, Option(help="A folder of .msg files, for a bag that does not define its messages.")
    ] = None
    delimiter: Annotated[
        str | None, Option(help="What separates the cells of a table, such as ';' or tab, where it does not show.")
    ] = None
    decimal: Annotated[
        str | None, Option(help="The decimal mark of a table's numbers, '.' or ',', where it does not show.")
    ] = None


@dataclass(frozen=True)
class Timed(Reading):
    """The same, as touches of a sensor with a rate of its own."""

    rate: ByTimes = None

    def taken(self, **more: Any) -> SourceOptions:
        """How these recordings are read. Raises InputError for options that do not fit together."""
        from scroll_tactile.clients.learning.sources import SourceOptions
        from scroll_tactile.recordings.decoding import definitions_of

        given = {name: getattr(value, "value", value) for name, value in vars(self).items() if value is not None}
        return SourceOptions(**{**given, "definitions": definitions_of(self.definitions), **more})


@dataclass(frozen=True)
class Named(Timed):
    """How recordings are read, cut into touches and named: the fields of `SourceOptions`, as they are typed."""

    material: Annotated[str | None, Option("--label", help="What all of them are touches of.")] = None
    by: Annotated[
        str | None,
        Option(
            "--label-by",
            help="What names each touch: file, folder, topic or task; folder:2, the second below the one typed; or "
            "group:2, the second part of the path of its array, where --field is a pattern such as 'run/*/tactile'.",
        ),
    ] = None
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
        Cut | None, Option(help="Where touches begin and end; without it by intervals or episodes if there are any.")
    ] = None

    def options(self) -> SourceOptions:
        """How recordings are read, cut and named. Raises InputError for options that do not fit together."""
        from scroll_tactile.recordings import declared_quantities, read_intervals

        given: dict[str, Any] = {"annotate": tuple(getattr(self, "annotate", None) or ())}
        if self.intervals is not None:
            if self.labels is not None:
                raise InputError("give --labels or --label-topic: both say where touches begin")
            given["intervals"] = tuple(read_intervals(self.intervals))
            given["quantities"] = tuple(declared_quantities(self.intervals))
            if not given["intervals"]:
                raise InputError(f"expected touches in {self.intervals}, one row each; there are none")
        return self.taken(**given)


@dataclass(frozen=True)
class Annotating(Named):
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


def console(*, error: bool = False) -> Console:
    """A console on the standard output, or error, of this moment (tests exchange them)."""
    return Console(stderr=error, highlight=False, soft_wrap=not error and not sys.stdout.isatty())


def say(*lines: str) -> None:
    """Print lines in rich's markup."""
    console().print(*lines, sep="\n")


def say_json(found: Mapping[str, Any]) -> None:
    """Print JSON in ASCII, whatever the names in it."""
    typer.echo(json.dumps(found).replace("\x7f", "\\u007f"))


def say_csv(*cells: object) -> None:
    """Print a line of CSV; what is None has an empty cell."""
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(plain_cell(cell) if isinstance(cell, str) else cell for cell in cells)
    typer.echo(line.getvalue())


def say_refused(refused: Sequence[Refused]) -> None:
    """Print on the standard error what could not be taken, and why; at most 20, and one list of what a file has."""
    listed = False
    for each in refused[:MOST_REFUSED]:
        first, *others = in_options(each.why, each.argument).splitlines() or [""]
        _warn(f"[yellow]refused:[/] {shown(each.source)}: {shown(first)}")
        for line in [] if listed else others:
            _warn(f"  {shown(line)}")
        listed = listed or bool(others)
    if len(refused) > MOST_REFUSED:
        _warn(f"[yellow]refused:[/] {len(refused) - MOST_REFUSED} more")


def say_facts(facts: Sequence[Fact | FactWarning]) -> None:
    """Print on the standard error what is odd about what was read."""
    for fact in facts:
        _warn(f"[yellow]Warning:[/] {shown(in_options(str(fact), fact.argument))}")


def facts_as_json(facts: Sequence[Fact]) -> list[dict[str, Any]]:
    """What is odd about what was read, in JSON's types."""
    return [fact.to_json() | {"text": in_options(fact.sentence, fact.argument)} for fact in facts]


def shown(text: object) -> str:
    """A name, a path or a message in rich's markup, with what does not print escaped."""
    return escape(printable(str(text)))


def counted(number: int, what: str) -> str:
    """A number and what it counts, given in the singular: "1 touch", "2 touches"."""
    plural = "es" if what.endswith("ch") else "s"
    return f"{number} {what}{'' if number == 1 else plural}"


def _show_version(requested: bool) -> None:
    if requested:
        typer.echo(f"scroll-tactile {__version__}, kernels {native.described()}")
        raise typer.Exit


def version(
    version: Annotated[
        bool, Option("--version", callback=_show_version, is_eager=True, help="Show the version, and exit.")
    ] = False,
) -> None:
    """Take the options that belong to no command."""


class Commands(TyperGroup):
    """Commands that end with one red line and exit code 1 on an expected error, and with 130 on ctrl-C.

    Errors of the system are expected: files that cannot be read, a device that is full.
    """

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that was typed, whose options errors name."""
        try:
            found = super().resolve_command(ctx, args)
        except Exception as error:
            _say_what_replaces(error, args[0])
            raise
        if found[1] is not None:
            own = [each for each in found[1].params if each.opts[0].startswith("-")]
            _options.set({each.name: max(each.opts, key=len) for each in own})
        return found

    def invoke(self, ctx: Any) -> Any:
        """Run the command that was typed."""
        try:
            with _warnings_as_lines():
                return super().invoke(ctx)
        except (ScrollTactileError, StoreError, OSError, MemoryError) as error:
            if not isinstance(error, BrokenPipeError):  # whoever read the output has enough of it
                message = in_options(str(error), getattr(error, "argument", None)) or "no memory is left"
                text = " ".join([*message.split(), *getattr(error, "__notes__", [])])
                _warn(f"[bold red]Error:[/] [red]{shown(text)}[/]")
            raise typer.Exit(1) from error
        except KeyboardInterrupt:
            _warn("[yellow]Interrupted.[/] What was observed is kept where there is a memory; start again to go on.")
            raise typer.Exit(INTERRUPTED) from None
        except Exception as error:
            if hasattr(error, "possibilities"):  # of an option that there is not
                _say_what_replaces(error, getattr(error, "option_name", ""))
            raise


def _say_what_replaces(error: Any, name: str) -> None:
    """Add to the error of a command or an option that there is not what replaces it, where it is one that is gone."""
    if (instead := GONE.get(name.lstrip("-"))) is not None:
        error.message = f"{error.message.rstrip('.')}: it is gone. {instead}"


def in_options(text: str, argument: str | None) -> str:
    """An error's message, with the arguments that the error names as options of the command that was typed.

    `cut='none'` is `--cut 'none'` there; an argument that the command has no option for is said to be Python's.
    """
    text, absent = f" {text}", []
    for name in argument.split() if argument else ():
        option = _options.get({}).get(name)
        if option is None:
            absent += [f"{name}="] * (f"{name}=" in text)
            continue
        for before in " (":
            for value, after in (("True", ""), ("'", " '"), ('"', ' "'), ("", "")):
                text = text.replace(f"{before}{name}={value}", f"{before}{option}{after}")
    return text[1:] + f" ({', '.join(absent)}: from Python alone)" * bool(absent)


@contextmanager
def _warnings_as_lines() -> Iterator[None]:
    """Show the warnings of this library as lines, and not where they came from."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", FactWarning)
        others = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if isinstance(message, FactWarning):
                say_facts([message])
            else:
                others(message, category, *where, **more)

        warnings.showwarning = show
        yield


def _warn(text: str) -> None:
    with suppress(OSError):  # nobody reads it
        Console(stderr=True, highlight=False, soft_wrap=True).print(text)


def opened(path: Path, *, sensor: Sensor | None = None, mode: Mode = "write", new: bool = False) -> TactileLearner:
    """A memory, or a new one where there is nothing and a sensor is given. Raises what `TactileLearner.open` raises.

    new: whether the command makes a memory, which takes a sensor or a preset.
    """
    from scroll_tactile.learner import TactileLearner

    try:
        return TactileLearner.open(path, sensor=sensor, mode=mode)
    except (InputError, NotAStoreError) as error:
        if path.is_file() or sensor is not None or (mode == "read" and path.exists()):
            raise
        raise no_memory(path, new=new) from error


def no_memory(path: Path, *, new: bool = False) -> InputError:
    """The error of a command whose memory is not there, with how this or another command makes one."""
    how = (
        "to make one, say which sensor it is for: --sensor or --preset. Of one that is not known "
        "`scroll-tactile sensor FILES > sensor.json` guesses it from its recordings, for --sensor sensor.json"
    )
    return InputError(f"there is no memory in {path}; {how if new else 'scroll-tactile observe or learn makes one'}")


def opened_for_upkeep(path: Path, *, mode: Mode = "write") -> TactileLearner:
    """A memory of any embedding, for all that needs none: showing, retracting, merging, compacting, exporting."""
    from scroll_tactile.learner import TactileLearner
    from scroll_tactile.memory.identity import absent_embedding

    if not path.exists():
        raise no_memory(path)
    return TactileLearner.open(path, embedding=absent_embedding(path), mode=mode)


def percent(share: float) -> str:
    """A share as a percentage."""
    return f"{100 * share:.1f} %"


def verdict(prediction: Prediction) -> str:
    """A prediction in words."""
    if prediction.material is None:
        return "never felt anything yet"
    name = shown(prediction.material)
    felt = f" ({', '.join((f'novelty {prediction.novelty:.1f}', *prediction.unusual))})"
    if prediction.known is False:
        return f"[bold yellow]never felt this[/]; nearest is {name}{felt}"
    doubt = "" if prediction.known else ", if it was ever felt: nothing learned so far can tell"
    return f"[bold green]{name}[/] with {percent(prediction.probability)}{felt}{doubt}"


def estimate_text(estimate: Estimate) -> str:
    """An estimate in words."""
    if estimate.value is None:
        return f"[yellow]no number[/]: {shown(estimate.missing)}"
    whose = "a learned material" if estimate.known else "a new material"
    more = f"; {shown(estimate.missing)}" if estimate.missing else f" with {percent(1 - estimate.risk)}, of {whose}"
    doubt = "" if estimate.inside else ", [yellow]unlike what was learned[/]"
    value = f"[bold]{estimate.value:.4g}[/] {shown(estimate.unit)}"
    return f"{value} ({estimate.low:.4g} to {estimate.high:.4g}{more}){doubt}"


@contextmanager
def progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """A bar on the standard error; yields its update: (what is being done, steps done, steps in all)."""
    named = TextColumn("{task.description}", markup=False)  # names of files, which may have brackets
    columns = named, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    screen = console(error=True)
    with Progress(*columns, console=screen, transient=True, disable=not screen.is_terminal) as progress:
        task = progress.add_task("starting", total=None)
        yield lambda what, done, of: progress.update(task, description=what, completed=done, total=of)


def confusion_text(names: Sequence[str], counts: np.ndarray) -> str:
    """Counts of (truth, predicted), shape (C, C), as text: column 3 is the material of row 3, a dot a count of 0."""
    wide = max(map(len, names)) + 3
    head = " " * wide + "".join(f"{i:>3}" for i in range(1, len(names) + 1))
    rows = [
        f"{i:>2} {name:<{wide - 3}}" + "".join(f"{count or '·':>3}" for count in row)
        for i, (name, row) in enumerate(zip(names, counts.tolist(), strict=True), start=1)
    ]
    return "\n".join([head, *rows])
