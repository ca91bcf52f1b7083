"""The field's metrics of continual learning, of what was counted on the way: see `examples.paper.studies.continual`.

>>> backward_transfer([{"felt": 1.0}, {"felt": 0.75, "silk": 0.5}, {"felt": 0.5, "silk": 1.0, "wool": 1.0}])
0.0
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

from examples.paper.studies.continual import Points, accuracy_of, forgetting_of
from scroll_tactile.errors import InputError

__all__ = ["METRICS", "anytime_area", "backward_transfer", "metrics"]

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


def metrics(points: Points, ends: Sequence[int]) -> dict[str, float | None]:
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
