"""The README's section on cameras, from the results of `fabric gelsight` and `reproduce table1 --sets gelsight`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

__all__ = ["cameras"]

Result = dict[str, Any]
Means = Mapping[str, Mapping[str, float]]

KNOWN = "known, counts", "known, network"
ATTRIBUTES = ("hardness", "roughness", "texture")


def cameras(read: Callable[[str], Result]) -> str:
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
    rows = [
        (name, *(new.get(name + what) for what in ("", ", composed", ", trees", ", always"))) for name in ATTRIBUTES
    ]
    return (
        _table(("percent right, by video", "`Frames()`", "`Frames(weights)`", "trees on the same counts"), known)
        + f"\n\n{objects} objects, {result['groups']} groups of them left out in turn:\n\n"
        + _table(("percent right, by video", "heads", "`compose`", "trees on the counts", "always the commonest"), rows)
    )


def _table(head: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    lines = [head, ("---",) * len(head), *((name, *map(_cell, figures)) for name, *figures in rows)]
    return "\n".join("|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|" for cells in lines)


def _cell(figure: Mapping[str, float] | None) -> str:
    return "" if figure is None else f"{100 * figure['mean']:.1f} ± {100 * figure['sd']:.1f}"
