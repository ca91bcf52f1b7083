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
    best = {one["case"]: one["best"] for one in judged}
    methods = list(dict.fromkeys(one["method"] for one in records))
    table = Table(title="relative error of the weights; in brackets decisions flipped", box=SIMPLE_HEAD)
    for name in ("case", *methods):
        table.add_column(name.replace("covariance", "cov").replace("symmetric", "sym"), no_wrap=True)
    for case in dict.fromkeys(one["case"] for one in records):
        mine = {one["method"]: one for one in records if one["case"] == case and one["family"] != "schedules"}
        cells = [_cell(mine.get(method), bold=best.get(case) == method) for method in methods]
        if mine:
            table.add_row(escape(case), *cells)
    # Cut off at 80 columns, as for want of a terminal's width, it would show nothing.
    screen = console()
    screen.width = max(WIDE, screen.width)
    screen.print(table)
    for one in records:
        if one["family"] == "schedules":
            say(f"{one['case']}: {one['method']}: {one['diagnosis']}")
        if "digits" in one and one["method"] == "exact":
            say(f"{escape(one['case'])}: {one['digits']:.1f} digits of the certified coefficients, exact")
    for what, why in result["not_measured"].items():
        say(f"[yellow]not measured:[/] {escape(what)}: {escape(why)}")
    missed = [one["case"] for one in judged if not one["met"]]
    say(f"exact within 10 × of the best method, or named why not: {len(judged) - len(missed)} of {len(judged)} cases")
    for case in missed:
        say(f"[red]missed:[/] {escape(case)}")


def _cell(one: Mapping[str, Any] | None, *, bold: bool) -> str:
    if one is None:
        return ""
    if one["relative_error"] is None:
        return "–"
    said = f"{one['relative_error']:.0e}" + (f" [{one['flipped']}]" if one["flipped"] else "")
    return f"[bold]{said}[/]" if bold else said
