"""The README's section on cameras, from the results of `fabric gelsight` and `reproduce table1 --sets gelsight`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from examples.paper.tables.markdown import Read, spread, table

__all__ = ["cameras"]

Means = Mapping[str, Mapping[str, float]]

KNOWN = "known, counts", "known, network"
ATTRIBUTES = ("hardness", "roughness", "texture")


def cameras(read: Read) -> str:
    """Two tables: objects that were touched, told by video, and attributes of objects never touched."""
    result = read("gelsight-objects")
    means: Mapping[str, Means] = result["means"]
    counts, network = (means.get(name, {}) for name in KNOWN)
    known = [
        ("a video's frames together", counts.get("video"), network.get("video"), counts.get("trees")),
        ("the majority of its frames", counts.get("vote"), network.get("vote"), counts.get("trees' vote")),
        ("a single frame", counts.get("frame"), network.get("frame"), None),
    ]
    objects = len({name for one in result["parts"] for name in one.get("objects", ())})
    new = means["never touched"]
    ways = ("", ", composed", ", trees", ", always")
    rows = [(name, *(new.get(name + what) for what in ways)) for name in ATTRIBUTES]
    return (
        table(("percent right, by video", "`Frames()`", "`Frames(weights)`", "trees on the same counts"), _shown(known))
        + f"\n\n{objects} objects, {result['groups']} groups of them left out in turn:\n\n"
        + table(
            ("percent right, by video", "heads", "`compose`", "trees on the counts", "always the commonest"),
            _shown(rows),
        )
    )


def _shown(rows: Iterable[tuple[Any, ...]]) -> list[tuple[str, ...]]:
    return [(name, *map(_cell, figures)) for name, *figures in rows]


def _cell(figure: Mapping[str, float] | None) -> str:
    return "" if figure is None else spread(figure)
