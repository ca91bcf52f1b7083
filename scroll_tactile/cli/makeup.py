"""`scroll-tactile describe` and `compose`: what the materials of a memory on disk are made of."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from scroll_tactile.cli.everyday import Columns, MemoryFolder, StreamFile
from scroll_tactile.cli.terminal import console, opened, percent, say, say_json, shown
from scroll_tactile.errors import DescriptionError

__all__ = ["compose", "describe"]

WORDS = {"yes": True, "no": False, "unknown": None}


def describe(
    memory: MemoryFolder,
    material: Annotated[str, typer.Argument(help="A material, observed or not yet.", show_default=False)],
    constituents: Annotated[
        list[str] | None,
        typer.Argument(
            help="Each as NAME=SHARE, shares by mass that sum to one, or NAME=yes, no or unknown. None: its "
            "description is removed.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Say what a material is made of, before or after it was touched: wool=0.65 viscose=0.35."""
    named = [_constituent(text) for text in constituents or []]
    shares = dict(named)
    if len(shares) < len(named):
        raise DescriptionError(f"expected each constituent once; came {', '.join(name for name, _ in named)}")
    with opened(memory) as learner:
        learner.describe(material, shares or None)
        count = learner.materials.get(material, 0)
    now = "its description is removed" if not shares else f"made of {', '.join(map(shown, shares))}"
    say(f"{shown(material)}: {now}; observed {count} time{'s' * (count != 1)}")


def _constituent(text: str) -> tuple[str, float | bool | None]:
    name, sign, value = text.rpartition("=")
    if value in WORDS and sign:
        return name.strip(), WORDS[value]
    try:
        return name.strip(), float(value if sign else "")
    except ValueError:
        raise DescriptionError(
            f"expected a constituent as NAME=SHARE, such as wool=0.65, or NAME=yes, no or unknown; came {text!r}"
        ) from None


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
