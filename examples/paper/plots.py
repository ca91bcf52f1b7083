"""The pictures of the studies. All need matplotlib and raise InputError without it, or where no file can be made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from examples.paper.drawing import picture
from examples.paper.systems.catalogue import name_of
from scroll_tactile.errors import InputError

__all__ = [
    "draw_activation",
    "draw_continual",
    "draw_efficiency",
    "draw_robustness",
    "draw_transfer",
    "robustness_curves",
]

Rows = Sequence[Mapping[str, Any]]
FloatArray = npt.NDArray[np.floating]


def draw_activation(path: Path, images: Mapping[str, FloatArray]) -> None:
    """Draw what each network's first block looks for, by network, side by side; a unit has the same place in all.

    images: of `maximise`, each of shape (units, 3, size, size), any range.
    """
    with picture(path, 6 * len(images), 6.4, dots=72) as figure:
        panels = np.atleast_1d(figure.subplots(1, len(images)))
        for panel, (name, units) in zip(panels, images.items(), strict=True):
            panel.imshow(_sheet(units), interpolation="nearest")
            panel.set_title(name)
            panel.set_axis_off()


def _sheet(images: FloatArray, across: int = 8, gap: int = 2) -> FloatArray:
    """Images as one, in lines of eight: shape (height, width, 3), in [0, 1], two standard deviations either way."""
    count, planes, size, _ = images.shape
    step = size + gap
    sheet = np.ones((-(-count // across) * step - gap, min(count, across) * step - gap, planes))
    for i, image in enumerate(images):
        top, left = i // across * step, i % across * step
        shown = np.clip((image - image.mean()) / (4 * image.std() + 1e-12) + 0.5, 0, 1)
        sheet[top : top + size, left : left + size] = shown.transpose(1, 2, 0)
    return sheet


def draw_efficiency(path: Path, curves: Rows) -> None:
    """Draw accuracy by epoch of the networks (left) and by touches of each material of ours, a row for each data set.

    curves: dataset, system, by ("epochs" or "streams") and points [(epoch or touches, mean, standard deviation)].
    """
    sets = list(dict.fromkeys(curve["dataset"] for curve in curves))
    with picture(path, 12, 4.5 * len(sets)) as figure:
        panels = np.asarray(figure.subplots(len(sets), 2, squeeze=False, sharey="row"))
        for dataset, (left, right) in zip(sets, panels, strict=True):
            mine = [curve for curve in curves if curve["dataset"] == dataset]
            for panel, by in ((left, "epochs"), (right, "streams")):
                for curve in (curve for curve in mine if curve["by"] == by):
                    place, mean, spread = np.nan_to_num(np.asarray(curve["points"], dtype=float)).T
                    panel.errorbar(place, 100 * mean, 100 * spread, marker=".", capsize=2, label=curve["system"])
                panel.grid(alpha=0.3)
                if panel.get_legend_handles_labels()[0]:
                    panel.legend(fontsize=8)
            left.xaxis.get_major_locator().set_params(integer=True)
            left.set(xlabel="epochs over all touches", ylabel="accuracy on the test, %", title=f"{dataset}: trained")
            right.set(xlabel="touches of each material, each met once", title=f"{dataset}: one pass")
            seen = {point[0] for curve in mine if curve["by"] == "streams" for point in curve["points"]}
            _logarithmic(right, seen)


def draw_transfer(path: Path, rows: Rows) -> None:
    """Draw accuracy by touches of each material, a line for each embedding, a panel for each data set tested.

    rows: dataset, system, and points: touches of each material → mean and sd, shares from 0 to 1. Raises InputError
    where there are none.
    """
    if not rows:
        raise InputError("expected rows to draw; came none")
    sets = list(dict.fromkeys(row["dataset"] for row in rows))
    with picture(path, 5 * len(sets), 4.5) as figure:
        panels = np.asarray(figure.subplots(1, len(sets), squeeze=False))[0]
        for dataset, panel in zip(sets, panels, strict=True):
            mine = [row for row in rows if row["dataset"] == dataset]
            for row in mine:
                means = [100 * point["mean"] for point in row["points"].values()]
                spreads = [100 * (point["sd"] or 0) for point in row["points"].values()]
                counts = [int(count) for count in row["points"]]
                panel.errorbar(counts, means, spreads, marker=".", capsize=2, label=row["system"])
            panel.set(xlabel="touches of each material", ylabel="accuracy on the test, %", title=dataset)
            _logarithmic(panel, {int(count) for row in mine for count in row["points"]})
            panel.grid(alpha=0.3)
            panel.legend(fontsize=7)


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
                _logarithmic(panel, {strength for points in lines.values() for strength, _, _ in points})
            if study == "session":
                panel.set_xticks([])
            panel.grid(alpha=0.3)
        handles, labels = panel.get_legend_handles_labels()  # all panels have the same lines
        figure.legend(handles, labels, loc="outside lower center", ncols=2 * wide, fontsize=8, handlelength=4)
        figure.suptitle(title)


def _logarithmic(panel: Any, ticks: set[Any]) -> None:
    panel.set_xscale("log")
    panel.set_xticks(sorted(ticks), [f"{tick:g}" for tick in sorted(ticks)], minor=False)
    panel.minorticks_off()


METHODS = {"f": "f (the same learned offline)", "f*": "f*, fine-tuned on the buffer", "ridge": "ridge floor"}


def draw_continual(path: Path, rows: Rows, *, title: str, lines: Mapping[str, float]) -> None:
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


def _by_size(panel: Any, rows: Rows, colours: Mapping[str, str]) -> None:
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


def _by_material(panel: Any, rows: Rows, colours: Mapping[str, str]) -> None:
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
