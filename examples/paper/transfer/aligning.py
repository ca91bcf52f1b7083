"""Ways to classify touches of a new sensor with what was learned by an old one, and few touches of the new."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve

from examples.paper.transfer.shared_features import Features
from scroll_tactile.errors import InputError
from scroll_tactile.readouts.readout import Readout
from scroll_tactile.readouts.task import Task
from scroll_tactile.signals.stream import Stream
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import in_units, to_codes
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["Known", "MapsAcross", "OneReadout", "SharesPrior"]

FloatArray = npt.NDArray[np.float64]
WHOLE = Scale("window", 1)  # features of a touch as a whole: one row each

_BOUND = 8.0  # of standardised features, in standard deviations
_OLD = "\0old "  # before the names of materials that are not to be answered
_RIDGE = 0.01  # λ of a map, as a share of the mean squared length of what is mapped
_SHRINKAGE = 0.03  # λ of Σ in whitening, of unit variances
_SPREAD = 0.3  # variance of one touch about its material's mean, as a share of that of the means


@dataclass(frozen=True)
class Known:
    """What was learned with the old sensor: features (N, d) and their materials."""

    features: FloatArray
    materials: list[str]

    @cached_property
    def standardised(self) -> FloatArray:
        """The features, each of mean 0 and variance 1, (N, d)."""
        return _Standard(self.features)(self.features)

    def statistics(self, before: str = "") -> Statistics:
        """What the library keeps of the standardised features; `before` goes before the materials' names."""
        if before not in self._statistics:
            names = [before + name for name in self.materials]
            self._statistics[before] = _statistics(self.standardised, names)
        return self._statistics[before]

    @cached_property
    def _statistics(self) -> dict[str, Statistics]:
        return {}

    @cached_property
    def names(self) -> list[str]:
        """The materials, each once, in alphabetical order."""
        return sorted(set(self.materials))

    @cached_property
    def means(self) -> FloatArray:
        """Means of the standardised features of `names`, (C, d)."""
        return _means(self.standardised, self.materials, self.names)

    @cached_property
    def scatter(self) -> FloatArray:
        """Scatter within materials of the standardised features, over N, and λ on its diagonal, (d, d)."""
        places = [self.names.index(name) for name in self.materials]
        rest = self.standardised - self.means[places]
        return rest.T @ rest / len(rest) + _SHRINKAGE * np.eye(rest.shape[1])

    @cached_property
    def weights(self) -> FloatArray:
        """Σ⁻¹ mᵀ, (d, C)."""
        with one_thread():
            solved: FloatArray = cho_solve(cho_factor(self.scatter), self.means.T)
        return solved

    @cached_property
    def likeness(self) -> FloatArray:
        """Cosines between the means, about their centre, where the scatter is white, (C, C).

        Not products: mat7 lies so far from all others that it alone would make two sensors agree.
        """
        about = self.means - self.means.mean(axis=0)
        with one_thread():
            products: FloatArray = about @ cho_solve(cho_factor(self.scatter), about.T)
        lengths = np.sqrt(np.diagonal(products))
        likeness: FloatArray = products / np.maximum(np.outer(lengths, lengths), 1e-12)
        return likeness


class _Touches:
    """Touches of the new sensor, as they come."""

    def __init__(self, features: Features) -> None:
        self.features = features
        self.vectors: list[FloatArray] = []
        self.materials: list[str] = []

    def observe(self, material: str, stream: Stream) -> None:
        """See `FewTouchLearner.observe`."""
        self.vectors.append(self.features(stream))
        self.materials.append(material)
        for name in ("fitted", "standard"):  # what rests on the touches, and is made anew when it is asked for
            self.__dict__.pop(name, None)

    @property
    def names(self) -> list[str]:
        return sorted(set(self.materials))

    @cached_property
    def standard(self) -> _Standard:
        if not self.vectors:
            raise InputError("expected touches of the new sensor; there are none. Call observe first")
        return _Standard(np.array(self.vectors))


class OneReadout(_Touches):
    """The library's closed-form readout over both sensors' touches, in features that do not know the sensor.

    Features are standardised, each sensor's by itself, and cut at 8 deviations; the new sensor's by its few touches.

    known: the old sensor's touches, or None. unlabelled: features of the new sensor, (M, d), to standardise by in
    place of the few touches. as_it_is: the new sensor's features are standardised as if they were the old one's.
    apart: materials of the old sensor are others than those of the new, so that all they give is the scatter within.
    """

    def __init__(
        self,
        features: Features,
        known: Known | None,
        *,
        unlabelled: FloatArray | None = None,
        as_it_is: bool = False,
        apart: bool = False,
    ) -> None:
        super().__init__(features)
        self._known = known
        self._apart = apart
        self._given: _Standard | None = None
        if as_it_is and known is not None:
            self._given = _Standard(known.features)
        elif unlabelled is not None:
            self._given = _Standard(unlabelled)

    def name_of(self, stream: Stream) -> str:
        """See `FewTouchLearner.name_of`. Raises InputError where nothing was learned."""
        readout, candidates = self.fitted
        codes = in_units(self._by(self.features(stream)), _BOUND)
        return readout.names[candidates[int(readout.scores(codes, candidates, "lda").argmax())]]

    @property
    def _by(self) -> _Standard:
        return self._given or self.standard

    @cached_property
    def fitted(self) -> tuple[Readout, list[int]]:
        """The readout, and the places of the materials that can be answered."""
        parts = []
        if self._known is not None:
            parts.append(self._known.statistics(_OLD if self._apart else ""))
        if self.vectors:
            parts.append(_statistics(self._by(np.array(self.vectors)), self.materials))
        if not parts:
            raise InputError("expected touches to have been learned; there are none. Call observe first")
        statistics = parts[0] if len(parts) == 1 else parts[0] + parts[1]
        names = statistics.names(WHOLE)
        readout = Task.of(statistics, WHOLE, names).solve()
        return readout, [i for i, name in enumerate(names) if not name.startswith(_OLD)]


