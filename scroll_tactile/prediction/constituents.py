"""Heads for each constituent over the readouts of a model, fitted and evaluated on the sampled touches.

Each sampled touch is scored by readouts of the folds that it is not in, and by heads that never observed its material.
These scores say how far heads, novelty and the probabilities of the materials are to be believed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.memory.descriptions import Target
from scroll_tactile.memory.state import Memory
from scroll_tactile.prediction.model import Model
from scroll_tactile.readouts.attributes import GAMMAS, Curve, RidgeSystem, fit_curve, solve
from scroll_tactile.readouts.calibration import FEWEST, fit_weights
from scroll_tactile.readouts.leave_one_out import leave_one_out_scores
from scroll_tactile.readouts.readout import Readout
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.sample import WindowSums
from scroll_tactile.statistics.statistics import fold_of

__all__ = ["ConstituentHead", "HeadFitter", "StageHeads", "combined", "space_of"]

FloatArray = npt.NDArray[np.float64]

DEFAULT_GAMMA = 0.1  # where no touch could be held out
PRESENCE = Curve(6.0, -3.0)  # of a head whose targets are 0 and 1, before any touch was held out
NOVEL = Curve(1.0, -2.0)  # of a novelty in spreads, likewise


@dataclass(frozen=True)
class _MaterialSpace:
    """The materials as a stage's readouts see them: names, and G of all its scales, weighted, shape (C, C)."""

    names: list[str]
    gram: FloatArray

    def places(self, known: Mapping[str, object]) -> npt.NDArray[np.intp]:
        """The places of the materials that are known."""
        return np.array([place for place, name in enumerate(self.names) if name in known], dtype=np.intp)


@dataclass(frozen=True)
class _HeldOutTouch:
    """A sampled touch, judged by the folds that it is not in: z of its stage, shape (C,), and its novelty.

    familiar: among all materials. unfamiliar: among all but its own.
    """

    fold: int
    material: str
    z: FloatArray
    familiar: float
    unfamiliar: float


@dataclass(frozen=True)
class ConstituentHead:
    """What the materials observed say of one constituent of a touch of another.

    places: of the materials that it knows. weights: (α, b). curve: from its value to a probability, for a presence; a
    share has none.
    """

    places: npt.NDArray[np.intp]
    weights: FloatArray
    curve: Curve | None

    def __call__(self, z: FloatArray) -> float:
        """The presence or share, from 0 to 1, of a touch with this z, shape (C,)."""
        value = float(self.weights[:-1] @ z[self.places] + self.weights[-1])
        return min(max(value, 0.0), 1.0) if self.curve is None else float(self.curve(value))


@dataclass(frozen=True)
class StageHeads:
    """The heads of one stage: constituent → its head, or in words why there is none.

    novel: from standardised novelty to the probability of a new material. sharpness: the power to which the
    probabilities of the materials observed are to be taken.
    """

    novel: Curve
    sharpness: float
    presence: dict[str, ConstituentHead | str]
    share: dict[str, ConstituentHead | str]


