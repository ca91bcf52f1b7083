"""The picture of `robustness`: accuracy against strength, a panel for each study, a line for each system."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from examples.paper.plots.drawing import available
from scroll_tactile.errors import InputError

__all__ = ["curves", "draw_robustness"]

Rows = Sequence[Mapping[str, Any]]

LABELS = {
    "length": "length of the touch, s",
    "speed": "speed, × that learned from",
    "noise": "amplitude of uniform noise, share of the range",
    "dead": "dead channels, share",
    "drift": "drift until the end, share of range and gain",
    "sitting": "another sitting",
}
LOGARITHMIC = ("length", "speed")
COLUMNS = 3


def curves(rows: Rows) -> dict[str, dict[tuple[str, bool], list[tuple[float, float, float]]]]:
    """Study → (system, augmented) → (strength, mean, sd), by strength, of the rows of `robustness.summary`."""
    found: dict[str, dict[tuple[str, bool], list[tuple[float, float, float]]]] = {}
    for row in sorted(rows, key=lambda one: one["strength"]):
        lines = found.setdefault(row["study"], {})
        lines.setdefault((row["system"], row["augmented"]), []).append((row["strength"], row["mean"], row["sd"]))
    return {study: found[study] for study in LABELS if study in found}


def draw_robustness(path: Path, rows: Rows, *, title: str) -> None:
    """Draw the rows of `robustness.summary` into a picture.

    Raises InputError where there are none, matplotlib is missing or the file cannot be written.
    """
    if not available():
        raise InputError('pictures need matplotlib: pip install "scroll-tactile[plots]"')
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = curves(rows)
    if not drawn:
        raise InputError("expected records of a study to draw; there are none")
    systems = list(dict.fromkeys(row["system"] for row in rows))
    colours = {system: f"C{at % 10}" for at, system in enumerate(systems)}
    wide = min(COLUMNS, len(drawn))
    tall = -(-len(drawn) // wide)
    figure = Figure(figsize=(5 * wide, 4 * tall), layout="constrained")
    FigureCanvasAgg(figure)
    for at, (study, lines) in enumerate(drawn.items()):
        panel = figure.add_subplot(tall, wide, at + 1)
        for (system, augmented), points in lines.items():
            panel.errorbar(
                [strength for strength, _, _ in points],
                [100 * mean for _, mean, _ in points],
                yerr=[100 * spread for _, _, spread in points],
                color=colours[system],
                linestyle="-" if augmented else "--",
                marker="o",
                markersize=4,
                capsize=2,
                label=f"{system}, augmented" if augmented else system,
            )
        panel.set(xlabel=LABELS[study], ylabel="accuracy, %", ylim=(0, 102))
        if study in LOGARITHMIC:
            panel.set_xscale("log")
            ticks = sorted({strength for points in lines.values() for strength, _, _ in points})
            panel.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
            panel.minorticks_off()
        if study == "sitting":
            panel.set_xticks([])
        panel.grid(alpha=0.3)
        if not at:
            panel.legend(fontsize=8)
    figure.suptitle(title)
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:  # ValueError: a kind of file that matplotlib does not write
        raise InputError(f"the plot cannot be written to {path}: {error}") from error
