"""README's tables of compositions and attributes, from the results of `scroll-tactile fabric`."""

from __future__ import annotations

from collections.abc import Mapping

from examples.paper.tables.markdown import Read, table

__all__ = ["attributes", "letters"]


_LETTERS = {
    "score": "mean score per dot",
    "exact": "all six dots right",
    "accuracy": "letter right, of 27",
    "untold": "per dot, not told whether the letter is new",
    "always": "per dot, always what is more common",
    "calibration_error": "expected calibration error of the dots",
}
_WAYS = {"ours": "ours", "untold": "… not told that it is new", "trees": "trees", "always": "most common grade"}


def letters(read: Read) -> str:
    """Known letters over folds, and letters never touched over groups: mean over touches ± standard deviation."""
    means = read("fabric-letters")["means"]
    kinds = [kind for kind in ("known", "never touched") if kind in means]
    rows = [[words, *(_cell(means[kind], figure, "sd") for kind in kinds)] for figure, words in _LETTERS.items()]
    # A letter never touched cannot be named.
    unnamed = [row if row[0] != _LETTERS["accuracy"] else [*row[:2], *[""] * (len(kinds) - 1)] for row in rows]
    return table(["Braille letters, percent", *(_titled(kind) for kind in kinds)], unnamed)


def attributes(read: Read) -> str:
    """Grades of materials left out: mean over materials ± standard error."""
    rows = [
        [f"{_NAMES.get(name, name)}, {attribute}", *(_cell(of, way, "error") for way in _WAYS)]
        for name, one in read("fabric-attributes")["sets"].items()
        for attribute, of in one["means"].items()
    ]
    return table(["grades right, of materials never touched, percent", *_WAYS.values()], rows)


_NAMES = {"biotac-20": "BioTac-20", "roboskin-20": "RoboSkin-20"}


def _titled(kind: str) -> str:
    return {"known": "known letters", "never touched": "letters never touched"}[kind]


def _cell(means: Mapping[str, Mapping[str, float]], figure: str, spread: str) -> str:
    one = means.get(figure)
    return "" if one is None else f"{100 * one['mean']:.1f} ± {100 * one[spread]:.1f}"
