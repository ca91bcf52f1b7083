"""The picture of transfer between tasks: accuracy by touches of each material, an embedding a line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from examples.paper.plots.drawing import available
from scroll_tactile.errors import InputError

__all__ = ["draw_transfer"]


def draw_transfer(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Draw the rows of `pipelines.transfer` into a picture: a panel for each data set that is asked about.

    rows: dataset, system, and points: touches of each material → mean and sd, shares from 0 to 1.

    Raises InputError where there are no rows, matplotlib is missing or the file cannot be written.
    """
    if not rows:
        raise InputError("expected rows to draw; came none")
    if not available():
        raise InputError('pictures need matplotlib: pip install "scroll-tactile[plots]"')
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    sets = list(dict.fromkeys(row["dataset"] for row in rows))
    figure = Figure(figsize=(5 * len(sets), 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    panels = np.asarray(figure.subplots(1, len(sets), squeeze=False))[0]
    for dataset, panel in zip(sets, panels, strict=True):
        seen: set[int] = set()
        for row in rows:
            if row["dataset"] != dataset:
                continue
            counts = [int(count) for count in row["points"]]
            means = [100 * point["mean"] for point in row["points"].values()]
            spreads = [100 * point["sd"] for point in row["points"].values()]
            panel.errorbar(counts, means, spreads, marker=".", capsize=2, label=row["system"])
            seen.update(counts)
        panel.set(xlabel="touches of each material", ylabel="accuracy on the test, %", title=dataset, xscale="log")
        panel.set_xticks(sorted(seen), [str(at) for at in sorted(seen)], minor=False)
        panel.minorticks_off()
        panel.grid(alpha=0.3)
        panel.legend(fontsize=7)
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:  # ValueError: a kind of file that matplotlib does not write
        raise InputError(f"the plot cannot be written to {path}: {error}") from error
