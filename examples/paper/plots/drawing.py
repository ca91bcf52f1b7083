"""Pictures of how well materials are told apart, for those who have matplotlib (the extra `plots`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scroll_tactile.errors import InputError

__all__ = ["available", "confusion_counts", "draw"]


def available() -> bool:
    """Whether matplotlib is installed."""
    from importlib.util import find_spec

    return find_spec("matplotlib") is not None


def confusion_counts(
    names: Sequence[str], tested: Sequence[int], confusions: Sequence[tuple[str, str, int]]
) -> np.ndarray:
    """Counts of (truth, said), shape (C, C), from the wrong answers.

    names: C materials. tested: touches of each. confusions: (truth, said, count) with said ≠ truth.
    """
    place = {name: at for at, name in enumerate(names)}
    counts = np.diag(np.asarray(tested, dtype=np.int64))
    for truth, said, count in confusions:
        counts[place[truth], place[said]] += count
        counts[place[truth], place[truth]] -= count
    return counts


def draw(
    path: Path,
    names: Sequence[str],
    counts: np.ndarray,
    *,
    title: str,
    curves: Sequence[Sequence[Sequence[float]]] = (),
) -> None:
    """Draw counts of (truth, said), shape (C, C), into a picture, with curves of (materials met, accuracy) beside.

    Raises InputError where matplotlib is missing or the file cannot be written.
    """
    if not available():
        raise InputError('pictures need matplotlib: pip install "scroll-tactile[plots]"')
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = [curve for curve in curves if curve]
    figure = Figure(figsize=(7.5 if not drawn else 13, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    panel = figure.add_subplot(1, 2 if drawn else 1, 1)
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    picture = panel.imshow(shares, cmap="viridis", vmin=0, vmax=1)
    panel.set_xticks(range(len(names)), names, rotation=90)
    panel.set_yticks(range(len(names)), names)
    panel.set(xlabel="said", ylabel="felt", title=title)
    figure.colorbar(picture, ax=panel, label="share of the touches of a material", shrink=0.8)
    if drawn:
        side = figure.add_subplot(1, 2, 2)
        for at, curve in enumerate(drawn):
            points = np.asarray(curve)
            side.plot(points[:, 0], 100 * points[:, 1], marker="o", label=f"run {at + 1}" if len(drawn) > 1 else None)
        side.set(xlabel="materials met so far", ylabel="accuracy over them, %", title="Learning one by one")
        side.grid(alpha=0.3)
        if len(drawn) > 1:
            side.legend()
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:  # ValueError: a kind of file that matplotlib does not write
        raise InputError(f"the plot cannot be written to {path}: {error}") from error
