"""What the benchmarks of speed print: medians, and the 99th percentile behind a stroke."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.table import Table

from scroll_tactile.cli.terminal import console, percent, say

__all__ = ["show_interleaved", "show_speed", "show_vision"]

Record = Mapping[str, Any]
WIDE = 160  # characters that the widest table takes


def _times(record: Record, prefix: str = "") -> str:
    """Median and p99, in milliseconds."""
    return f"{record[f'{prefix}median_milliseconds']:.2f} / {record[f'{prefix}p99_milliseconds']:.2f}"


def _print(table: Table) -> None:
    # Cut off at 80 columns, as for want of a terminal's width, it would show nothing.
    screen = console()
    screen.width = max(WIDE, screen.width)
    screen.print(table)


def show_speed(result: Record) -> None:
    """Print what each case takes, before and after where there was a before, and of a bare forward pass."""
    table = Table("memory", "case", "", "now", "p99", "before", "p99", "times", "of a ResNet-18", "to reach")
    for record in result["records"]:
        values = (record.get(name) for name in ("median", "p99", "before_median", "before_p99", "times", "of_forward"))
        cells = ["" if value is None else f"{value:.4g}" for value in values]
        table.add_row(record["memory"], record["case"], record["unit"], *cells, record["to_reach"])
    _print(table)


def show_vision(result: Record) -> None:
    """Print what each way to run the network takes, and of a bare pass how much that is."""
    table = Table("what", "image", "ms, median / p99", "ratio", "to one thread", "error of features")
    for record in result["records"]:
        error = record["relative_error"]
        ratios = f"{record['ratio']:.2f}", f"{record['ratio_to_one_thread']:.2f}"
        said = "" if error is None else f"{error:.1e}"
        table.add_row(record["case"], record["image"], _times(record), *ratios, said)
    _print(table)
    for name, share in result["accuracy"].items():
        say(f"RoboSkin-20, fold 0, {name}: {percent(share)}")


def show_interleaved(result: Record) -> None:
    """Print what a pair of an observation and a prediction takes each learner, and of ours how much that is."""
    title = f"{result['streams']} streams, {result['materials']} materials, {result['features']} features"
    head = ("ms a pair, median / p99", "mean", "times ours", "… in memory", "observe", "predict", "wrong")
    table = Table("learner", *head, title=title)
    for record in result["records"]:
        if not record["measured"]:
            table.add_row(record["learner"], f"not measured: {record['why']}")
            continue
        means = (f"{record[name]:.2f}" for name in ("mean_milliseconds", "times_ours", "times_ours_in_memory"))
        parts = _times(record, "observe_"), _times(record, "predict_")
        table.add_row(record["learner"], _times(record), *means, *parts, percent(record["wrong"]))
    _print(table)
