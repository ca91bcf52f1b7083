"""The README's tables of transfer, between tasks and across sensors, from their results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from examples.paper.tables.markdown import Read, table

__all__ = ["sensors", "tasks"]


_SHOWN = ("1", "5", "20")  # touches of each material, of the table of tasks


def tasks(read: Read) -> str:
    """A row for each embedding, a column for each data set; of its own training in brackets. Then how it was made."""
    result = read("transfer-tasks")
    found = {(row["system"], row["dataset"]): row for row in result["rows"]}
    systems = list(dict.fromkeys(system for system, _ in found))
    names = list(dict.fromkeys(name for _, name in found))
    lines = []
    for system in systems:
        cells = []
        for name in names:
            row = found[system, name]
            shares = " / ".join(_percent(row["points"].get(count)) for count in _SHOWN)
            cells.append(f"({shares})" if row["tuned on"] == name else shares)
        lines.append([system, *cells])
    trained = {cell.partition(",")[0]: one for cell, one in result["cells"].items() if "losses" in one}
    own = ", ".join(f"{name} {100 * one['right'] / one['tested']:.0f}" for name, one in trained.items())
    gains = [
        point["gain"] * 100
        for row in result["rows"]
        if row["tuned on"] not in (None, row["dataset"])
        for count, point in row["points"].items()
        if count in _SHOWN and point["gain"] is not None
    ]
    better = sum(gain > 1 for gain in gains)
    worse = sum(gain < -1 for gain in gains)
    epochs = result["epochs"]
    return (
        f"{table([_head(_SHOWN), *names], lines)}\n\n"
        f"Percent right on the test fold, mean of {result['draws']} draws of the touches. In brackets: fine-tuned on "
        f"all touches of that very task. Fine-tuned for {epochs} epoch{'s' * (epochs > 1)}, after which the networks "
        f"themselves have, on their own tests: {own}.\n"
        f"Against the vision model as it was, a network of another task is better by more than a point in {better} of "
        f"{len(gains)} cells, and worse in {worse}."
    )


def sensors(read: Read) -> str:
    """A row for each way, a column for each direction, with what the few touches alone have; and how far they agree."""
    result = read("transfer-sensors")
    directions = list(dict.fromkeys(row["direction"] for row in result["rows"]))
    found = {(row["way"], row["direction"]): row for row in result["rows"]}
    counts = [str(count) for count in result["counts"]]
    lines = []
    for way in dict.fromkeys(way for way, _ in found):
        points = [found[way, direction]["points"] for direction in directions]
        name = found[way, directions[0]]["name"]
        lines.append([name, *(" / ".join(_percent(own.get(count)) for count in counts) for own in points)])
    agreement = "; ".join(
        f"{kind} {one['correlation']:+.2f} (by chance ± {one['chance']:.2f})"
        for kind, one in result["agreement"].items()
    )
    return (
        f"{table([_head(counts), *directions], lines)}\n\n"
        f"Percent right, mean of {result['draws']} draws on each of {len(result['folds'])} folds; chance is "
        f"{100 * result['chance']:.0f}. Which materials feel alike to one sensor and which to the other, as a "
        f"correlation over pairs of materials: {agreement}."
    )


def _percent(point: Mapping[str, float] | None) -> str:
    return "–" if point is None else f"{100 * point['mean']:.0f}"


def _head(counts: Sequence[str]) -> str:
    return f"{' / '.join(counts)} touches of each material"
