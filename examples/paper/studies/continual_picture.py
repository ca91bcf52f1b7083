"""The picture of `continual`: accuracy against the size of the buffer, and as materials are met."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from examples.paper.runs.pictures import picture

__all__ = ["draw_continual"]

METHODS = {"f": "f (the same learned offline)", "f*": "f*, fine-tuned on the buffer", "ridge": "ridge floor"}


def draw_continual(path: Path, rows: Sequence[Mapping[str, Any]], *, title: str, lines: Mapping[str, float]) -> None:
    """Draw accuracy against the size of the buffer, and as materials are met.

    rows: of a continual summary: method, size, accuracy {"mean", "sd"} and curve [(materials met, accuracy)] of each.
    lines: further ones, label → accuracy.
    """
    colours = {method: f"C{i % 10}" for i, method in enumerate(dict.fromkeys(row["method"] for row in rows))}
    with picture(path, 14, 6.5) as figure:
        left, right = figure.subplots(1, 2)
        _by_size(left, rows, colours)
        for i, (label, value) in enumerate(lines.items()):
            left.axhline(100 * value, color="black", linewidth=1, linestyle=("--", ":", "-.")[i % 3], label=label)
        left.set(xlabel="exemplars in the buffer", ylabel="accuracy after the last material, %", title=title)
        _by_material(right, rows, colours)
        right.set(xlabel="materials met so far", ylabel="accuracy over them, %", title="As they are met")
        right.xaxis.get_major_locator().set_params(integer=True)
        for panel in (left, right):
            panel.grid(alpha=0.3)
            if panel.get_legend_handles_labels()[0]:
                panel.legend(fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.1))


def _by_size(panel: Any, rows: Sequence[Mapping[str, Any]], colours: Mapping[str, str]) -> None:
    sizes = [row["size"] for row in rows if row["method"] == "f*"]
    panel.set_xticks(range(len(sizes)), sizes)
    for method, colour in colours.items():
        mine = [row for row in rows if row["method"] == method]
        mean = 100 * np.array([row["accuracy"]["mean"] for row in mine])
        spread = 100 * np.array([row["accuracy"]["sd"] for row in mine])
        ours = method in METHODS
        if mine[0]["size"] is None:  # whatever the buffer, it is the same
            width, dashes = 2 if ours else 0.8, "--" if method == "ridge" else "-"
            panel.axhline(mean[0], color=colour, linewidth=width, linestyle=dashes, label=METHODS.get(method, method))
            if method == "f":
                panel.axhspan(mean[0] - spread[0], mean[0] + spread[0], color=colour, alpha=0.12)
            continue
        places = [sizes.index(row["size"]) for row in mine]
        style = {"marker": "o", "capsize": 3, "linewidth": 2} if ours else {"linewidth": 0.8, "capsize": 0}
        panel.errorbar(places, mean, spread, color=colour, label=METHODS.get(method, method), **style)


def _by_material(panel: Any, rows: Sequence[Mapping[str, Any]], colours: Mapping[str, str]) -> None:
    for method, colour in colours.items():
        # Of a method with a buffer the largest one that was measured.
        row = [row for row in rows if row["method"] == method][-1]
        if not row["curve"]:
            continue
        met, share = np.asarray(row["curve"], dtype=float).T
        label = method if row["size"] is None else f"{method}, {row['size']} exemplars"
        ours = method in ("f", "f*")
        panel.plot(
            met, 100 * share, color=colour, linewidth=2 if ours else 0.8, marker="." if ours else None, label=label
        )
