"""Files of Rerun, read again by its own reader."""

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

pytest.importorskip("rerun", reason="the extra rerun is not installed")


class Row(NamedTuple):
    """A row of an entity: its times by timeline (seconds, or a number), and what was logged, by component."""

    times: dict[str, float]
    values: dict[str, Any]


def rows(path: Path) -> dict[str, list[Row]]:
    """Entity → its rows in the order of their times; static ones first."""
    from rerun.chunk import RrdReader

    found: dict[str, list[Row]] = defaultdict(list)
    for chunk in RrdReader(path).stream():
        timelines = set(chunk.timeline_names)
        for row in chunk.to_record_batch().to_pylist():
            times = {name: _number(value) for name, value in row.items() if name in timelines and value is not None}
            values = {name: value for name, value in row.items() if name not in timelines and value is not None}
            found[chunk.entity_path].append(Row(times, values))
    return {path: sorted(own, key=lambda row: sorted(row.times.items())) for path, own in found.items()}


def scalars(found: dict[str, list[Row]], path: str, timeline: str) -> list[tuple[float, list[float]]]:
    """(time, values) of what was logged as Scalars."""
    return [
        (row.times[timeline], row.values["Scalars:scalars"])
        for row in found.get(path, [])
        if "Scalars:scalars" in row.values
    ]


def tensors(found: dict[str, list[Row]], path: str) -> list[np.ndarray]:
    """What was logged as Tensor, in order."""
    return [_array(row.values["Tensor:data"][0]) for row in found.get(path, []) if "Tensor:data" in row.values]


def texts(found: dict[str, list[Row]], path: str) -> list[str]:
    """What was logged as text, in order."""
    return [row.values["TextLog:text"][0] for row in found.get(path, []) if "TextLog:text" in row.values]


def _array(value: dict[str, Any]) -> np.ndarray:
    buffer = value["buffer"]
    if isinstance(buffer, dict):
        buffer = next(own for own in buffer.values() if own is not None)
    return np.array(buffer).reshape(value["shape"])


def _number(value: Any) -> float:
    if hasattr(value, "total_seconds"):
        return float(value.total_seconds())
    return float(value.timestamp()) if hasattr(value, "timestamp") else float(value)


def colours(found: dict[str, list[Row]], paths: Iterable[str]) -> list[int]:
    """The colour of each of these lines, or of its points, as it was logged."""
    return [
        value[0]
        for path in paths
        for row in found[path]
        for name, value in row.values.items()
        if name in ("SeriesLines:colors", "SeriesPoints:colors")
    ]
