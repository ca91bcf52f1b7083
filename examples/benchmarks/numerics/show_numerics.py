"""How `benchmarks numerics` is shown: a table of cases and methods, the bar, and what was not measured."""

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
    """Show relative errors, case by method, the best in bold, and in brackets how many decisions flipped."""
    records, judged = result["records"], result["bars"]
    best = {record["case"]: record["best"] for record in judged}
    methods = list(dict.fromkeys(record["method"] for record in records))
    table = Table(title="relative error of the weights; in brackets decisions flipped", box=SIMPLE_HEAD)
    for name in ("case", *methods):
        table.add_column(name.replace("covariance", "cov").replace("symmetric", "sym"), no_wrap=True)
    for case in dict.fromkeys(record["case"] for record in records):
        mine = {
            record["method"]: record for record in records if record["case"] == case and record["family"] != "schedules"
        }
        cells = [_cell(mine.get(method), bold=best.get(case) == method) for method in methods]
        if mine:
            table.add_row(escape(case), *cells)
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
    missed = [record["case"] for record in judged if not record["met"]]
    say(f"exact within 10 × of the best method, or named why not: {len(judged) - len(missed)} of {len(judged)} cases")
    for case in missed:
        say(f"[red]missed:[/] {escape(case)}")


def _cell(record: Mapping[str, Any] | None, *, bold: bool) -> str:
    if record is None:
        return ""
    if record["relative_error"] is None:
        return "–"
    said = f"{record['relative_error']:.0e}" + (f" [{record['flipped']}]" if record["flipped"] else "")
    return f"[bold]{said}[/]" if bold else said
