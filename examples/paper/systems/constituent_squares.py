"""Systems that estimate what a touch is made of: their protocol, and the simplest of them, least squares.

Each learns touches by the fabric that they are of, as a `System` does, and knows from a `Shares` what fabrics are made
of; what is unknown of a fabric is left out of the constituent's targets, and is not a zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from examples.paper.systems.least_squares import PENALTIES, LeastSquares, Ridge, ridge
from examples.paper.systems.system_protocol import Watch, require_touches, silent, unwatched
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.training import Progress
from scroll_tactile.pipelines.classification import Labelled
from scroll_tactile.signals.stream import Stream

__all__ = ["ConstituentSquares", "ConstituentSystem", "Estimates", "Heads", "Shares"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Shares:
    """What fabrics are made of.

    names: K constituents. of: fabric → constituent → its share by mass, 0 where it is absent, None where it is unknown.
    """

    names: tuple[str, ...]
    of: Mapping[str, Mapping[str, float | None]]

    def masses(self, fabrics: Sequence[str]) -> FloatArray:
        """Shares, (N, K), of N fabrics; NaN where they are unknown."""
        rows = [[self.of[fabric][name] for name in self.names] for fabric in fabrics]
        return np.array(rows, dtype=np.float64).reshape(-1, len(self.names))  # None becomes NaN

    def presence(self, fabrics: Sequence[str]) -> FloatArray:
        """1 where a constituent is there, 0 where it is not, NaN where that is unknown; (N, K)."""
        masses = self.masses(fabrics)
        return np.where(np.isnan(masses), np.nan, masses > 0)


@dataclass(frozen=True)
class Estimates:
    """Estimates for N touches: probability of each of K constituents, and its share; (N, K), NaN where none is."""

    presence: FloatArray
    share: FloatArray


class ConstituentSystem(Protocol):
    """A system that estimates constituents."""

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    def fit(
        self,
        streams: Sequence[Stream],
        materials: Sequence[str],
        validation: Sequence[Labelled],
        seed: int,
        progress: Progress = silent,
        watch: Watch = unwatched,
    ) -> None:
        """As `System.fit`."""
        ...

    def estimate(self, streams: Sequence[Stream], progress: Progress = silent) -> Estimates:
        """What each stream is made of. Raises InputError before `fit`."""
        ...


class Heads:
    """Ridge heads of presences and of shares on features, each constituent's of the touches for which it is known.

    λ of the presences is what the validation has the best score with, that of the shares the least squared error, in
    each case the largest of equals, 1e-3 without validation; then all touches are learned.

    features: (N, d) of N touches of `fabrics`, and held: (M, d) of those of the validation, of `asked`.
    penalties: λ of presences and of shares.
    """

    def __init__(
        self, features: FloatArray, held: FloatArray, shares: Shares, fabrics: Sequence[str], asked: Sequence[str]
    ) -> None:
        self.penalties: list[float] = []
        self._heads: list[list[_Head | None]] = []
        rows = np.concatenate([features, held])
        for what, lost in ((shares.presence, _wrong), (shares.masses, _apart)):
            learned, tested = what(fabrics), what(asked)
            penalty = 1e-3
            if np.isfinite(tested).any():
                losses = [lost(_predict(_solved(features, learned, choice), held), tested) for choice in PENALTIES]
                penalty = max(choice for choice, loss in zip(PENALTIES, losses, strict=True) if loss == min(losses))
            self.penalties.append(penalty)
            self._heads.append(_solved(rows, np.concatenate([learned, tested]), penalty))

    def __call__(self, features: FloatArray) -> Estimates:
        """What touches of these features, (N, d), are made of; their shares sum to one."""
        presence, share = (_predict(heads, features) for heads in self._heads)
        total = share.sum(axis=1, keepdims=True)  # NaN where one is unknown: then they stay as they are
        return Estimates(presence, np.divide(share, total, out=share.copy(), where=total > 0))


_Head = tuple[Ridge, int]  # and which of its outputs


def _wrong(predicted: FloatArray, true: FloatArray) -> float:
    return float((((predicted > 0.5) != (true > 0)) & np.isfinite(true)).sum())


def _apart(predicted: FloatArray, true: FloatArray) -> float:
    return float(np.nansum(np.square(predicted - true)))


def _solved(features: FloatArray, wanted: FloatArray, penalty: float) -> list[_Head | None]:
    """A head for each constituent, None where nothing is known of it; those known of the same touches share a ridge."""
    known = np.isfinite(wanted)
    solved: dict[bytes, tuple[Ridge, list[int]]] = {}
    heads: list[_Head | None] = []
    for i in range(wanted.shape[1]):
        rows = known[:, i]
        if not rows.any():
            heads.append(None)
            continue
        if rows.tobytes() not in solved:
            same = (known == rows[:, None]).all(axis=0)
            model = ridge(features[rows], wanted[rows][:, same], penalty)
            solved[rows.tobytes()] = model, np.flatnonzero(same).tolist()
        model, places = solved[rows.tobytes()]
        heads.append((model, places.index(i)))
    return heads


def _predict(heads: Sequence[_Head | None], features: FloatArray) -> FloatArray:
    """Outputs between 0 and 1, (N, K), NaN where there is no head."""
    columns = [np.full(len(features), np.nan) if head is None else head[0](features)[:, head[1]] for head in heads]
    predicted: FloatArray = np.clip(np.stack(columns, axis=1), 0, 1)
    return predicted


class ConstituentSquares:
    """Ridge regression of presences and shares on a frozen network's features of the whole image.

    squares: whose features these are; what it has embedded it keeps. chosen: λ of presences and of shares.
    """

    def __init__(self, name: str, shares: Shares, squares: LeastSquares) -> None:
        self.name = name
        self.chosen: list[float] = []
        self._shares, self._squares = shares, squares
        self._heads: Heads | None = None

    def fit(
        self,
        streams: Sequence[Stream],
        materials: Sequence[str],
        validation: Sequence[Labelled],
        seed: int,
        progress: Progress = silent,
        watch: Watch = unwatched,
    ) -> None:
        """See `System.fit`; nothing is drawn, so the seed is of no effect."""
        require_touches(streams, materials, validation)
        features = self._squares.features(streams, progress)
        held = self._squares.features([stream for _, stream in validation], progress)
        self._heads = Heads(features, held, self._shares, materials, [name for name, _ in validation])
        self.chosen = self._heads.penalties

    def estimate(self, streams: Sequence[Stream], progress: Progress = silent) -> Estimates:
        """See `ConstituentSystem.estimate`."""
        if self._heads is None:
            raise InputError(f"{self.name} has learned nothing yet: call fit first")
        return self._heads(self._squares.features(streams, progress))
