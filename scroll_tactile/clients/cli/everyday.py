"""`scroll-tactile observe`, `predict`, `inspect`, `describe` and `compose`: a memory on disk, and touches in files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from difflib import get_close_matches
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from scroll_tactile.clients.cli.options import (
    Axis,
    Clock,
    Columns,
    Field,
    MemoryFolder,
    Preset,
    Sources,
    StreamFile,
    Topic,
    materials_of,
    sensor_for,
)
from scroll_tactile.clients.cli.terminal import (
    console,
    estimate_text,
    opened,
    opened_for_upkeep,
    percent,
    say,
    say_csv,
    say_json,
    say_refused,
    shown,
    verdict,
)
from scroll_tactile.clients.cli.wording import counted
from scroll_tactile.errors import DescriptionError, InputError, printable
from scroll_tactile.settings import LONGEST_SOURCE, require_name

if TYPE_CHECKING:
    from scroll_tactile.clients.learning.learning import Answered
    from scroll_tactile.clients.learning.sources import Refused

__all__ = ["ANSWER", "answer_row", "compose", "describe", "inspect", "observe", "predict"]

NEAR = 0.85  # likeness of two names, of which one is taken for a slip of the other
WORDS = {"yes": True, "no": False, "unknown": None}

ANSWER = ("source", "answer", "probability", "known", "novelty", "seconds")


def observe(
    memory: MemoryFolder,
    material: Annotated[str, typer.Argument(help="What was touched; any name.", show_default=False)],
    file: StreamFile,
    sensor: Annotated[
        str | None,
        typer.Option(
            help="Whose readings they are: biotac, biotac-all, roboskin, contactile, gelsight, or a JSON file with "
            "name, channels, rate, low, high, unit and duration; or give --preset. Needed only to make a new memory."
        ),
    ] = None,
    preset: Preset = None,
    topic: Topic = None,
    field: Field = None,
    clock: Clock = None,
    columns: Columns = None,
    value: Annotated[
        list[str] | None,
        typer.Option(help="What was measured of it, such as force=1.4, of a declared quantity; several times."),
    ] = None,
    axis: Annotated[
        list[str] | None, typer.Option(help="What else it is, as axis=label, such as slip=north; several times.")
    ] = None,
) -> None:
    """Learn how a material feels, from one touch in a file; it is on disk when this returns."""
    from scroll_tactile.learner import TactileLearner
    from scroll_tactile.recordings import read

    require_name(material)
    labels = _noted("axis", axis)
    try:
        values = {name: float(number) for name, number in _noted("value", value).items()}
    except ValueError as error:
        raise InputError(f"expected --value as a name and a number, such as force=1.4: {error}") from None
    recording = read(file, topic=topic, field=field, clock=clock, columns=columns, preset=preset)
    chosen = sensor_for(memory, sensor, preset)
    if chosen is not None and not memory.exists():
        TactileLearner(sensor=chosen).stream(recording.stream(chosen))  # what is refused makes no memory
    with opened(memory, sensor=chosen) as learner:
        source = printable(str(file))[-LONGEST_SOURCE:]
        stream = learner.stream(recording.stream(learner.sensor))
        others = [name for name in learner.names_of(stream) if name != material]
        receipt = learner.observe(material, stream, values=values, labels=labels, source=source)
        count = learner.materials[material]
    clipped = f", {receipt.clipped} values outside the sensor's range clipped" if receipt.clipped else ""
    if receipt.repeated:
        say(f"{shown(material)}: this touch was learned already, as observation {receipt.sequence}")
    else:
        say(f"{shown(material)}: {receipt.seconds:g} s kept as observation {receipt.sequence}{clipped}")
    if others:
        say(f"this very touch is there as {', '.join(map(shown, others))}, too: relabel or retract one of them")
    say(f"it has now been observed {count} time{'s' * (count > 1)}")


def _noted(option: str, given: Sequence[str] | None) -> dict[str, str]:
    """What an option says several times, by name."""
    pairs = [each.partition("=") for each in given or ()]
    if wrong := [each for each, pair in zip(given or (), pairs, strict=True) if not (pair[0] and pair[2])]:
        raise InputError(f"expected --{option} as name=what, such as force=1.4 or slip=north; came {wrong[0]!r:.60}")
    if len({name for name, *_ in pairs}) < len(pairs):
        raise InputError(f"expected each name once; came --{option} {' '.join(given or ())!r:.80}")
    return {name: told for name, _, told in pairs}


def predict(
    memory: MemoryFolder,
    sources: Sources,
    scene: Annotated[
        str | None, typer.Option(help="The materials that can be here, separated by commas; all of them otherwise.")
    ] = None,
    of: Axis = None,
    preset: Preset = None,
    topic: Topic = None,
    field: Field = None,
    clock: Clock = None,
    columns: Columns = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON, with the whole ranking; of many touches a line each.")
    ] = False,
    as_csv: Annotated[bool, typer.Option("--csv", help="Print CSV, a line for each touch.")] = False,
) -> None:
    """Say what touches in files feel like; the memory stays as it is.

    Of many the exit code is 1 where some were refused.
    """
    from scroll_tactile.clients.learning.learning import answers
    from scroll_tactile.clients.learning.sources import SourceOptions, find_sources

    candidates = materials_of(scene)
    found, refused = find_sources(sources)
    options = SourceOptions(topic=topic, field=field, clock=clock, columns=columns, preset=preset)
    alone = len(sources) == 1 and len(found) + len(refused) == 1 and not as_csv
    with opened(memory, mode="read") as learner:
        answered = answers(learner, found, options, scene=candidates, of=of)
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
    """Print a line for each answer, as it comes; returns what was refused."""
    from scroll_tactile.clients.learning.sources import Refused

    refused = []
    if as_csv:
        say_csv(*ANSWER)
    for each in answered:
        if isinstance(each, Refused):
            refused.append(each)
        elif as_csv:
            say_csv(*answer_row(each))
        elif as_json:
            say_json({"source": each.touch.source} | _answer(each))
        else:
            say(f"{shown(each.touch.source)}: {verdict(each.prediction)}")
            _say_estimates(each)
    return refused


def _show_answer(found: Answered | Refused, as_json: bool) -> None:
    """The one answer that there is, or why there is none."""
    from scroll_tactile.clients.learning.sources import Refused

    if isinstance(found, Refused):
        raise InputError(found.why)
    prediction = found.prediction
    if as_json:
        say_json(_answer(found))
        return
    say(f"{verdict(prediction)}, from {prediction.seconds:g} s of touch")
    for name, probability in prediction.ranking[:5]:
        say(f"  {percent(probability):>8}  {shown(name)}")
    _say_estimates(found)


def _say_estimates(answered: Answered) -> None:
    for name, estimate in answered.estimates.items():
        say(f"  {shown(name)}: {estimate_text(estimate)}")


def _answer(answered: Answered) -> dict[str, Any]:
    of, found = answered.prediction, {name: own.as_json() for name, own in answered.estimates.items()}
    return (
        of.as_json()
        | {"seconds": of.seconds, "ranking": of.ranking_as_json()}
        | ({"estimates": found} if found else {})
    )


def answer_row(answered: Answered) -> list[Any]:
    """The cells that `ANSWER` names."""
    of = answered.prediction
    return [answered.touch.source, *of.as_json().values(), of.seconds]


def inspect(memory: MemoryFolder, as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False) -> None:
    """Show what a memory holds: materials with their counts, sensor, embedding, digest and size on disk."""
    with opened_for_upkeep(memory, mode="read") as learner:
        materials, digest, sensor, embedding = learner.materials, learner.digest(), learner.sensor, learner.embedding
        kept = len(learner.memory.kept or ())
    size = sum(file.stat().st_size for file in memory.rglob("*") if file.is_file())
    if as_json:
        found = {
            "materials": materials,
            "observations": sum(materials.values()),
            "kept": kept,
            "sensor": sensor.model_dump(mode="json"),
            "embedding": {
                "name": embedding.name,
                "dimension": embedding.dimension,
                "fingerprint": embedding.fingerprint,
            },
            "digest": digest,
            "bytes": size,
        }
        say_json(found)
        return
    table = Table("material", "observations")
    for name, count in materials.items():
        table.add_row(shown(name), str(count))
    console().print(table)
    say(f"[bold]observations:[/] {sum(materials.values())} of {counted(len(materials), 'material')}")
    say(f"[bold]kept touches:[/] {kept}")
    say(f"[bold]sensor:[/] {shown(sensor.name)}, {counted(sensor.channels, 'channel')} at {sensor.rate:g} Hz")
    say(
        f"[bold]embedding:[/] {shown(embedding.name)}, {embedding.dimension} features, "
        f"fingerprint {embedding.fingerprint[:12]}"
    )
    say(f"[bold]digest:[/] {digest}")
    say(f"[bold]on disk:[/] {size / 2**20:.1f} MB")


def describe(
    memory: MemoryFolder,
    material: Annotated[str, typer.Argument(help="A material, observed or not yet.", show_default=False)],
    constituents: Annotated[
        list[str] | None,
        typer.Argument(
            help="Each as NAME=SHARE, shares by mass that sum to one, or NAME=yes, no or unknown; a property as "
            "'hardness=62 Shore A'. None: its description is removed.",
            show_default=False,
        ),
    ] = None,
    new: Annotated[bool, typer.Option("--new", help="Though its name is nearly that of an observed material.")] = False,
) -> None:
    """Say what a material is made of, before or after it was touched: wool=0.65 viscose=0.35."""
    named = [_constituent(text) for text in constituents or []]
    shares = dict(named)
    if len(shares) < len(named):
        raise DescriptionError(f"expected each constituent once; came {', '.join(name for name, _ in named)}")
    with opened(memory) as learner:
        known = {*learner.materials, *learner.memory.descriptions}
        if not new and material not in known and (meant := _meant(material, known)) is not None:
            raise InputError(
                f"no material {material!r} was observed or described, and {meant!r} is nearly called so: name that "
                "one, or add --new"
            )
        learner.describe(material, shares or None)
        count = learner.materials.get(material, 0)
    now = "its description is removed" if not shares else f"made of {', '.join(map(shown, shares))}"
    say(f"{shown(material)}: {now}; observed {counted(count, 'time')}")


def _meant(name: str, known: Iterable[str]) -> str | None:
    """The known name that this one is a slip of; names that differ in their numbers alone are other ones."""
    letters = re.sub(r"\d", "", name)
    others = [other for other in sorted(known) if re.sub(r"\d", "", other) != letters]
    return next(iter(get_close_matches(name, others, 1, NEAR)), None)


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
    memory: MemoryFolder,
    file: StreamFile,
    columns: Columns = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Say what a touch in a file feels made of, of all that was described; the memory stays as it is."""
    from scroll_tactile.recordings import read

    recording = read(file, columns=columns)
    with opened(memory, mode="read") as learner:
        made_of = learner.compose(recording.stream(learner.sensor))
    if as_json:
        found = [
            {
                "constituent": constituent.name,
                "presence": constituent.presence,
                "share": constituent.share,
                "evidence": constituent.evidence,
                "unlearned": constituent.unlearned,
            }
            for constituent in made_of.constituents
        ]
        answer = {"constituents": found, "unfamiliar": made_of.unfamiliar, "material": made_of.prediction.material}
        say_json(answer)
        return
    table = Table("constituent", "there with", "share", "feels most like")
    for constituent in made_of.constituents:
        there = shown(constituent.unlearned) if constituent.presence is None else percent(constituent.presence)
        share = "" if constituent.share is None else percent(constituent.share)
        table.add_row(
            shown(constituent.name), there, share, shown(constituent.evidence[0][0]) if constituent.evidence else ""
        )
    console().print(table)
    say(f"a material never observed: {percent(made_of.unfamiliar)}")
