"""`scroll-tactile live`: answers as they grow."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.live import Live
from rich.table import Table

from scroll_tactile.clients.cli.options import Axis, Clock, Columns, Field, MemoryFolder, Preset, Topic
from scroll_tactile.clients.cli.terminal import (
    console,
    estimate_text,
    opened,
    percent,
    say,
    say_json,
    shown,
    verdict,
)
from scroll_tactile.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from scroll_tactile.live.answers import LiveReport, LiveState, LiveTouch
    from scroll_tactile.live.session import LiveSession
    from scroll_tactile.results import Estimate

__all__ = ["live"]

SHOWN = 5  # materials
BAR = 30  # characters of a probability of one
LONGEST_LINE = 2**24  # characters of a reading, of a camera, too


def live(
    memory: MemoryFolder,
    file: Annotated[
        Path,
        typer.Argument(
            help="A .npy or .csv file of readings, a row each, or a bag; or - for lines of comma-separated numbers on "
            "the standard input, as they come.",
            show_default=False,
        ),
    ],
    columns: Columns = None,
    risk: Annotated[float, typer.Option(help="The share of wrong answers among those that are decided.")] = 0.05,
    timed: Annotated[bool, typer.Option("--timed", help="The first column is each reading's time in seconds.")] = False,
    touch: Annotated[
        bool, typer.Option("--touch", help="All of it is one touch; otherwise touches are found, after 2 s at rest.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a line of JSON for each thing that happens.")] = False,
    of: Axis = None,
    preset: Preset = None,
    topic: Topic = None,
    field: Field = None,
    clock: Clock = None,
) -> None:
    """Take readings as they come, find the touches, and show each answer grow; the memory stays as it is."""
    from scroll_tactile.recordings.recording import places

    screen = console()
    rows = _rows(file, timed, {"preset": preset, "topic": topic, "field": field, "clock": clock})
    if columns is not None:
        rows = ((time, reading[places(columns, reading.size)]) for time, reading in rows)
    growing, before = Live(console=screen, auto_refresh=False, transient=True), None
    with (
        opened(memory, mode="read") as learner,
        learner.live(risk=risk, contact="manual" if touch else "auto", of=of) as session,
    ):
        with growing if screen.is_terminal and not as_json else nullcontext():
            for now, at in _states(session, rows, touch):
                before = _shown(before, now, at, as_json, growing)
    _summed_up(session.report, as_json, whole=touch)


def _states(
    session: LiveSession, rows: Iterator[tuple[float | None, npt.NDArray[np.float64]]], touch: bool
) -> Iterator[tuple[LiveState, float]]:
    """The state after each reading, and when; also the state at the end, where all of them are one touch."""
    sensor, at = session.sensor, 0.0
    if touch:
        session.begin()
    for count, (time, reading) in enumerate(rows, start=1):
        at = count / sensor.rate if time is None else time
        shaped = reading.reshape(sensor.shape) if reading.size == sensor.channels else reading
        yield session.push(shaped, time), at
    if touch:
        yield session.end(), at


def _rows(
    file: Path, timed: bool = False, where: Mapping[str, Any] | None = None
) -> Iterator[tuple[float | None, npt.NDArray[np.float64]]]:
    """Readings, one after the other, with their times where these are there, as in bags, or were asked for."""
    import numpy as np

    from scroll_tactile.recordings import read

    if str(file) != "-":
        recording = read(file, **(where or {}))
        own = recording.report.clock is not None and (timed or recording.topic is not None)
        for time, reading in zip(recording.times.tolist(), recording.readings, strict=True):
            yield (time, reading) if own else _parted(reading, timed)  # a table names its times, or they come first
        return
    if named := [f"--{name} {value}" for name, value in (where or {}).items() if value is not None]:
        raise InputError(
            f"the standard input has readings alone; came {', '.join(named)}: leave that out, or give a file"
        )
    for number, line in enumerate(_lines(), start=1):
        if not line.strip():
            continue
        try:
            yield _parted(np.array([float(cell) for cell in line.split(",")]), timed)
        except ValueError:
            raise InputError(
                f"standard input, line {number}: expected numbers with commas between; came {line.strip()!r:.60}"
            ) from None


def _lines() -> Iterator[str]:
    """Lines of the standard input, however long it is. Raises InputError where one does not end."""
    if isinstance(sys.stdin, io.TextIOWrapper):
        sys.stdin.reconfigure(errors="backslashreplace")  # what is no text is no number, which is said of its line
    while line := sys.stdin.readline(LONGEST_LINE):
        if len(line) == LONGEST_LINE and not line.endswith("\n"):
            raise InputError(f"standard input: expected a line a reading, of less than {LONGEST_LINE} characters")
        yield line


def _parted(row: npt.NDArray[np.float64], timed: bool) -> tuple[float | None, npt.NDArray[np.float64]]:
    return (float(row[0]), row[1:]) if timed else (None, row)


def _shown(before: LiveState | None, now: LiveState, at: float, as_json: bool, growing: Live) -> LiveState:
    """Show what is new after a reading."""
    for ended in now.touches:
        if as_json:
            _line(
                "ended",
                ended.at,
                seconds=ended.stream.seconds,
                decided=ended.decided,
                revised=ended.revised is not None,
                end=ended.end,
                **ended.prediction.as_json(),
                **_measured(ended.estimates),
            )
        else:
            say(f"{ended.at:8.2f} s  touched for {ended.stream.seconds:.2f} s: {_judged(ended)}")
            for name, estimate in ended.estimates.items():
                say(f"            {shown(name)}: {estimate_text(estimate)}")
            growing.update("", refresh=growing.is_started)
    old = before if before is not None and before.contact else None
    if not now.contact:
        return now
    if as_json:
        if old is None:
            _line("began", at - now.seconds)
        if now.prediction is not None and (old is None or now.prediction is not old.prediction):
            _line(
                "prediction",
                at,
                seconds=now.seconds,
                decided=now.decided,
                **now.prediction.as_json(),
                **_measured(now.estimates),
            )
        return now
    if growing.is_started:
        growing.update(_table(now), refresh=True)
    elif now.decided and (old is None or not old.decided) and now.prediction is not None:
        say(f"{at:8.2f} s  after {now.seconds:.2f} s: {verdict(now.prediction)}, decided")
    return now


def _measured(estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    return {"estimates": {name: own.as_json() for name, own in estimates.items()}} if estimates else {}


def _judged(ended: LiveTouch) -> str:
    """The answer to a touch, and whether it was decided, or takes back what was."""
    if ended.revised is not None:
        return f"{verdict(ended.prediction)}, [yellow]revised[/]: it was decided as {verdict(ended.revised)}"
    return f"{verdict(ended.prediction)}, {'decided' if ended.decided else '[yellow]undecided[/]'}"


def _table(now: LiveState) -> Table:
    """The likeliest materials of a touch under way."""
    state = "decided" if now.decided else "not yet decided"
    table = Table(title=f"touched for {now.seconds:.2f} s, {state}")
    for heading in ("material", "probability", ""):
        table.add_column(heading)
    if now.prediction is not None:
        for name, probability in now.prediction.ranking[:SHOWN]:
            table.add_row(shown(name), percent(probability), "█" * round(BAR * probability))
    for name, estimate in now.estimates.items():
        table.add_row(shown(name), "", estimate_text(estimate))
    return table


def _line(event: str, at: float, **more: Any) -> None:
    say_json({"event": event, "at": round(at, 6), **more})
    sys.stdout.flush()


def _summed_up(report: LiveReport, as_json: bool, *, whole: bool) -> None:
    counted = {name: count for name, count in vars(report).items() if count}
    if as_json:
        typer.echo(json.dumps({"event": "report", **counted}))
    if not report.touches and not whole:
        why = "all of it went into learning" if report.learning else "its first 2 s were taken for"
        console(error=True).print(
            f"[yellow]no touch was found:[/] {why} the sensor at rest. If it begins in a touch, or is one from end to "
            "end, take --touch"
        )
    if as_json:
        return
    say(
        f"[bold]readings:[/] {report.readings}; [bold]touches:[/] {report.touches}, {report.undecided} undecided, "
        f"{report.revised} revised"
    )
    irregular = [
        name
        for name in ("lost", "repeated", "late", "surplus", "untimed", "gaps", "steps_back", "relearned", "truncated")
        if counted.get(name)
    ]
    if irregular:
        say(", ".join(f"{name.replace('_', ' ')}: {counted[name]}" for name in irregular))
