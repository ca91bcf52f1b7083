"""Pictures, for those who have matplotlib (the extra `plots`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.markup import escape

from scroll_tactile.clients.cli.terminal import say
from scroll_tactile.errors import InputError
from scroll_tactile.libraries import missing

__all__ = ["available", "draw_into", "logarithmic", "picture"]


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


def draw_into(plot: Path | None, draw: Callable[[Path], object]) -> None:
    """Draw a picture into the file that was asked for, and say so, or that it cannot be without matplotlib."""
    if plot is None:
        return
    if not available():
        say(f"[yellow]No picture:[/] {escape(str(missing('matplotlib', 'plots', 'it')))}")
        return
    draw(plot)
    say(f"plot: {plot}")


def logarithmic(panel: Any, ticks: set[Any]) -> None:
    """Give a panel a logarithmic axis across, with these ticks."""
    panel.set_xscale("log")
    panel.set_xticks(sorted(ticks), [f"{tick:g}" for tick in sorted(ticks)], minor=False)
    panel.minorticks_off()
