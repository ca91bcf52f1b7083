"""The pictures of `strengths`: accuracy against strength, a line for each system."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from examples.paper.runs.pictures import logarithmic, picture
from examples.paper.systems.catalogue import name_of
from scroll_tactile.errors import InputError

__all__ = ["draw_robustness", "robustness_curves"]

Rows = Sequence[Mapping[str, Any]]

LABELS = {
    "length": "length of the touch, s",
    "speed": "speed, × that learned from",
    "noise": "amplitude of uniform noise, share of the range",
    "dead": "dead channels, share",
    "drift": "drift until the end, share of range and gain",
    "session": "another recording session",
}


def robustness_curves(rows: Rows) -> dict[str, dict[tuple[str, bool], list[tuple[float, float, float]]]]:
    """Study → (system, augmented) → (strength, mean, sd), by strength, of the rows of a robustness summary."""
    found: dict[str, dict[tuple[str, bool], list[tuple[float, float, float]]]] = {}
    for row in sorted(rows, key=lambda row: row["strength"]):
        lines = found.setdefault(row["study"], {})
        lines.setdefault((row["system"], row["augmented"]), []).append((row["strength"], row["mean"], row["sd"] or 0.0))
    return {study: found[study] for study in LABELS if study in found}


def draw_robustness(path: Path, rows: Rows, *, title: str) -> None:
    """Draw accuracy against strength, a panel for each study, a line for each system.

    Dashed where a system is without augmentation and its other line is with it.

    rows: of a robustness summary. Raises InputError where there are none.
    """
    drawn = robustness_curves(rows)
    if not drawn:
        raise InputError("expected records of a study to draw; there are none")
    colours = {system: f"C{i % 10}" for i, system in enumerate(dict.fromkeys(row["system"] for row in rows))}
    wide = min(3, len(drawn))
    tall = -(-len(drawn) // wide)
    with picture(path, 5 * wide, 4 * tall + 1) as figure:
        for i, (study, lines) in enumerate(drawn.items()):
            panel = figure.add_subplot(tall, wide, i + 1)
            for (system, augmented), points in lines.items():
                strengths, means, spreads = zip(*points, strict=True)
                panel.errorbar(
                    strengths,
                    [100 * mean for mean in means],
                    yerr=[100 * spread for spread in spreads],
                    color=colours[system],
                    linestyle="--" if not augmented and (system, True) in lines else "-",
                    marker="o",
                    markersize=4,
                    capsize=2,
                    label=f"{name_of(system)}, augmented" if augmented else name_of(system),
                )
            panel.set(xlabel=LABELS[study], ylabel="accuracy, %", ylim=(0, 102))
            if study in ("length", "speed"):
                logarithmic(panel, {strength for points in lines.values() for strength, _, _ in points})
            if study == "session":
                panel.set_xticks([])
            panel.grid(alpha=0.3)
        handles, labels = panel.get_legend_handles_labels()  # all panels have the same lines
        figure.legend(handles, labels, loc="outside lower center", ncols=2 * wide, fontsize=8, handlelength=4)
        figure.suptitle(title)
