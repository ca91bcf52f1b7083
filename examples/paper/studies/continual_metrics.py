"""The field's metrics of continual learning, of what was counted on the way.

>>> forgetting([{"felt": 1.0}, {"felt": 0.75, "silk": 1.0}, {"felt": 0.5, "silk": 1.0, "wool": 1.0}])
0.25
>>> backward_transfer([{"felt": 1.0}, {"felt": 0.75, "silk": 0.5}, {"felt": 0.5, "silk": 1.0, "wool": 1.0}])
0.0
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from scroll_tactile.clients.learning.metrics import mean_and_spread
from scroll_tactile.errors import InputError

__all__ = [
    "METRICS",
    "Point",
    "Points",
    "accuracy_of",
    "anytime_area",
    "backward_transfer",
    "curve",
    "forgetting",
    "forgetting_of",
    "method_row",
    "metrics_of",
    "spread_of",
    "tally",
]

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


METRICS = ("last", "average", "anytime", "forgetting", "backward_transfer")
"""Of a pass: A_last, accuracy at its end; A_avg, the mean over the ends of tasks; A_AUC, see `anytime_area`; and
`forgetting` and `backward_transfer` between the ends of tasks. Accuracy is of the materials met by then."""


def anytime_area(curve: Sequence[tuple[int, float]]) -> float:
    """A_AUC = Σ a_i Δn_i / n: accuracy a_i after n_i touches, for the Δn_i since the last (Koh et al. 2022).

    curve: (touches learned, accuracy), in order; the last is the end of the pass. The sum is arXiv 2110.10031's, with
    steps that may differ. Raises InputError for no points, or touches that do not ascend from 1.
    """
    touches = [0, *(learned for learned, _ in curve)]
    steps = [after - before for before, after in pairwise(touches)]
    if not steps or min(steps) < 1:
        raise InputError(f"expected accuracies after ascending numbers of touches; came {touches[1:]}")
    return sum(share * step for (_, share), step in zip(curve, steps, strict=True)) / touches[-1]


def backward_transfer(shares: Sequence[Mapping[str, float]]) -> float | None:
    """Mean over materials of the final accuracy less that at the end of the task it was first met in.

    BWT of Lopez-Paz and Ranzato 2017 (arXiv 1706.08840), by material where theirs is by task: above 0 where what came
    later helped. Materials of the last task are left out.

    shares: material → accuracy, at the end of each task. None where no material was met before the last. Raises
    InputError where a material is no longer tested at the last moment, or there is no moment.
    """
    if not shares:
        raise InputError("expected accuracies at one moment at least; came none")
    *earlier, final = shares
    first: dict[str, float] = {}
    for moment in earlier:
        first = {**moment, **first}
    if first.keys() - final.keys():
        raise InputError(f"expected final accuracies of all materials; missing: {sorted(first.keys() - final.keys())}")
    return sum(final[name] - share for name, share in first.items()) / len(first) if first else None


def metrics_of(points: Points, ends: Sequence[int]) -> dict[str, float | None]:
    """METRICS of what was answered after so many touches. ends: of the tasks, each of them among the points."""
    curve = [(int(key), accuracy_of(points[key])) for key in sorted(points, key=int)]
    at_ends = {str(end): points[str(end)] for end in sorted(ends)}
    shares = [{name: right / tested for name, (right, tested) in point.items()} for point in at_ends.values()]
    return {
        "last": curve[-1][1],
        "average": sum(map(accuracy_of, at_ends.values())) / len(at_ends),
        "anytime": anytime_area(curve),
        "forgetting": forgetting_of(at_ends),
        "backward_transfer": backward_transfer(shares),
    }


def method_row(method: str, size: str | None, folds: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What the folds of a method, with a size of its buffer, have in the mean."""
    moments = zip(*(fold["curve"] for fold in folds), strict=True)
    return {
        "method": method,
        "size": size,
        "accuracy": spread_of([fold["accuracy"] for fold in folds]),
        "forgetting": spread_of([fold["forgetting"] for fold in folds]),
        # Folds of a set that is not balanced may have met other numbers of materials by then: the mean of these too.
        "curve": [[sum(column) / len(folds) for column in zip(*moment, strict=True)] for moment in moments],
    }


def spread_of(values: Sequence[float | None]) -> dict[str, float] | None:
    """Mean and standard deviation over folds, None where one has none."""
    known = [value for value in values if value is not None]
    if not known or len(known) < len(values):
        return None
    mean, spread = mean_and_spread(known)
    return {"mean": mean, "sd": spread}