class MapsAcross(_Touches):
    """The new sensor's features mapped to the old one's, where the old sensor's readout answers.

    Targets are the old sensor's means of the touches' materials. A ridge map minimises Σ ‖m_y − Bᵀ x‖² + λ ‖B‖²;
    turned, it is the rotation and scale that bring the new means next to the old (orthogonal Procrustes, Schönemann
    1966), both about their centres.
    """

    def __init__(self, features: Features, known: Known, *, turned: bool) -> None:
        super().__init__(features)
        self._known = known
        self._turned = turned

    def name_of(self, stream: Stream) -> str:
        """See `FewTouchLearner.name_of`. Raises InputError before a touch was observed."""
        mapped = self.standard(self.features(stream)) @ self.fitted
        means, weights = self._known.means, self._known.weights
        scores = mapped @ weights - np.einsum("cd,dc->c", means, weights) / 2
        return self._known.names[int(scores.argmax())]

    @cached_property
    def fitted(self) -> FloatArray:
        """B, (d of the new, d of the old)."""
        vectors = self.standard(np.array(self.vectors))
        if not self._turned:
            places = [self._known.names.index(name) for name in self.materials]
            gram = vectors @ vectors.T
            gram[np.diag_indices_from(gram)] += _RIDGE * np.trace(gram) / len(gram)
            return vectors.T @ np.linalg.solve(gram, self._known.means[places])
        new = _means(vectors, self.materials, self.names)
        old = self._known.means[[self._known.names.index(name) for name in self.names]]
        new, old = new - new.mean(axis=0), old - old.mean(axis=0)
        # Means of C materials span C − 1 directions: both are turned within theirs.
        left, right = _basis(new), _basis(old)
        u, s, v = np.linalg.svd((new @ left).T @ (old @ right), full_matrices=False)
        turn: FloatArray = left @ (u @ v) @ right.T * (s.sum() / max(float(np.square(new).sum()), 1e-12))
        return turn


class SharesPrior(_Touches):
    """The new sensor's means drawn towards each other as the old sensor's materials lie.

    The means have the prior N(0, K ⊗ Σ), K = r G + (1 − r) I, with G the cosines between the old sensor's means where
    their scatter is white; given k touches they are K (K + s/k I)⁻¹ of what was observed.

    likeness: r, from 0 (materials lie apart alike, the control) to 1.
    """

    def __init__(self, features: Features, known: Known, *, likeness: float) -> None:
        super().__init__(features)
        self._known = known
        self._likeness = likeness

    def name_of(self, stream: Stream) -> str:
        """See `FewTouchLearner.name_of`. Raises InputError before a touch was observed."""
        weights, offset = self.fitted
        return self.names[int((self.standard(self.features(stream)) @ weights - offset).argmax())]

    @cached_property
    def fitted(self) -> tuple[FloatArray, FloatArray]:
        """Weights (d, C) and offsets (C,) of the new sensor's own LDA with the means drawn."""
        vectors, names = self.standard(np.array(self.vectors)), self.names
        means = _means(vectors, self.materials, names)
        places = [self._known.names.index(name) for name in names]
        near = self._known.likeness[np.ix_(places, places)]
        likely = self._likeness * near + (1 - self._likeness) * np.eye(len(names))
        noise = np.diag([_SPREAD / self.materials.count(name) for name in names])
        drawn = likely @ np.linalg.solve(likely + noise, means - means.mean(axis=0)) + means.mean(axis=0)
        rest = vectors - means[[names.index(name) for name in self.materials]]
        weights = _solve_wide(rest, drawn)
        return weights, np.einsum("cd,dc->c", drawn, weights) / 2


class _Standard:
    """Features less their mean, over their standard deviation, cut at 8; of a constant one nothing but 0."""

    def __init__(self, features: FloatArray) -> None:
        self._mean = features.mean(axis=0)
        spread = features.std(axis=0)
        self._scale = np.where(spread > 1e-9, 1 / np.maximum(spread, 1e-9), 0.0)

    def __call__(self, features: FloatArray) -> FloatArray:
        scaled: FloatArray = np.clip((features - self._mean) * self._scale, -_BOUND, _BOUND)
        return scaled


def _means(features: FloatArray, materials: Sequence[str], names: Sequence[str]) -> FloatArray:
    labels = np.array(materials)
    return np.stack([features[labels == name].mean(axis=0) for name in names])


def _statistics(features: FloatArray, materials: Sequence[str]) -> Statistics:
    """Statistics of one scale, 0, of standardised features (N, d)."""
    statistics = Statistics(features.shape[1], (WHOLE,))
    for vector, material in zip(features, materials, strict=True):
        statistics.add(material, {WHOLE: to_codes(vector[None], _BOUND)})
    return statistics


def _basis(means: FloatArray) -> FloatArray:
    """Orthonormal columns that span centred means (C, d): (d, C − 1)."""
    basis: FloatArray = np.linalg.svd(means, full_matrices=False)[2][: len(means) - 1].T
    return basis


def _solve_wide(rest: FloatArray, means: FloatArray) -> FloatArray:
    """Σ⁻¹ mᵀ, (d, C), of Σ = Σ_i r_i r_iᵀ / N + λ I, of fewer rows r (N, d) than features (Woodbury's identity)."""
    gram = rest @ rest.T
    gram[np.diag_indices_from(gram)] += len(rest) * _SHRINKAGE
    solved: FloatArray = (means - (means @ rest.T) @ np.linalg.solve(gram, rest)).T / _SHRINKAGE
    return solved
