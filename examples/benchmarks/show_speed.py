"""What `scroll-tactile bench speed` prints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table

from scroll_tactile.cli.terminal import console, percent, say

__all__ = ["show_speed"]

Records = Sequence[Mapping[str, Any]]


def show_speed(result: Mapping[str, Any]) -> None:
    """Print the ratios, and of recorded touches the frontier, the peers and the knee."""
    table = Table("what", "ms", "beside", "ms", "ratio", "bar", "error")
    for record in result["records"]:
        table.add_row(
            record["case"],
            f"{record['milliseconds']:.2f}",
            record["against"],
            f"{record['against_milliseconds']:.2f}",
            f"{record['ratio']:.2f}",
            record["bar"],
            record["error"],
        )
    console().print(table)
    if "frontier" in result:
        _show_frontier(result["frontier"])
        _show_peers(result["peers"])
        _show_knee(result["knee"])


def _show_frontier(records: Records) -> None:
    table = Table("set", "features", "readout", "asked about", "wrong", "ms observe", "ms predict", "ms first predict")
    for record in records:
        table.add_row(
            record["dataset"],
            str(record["width"]),
            record["readout"],
            "whole touches" if record["length"] == "all" else record["length"],
            percent(record["wrong"]),
            *(f"{record[name]:.2f}" for name in ("observe_ms", "predict_ms", "first_predict_ms")),
        )
    console().print(table)


def _show_peers(records: Records) -> None:
    table = Table(
        "set", "learner of the same features", "wrong", "ms observe", "ms predict", "ms predict after observe"
    )
    for record in records:
        if record["measured"]:
            times = (f"{record[name]:.3f}" for name in ("observe_ms", "predict_ms", "fresh_ms"))
            table.add_row(record["dataset"], record["learner"], percent(record["wrong"]), *times)
        else:
            table.add_row(record["dataset"], record["learner"], f"not measured: {record['why']}")
    console().print(table)


def _show_knee(knee: Mapping[str, Any]) -> None:
    for step in knee["steps"]:
        say(
            f"{step['width']} features: {percent(step['wrong'])} wrong (± {percent(step['standard_error'])}), "
            f"{step['predict_ms']:.2f} ms; wider ones take away {percent(step['gained_by_wider'])} at most"
        )
    say(
        f"the knee is at {knee['width']} features, from where no wider embedding gains more than the standard error; "
        f"the default has {knee['default']}"
    )
