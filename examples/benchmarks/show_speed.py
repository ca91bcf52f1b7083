"""What the benchmarks of speed print: medians, and the 99th percentile behind a stroke."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table

from scroll_tactile.cli.terminal import console, percent, say

__all__ = ["show_frontier", "show_interleaved", "show_speed", "show_vision"]

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
    """Print what each case takes, what it stands beside, and the ratio of the medians."""
    table = Table("what", "clock", "ms, median / p99", "beside", "ms", "ratio", "bar", "error")
    for record in result["records"]:
        ratio = f"{record['ratio']:.2f}"
        times = _times(record), record["against"], _times(record, "against_"), ratio
        table.add_row(record["case"], record["clock"], *times, record["bar"], record["error"])
    _print(table)
    if "before" in result:
        head = ("what", "clock", "ms now", "ms before", "ratio", "of processor time")
        table = Table(*head, title="this checkout beside the one before")
        for record in result["before"]:
            ratio = f"{record['ratio']:.2f}"
            both = _times(record), _times(record, "before_")
            table.add_row(record["case"], record["clock"], *both, ratio, f"{record['processor_ratio']:.2f}")
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
    """Print what a pair of an observation and a prediction takes each learner, and whether anything drifted."""
    title = f"{result['streams']} streams, {result['materials']} materials, {result['features']} features"
    head = ("ms a pair, median / p99", "mean", "times ours", "observe", "predict", "wrong")
    table = Table("learner", *head, title=title)
    for record in result["records"]:
        if not record["measured"]:
            table.add_row(record["learner"], f"not measured: {record['why']}")
            continue
        means = f"{record['mean_milliseconds']:.2f}", f"{record['times_ours']:.1f}"
        parts = _times(record, "observe_"), _times(record, "predict_")
        table.add_row(record["learner"], _times(record), *means, *parts, percent(record["wrong"]))
    _print(table)
    drift = result["drift"]
    say(
        f"after {drift['interleavings']} interleavings the weights differ from those solved anew by "
        f"{drift['largest_relative_difference']:.0e} at most; by the paper's recursion {drift['of_the_recursion']:.0e}"
    )


def show_frontier(result: Record) -> None:
    """Print the frontier, the peers and the knee."""
    _show_widths(result["frontier"])
    _show_peers(result["peers"])
    _show_knee(result["knee"])


def _show_widths(records: Sequence[Record]) -> None:
    table = Table("set", "features", "readout", "evaluated on", "wrong", "ms observe", "ms predict", "ms first predict")
    for record in records:
        table.add_row(
            record["dataset"],
            str(record["width"]),
            record["readout"],
            "whole touches" if record["length"] == "all" else record["length"],
            percent(record["wrong"]),
            *(f"{record[name]:.2f}" for name in ("observe_ms", "predict_ms", "first_predict_ms")),
        )
    _print(table)


def _show_peers(records: Sequence[Record]) -> None:
    table = Table(
        "set", "learner of the same features", "wrong", "ms observe", "ms predict", "ms predict after observe"
    )
    for record in records:
        if record["measured"]:
            times = (f"{record[name]:.3f}" for name in ("observe_ms", "predict_ms", "fresh_ms"))
            table.add_row(record["dataset"], record["learner"], percent(record["wrong"]), *times)
        else:
            table.add_row(record["dataset"], record["learner"], f"not measured: {record['why']}")
    _print(table)


def _show_knee(knee: Record) -> None:
    for step in knee["steps"]:
        say(
            f"{step['width']} features: {percent(step['wrong'])} wrong (± {percent(step['standard_error'])}), "
            f"{step['predict_ms']:.2f} ms; wider ones take away {percent(step['gained_by_wider'])} at most"
        )
    say(
        f"the knee is at {knee['width']} features, from where no wider embedding gains more than the standard error; "
        f"the default has {knee['default']}"
    )
