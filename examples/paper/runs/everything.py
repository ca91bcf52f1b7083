"""`all`: every result that RESULTS.md stands on, made anew by the command that is noted in it."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from examples.paper.runs.options import Data, Quick, Weights
from examples.paper.runs.pictures import available
from examples.paper.runs.results import show
from examples.paper.runs.runfile import RunFile
from examples.paper.runs.study import weights_digest
from examples.tables import duration, seconds_of
from scroll_tactile.clients.cli import INTERRUPTED
from scroll_tactile.clients.cli.terminal import say
from scroll_tactile.errors import InputError

__all__ = ["everything"]

RESULTS = Path(__file__).parents[1] / "results"
IN_DATA = ("--series", "--grades")
"""Options for files of one's own; they are looked for in the folder of the data."""
ELSEWHERE = ("--before",)
"""Options for what `all` has not; measured without."""
LESS = ("--epochs", "--biotac-epochs", "--every", "--take", "--draws", "--sizes")
"""Options that a quick run chooses itself."""

Only = Annotated[str | None, typer.Option(help="Which results, by the names of their files, with commas between.")]
RunAll = Annotated[
    Path, typer.Option("--run", help="Finished parts are noted here, and the same command resumes; figures: results/.")
]


@dataclass(frozen=True)
class Part:
    """A result: its file's name, the commands that make it, each a list of words, and how long they took (or None)."""

    name: str
    commands: list[list[str]]
    seconds: float | None


def everything(
    ctx: typer.Context,
    data: Data,
    run: RunAll,
    weights: Weights = None,
    device: Annotated[str | None, typer.Option(help="Where networks are trained; as noted unless given.")] = None,
    only: Only = None,
    quick: Quick = False,
) -> None:
    """Make every result anew by its noted command: what needs least time first, killed runs go on where they were.

    Files of one's own, series.npz and grades.csv, are looked for in the folder of the data. Tables of what was made:
    python -m examples.tables --results RUN NAME.
    """
    program = ctx.find_root().command
    assert isinstance(program, TyperGroup)
    notes = RunFile(run / "all.json", {"run": "all", "quick": quick, "device": device})
    digest = None if weights is None else weights_digest(weights)
    if notes.notes.setdefault("weights", digest) != digest:
        raise InputError(f"the run in {run} was begun with other weights: give the same, or take another folder")
    (run / "results").mkdir(exist_ok=True)
    parts = _wanted(read_parts(), only)
    todo: dict[str, list[list[str]]] = {}
    for part in parts:
        words = [
            _bound(_leaf(program, command), command, part.name, data, weights, run, device, quick=quick)
            for command in part.commands
        ]
        if all(words):
            todo[part.name] = [each for each in words if each]
        else:
            say(f"[yellow]left out:[/] {part.name} needs files that are not there, or --weights")
    parts = [part for part in parts if part.name in todo]
    _announce(parts, notes.notes, quick=quick)
    failed = [part.name for i, part in enumerate(parts) if not _done(program, parts[i:], todo[part.name], notes)]
    if failed:
        raise InputError(f"not made: {', '.join(failed)}; the reason stands above each. The same command tries again")


def read_parts() -> list[Part]:
    """All results that there are, those that took least time first, those without a noted time last."""
    parts = []
    for file in sorted(RESULTS.glob("*.json")):
        made = json.loads(file.read_text(encoding="utf-8"))
        commands = [shlex.split(command)[3:] for command in made["command"].split(" && ")]
        parts.append(Part(file.stem, commands, seconds_of(made)))
    return sorted(parts, key=lambda part: (part.seconds is None, part.seconds or 0.0, part.name))


def _wanted(parts: Sequence[Part], only: str | None) -> list[Part]:
    if only is None:
        return list(parts)
    names = {name.strip() for name in only.split(",")}
    if strange := names - {part.name for part in parts}:
        known = ", ".join(sorted(part.name for part in parts))
        raise InputError(f"expected --only out of {known}; came {', '.join(sorted(strange))}")
    return [part for part in parts if part.name in names]


def _leaf(program: Any, words: Sequence[str]) -> Any:
    for word in words:
        if not isinstance(program, TyperGroup):
            break
        program = program.commands[word]
    return program


def _bound(
    command: Any,
    noted: Sequence[str],
    name: str,
    data: Path,
    weights: str | None,
    run: Path,
    device: str | None,
    *,
    quick: bool,
) -> list[str] | None:
    """The words of a noted command with this run's files in them; None where one is needed and not there."""
    has = {option: parameter for parameter in command.params for option in parameter.opts}
    mine = {"DATA": str(data), "BIOTAC": str(data), "RUN": str(run / name)}
    words: list[str] = []
    pairs = iter(noted)
    for word in pairs:
        if word == "--weights":
            next(pairs)
            if weights is None:
                return None
            words += [word, weights]
        elif word in IN_DATA:
            file = data / next(pairs)
            if file.is_file():
                words += [word, str(file)]
            elif has[word].required:
                return None
        elif word in ELSEWHERE or (quick and word in LESS):
            next(pairs)
        else:
            words.append(mine.get(word, word))
    added = {"--json": str(run / "results" / f"{name}.json"), "--run": str(run / name)}
    added |= {"--plot": str(run / "results" / f"{name}.png")} if available() else {}
    added |= {} if device is None else {"--device": device}
    if quick and "--quick" not in has:
        added |= {"--folds": "0"}
    for option, value in added.items():
        words += [option, value] if option in has else []  # the last of two counts
    return words + (["--quick"] if quick and "--quick" in has else [])


def _announce(parts: Sequence[Part], notes: Mapping[str, Any], *, quick: bool) -> None:
    rows = [
        {
            "result": part.name,
            "command": " ".join(part.commands[0][:2]),
            "took here": "not noted" if part.seconds is None else duration(part.seconds),
            "now": "made" if part.name in notes else "",
        }
        for part in parts
    ]
    show("results", {name: f"{{./{name}}}" for name in ("result", "command", "took here", "now")}, rows)
    if quick:
        say("quick: the times are those of the whole studies; each now takes a minute or two on two cores")
    else:
        say(f"{len(parts)} results{_left(parts, notes)}")


def _left(parts: Sequence[Part], notes: Mapping[str, Any]) -> str:
    """In words, how long what is not made will take: by the noted times, times how much slower it went so far."""
    timed = [part for part in parts if part.seconds is not None]
    took = sum(notes[part.name] for part in timed if part.name in notes)
    noted = sum(part.seconds or 0.0 for part in timed if part.name in notes)
    ahead = sum(part.seconds or 0.0 for part in timed if part.name not in notes)
    unknown = [part.name for part in parts if part.seconds is None and part.name not in notes]
    without = f", and {', '.join(unknown)}, whose time is not noted" if unknown else ""
    return f", about {duration(ahead * (took / noted if noted and took else 1.0))} to go{without}"


def _done(program: TyperGroup, ahead: Sequence[Part], commands: Sequence[Sequence[str]], notes: RunFile) -> bool:
    """Make the first of the parts ahead, where it is not made; whether it is now."""
    name = ahead[0].name
    if name in notes.notes:
        return True
    say(f"[bold]{name}[/]{_left(ahead, notes.notes)}")
    begun = time.perf_counter()
    for words in commands:
        code = program.main(list(words), prog_name="python -m examples.paper", standalone_mode=False)
        if code == INTERRUPTED:
            raise KeyboardInterrupt
        if code:
            return False
    notes.note(name, time.perf_counter() - begun)
    return True
