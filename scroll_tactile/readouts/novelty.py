"""Novelty: how unlike the known touches one is, and from where on it is called new.

Its measures are relative Mahalanobis distances (Ren et al. 2021), and u, which sees features in which no material
differs: a local outlier factor (Breunig, Kriegel, Ng and Sander 2000), with s the sampled touch nearest to x, N(s) the
five nearest others of s and |·| a distance by diagonal scatter,

    u(x) = log |x − s| − log mean_{r in N(s)} |s − r|.

Thresholds are conformal quantiles of the novelty of held-out touches (Vovk et al. 2005).
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.leave_one_out import Sampled, StageScores, rows_at
from scroll_tactile.readouts.readout import Readout
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import one_thread

__all__ = ["FEWEST", "TINY", "UNMEASURED", "Neighbours", "NoveltyThresholds", "novelty_measures"]

FloatArray = npt.NDArray[np.float64]

FEWEST = 8  # held-out touches; with fewer, a stage keeps the threshold and the spreads set beforehand
UNMEASURED = 5.0  # spreads: where too few could be held out to measure the distances of known touches
OWN = 2.0  # held-out touches expected above a material's own threshold
NEAREST = 5  # sampled touches around the nearest one; with 1, 3 or 10 it told new touches as well
TINY = 1e-300


@dataclass(frozen=True)
class NoveltyThresholds:
    """Up to which novelty a touch counts as one of its material, and below which as one that is known.

    A material has a threshold of its own where OWN of its held-out touches are expected above it, 40 at 5 %. The others
    share one in which each material counts alike, or one of hundreds of touches would set it. Both hold for touches
    that are exchangeable with the sampled ones: not for another run, speed or sensor.

    names: the materials, ascending. targets: the place of each held-out touch's material among them, (N,). novelties:
    of these touches, (N,). if_new: the same had their own materials never been observed, (N,).
    """

    names: Sequence[str] = ()
    targets: npt.NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    novelties: FloatArray = field(default_factory=lambda: np.zeros(0))
    if_new: FloatArray = field(default_factory=lambda: np.zeros(0))

    def above(self, material: str, false_alarms: float) -> float:
        """Above which novelty a touch that is answered `material`, or "" for any, is new, as false alarms are."""
        if len(self.novelties) < FEWEST:
            return UNMEASURED
        if (material, false_alarms) not in self._found:
            own = self.novelties[self.targets == (self.names.index(material) if material in self.names else -1)]
            if len(own) * false_alarms >= OWN:
                found = _conformal(own, np.ones(len(own)), false_alarms)
            else:
                found = min(_conformal(self.novelties, self._alike, false_alarms), 2 * float(self.novelties.max()))
            self._found[material, false_alarms] = found
        return self._found[material, false_alarms]

    def below(self, false_alarms: float) -> float:
        """Below which novelty a touch is known: no larger a share of new ones lies there; -inf where none was tried."""
        if (None, false_alarms) not in self._found:
            several = len(set(self.targets.tolist())) > 1
            found = -_conformal(-self.if_new, self._alike, false_alarms) if several else -np.inf
            self._found[None, false_alarms] = found
        return self._found[None, false_alarms]

    def detects(self, false_alarms: float) -> bool:
        """Whether most touches would lie above the shared threshold, had their materials never been observed."""
        return np.isfinite(self.below(false_alarms)) and float(np.median(self.if_new)) > self.above("", false_alarms)

    @cached_property
    def _alike(self) -> FloatArray:
        """Weights of the touches, each material's of one sum and all together of N."""
        counts = np.bincount(self.targets)
        return np.asarray(len(self.targets) / (np.count_nonzero(counts) * counts[self.targets]))

    @cached_property
    def _found(self) -> dict[tuple[str | None, float], float]:
        """What was asked for before, for every answer asks for the same; None: of `below`."""
        return {}


def _conformal(values: FloatArray, weights: FloatArray, share: float) -> float:
    """The least value above which no more than this share of the weight lies, with a new one's of 1; inf if none is.

    Of equal weights it is the conformal quantile; weighted: Tibshirani, Foygel Barber, Candès and Ramdas 2019.
    """
    order = np.argsort(-values, kind="stable")
    above = np.concatenate([[0.0], np.cumsum(weights[order])[:-1]])
    allowed = share * (weights.sum() + 1) - 1
    within = int(np.count_nonzero(above <= allowed + 1e-9 * weights.sum()))
    return float(values[order[within - 1]]) if within else np.inf


