"""Heads for objects never touched, over a memory's own statistics, with a λ that is chosen by leaving objects out.

`compose` takes over the shrinkage by which materials are classified, so that describing costs no factorisation. Where
objects are few and unlike each other a head wants a tamer one. Both λ, the ridge beside the scatter within objects, and
γ (see `readouts.attributes`) are those of least squared error on the class means of objects left out, one by one: of a
head that solves with B, the error of leaving object y out is α_y / B_yy, so no head is fitted twice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.readouts.attributes import GAMMAS, solve
from scroll_tactile.readouts.task import Task
from scroll_tactile.readouts.triangle import InverseTriangle
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["PENALTIES", "UnseenHead", "fit_heads"]

FloatArray = npt.NDArray[np.float64]

PENALTIES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""λ, as shares of a feature's mean variance within objects."""


@dataclass(frozen=True)
class UnseenHead:
    """A head for one attribute: how much speaks for each of its values.

    values: V of them. origin: (d,), in codes. weights: (d, V) of features about it; offsets: (V,). penalty: the
    chosen λ. gamma: the chosen γ. error: squared, of objects left out, summed.
    """

    values: tuple[int, ...]
    origin: FloatArray
    weights: FloatArray
    offsets: FloatArray
    penalty: float
    gamma: float
    error: float

    def __call__(self, mean: FloatArray) -> int:
        """The value that a touch feels like; mean: its mean features in grid units, (d,). Ties go to the first."""
        return self.values[int(np.argmax((mean - self.origin) @ self.weights + self.offsets))]


def fit_heads(
    statistics: Statistics, scale: Scale, attributes: Mapping[str, Mapping[str, int]], keys: Sequence[str]
) -> dict[str, UnseenHead]:
    """Attribute → its head over what was observed at a scale.

    attributes: material → attribute → value, of those that are known; of others there may be any.

    Raises InputError where fewer than two materials with known attributes were observed.
    """
    names = statistics.names(scale)
    places = np.array([i for i, name in enumerate(names) if name in attributes], dtype=np.intp)
    if len(places) < 2:
        raise InputError(f"expected two materials or more with known attributes; observed was {len(places)}")
    known = {key: np.array([attributes[names[i]][key] for i in places]) for key in keys}
    best: dict[str, UnseenHead] = {}
    with one_thread():
        task = Task.of(statistics, scale, names)
        means = task.sums[places] / task.counts[places, None] - task.origin
        variance = float(np.trace(task.scatter)) / len(task.origin)
        # From the tamest on: of equals the first stays.
        for penalty in sorted(PENALTIES, reverse=True):
            ridge = penalty * variance * np.eye(len(task.origin))
            solved = InverseTriangle(task.scatter + ridge).solve(means)
            for gamma in GAMMAS:
                system = solve(solved @ means.T, gamma)
                for key, truth in known.items():
                    values = np.unique(truth)
                    weights = system[:, :-1] @ (truth[:, None] == values).astype(np.float64)
                    missed = weights[:-1] / np.diagonal(system)[:-1, None]
                    error = float(np.square(missed).sum())
                    if key not in best or error < best[key].error:
                        answers = tuple(values.tolist())
                        slopes = solved.T @ weights[:-1]
                        best[key] = UnseenHead(answers, task.origin, slopes, weights[-1], penalty, gamma, error)
    return best
