"""The picture of `benchmarks numerics`: speed against error of the answers, one series a method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from examples.benchmarks.numerics.learned import AGREED
from examples.paper.drawing import picture

__all__ = ["draw_numerics", "points"]

Records = Sequence[Mapping[str, Any]]

NO_ANSWER = 1e2  # where refusals are drawn, and errors that large
LEAST = 1e-17  # an error of 0 has no place on a logarithmic axis
COLOURS = {
    "learner": "#000000",
    "learner, followed": "#7a3fbf",
    "exact": "#1f77b4",
    "square root": "#2ca02c",
    "plain sums": "#ff7f0e",
    "pseudo-inverse": "#8c564b",
    "recursion": "#d62728",
}


def points(records: Records) -> dict[str, list[tuple[float, float]]]:
    """(seconds, error of the answers) by method and memory: an observation, and the answer after it.

    A refusal, or weights that are not numbers, count as the error NO_ANSWER; regressions, schedules and the grid, which
    takes no time, are left out.
    """
    memories = {record["case"] for record in records if record["method"].startswith("learner")}
    found: dict[str, list[tuple[float, float]]] = {}
    for record in records:
        if record["case"] not in memories or record.get("seconds_per_row") is None or record["family"] == "schedules":
            continue
        error = record.get("answers_error")
        height = NO_ANSWER if error is None else float(np.clip(error, LEAST, NO_ANSWER))
        found.setdefault(record["method"], []).append((record["seconds_per_row"] + record["solve_seconds"], height))
    return found


def draw_numerics(path: Path, records: Records, *, title: str) -> None:
    """Draw the records of `benchmarks numerics` into a picture.

    Raises InputError where matplotlib is missing or the file cannot be written.
    """
    wanted = {"method": "grid", "family": "within the bound"}
    grid = [LEAST, *(record["answers_error"] for record in records if wanted.items() <= record.items())]
    with picture(path, 9, 6) as figure:
        panel = figure.add_subplot()
        for method, drawn in points(records).items():
            seconds, errors = np.array(drawn).T
            colour = COLOURS.get(method, "grey")
            panel.scatter(seconds * 1e3, errors, s=14, alpha=0.35, color=colour, linewidths=0)
            middle, worst = float(np.median(seconds)) * 1e3, float(errors.max())
            panel.plot([middle, middle], [errors.min(), worst], color=colour, linewidth=1)
            panel.scatter(middle, worst, s=90, color=colour, label=method)
        for height, words in (
            (max(grid), "what the grid costs"),
            (AGREED, "claimed"),
            (2.0**-53, "rounding of a double"),
        ):
            panel.axhline(height, color="grey", linewidth=0.8, linestyle=":")
            place: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "bottom"}
            panel.annotate(words, (0.995, height), fontsize=8, color="grey", **place)
        panel.set(xscale="log", yscale="log", title=title, ylim=(LEAST / 3, 3 * NO_ANSWER))
        panel.set(xlabel="processor time of an observation and the answer after it, ms")
        panel.set(ylabel="relative error of the answers: each memory, and the worst")
        panel.grid(alpha=0.25)
        panel.legend(loc="upper right", fontsize=9)
