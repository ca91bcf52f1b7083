"""The records of one run of a benchmark of calls, and how much of each it makes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["Bench", "Note", "Record", "Sides", "Sizes"]

Record = dict[str, Any]
Note = Callable[[str], object]
Sides = dict[str, Path]


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    touches: of the everyday memory, asked about `asked` others of each material. pairs: of an observation and a
    prediction. starts: processes that open it anew.
    materials: of the large memory, with so many touches `each`; before_materials: of the one that an older checkout is
    given, too. opening: touches of the memories that are opened; before_opening: the largest for an older checkout.
    """

    touches: int = 800
    asked: int = 10
    pairs: int = 200
    starts: int = 5
    materials: int = 10_000
    before_materials: int = 1_000
    each: int = 5
    opening: tuple[int, ...] = (10_000, 100_000)
    before_opening: int = 10_000


@dataclass
class Bench:
    """The records of one run, and what it is done with."""

    sides: Sides
    folder: Path
    sizes: Sizes
    seed: int
    note: Note
    records: list[Record] = field(default_factory=list)

    def only_now(self) -> Sides:
        """The checkout that is measured, without an older one."""
        return {"now": self.sides["now"]}

    def seconds(self, memory: str, case: str, taken: dict[str, list[float]], bar: str = "", **more: Any) -> None:
        """A record of calls' seconds by side, in milliseconds."""
        self._add(memory, case, "ms", {name: [1e3 * value for value in values] for name, values in taken.items()}, bar)
        self.records[-1] |= more

    def size(self, memory: str, case: str, unit: str, taken: dict[str, float], bar: str = "") -> None:
        """A record of one value a side."""
        self._add(memory, case, unit, {name: [value] for name, value in taken.items()}, bar)

    def _add(self, memory: str, case: str, unit: str, taken: dict[str, list[float]], bar: str) -> None:
        record: Record = {"memory": memory, "case": case, "unit": unit, "to_reach": bar}
        for name, values in taken.items():
            prefix = "" if name == "now" else f"{name}_"
            record[f"{prefix}median"] = float(np.median(values))
            record[f"{prefix}p99"] = float(np.percentile(values, 99)) if len(values) > 1 else None
            record[f"{prefix}largest"] = max(values)
            record[f"{prefix}calls"] = len(values)
        if "before" in taken:
            record["times"] = record["before_median"] / record["median"]
        self.records.append(record)
