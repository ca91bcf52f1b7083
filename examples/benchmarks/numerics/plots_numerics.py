"""The picture of `benchmarks numerics`: speed against error, one point for each method and family of cases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from examples.paper.drawing import picture

__all__ = ["draw_numerics", "points"]

Records = Sequence[Mapping[str, Any]]

MARKERS = ("o", "s", "D", "^", "v", "<", ">", "p", "P", "X", "*", "d", "h", "8", "$a$", "$b$", "$c$")
LETTERS = {"nist": "$N$", "updates": "$u$"}  # families that shapes would not tell from others
NO_ANSWER = 1e3  # where families begin to be drawn that a method has no answer to, each method in a line of its own
BETWEEN = 4.0  # these lines
LEAST = 1e-17  # an error of 0 has no place on a logarithmic axis
COLOURS = {
    "covariance": "#d62728",
    "covariance-symmetric": "#ff9896",
    "qr": "#2ca02c",
    "gram64": "#1f77b4",
    "gram32": "#aec7e8",
    "exact": "#000000",
    "exact24": "#7f7f7f",
    "exact20": "#c49c94",
}


def points(records: Records) -> list[tuple[str, str, float, float]]:
    """(method, family, seconds a row, error) with the median time and the worst error over a family's cases.

    A refusal, or weights that are not numbers, count as the error NO_ANSWER; a method that is not defined for a
    case, and records without a time, are left out.
    """
    found = []
    for method in dict.fromkeys(record["method"] for record in records):
        for family in dict.fromkeys(record["family"] for record in records):
            mine = [
                record
                for record in records
                if (record["method"], record["family"]) == (method, family)
                and record["seconds_per_row"] is not None
                and family != "schedules"
            ]
            if mine:
                errors = [
                    NO_ANSWER if record["relative_error"] is None else record["relative_error"] for record in mine
                ]
                seconds = float(np.median([record["seconds_per_row"] for record in mine]))
                found.append((method, family, seconds, min(NO_ANSWER, max(LEAST, *errors))))
    return found


def draw_numerics(path: Path, records: Records, *, title: str) -> None:
    """Draw the records of `benchmarks numerics` into a picture.

    Raises InputError where matplotlib is missing or the file cannot be written.
    """
    drawn = points(records)
    families = list(dict.fromkeys(family for _, family, _, _ in drawn))
    methods = list(dict.fromkeys(method for method, _, _, _ in drawn))
    colours = {method: COLOURS.get(method, f"C{i % 10}") for i, method in enumerate(methods)}
    markers = {family: LETTERS.get(family, MARKERS[i % len(MARKERS)]) for i, family in enumerate(families)}
    with picture(path, 13, 8) as figure:
        panel = figure.add_subplot()
        for method, family, seconds, error in drawn:
            mark = markers[family]
            height = error if error < NO_ANSWER else NO_ANSWER * BETWEEN ** (1 + methods.index(method))
            panel.scatter(seconds * 1e6, height, s=70, alpha=0.85, color=colours[method], marker=mark, linewidths=0)
        panel.set(xscale="log", yscale="log", title=title)
        panel.set(xlabel="processor time for each row, µs (median of the family's cases)")
        panel.set(ylabel="relative error of the weights (worst of the family's cases)")
        top = NO_ANSWER * BETWEEN ** (len(methods) + 1)
        panel.set_ylim(LEAST / 3, top)
        panel.set_yticks([10.0**power for power in range(-15, 3, 3)])
        panel.axhline(1.0, color="grey", linewidth=0.8, linestyle=":")
        panel.axhline(2.0**-53, color="grey", linewidth=0.8, linestyle=":")
        panel.axhspan(NO_ANSWER, top, color="grey", alpha=0.12, linewidth=0)
        for height, words in ((1.0, "nothing is right"), (2.0**-53, "rounding of a double")):
            panel.annotate(
                words, (0.004, height), xycoords=("axes fraction", "data"), va="bottom", fontsize=8, color="grey"
            )
        panel.annotate(
            "no answer, or an error of 1000 and more",
            (0.004, NO_ANSWER * 1.3),
            xycoords=("axes fraction", "data"),
            fontsize=8,
            color="grey",
        )
        panel.grid(alpha=0.25)
        _legends(figure, panel, colours, markers)


def _legends(figure: Any, panel: Any, colours: Mapping[str, str], markers: Mapping[str, str]) -> None:
    from matplotlib.lines import Line2D

    by_colour = [Line2D([], [], color=colour, marker="o", linestyle="", label=name) for name, colour in colours.items()]
    by_shape = [Line2D([], [], color="black", marker=mark, linestyle="", label=name) for name, mark in markers.items()]
    figure.legend(handles=by_colour, title="method", loc="outside right upper", fontsize=9)
    figure.legend(handles=by_shape, title="family of cases", loc="outside right lower", fontsize=9)
