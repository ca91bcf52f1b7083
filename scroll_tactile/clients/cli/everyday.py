"""`scroll-tactile observe`, `predict`, `live`, `inspect`, `describe`, `compose`: a memory on disk, touches in files."""

from __future__ import annotations

import io
import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.live import Live
from rich.table import Table
from typer import Argument, Option

from scroll_tactile.clients.cli.terminal import (
    AsCsv,
    AsJson,
    Axis,
    ByTimes,
    Columns,
    MemoryFolder,
    Reading,
    Risk,
    Scene,
    Sources,
    StreamFile,
    Timed,
    console,
    counted,
    estimate_text,
    facts_as_json,
    materials_of,
    opened,
    opened_for_upkeep,
    percent,
    say,
    say_csv,
    say_facts,
    say_json,
    say_refused,
    sensor_for,
    shown,
    verdict,
    with_options,
)
from scroll_tactile.errors import DescriptionError, InputError
from scroll_tactile.settings import require_name

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from scroll_tactile.clients.learning.learning import Answered
    from scroll_tactile.clients.learning.sources import Refused, SourceOptions, SourceTouch
    from scroll_tactile.learner import TactileLearner
    from scroll_tactile.live.answers import LiveReport, LiveState, LiveTouch
    from scroll_tactile.live.session import LiveSession
    from scroll_tactile.results import Estimate

__all__ = ["ANSWER", "answer_row", "compose", "describe", "inspect", "live", "observe", "predict"]

NEAR = 0.85  # likeness of two names, of which one is taken for a slip of the other
WORDS = {"yes": True, "no": False, "unknown": None}

SHOWN = 5  # likeliest materials of a touch
BAR = 30  # characters of a probability of one
LONGEST_LINE = 2**24  # characters of a reading, of a camera, too
GIVEN_UP = 100  # lines without a reading, before the first that has one
IRREGULAR = (
    "left_out",
    "lost",
    "repeated",
    "late",
    "surplus",
    "untimed",
    "gaps",
    "steps_back",
    "relearned",
    "truncated",
)

ANSWER = ("source", "answer", "probability", "known", "novelty", "seconds")


@with_options
def observe(
    memory: MemoryFolder,
    material: Annotated[str, Argument(help="What was touched; any name.", show_default=False)],
    file: StreamFile,
    *,
    sensor: Annotated[
        str | None,
        Option(
            help="Whose readings they are: biotac, biotac-all, roboskin, contactile, gelsight, or a JSON file with "
            "name, channels, rate, low, high, unit and duration; or give --preset. Needed only to make a new memory."
        ),
    ] = None,
    how: Timed,
    value: Annotated[
        list[str] | None,
        Option(help="What was measured of it, such as force=1.4, of a declared quantity; several times."),
    ] = None,
    axis: Annotated[
        list[str] | None, Option(help="What else it is, as axis=label, such as slip=north; several times.")
    ] = None,
) -> None:
    """Learn how a material feels, from one touch in a file; it is on disk when this returns."""
    from scroll_tactile.clients.learning.sources import stored_source
    from scroll_tactile.learner import TactileLearner
    from scroll_tactile.signals.facts import OF_TOUCHES

    require_name(material)
    labels = _noted("axis", axis)
    try:
        values = {name: float(number) for name, number in _noted("value", value).items()}
    except ValueError as error:
        raise InputError(f"expected --value as a name and a number, such as force=1.4: {error}") from None
    options, chosen = how.taken(cut="none", material=material), sensor_for(memory, sensor, how.preset)
    touch = None
    if chosen is not None and not memory.exists():
        options = options.by_names([str(file)], chosen)
        chosen = chosen.model_copy(update={"columns": tuple(options.names) or None})
        touch = _one_touch(TactileLearner(sensor=chosen), str(file), options)  # what is refused makes no memory
    with opened(memory, sensor=chosen, new=True) as learner:
        touch = touch or _one_touch(learner, str(file), options.by_names([], learner.sensor))
        say_facts([fact for fact in touch.facts if fact.kind not in OF_TOUCHES])  # of the others observe warns
        receipt = learner.observe(material, touch.stream, values=values, labels=labels, source=stored_source(str(file)))
        count = learner.materials[material]
    clipped = f", {receipt.clipped} values outside the sensor's range clipped" if receipt.clipped else ""
    done = f"{receipt.seconds:g} s kept as observation {receipt.sequence}{clipped}"
    if receipt.repeated:
        done = f"this touch was learned already, as observation {receipt.sequence}"
    say(f"{shown(material)}: {done}")
    say(f"it has now been observed {counted(count, 'time')}")


