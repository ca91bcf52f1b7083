"""Pictures, for those who have matplotlib (the extra `plots`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from scroll_tactile.errors import InputError
from scroll_tactile.libraries import missing

__all__ = ["available", "draw", "picture"]


def available() -> bool:
    """Whether matplotlib is installed."""
    return find_spec("matplotlib") is not None


@contextmanager
def picture(path: Path, width: float, height: float, dots: int = 120) -> Iterator[Any]:
    """Yield a matplotlib figure of so many inches, and write it, with `dots` an inch, when the block ends.

    Raises InputError where matplotlib is missing or the file cannot be written.
    """
    if not available():
        raise missing("matplotlib", "plots", "a picture")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    yield figure
    try:
        figure.savefig(path, dpi=dots)
    except (OSError, ValueError) as error:  # ValueError: a kind of file that matplotlib does not write
        raise InputError(f"the plot cannot be written to {path}: {error}") from error


def draw(path: Path, names: Sequence[str], counts: np.ndarray, *, title: str) -> None:
    """Draw counts of (truth, predicted), shape (C, C), into a picture.

    Raises InputError where matplotlib is missing or the file cannot be written.
    """
    with picture(path, 7.5, 6.5) as figure:
        panel = figure.add_subplot()
        shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        image = panel.imshow(shares, cmap="viridis", vmin=0, vmax=1)
        panel.set_xticks(range(len(names)), names, rotation=90)
        panel.set_yticks(range(len(names)), names)
        panel.set(xlabel="predicted", ylabel="touched", title=title)
        figure.colorbar(image, ax=panel, label="share of the touches of a material", shrink=0.8)
