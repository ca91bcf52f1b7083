"""The picture of learning efficiency: accuracy by epoch of the networks, and by touches of each material of ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from examples.paper.plots.drawing import available
from scroll_tactile.errors import InputError

__all__ = ["draw_efficiency"]


def draw_efficiency(path: Path, curves: Sequence[Mapping[str, Any]]) -> None:
    """Draw curves of `pipelines.efficiency` into a picture: a row for each data set, epochs left and touches right.

    curves: dataset, system, by ("epochs" or "streams") and points [(epoch or touches, mean, standard deviation)].

    Raises InputError where matplotlib is missing or the file cannot be written.
    """
    if not available():
        raise InputError('pictures need matplotlib: pip install "scroll-tactile[plots]"')
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    sets = list(dict.fromkeys(curve["dataset"] for curve in curves))
    figure = Figure(figsize=(12, 4.5 * len(sets)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = np.asarray(figure.subplots(len(sets), 2, squeeze=False, sharey="row"))
    for dataset, (left, right) in zip(sets, panels, strict=True):
        mine = [curve for curve in curves if curve["dataset"] == dataset]
        _draw(left, [curve for curve in mine if curve["by"] == "epochs"])
        _draw(right, [curve for curve in mine if curve["by"] == "streams"])
        left.xaxis.get_major_locator().set_params(integer=True)
        left.set(xlabel="epochs over all touches", ylabel="accuracy on the test, %", title=f"{dataset}: trained")
        right.set(xlabel="touches of each material, each met once", title=f"{dataset}: one pass", xscale="log")
        seen = sorted({point[0] for curve in mine if curve["by"] == "streams" for point in curve["points"]})
        right.set_xticks(seen, [f"{at:g}" for at in seen], minor=False)
        right.minorticks_off()
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:  # ValueError: a kind of file that matplotlib does not write
        raise InputError(f"the plot cannot be written to {path}: {error}") from error


def _draw(panel: Any, curves: Sequence[Mapping[str, Any]]) -> None:
    for curve in curves:
        at, mean, spread = 100 * np.asarray(curve["points"], dtype=float).T
        panel.errorbar(at / 100, mean, spread, marker=".", capsize=2, label=curve["system"])
    panel.grid(alpha=0.3)
    if curves:
        panel.legend(fontsize=8)