def _one_touch(learner: TactileLearner, file: str, options: SourceOptions) -> SourceTouch:
    """The one touch in a file. Raises InputError where it is refused, or is several."""
    from scroll_tactile.clients.learning.sources import Refused, source_touches

    found = list(source_touches(learner, file, options, named=False))
    if isinstance(found[0], Refused):
        raise found[0].error()
    if len(found) > 1:
        why = next(str(fact) for fact in found[0].facts if fact.then == "cut")
        text = f"expected one touch; these are {len(found)}, for `scroll-tactile learn`. {why}"
        raise InputError(text, argument="rate")
    return found[0]


def _noted(option: str, given: Sequence[str] | None) -> dict[str, str]:
    """What an option says several times, by name."""
    pairs = [each.partition("=") for each in given or ()]
    if wrong := [each for each, pair in zip(given or (), pairs, strict=True) if not (pair[0] and pair[2])]:
        raise InputError(f"expected --{option} as name=what, such as force=1.4 or slip=north; came {wrong[0]!r:.60}")
    if len({name for name, *_ in pairs}) < len(pairs):
        raise InputError(f"expected each name once; came --{option} {' '.join(given or ())!r:.80}")
    return {name: told for name, _, told in pairs}


@with_options
def predict(
    memory: MemoryFolder,
    sources: Sources,
    *,
    scene: Scene = None,
    of: Axis = None,
    how: Timed,
    as_json: Annotated[
        bool, Option("--json", help="Print JSON, with the whole ranking; of many touches a line each.")
    ] = False,
    as_csv: AsCsv = False,
) -> None:
    """Say what touches in files feel like; the memory stays as it is.

    Of many the exit code is 1 where some were refused.
    """
    from scroll_tactile.clients.learning.learning import answers
    from scroll_tactile.clients.learning.sources import find_sources

    options = how.taken()
    found, refused = find_sources(sources)
    alone = len(sources) == 1 and len(found) + len(refused) == 1 and not as_csv
    with opened(memory, mode="read") as learner:
        answered = answers(learner, found, options, scene=materials_of(scene), of=of)
        if alone:
            several = [*refused, *answered]
            if len(several) == 1:
                _show_answer(several[0], as_json)
                return
            refused, answered = [], iter(several)
        refused += _show_answers(answered, as_json, as_csv)
    say_refused(refused)
    if refused:
        raise typer.Exit(1)


def _show_answers(answered: Iterator[Answered | Refused], as_json: bool, as_csv: bool) -> list[Refused]:
    """Print a line for each answer, as it comes, and what is odd at the end; returns what was refused."""
    from scroll_tactile.clients.learning.sources import Refused
    from scroll_tactile.signals.facts import Fact, merged

    refused, facts = [], list[Fact]()
    if as_csv:
        say_csv(*ANSWER)
    for each in answered:
        if isinstance(each, Refused):
            refused.append(each)
            continue
        facts = merged([*facts, *each.touch.facts])
        if as_csv:
            say_csv(*answer_row(each))
        elif as_json:
            say_json({"source": each.touch.source} | _answer(each))
        else:
            say(f"{shown(each.touch.source)}: {verdict(each.prediction)}")
            _say_estimates(each.estimates)
    if not as_json:
        say_facts(facts)
    return refused


def _show_answer(found: Answered | Refused, as_json: bool) -> None:
    """The one answer that there is, or why there is none."""
    from scroll_tactile.clients.learning.sources import Refused

    if isinstance(found, Refused):
        raise found.error()
    if as_json:
        say_json(_answer(found))
        return
    say_facts(found.touch.facts)
    ranked = [f"  {percent(probability):>8}  {shown(name)}" for name, probability in found.prediction.ranking[:SHOWN]]
    say(f"{verdict(found.prediction)}, from {found.prediction.seconds:g} s of touch", *ranked)
    _say_estimates(found.estimates)


