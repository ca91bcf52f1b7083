"""The README's table of what fabrics are made of, from results of `scroll-tactile fabric contactile --simulated`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from examples.paper.contactile.contactile_rows import ROWS
from examples.paper.contactile.contactile_study import HAND, HELD_OUT
from examples.paper.tables.markdown import Read, Result, table

__all__ = ["contactile"]

ALL_ROWS, FULL = "contactile-simulated-small", "contactile-simulated"
"""Results: of every row, at a size that networks can be trained at; and of those in closed form, of all touches."""


def contactile(read: Read) -> str:
    """A table of all rows, the paper's figures beside, and in words what was learned and what the figures are of."""
    small, full = read(ALL_ROWS), read(FULL)
    part, whole = _figures(small, HAND), _figures(full, HAND)
    held = _figures(full, HELD_OUT)
    head = [
        "simulated, percent",
        "paper, real fabrics",
        f"score, {_learned(part)} touches",
        "all right",
        "shares off by",
        "calibration error",
        f"score, {_learned(whole)} touches",
        f"… robot → robot, {_learned(held)}",
    ]
    lines = []
    for key, name in ROWS.items():
        if key not in part and key not in whole:
            continue
        paper = next(row["paper"] for result in (small, full) for row in result["rows"] if row["key"] == key)
        here = part.get(key)
        lines.append(
            [
                f"**{name}**" if name.startswith("ours") else name,
                "" if paper is None else _percent(paper),
                "" if here is None else _percent(here["score"]),
                "" if here is None else _percent(here["exact"]),
                "" if here is None else _percent(here["share_error"]),
                "" if here is None else f"{here['calibration_error']:.2f}",
                *(_percent(where[key]["score"]) if key in where else "" for where in (whole, held)),
            ]
        )
    always = [next(iter(where.values()))["always"] for where in (part, whole, held)]
    lines.append(["saying always what is more common", "", _percent(always[0]), "", "", "", *map(_percent, always[1:])])
    return f"{table(head, lines)}\n\n{_words(small, part)}"


def _words(small: Result, part: Mapping[str, Mapping[str, Any]]) -> str:
    told = next((cell["accuracy on BioTac"] for cell in part.values() if "accuracy on BioTac" in cell), None)
    tuned = "" if told is None else f", after which it tells {100 * told:.0f} % of BioTac's touches"
    return (
        f"{small['fabrics']} simulated fabrics of {len(small['constituents'])} constituents, learned from a robot's "
        f"touches and asked about a hand's.\nNetworks: {small['epochs']} epochs where the paper has 50 "
        f"({small['biotac_epochs']} on BioTac{tuned}), images averaged over {small['every']} columns."
    )


def _figures(result: Result, part: str) -> dict[str, Mapping[str, Any]]:
    """Row → its cell in a part, of those that were measured."""
    keys = {f"{part}, fold 0, {key}": key for key in ROWS}
    return {keys[cell]: figures for cell, figures in result["cells"].items() if cell in keys}


def _learned(cells: Mapping[str, Mapping[str, Any]]) -> int:
    """Touches learned and held for choosing."""
    one = next(iter(cells.values()))
    return int(one["taught"]) + int(one["validation"])


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"
