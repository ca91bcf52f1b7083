"""The picture of `benchmarks frontier`: error against milliseconds, ours by width, others as points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from examples.paper.drawing import available
from scroll_tactile.errors import InputError

__all__ = ["draw_frontier"]

Records = Sequence[Mapping[str, Any]]
STYLES = {"lda": "-", "ridge": "--"}


def draw_frontier(path: Path, records: Records, peers: Records, *, default: int) -> None:
    """Draw the records of `run_frontier` and `run_peers` into a picture; `default` is the width to be marked.

    Raises InputError where matplotlib is missing or the file cannot be written.
    """
    if not available():
        raise InputError('pictures need matplotlib: pip install "scroll-tactile[plots]"')
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6), layout="constrained")
    FigureCanvasAgg(figure)
    ours, others = figure.subplots(1, 2)
    _draw_widths(ours, records, default)
    _draw_peers(others, [record for record in peers if record["measured"]])
    for panel in (ours, others):
        panel.set(xscale="log", yscale="log", ylabel="touches taken for something else, %")
        panel.grid(alpha=0.25, which="both")
        if panel.get_legend_handles_labels()[0]:
            panel.legend(fontsize=8)
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:  # ValueError: a kind of file that matplotlib does not write
        raise InputError(f"the plot cannot be written to {path}: {error}") from error


def _draw_widths(panel: Any, records: Records, default: int) -> None:
    lines = dict.fromkeys((record["dataset"], record["length"], record["readout"]) for record in records)
    colours = {key: f"C{i}" for i, key in enumerate(dict.fromkeys((dataset, length) for dataset, length, _ in lines))}
    for dataset, length, readout in lines:
        mine = [
            record
            for record in records
            if (record["dataset"], record["length"], record["readout"]) == (dataset, length, readout)
        ]
        mine.sort(key=lambda record: record["width"])
        times, errors = [record["predict_ms"] for record in mine], [_percent(record) for record in mine]
        colour = colours[dataset, length]
        label = f"{dataset}, {'whole touches' if length == 'all' else length}, {readout}"
        panel.plot(times, errors, STYLES[readout], color=colour, marker=".", label=label)
        marked = [place for place, record in enumerate(mine) if record["width"] == default]
        panel.scatter([times[place] for place in marked], [errors[place] for place in marked], s=90, color=colour)
    panel.set(xlabel="ms a prediction, embedding included", title=f"widths of the embedding; large: {default}, default")


def _draw_peers(panel: Any, peers: Records) -> None:
    names = list(dict.fromkeys(record["learner"] for record in peers))
    markers = dict(zip(dict.fromkeys(record["dataset"] for record in peers), "os^D", strict=False))
    for i, name in enumerate(names):
        for record in (record for record in peers if record["learner"] == name):
            label = f"{name}, {record['dataset']}"
            pair = record["observe_ms"] + record["fresh_ms"]
            panel.scatter(
                pair, _percent(record), s=70, color=f"C{i % 10}", marker=markers[record["dataset"]], label=label
            )
    features = peers[0]["features"] if peers else ""
    panel.set(xlabel="ms an observation and the prediction that follows", title=f"the same {features} features for all")


def _percent(record: Mapping[str, Any]) -> float:
    # None wrong has no place on a logarithmic axis: it stands where a tenth of a percent is.
    return max(100.0 * float(record["wrong"]), 0.1)
