"""How `benchmarks numerics` is shown: the learner first, then the grid, its peers, and what was not measured."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from scroll_tactile.cli.terminal import console, say

__all__ = ["show_numerics"]

WIDE = 140  # characters that the table takes


def show_numerics(result: Mapping[str, Any]) -> None:
    """Show relative errors of answers, or of weights where a case has none, case by method."""
    records, claimed = result["records"], result["claims"]
    methods = list(dict.fromkeys(record["method"] for record in records))
    table = Table(
        title="relative error of the answers; in brackets answers flipped; w: of the weights", box=SIMPLE_HEAD
    )
    for name in ("case", *methods):
        table.add_column(name, no_wrap=True)
    for case in dict.fromkeys(record["case"] for record in records if record["family"] != "schedules"):
        mine = {record["method"]: record for record in records if record["case"] == case}
        table.add_row(escape(case), *[_cell(mine.get(method)) for method in methods])
    # Cut off at 80 columns, as for want of a terminal's width, it would show nothing.
    screen = console()
    screen.width = max(WIDE, screen.width)
    screen.print(table)
    for record in records:
        if record["family"] == "schedules":
            say(f"{record['case']}: {record['method']}: {record['diagnosis']}")
        if "digits" in record and record["method"] == "exact":
            say(f"{escape(record['case'])}: {record['digits']:.1f} digits of the certified coefficients, exact")
    for what, why in result["not_measured"].items():
        say(f"[yellow]not measured:[/] {escape(what)}: {escape(why)}")
    for name, found in claimed.items():
        if isinstance(found, Mapping):
            said = ", ".join(
                f"{key} {value:.0e}" if isinstance(value, float) else f"{key} {value}" for key, value in found.items()
            )
            say(f"the learner's worst {name.replace('_', ' ')}: {escape(said)}")
    verdict = "stay below" if claimed["agreed"] else "[red]exceed[/]"
    say(f"scores, novelty and ρ of the learner {verdict} {claimed['limit']:.0e}; flipped: {claimed['flipped']}")


def _cell(record: Mapping[str, Any] | None) -> str:
    if record is None:
        return ""
    error, of = record.get("answers_error"), ""
    if error is None:
        error, of = record.get("weights_error"), "w"
    if error is None:
        return "–"
    return f"{of}{error:.0e}" + (f" [{record['flipped']}]" if record.get("flipped") else "")
