"""The picture of `reproduce activation`: what each network's first block looks for, unit by unit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from examples.paper.plots.drawing import available
from scroll_tactile.errors import InputError

__all__ = ["draw_activation"]

ACROSS = 8  # units in a line
GAP = 2  # pixels between two


def draw_activation(path: Path, images: Mapping[str, npt.NDArray[np.floating]]) -> None:
    """Draw the images of `maximise`, by network, side by side; the same unit stands at the same place.

    images: each of shape (units, 3, size, size), any range.

    Raises InputError where matplotlib is missing or the file cannot be written.
    """
    if not available():
        raise InputError('pictures need matplotlib: pip install "scroll-tactile[plots]"')
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6 * len(images), 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    panels = np.atleast_1d(figure.subplots(1, len(images)))
    for panel, (name, those) in zip(panels, images.items(), strict=True):
        panel.imshow(_sheet(those), interpolation="nearest")
        panel.set_title(name)
        panel.set_axis_off()
    try:
        figure.savefig(path, dpi=72)
    except (OSError, ValueError) as error:  # ValueError: a kind of file that matplotlib does not write
        raise InputError(f"the plot cannot be written to {path}: {error}") from error


def _sheet(images: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Images as one, in lines of eight: shape (height, width, 3), in [0, 1], two standard deviations either way."""
    count, planes, size, _ = images.shape
    lines = -(-count // ACROSS)
    step = size + GAP
    sheet = np.ones((lines * step - GAP, min(count, ACROSS) * step - GAP, planes))
    for at, image in enumerate(images):
        top, left = at // ACROSS * step, at % ACROSS * step
        shown = np.clip((image - image.mean()) / (4 * image.std() + 1e-12) + 0.5, 0, 1)
        sheet[top : top + size, left : left + size] = shown.transpose(1, 2, 0)
    return sheet