def _say_estimates(estimates: Mapping[str, Estimate], margin: str = "  ") -> None:
    for name, estimate in estimates.items():
        say(f"{margin}{shown(name)}: {estimate_text(estimate)}")


def _answer(answered: Answered) -> dict[str, Any]:
    of = answered.prediction
    more = {"seconds": of.seconds, "ranking": of.ranking_as_json(), "facts": facts_as_json(answered.touch.facts)}
    return of.as_json() | more | _measured(answered.estimates)


def _measured(estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    return {"estimates": {name: own.as_json() for name, own in estimates.items()}} if estimates else {}


def answer_row(answered: Answered) -> list[Any]:
    """The cells that `ANSWER` names."""
    of = answered.prediction
    return [answered.touch.source, *of.as_json().values(), of.seconds]


def inspect(memory: MemoryFolder, as_json: AsJson = False) -> None:
    """Show what a memory holds: materials with their counts, sensor, embedding, digest and size on disk."""
    with opened_for_upkeep(memory, mode="read") as learner:
        materials, digest, sensor, embedding = learner.materials, learner.digest(), learner.sensor, learner.embedding
        kept = len(learner.memory.kept or ())
    size = sum(file.stat().st_size for file in memory.rglob("*") if file.is_file())
    if as_json:
        held = {"materials": materials, "observations": sum(materials.values()), "kept": kept}
        made = {name: getattr(embedding, name) for name in ("name", "dimension", "fingerprint")}
        by = {"sensor": sensor.model_dump(mode="json"), "embedding": made}
        say_json({**held, **by, "digest": digest, "bytes": size})
        return
    table = Table("material", "observations")
    for name, count in materials.items():
        table.add_row(shown(name), str(count))
    console().print(table)
    fingerprint = embedding.fingerprint[:12]
    say(
        f"[bold]observations:[/] {sum(materials.values())} of {counted(len(materials), 'material')}",
        f"[bold]kept touches:[/] {kept}",
        f"[bold]sensor:[/] {shown(sensor.name)}, {counted(sensor.channels, 'channel')} at {sensor.rate:g} Hz",
        f"[bold]embedding:[/] {shown(embedding.name)}, {embedding.dimension} features, fingerprint {fingerprint}",
        f"[bold]digest:[/] {digest}",
        f"[bold]on disk:[/] {size / 2**20:.1f} MB",
    )


def describe(
    memory: MemoryFolder,
    material: Annotated[str, Argument(help="A material, observed or not yet.", show_default=False)],
    constituents: Annotated[
        list[str] | None,
        Argument(
            help="Each as NAME=SHARE, shares by mass that sum to one, or NAME=yes, no or unknown; a property as "
            "'hardness=62 Shore A'. None: its description is removed.",
            show_default=False,
        ),
    ] = None,
    new: Annotated[bool, Option("--new", help="Though its name is nearly that of an observed material.")] = False,
) -> None:
    """Say what a material is made of, before or after it was touched: wool=0.65 viscose=0.35."""
    named = [_constituent(text) for text in constituents or []]
    shares = dict(named)
    if len(shares) < len(named):
        raise DescriptionError(f"expected each constituent once; came {', '.join(name for name, _ in named)}")
    with opened(memory) as learner:
        known = {*learner.materials, *learner.memory.descriptions}
        letters = re.sub(r"\d", "", material)
        others = [name for name in sorted(known) if re.sub(r"\d", "", name) != letters]  # a number makes another one
        if not new and material not in known and (meant := get_close_matches(material, others, 1, NEAR)):
            raise InputError(
                f"no material {material!r} was observed or described, and {meant[0]!r} is nearly called so: name that "
                "one, or add --new"
            )
        learner.describe(material, shares or None)
        count = learner.materials.get(material, 0)
    now = "its description is removed" if not shares else f"made of {', '.join(map(shown, shares))}"
    say(f"{shown(material)}: {now}; observed {counted(count, 'time')}")


def _constituent(text: str) -> tuple[str, float | bool | tuple[float, str] | None]:
    name, sign, value = text.rpartition("=")
    if value in WORDS and sign:
        return name.strip(), WORDS[value]
    number, _, unit = value.strip().partition(" ")
    try:
        share = float(number if sign else "")
    except ValueError:
        raise DescriptionError(
            "expected a constituent as NAME=SHARE, such as wool=0.65, or NAME=yes, no or unknown, or a property as "
            f"'hardness=62 Shore A'; came {text!r}"
        ) from None
    return name.strip(), (share, unit.strip()) if unit else share


def compose(
    memory: MemoryFolder, file: StreamFile, columns: Columns = None, rate: ByTimes = None, as_json: AsJson = False
) -> None:
    """Say what a touch in a file feels made of, of all that was described; the memory stays as it is."""
    from scroll_tactile.recordings import read

    recording = read(file, columns=columns)
    with opened(memory, mode="read") as learner:
        by: Any = None if rate is None else rate.value
        made_of = learner.compose(recording.stream(learner.sensor, rate=by))
    if as_json:
        kept = ("presence", "share", "evidence", "unlearned")
        found = [{"constituent": of.name, **{name: getattr(of, name) for name in kept}} for of in made_of.constituents]
        say_json({"constituents": found, "unfamiliar": made_of.unfamiliar, "material": made_of.prediction.material})
        return
    table = Table("constituent", "there with", "share", "feels most like")
    for each in made_of.constituents:
        there = shown(each.unlearned) if each.presence is None else percent(each.presence)
        share = "" if each.share is None else percent(each.share)
        table.add_row(shown(each.name), there, share, shown(each.evidence[0][0]) if each.evidence else "")
    console().print(table)
    say(f"a material never observed: {percent(made_of.unfamiliar)}")


@with_options
def live(
    memory: MemoryFolder,
    file: Annotated[
        Path,
        Argument(
            help="A .npy or .csv file of readings, a row each, or a bag; or - for lines of numbers on the standard "
            "input, as they come, with what a table has between them.",
            show_default=False,
        ),
    ],
    *,
    risk: Risk = 0.05,
    timed: Annotated[bool, Option("--timed", help="The first column is each reading's time in seconds.")] = False,
    touch: Annotated[
        bool, Option("--touch", help="All of it is one touch; otherwise touches are found, after 2 s at rest.")
    ] = False,
    as_json: Annotated[bool, Option("--json", help="Print a line of JSON for each thing that happens.")] = False,
    of: Axis = None,
    how: Reading,
) -> None:
    """Take readings as they come, find the touches, and show each answer grow; the memory stays as it is."""
    screen = console()
    growing, before = Live(console=screen, auto_refresh=False, transient=True), None
    with (
        opened(memory, mode="read") as learner,
        learner.live(risk=risk, contact="manual" if touch else "auto", of=of) as session,
        growing if screen.is_terminal and not as_json else nullcontext(),
    ):
        lines = LiveLines(learner.sensor.channels, timed=timed, how=how)
        rows = lines.readings() if str(file) == "-" else _replayed(file, timed, how)
        for now, at in _states(session, rows, touch):
            before = _shown(before, now, at, as_json, growing)
    _summed_up(session.report, as_json, whole=touch, left_out=lines.left_out)


def _states(
    session: LiveSession, rows: Iterator[tuple[float | None, npt.NDArray[np.float64]]], touch: bool
) -> Iterator[tuple[LiveState, float]]:
    """The state after each reading, and when; and that at the end, where all of them are one touch."""
    sensor, at = session.sensor, 0.0
    if touch:
        session.begin()
    for count, (time, reading) in enumerate(rows, start=1):
        at = count / sensor.rate if time is None else time
        yield session.push(reading.reshape(sensor.shape) if reading.size == sensor.channels else reading, time), at
    if touch:
        yield session.end(), at


def _replayed(file: Path, timed: bool, how: Reading) -> Iterator[tuple[float | None, npt.NDArray[np.float64]]]:
    """Readings of a file, with their times where these are there, as in bags, or were asked for."""
    from scroll_tactile.recordings import read
    from scroll_tactile.recordings.recording import places

    recording = read(file, **{**vars(how), "columns": None})  # which are counted behind the time
    own = recording.report.clock is not None and (timed or recording.topic is not None)
    for time, row in zip(recording.times.tolist(), recording.readings, strict=True):
        # A table names its times, or they come first.
        at, reading = (time, row) if own else (float(row[0]), row[1:]) if timed else (None, row)
        yield at, reading if how.columns is None else reading[places(how.columns, reading.size)]


class LiveLines:
    """Readings out of lines of the standard input, written as tables are; others are left out, counted and told.

    channels: of the sensor. timed: whether the first cell is a time; a header may name another.
    Raises InputError for options that lines have no use for.
    """

    def __init__(self, channels: int, *, timed: bool, how: Reading) -> None:
        from scroll_tactile.recordings.text import Layout

        self.left_out = self.taken = self._width = 0
        self._channels, self._how = channels, how
        self._time, self._clock = 0 if timed else None, ""
        self._layout: Layout | None = None
        Layout.of([], how.delimiter, how.decimal)

    def readings(self) -> Iterator[tuple[float | None, npt.NDArray[np.float64]]]:
        """Each reading with its time. Raises InputError where a hundred lines, or all there are, have none."""
        unfit = {name: value for name, value in vars(self._how).items() if value is not None}
        for name in ("columns", "delimiter", "decimal"):
            unfit.pop(name, None)
        if named := [f"--{name} {value}" for name, value in unfit.items()]:
            raise InputError(
                f"the standard input has readings alone; came {', '.join(named)}: leave that out, or give a file"
            )
        error = None
        for row, line in enumerate(_lines(), start=1):
            try:
                reading = self._reading(line) if line.strip() else None
            except InputError as found:
                error = InputError(f"standard input, line {row}: {found}", argument=found.argument)
                self._leave_out(error)
                continue
            if reading is not None:
                self.taken += 1
                yield reading
        if error is not None and not self.taken:
            raise error

    def _leave_out(self, error: InputError) -> None:
        self.left_out += 1
        if not self.taken and self.left_out == GIVEN_UP:
            raise error
        if set(str(self.left_out)) <= {"0", "1"} and str(self.left_out).count("1") == 1:  # 1, 10, 100 …
            so_far = f"; {self.left_out} lines so far" if self.left_out > 1 else ""
            console(error=True).print(f"[yellow]left out:[/] {shown(error)}{so_far}")

    def _reading(self, line: str) -> tuple[float | None, npt.NDArray[np.float64]] | None:
        """The time and the numbers of a line; None of a header. Raises InputError for other lines."""
        import numpy as np

        from scroll_tactile.recordings.blocks import in_seconds, is_clock
        from scroll_tactile.recordings.recording import places
        from scroll_tactile.recordings.text import Layout, moment, number

        layout = self._layout or Layout.of([line.strip()], self._how.delimiter, self._how.decimal)
        cells = layout.cells(line.strip("\n"))
        wide = self._width or self._channels + (self._time is not None)
        free = self._how.columns is not None and not self._width  # then the first line says how wide they are
        if len(cells) > wide and not cells[-1].strip():
            cells.pop()
        values = [number(cell, layout.decimal) for cell in cells]
        fits = len(cells) > self._channels if free else len(cells) in (wide, wide + 1)
        if not self.taken and fits and set(values) == {None}:
            named = (i for i, name in enumerate(cells) if is_clock(name))
            self._time = next(named, None) if self._time is None else self._time
            self._clock = "" if self._time is None else cells[self._time]
            return None
        if len(cells) != wide and not free:
            more = ". If the first is a time, add --timed; otherwise name some by --columns" * (len(cells) > wide)
            raise InputError(f"expected {wide} numbers; came {line.strip()!r:.60}, {len(cells)} cells{more}")
        at = None if self._time is None else moment(cells[self._time], layout.decimal)
        if self._time is not None:
            del values[self._time]
            if at is None or not math.isfinite(at):
                raise InputError(f"expected a time in cell {self._time + 1}; came {line.strip()!r:.60}")
            at = float(in_seconds(np.array([at]), self._clock)[0]) if self._clock else at
        chosen = values if self._how.columns is None else [values[i] for i in places(self._how.columns, len(values))]
        if None in chosen or len(chosen) != self._channels:
            raise InputError(f"expected {self._channels} numbers; came {line.strip()!r:.60}")
        self._layout, self._width = layout, len(cells)
        return at, np.array(chosen, np.float64)


def _lines() -> Iterator[str]:
    """Lines of the standard input, however long it is. Raises InputError where one does not end."""
    if isinstance(sys.stdin, io.TextIOWrapper):
        sys.stdin.reconfigure(errors="backslashreplace")  # what is no text is no number, which is said of its line
    while line := sys.stdin.readline(LONGEST_LINE):
        if len(line) == LONGEST_LINE and not line.endswith("\n"):
            raise InputError(f"standard input: expected a line a reading, of less than {LONGEST_LINE} characters")
        yield line


def _shown(before: LiveState | None, now: LiveState, at: float, as_json: bool, growing: Live) -> LiveState:
    """Show what is new after a reading."""
    for ended in now.touches:
        if as_json:
            more = {"revised": ended.revised is not None, "end": ended.end}
            _line("ended", ended.at, _answer_of(ended, ended.stream.seconds, **more))
        else:
            how = "decided" if ended.decided else "[yellow]undecided[/]"
            if ended.revised is not None:
                how = f"[yellow]revised[/]: it was decided as {verdict(ended.revised)}"
            say(f"{ended.at:8.2f} s  touched for {ended.stream.seconds:.2f} s: {verdict(ended.prediction)}, {how}")
            _say_estimates(ended.estimates, " " * 12)
            growing.update("", refresh=growing.is_started)
    old = before if before is not None and before.contact else None
    if not now.contact:
        return now
    if as_json:
        if old is None:
            _line("began", at - now.seconds, {})
        if now.prediction is not None and (old is None or now.prediction is not old.prediction):
            _line("prediction", at, _answer_of(now, now.seconds))
    elif growing.is_started:
        growing.update(_table(now), refresh=True)
    elif now.decided and (old is None or not old.decided) and now.prediction is not None:
        say(f"{at:8.2f} s  after {now.seconds:.2f} s: {verdict(now.prediction)}, decided")
    return now


def _table(now: LiveState) -> Table:
    """The likeliest materials of a touch under way."""
    state = "decided" if now.decided else "not yet decided"
    table = Table("material", "probability", "", title=f"touched for {now.seconds:.2f} s, {state}")
    if now.prediction is not None:
        for name, probability in now.prediction.ranking[:SHOWN]:
            table.add_row(shown(name), percent(probability), "█" * round(BAR * probability))
    for name, estimate in now.estimates.items():
        table.add_row(shown(name), "", estimate_text(estimate))
    return table


def _answer_of(touch: LiveTouch | LiveState, seconds: float, **more: Any) -> dict[str, Any]:
    answer = {} if touch.prediction is None else touch.prediction.as_json()
    return {"seconds": seconds, "decided": touch.decided, **more, **answer, **_measured(touch.estimates)}


def _line(event: str, at: float, more: Mapping[str, Any]) -> None:
    say_json({"event": event, "at": round(at, 6), **more})


def _summed_up(report: LiveReport, as_json: bool, *, whole: bool, left_out: int) -> None:
    met = {name: count for name, count in {**vars(report), "left_out": left_out}.items() if count}
    if as_json:
        say_json({"event": "report", **met})
    if not report.touches and not whole:
        why = "all of it went into learning" if report.learning else "its first 2 s were taken for"
        console(error=True).print(
            f"[yellow]no touch was found:[/] {why} the sensor at rest. If it begins in a touch, or is one from end to "
            "end, take --touch"
        )
    if not as_json:
        irregular = ", ".join(f"{name.replace('_', ' ')}: {met[name]}" for name in IRREGULAR if name in met)
        say(
            f"[bold]readings:[/] {report.readings}; [bold]touches:[/] {report.touches}, {report.undecided} undecided, "
            f"{report.revised} revised",
            *([irregular] if irregular else []),
        )
