"""How accuracy went during a pass, material by material, and what was forgotten by its end.

>>> forgetting([{"felt": 1.0}, {"felt": 0.75, "silk": 1.0}, {"felt": 0.5, "silk": 1.0, "wool": 1.0}])
0.25
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from scroll_tactile.errors import InputError
from scroll_tactile.pipelines.metrics import mean_and_spread

__all__ = ["Point", "Points", "accuracy_of", "curve", "forgetting", "forgetting_of", "summary", "tally"]

Point = dict[str, list[int]]
"""At one moment: material → [right answers, answers]."""

Points = dict[str, Point]
"""Touches learned so far (a string: JSON has no other keys) → what was answered then."""


def forgetting(shares: Sequence[Mapping[str, float]]) -> float | None:
    """Mean over materials of the best earlier accuracy less the final one (Chaudhry et al. 2018, arXiv 1801.10112).

    F = mean_j (max_{l < k} a_{l,j} − a_{k,j}), over all materials j that were tested before the last moment k:
    class by class all but the last. Below 0 where what was learned later helped.

    shares: material → accuracy on it, from 0 to 1, at successive moments. None where no material was tested
    earlier. Raises InputError where a material is no longer tested at the last moment, or there is no moment.
    """
    if not shares:
        raise InputError("expected accuracies at one moment at least; came none")
    *earlier, final = shares
    best: dict[str, float] = {}
    for moment in earlier:
        for material, share in moment.items():
            best[material] = max(best.get(material, share), share)
    if best.keys() - final.keys():
        raise InputError(f"expected final accuracies of all materials; missing: {sorted(best.keys() - final.keys())}")
    if not best:
        return None
    return sum(share - final[material] for material, share in best.items()) / len(best)


def tally(truth: Sequence[str], predicted: Sequence[str | None]) -> Point:
    """Count right answers by material. Raises InputError where there are not as many answers as truths."""
    if len(truth) != len(predicted):
        raise InputError(f"expected as many answers as truths; came {len(predicted)} and {len(truth)}")
    point: Point = {}
    for name, answer in zip(truth, predicted, strict=True):
        counts = point.setdefault(name, [0, 0])
        counts[0] += answer == name
        counts[1] += 1
    return point


def accuracy_of(point: Point) -> float:
    """The share of right answers at one moment."""
    return sum(right for right, _ in point.values()) / sum(tested for _, tested in point.values())


def curve(points: Points) -> list[list[float]]:
    """[materials learned, accuracy over them] at each moment, in the order of learning."""
    return [[len(points[key]), accuracy_of(points[key])] for key in sorted(points, key=int)]


def forgetting_of(points: Points) -> float | None:
    """`forgetting` of counts."""
    ordered = [points[key] for key in sorted(points, key=int)]
    return forgetting([{name: right / tested for name, (right, tested) in point.items()} for point in ordered])


def summary(folds: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row for each method and size of the buffer: means and standard deviations over the folds.

    folds: the figures of each, as `examples.paper` notes them. A row has the method, its size (None: it has no
    buffer), accuracy and forgetting as {"mean", "sd"} (None: not measured), and the mean curve. Rows of
    `f*` also hold how many folds kept theirs, and the mean seconds of a fine-tune, exemplars, and bytes of one.
    """
    if not folds:
        return []
    rows = [_row("f", None, [fold["f"] for fold in folds])]
    for size in folds[0]["tuned"]:
        parts = [fold["tuned"][size] for fold in folds]
        measured = {
            name: _spread([part.get(name) for part in parts]) for name in ("seconds", "exemplars", "bytes_per_exemplar")
        }
        rows.append(_row("f*", size, parts) | measured | {"kept": sum(part["kept"] for part in parts)})
    floor = [{"accuracy": fold["ridge"], "forgetting": None, "curve": []} for fold in folds]
    rows.append(_row("ridge", None, floor))
    for peer in zip(*(fold["peers"] for fold in folds), strict=True):
        rows.append(_row(peer[0]["peer"], peer[0]["size"], peer))
    return rows


def _row(method: str, size: str | None, parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    moments = zip(*(part["curve"] for part in parts), strict=True)
    return {
        "method": method,
        "size": size,
        "accuracy": _spread([part["accuracy"] for part in parts]),
        "forgetting": _spread([part["forgetting"] for part in parts]),
        # Folds of a set that is not balanced may have met other numbers of materials by then: the mean of these too.
        "curve": [[sum(column) / len(parts) for column in zip(*moment, strict=True)] for moment in moments],
    }


def _spread(values: Sequence[float | None]) -> dict[str, float] | None:
    known = [value for value in values if value is not None]
    if not known or len(known) < len(values):
        return None
    mean, spread = mean_and_spread(known)
    return {"mean": mean, "sd": spread}