class HeadFitter:
    """Fits the heads of one stage and evaluates them on the sampled touches."""

    def __init__(self, model: Model, memory: Memory, stage: int) -> None:
        self.model = model
        self.memory = memory
        self.stage = stage
        self.space = space_of(model, stage)
        self.folds: dict[int, _MaterialSpace] = {}
        self.touches = [touch for item in memory.sample if (touch := self._held_out(*item)) is not None]
        self._systems: dict[tuple[int | None, float, bytes], RidgeSystem] = {}

    def _held_out(self, material: str, key: bytes, sums: WindowSums) -> _HeldOutTouch | None:
        model, fold = self.model, fold_of(key)
        means = sums.means(self.stage)
        scales = model.stages[self.stage]
        if means is None or any(fold not in model.selections[scale].held_out for scale in scales):
            return None
        if fold not in self.folds:
            self.folds[fold] = space_of(model, self.stage, fold)
        names = self.folds[fold].names
        if material not in names or len(names) < 2:
            return None
        readouts = {scale: model.selections[scale].held_out[fold] for scale in scales}
        z = {scale: readout.project(mean) for (scale, (_, readout)), mean in zip(readouts.items(), means, strict=True)}
        novelty = [
            [
                float(readout.novelty(z[scale], _others(model, scale, known, out)))
                for scale, (known, readout) in readouts.items()
            ]
            for out in (None, material)
        ]
        familiar, unfamiliar = model.calibrations[self.stage].novelty(np.array(novelty))
        return _HeldOutTouch(
            fold, material, combined(model, self.stage, names, z, fold), float(familiar), float(unfamiliar)
        )

    def fit(self, targets: Mapping[str, Target]) -> StageHeads:
        """The heads of all constituents, and how novelty is to be read."""
        values = [touch.familiar for touch in self.touches] + [touch.unfamiliar for touch in self.touches]
        truth = [0.0] * len(self.touches) + [1.0] * len(self.touches)
        return StageHeads(
            fit_curve(values, truth, NOVEL),
            self._sharpness(),
            {name: self._head(dict(target.presence), curved=True) for name, target in targets.items()},
            {name: self._head(target.share, curved=False) for name, target in targets.items()},
        )

    def _sharpness(self) -> float:
        """The sharpness, from leaving single touches out of the readouts that answer; 1 where that cannot be done.

        The probabilities are calibrated on readouts of two thirds of the touches. These are wrong more often, so the
        probabilities are not sharp enough. A touch can be left out where it is one row of the statistics: of several
        windows the sample holds the sum alone, and not the products.
        """
        statistics, scales = self.memory.statistics, self.model.stages[self.stage]
        touches = sum(statistics.materials.values())
        single = all(int(statistics.totals(scale)[0].sum()) <= touches for scale in scales)
        if self.model.kind != "lda" or not single or len(self.space.names) < 2:
            return 1.0
        rows = self._single_rows()
        if len(rows) < FEWEST:
            return 1.0
        logits = np.zeros((len(rows), len(self.space.names)))
        weights = self.model.calibrations[self.stage].weights
        for i, (scale, weight) in enumerate(zip(scales, weights, strict=True)):
            selection = self.model.selections[scale]
            codes = np.stack([means[i] for _, means in rows])
            places = [selection.places[material] for material, _ in rows]
            scores = leave_one_out_scores(statistics, scale, selection.readout, codes, places)
            logits += weight * scores[:, [selection.places[name] for name in self.space.names]]
        targets = [self.space.names.index(material) for material, _ in rows]
        return float(fit_weights([row[None] for row in logits], targets, np.ones(1))[0])

    def _single_rows(self) -> list[tuple[str, list[FloatArray]]]:
        """(material, codes by scale) of sampled touches of one window a scale whose material has other touches too."""
        statistics, scales = self.memory.statistics, self.model.stages[self.stage]
        counts = [
            dict(zip(self.model.selections[scale].names, statistics.totals(scale)[0], strict=True)) for scale in scales
        ]
        rows = []
        for material, _, sums in self.memory.sample:
            means, windows = sums.means(self.stage), set(sums.windows(self.stage))
            others = material in self.space.names and all(count[material] > 1 for count in counts)
            if means is not None and windows == {1} and others:
                rows.append((material, means))
        return rows

    def _head(self, known: Mapping[str, float], *, curved: bool) -> ConstituentHead | str:
        places = self.space.places(known)
        values = np.array([known[self.space.names[place]] for place in places], dtype=np.float64)
        if len(places) < 2:
            return f"it is known of {len(places)} of the materials observed for long enough; a head takes two or more"
        if np.ptp(values) == 0:
            return f"{'every' if values[0] else 'no'} material observed for long enough has it, as far as known"
        evaluated = {gamma: self._evaluated(known, gamma) for gamma in GAMMAS}
        losses = {
            gamma: float(np.square(predicted - truth).sum())
            for gamma, (predicted, truth) in evaluated.items()
            if len(predicted)
        }
        # Ties go to the larger γ, the tamer head.
        gamma = min(sorted(losses, reverse=True), key=losses.__getitem__) if losses else DEFAULT_GAMMA
        weights = self._system(None, gamma, places).weights(values)
        # A half stays a half. Leaving a material out makes what it has rarer among the others, and where presence
        # begins, fitted on few such heads, came out on the wrong side: letters never touched 72 % right in place of 75.
        curve = fit_curve(*evaluated[gamma], PRESENCE, turning=False) if curved else None
        return ConstituentHead(places, weights, curve)

    def _evaluated(self, known: Mapping[str, float], gamma: float) -> tuple[FloatArray, FloatArray]:
        """What heads that never observed a held-out touch's material predict of it, and what is true."""
        predicted, truth = [], []
        for fold, space in self.folds.items():
            places = space.places(known)
            if len(places) < 3:
                continue
            values = np.array([known[space.names[place]] for place in places], dtype=np.float64)
            system = self._system(fold, gamma, places)
            weights = system.weights(values)
            others = {
                space.names[place]: system.weights_without(weights, i)
                for i, place in enumerate(places)
                if np.ptp(np.delete(values, i)) > 0  # what is left is no task otherwise
            }
            for touch in self.touches:
                if touch.fold == fold and touch.material in others:
                    head = others[touch.material]
                    predicted.append(float(head[:-1] @ touch.z[places] + head[-1]))
                    truth.append(float(known[touch.material]))
        return np.array(predicted), np.array(truth)

    def _system(self, fold: int | None, gamma: float, places: npt.NDArray[np.intp]) -> RidgeSystem:
        key = fold, gamma, places.tobytes()
        if key not in self._systems:
            gram = (self.space if fold is None else self.folds[fold]).gram
            self._systems[key] = solve(gram[np.ix_(places, places)], gamma)
        return self._systems[key]