class Neighbours:
    """The rows of one scale that sampled touches have at one stage, among which a touch lies near one or near none.

    Rows are scaled to a spread of 1 within materials and held in single precision: 1 MB of 256 touches.
    stages: the scales that judge at each. places: of the touches among the sample that have such a row, ascending.
    names: their materials.
    """

    def __init__(self, readout: Readout, sample: Sampled, stages: Sequence[Sequence[Scale]], stage: int) -> None:
        self._origin, self._unit = readout.origin, np.sqrt(readout.precision)
        self._stages, self._scale, self._stage = stages, readout.scale, stage
        self.places, self.names, self._rows = self._of(sample)
        self._sizes = np.square(self._rows).sum(axis=1)
        # Nearer than it is rounded no distance is told from 0.
        self._least = max(1e-6 * float(self._sizes.mean()), TINY) if self.names else TINY

    def _of(self, sample: Sampled) -> tuple[list[int], list[str], npt.NDArray[np.float32]]:
        """The places of touches that have such a row, their materials, and the scaled rows, (N, d)."""
        found = [
            (place, material, touch.rows[row])
            for place, (material, _, touch) in enumerate(sample)
            for row in rows_at(touch, self._stages, self._scale)
            if touch.pairs[row, 0] == self._stage
        ]
        rows = np.array([row for *_, row in found], dtype=np.int32).reshape(len(found), len(self._origin))
        return [place for place, *_ in found], [material for _, material, _ in found], self._scaled(rows)

    def extended(self, sample: Sampled) -> Neighbours:
        """These and touches that were sampled since, never held out."""
        other, (_, names, rows) = copy.copy(self), self._of(sample)
        other.names, other._rows = [*self.names, *names], np.concatenate([self._rows, rows])
        other._sizes = np.concatenate([self._sizes, np.square(rows).sum(axis=1)])
        return other

    def novelty(self, features: FloatArray, names: Collection[str] | None = None) -> float:
        """u of features in grid units, (d,). names: materials of whose touches one is the nearest; all unless given."""
        away = self._distances(self._scaled(features[None]))
        if names is not None:
            away[0, [name not in names for name in self.names]] = np.inf
        return float(self._local(away, lambda near: self._distances(self._rows[near]))[0])

    def held_out(self, places: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """u of N sampled touches at these places, each left out, and without all touches of their materials, (N,)."""
        between, at = self._distances(self._rows), np.searchsorted(self.places, places)
        kinds = np.unique(self.names, return_inverse=True)[1]
        itself, alike = at[:, None] == np.arange(len(between)), kinds[at][:, None] == kinds
        known, new = (self._local(np.where(out, np.inf, between[at]), between.__getitem__) for out in (itself, alike))
        return known, new

    def _local(self, seen: FloatArray, between: Callable[[npt.NDArray[np.intp]], FloatArray]) -> FloatArray:
        """u by distances from the rows, (N, M), infinite from those left out; between: those of some rows from all."""
        rows, near = np.arange(len(seen)), seen.argmin(axis=1)
        around = np.where(np.isinf(seen), np.inf, between(near))
        around[rows, near] = np.inf
        nearest = np.sort(np.partition(around, min(NEAREST, len(self.names) - 1), axis=1)[:, :NEAREST], axis=1)
        count = np.isfinite(nearest).sum(axis=1)
        total = np.where(np.isfinite(nearest), nearest, 0.0).sum(axis=1)
        mean = np.divide(total, count, out=np.ones(len(seen)), where=count > 0)
        return np.asarray(np.log(np.where(count > 0, seen[rows, near], 1.0) / mean))  # 0 where all but one are left out

    def _scaled(self, features: npt.NDArray[np.number]) -> npt.NDArray[np.float32]:
        return np.asarray((features - self._origin) * self._unit, dtype=np.float32)

    def _distances(self, rows: npt.NDArray[np.float32]) -> FloatArray:
        """Distances of scaled rows (N, d) from all rows, (N, M)."""
        with one_thread():
            products = rows @ self._rows.T
        squares = np.square(rows).sum(axis=1)[:, None] + self._sizes - 2 * products
        return np.asarray(np.sqrt(np.maximum(squares, self._least, dtype=np.float64)))


def novelty_measures(found: StageScores, neighbours: Sequence[Neighbours]) -> tuple[FloatArray, FloatArray]:
    """The least distance at each scale that measures novelty, then u among neighbours, of N held-out touches, (N, S').

    And the same had their own materials never been observed.
    """
    local = [each.held_out(found.places) for each in neighbours]
    known, new = found.distances().min(axis=2, initial=np.inf), found.distances_if_new()
    return np.column_stack([known, *(u for u, _ in local)]), np.column_stack([new, *(u for _, u in local)])
