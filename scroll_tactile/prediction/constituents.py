"""Heads for each constituent over the readouts of a model, fitted and evaluated on the sampled touches.

Each sampled touch is scored by readouts that never observed it, and by heads that never observed its material. These
scores calibrate heads and novelty.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.memory.descriptions import Target
from scroll_tactile.prediction.model import Model
from scroll_tactile.readouts.attributes import GAMMAS, Curve, RidgeSystem, fit_curve, solve
from scroll_tactile.readouts.calibration import common_names, judged_touches
from scroll_tactile.signals.windows import Scale

__all__ = ["ConstituentHead", "HeadFitter", "MaterialSpace", "StageHeads", "combined"]

FloatArray = npt.NDArray[np.float64]

DEFAULT_GAMMA = 0.1  # where no touch could be held out
PRESENCE = Curve(6.0, -3.0)  # of a head whose targets are 0 and 1, before any touch was held out
NOVEL = Curve(1.0, -2.0)  # of a novelty in spreads, likewise


@dataclass(frozen=True)
class MaterialSpace:
    """The materials as a stage's readouts see them: names, and G of all its scales, weighted, shape (C, C)."""

    names: list[str]
    gram: FloatArray

    def places(self, known: Mapping[str, object]) -> npt.NDArray[np.intp]:
        """The places of the materials that are known."""
        return np.array([place for place, name in enumerate(self.names) if name in known], dtype=np.intp)


@dataclass(frozen=True)
class _ScoredTouch:
    """A sampled touch, judged by readouts that never observed it: z of its stage, shape (C,), and its novelty.

    known_novelty: its novelty among all materials. new_novelty: among all but its own.
    """

    material: str
    z: FloatArray
    known_novelty: float
    new_novelty: float


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

    novel: from standardised novelty to the probability of a new material.
    """

    novel: Curve
    presence: dict[str, ConstituentHead | str]
    share: dict[str, ConstituentHead | str]


class HeadFitter:
    """Fits the heads of one stage and evaluates them on the sampled touches."""

    def __init__(self, model: Model, stage: int) -> None:
        self.space = space_of(model, stage)
        self.touches = _scored_touches(model, stage, self.space.names)
        self._systems: dict[tuple[float, bytes], RidgeSystem] = {}

    def fit(self, targets: Mapping[str, Target]) -> StageHeads:
        """The heads of all constituents, and how novelty is to be read."""
        values = [touch.known_novelty for touch in self.touches] + [touch.new_novelty for touch in self.touches]
        truth = [0.0] * len(self.touches) + [1.0] * len(self.touches)
        return StageHeads(
            fit_curve(values, truth, NOVEL),
            {name: self._head(dict(target.presence), curved=True) for name, target in targets.items()},
            {name: self._head(target.share, curved=False) for name, target in targets.items()},
        )

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
        weights = self._system(gamma, places).weights(values)
        # A half stays a half. Leaving a material out makes what it has rarer among the others, and where presence
        # begins, fitted on few such heads, came out on the wrong side: letters never touched 72 % right in place of 75.
        curve = fit_curve(*evaluated[gamma], PRESENCE, turning=False) if curved else None
        return ConstituentHead(places, weights, curve)

    def _evaluated(self, known: Mapping[str, float], gamma: float) -> tuple[FloatArray, FloatArray]:
        """What heads that never observed the material of a touch predict of it, and what is true."""
        places = self.space.places(known)
        predicted, truth = [], []
        if len(places) >= 3:
            values = np.array([known[self.space.names[place]] for place in places], dtype=np.float64)
            system = self._system(gamma, places)
            weights = system.weights(values)
            others = {
                self.space.names[place]: system.weights_without(weights, i)
                for i, place in enumerate(places)
                if np.ptp(np.delete(values, i)) > 0  # what is left is no task otherwise
            }
            for touch in self.touches:
                if (head := others.get(touch.material)) is not None:
                    predicted.append(float(head[:-1] @ touch.z[places] + head[-1]))
                    truth.append(float(known[touch.material]))
        return np.array(predicted), np.array(truth)

    def _system(self, gamma: float, places: npt.NDArray[np.intp]) -> RidgeSystem:
        key = gamma, places.tobytes()
        if key not in self._systems:
            self._systems[key] = solve(self.space.gram[np.ix_(places, places)], gamma)
        return self._systems[key]


def space_of(model: Model, stage: int) -> MaterialSpace:
    """The materials that the readouts of a stage rested on when they were fitted, as they see them."""
    readouts = [model.readouts[scale] for scale in model.stages[stage]]
    known = [[readout.names[place] for place in readout.reference] for readout in readouts]
    names = common_names([model.held_out[scale] for scale in model.stages[stage]])
    gram = np.zeros((len(names), len(names)))
    for weight, own, readout in zip(_weights(model, stage), known, readouts, strict=True):
        places = [own.index(name) for name in names]
        gram += weight * readout.derived().gram[np.ix_(places, places)]
    return MaterialSpace(names, gram)


def combined(model: Model, stage: int, names: Sequence[str], means: Mapping[Scale, FloatArray]) -> FloatArray:
    """z of a stage, shape (C,), of a touch's mean features by scale, in the order of the names."""
    total = np.zeros(len(names))
    for weight, scale in zip(_weights(model, stage), model.stages[stage], strict=True):
        readout = model.readouts[scale]
        places = {readout.names[place]: i for i, place in enumerate(readout.reference)}
        total += weight * readout.centred(means[scale])[[places[name] for name in names]]
    return total


def _scored_touches(model: Model, stage: int, names: Sequence[str]) -> list[_ScoredTouch]:
    held_out, calibration = [model.held_out[scale] for scale in model.stages[stage]], model.calibrations[stage]
    if len(names) < 2:
        return []
    places = [[left.names.index(name) for name in names] for left in held_out]
    touches = []
    for number in judged_touches(stage, held_out):
        material, *_ = model.sample[number]
        if material not in names:
            continue
        rows = [left.rows[number, stage] for left in held_out]
        distances = np.stack([left.distances[row][own] for left, row, own in zip(held_out, rows, places, strict=True)])
        z = sum(
            weight * left.z[row][own]
            for weight, left, row, own in zip(_weights(model, stage), held_out, rows, places, strict=True)
        )
        others = np.delete(distances, names.index(material), axis=1)
        novelties = [float(calibration.novelty(part.min(axis=1))) for part in (distances, others)]
        touches.append(_ScoredTouch(material, np.asarray(z), *novelties))
    return touches


def _weights(model: Model, stage: int) -> FloatArray:
    """The weight of each scale of a stage, summing to one; equal, where the calibration gives none any."""
    weights = model.calibrations[stage].weights
    total = float(weights.sum())
    return weights / total if total > 0 else np.full(len(weights), 1 / len(weights))