def _readout(model: Model, scale: Scale, fold: int | None) -> tuple[list[str], Readout]:
    """The materials of a scale's readout, and the readout: of all that was observed, or of all but a fold."""
    selection = model.selections[scale]
    if fold is None:
        return selection.names, selection.readout
    known, readout = selection.held_out[fold]
    return [selection.names[place] for place in known], readout


def space_of(model: Model, stage: int, fold: int | None = None) -> _MaterialSpace:
    """The materials as the readouts of a stage see them: of all that was observed, or of all but a fold."""
    readouts = [_readout(model, scale, fold) for scale in model.stages[stage]]
    names = sorted(set.intersection(*(set(known) for known, _ in readouts)))
    gram = np.zeros((len(names), len(names)))
    for weight, (known, readout) in zip(_weights(model, stage), readouts, strict=True):
        places = [known.index(name) for name in names]
        gram += weight * readout.gram[np.ix_(places, places)]
    return _MaterialSpace(names, gram)


def combined(
    model: Model, stage: int, names: Sequence[str], z: Mapping[Scale, FloatArray], fold: int | None = None
) -> FloatArray:
    """z of a stage, shape (C,), of the z that its scales' readouts give, in the order of the names."""
    total = np.zeros(len(names))
    for weight, scale in zip(_weights(model, stage), model.stages[stage], strict=True):
        places = {name: place for place, name in enumerate(_readout(model, scale, fold)[0])}
        total += weight * z[scale][[places[name] for name in names]]
    return total


def _weights(model: Model, stage: int) -> FloatArray:
    """How far each scale of a stage is believed, summing to one; equally, where the calibration believes none."""
    weights = model.calibrations[stage].weights
    total = float(weights.sum())
    return weights / total if total > 0 else np.full(len(weights), 1 / len(weights))


def _others(model: Model, scale: Scale, known: npt.NDArray[np.intp], out: str | None) -> npt.NDArray[np.intp]:
    names = model.selections[scale].names
    return np.array([i for i, place in enumerate(known) if names[place] != out], dtype=np.intp)
