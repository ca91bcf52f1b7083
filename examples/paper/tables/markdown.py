"""How the README's tables are written: a result read by its name, and a table in Markdown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

__all__ = ["Read", "Result", "spread", "table"]

Result = dict[str, Any]
Read = Callable[[str], Result]
"""The name of a file of results, without its ending → what it holds."""


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table with a line for each row."""
    lines = ["|" + "|".join(f" {cell} " if cell else " " for cell in line) + "|" for line in [head, *rows]]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:]])


def spread(figure: Mapping[str, float], times: float = 100.0, digits: int = 1) -> str:
    """A mean and its standard deviation, as percentages unless said otherwise."""
    return f"{times * figure['mean']:.{digits}f} ± {times * figure['sd']:.{digits}f}"
