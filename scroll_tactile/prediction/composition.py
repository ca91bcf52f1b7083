"""The composition of a touch, by a ridge regression (a head) for each constituent over the readouts of a model.

If a touch is of an observed material, its composition is the mean of the materials' descriptions, weighted by their
probabilities. If it is of a new material, the heads predict it. The novelty weighs these
two cases. Heads and novelty are calibrated on the sampled touches: each is scored by readouts that
never observed it, and by heads that never observed its material. A material described after it was touched gives the
same as one described before, to the bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.memory.descriptions import Target, targets_of
from scroll_tactile.memory.state import Memory
from scroll_tactile.prediction.features import Encoded
from scroll_tactile.prediction.model import Model
from scroll_tactile.readouts.attributes import GAMMAS, Curve, RidgeSystem, fit_curve, solve
from scroll_tactile.readouts.leave_one_out import StageScores
from scroll_tactile.readouts.novelty import novelty_measures
from scroll_tactile.results import Constituent
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import one_thread

__all__ = ["Composer", "ConstituentHead", "HeadFitter", "StageHeads"]

FloatArray = npt.NDArray[np.float64]

MOST_EVIDENCE = 5  # materials
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
class ConstituentHead:
    """Predicts one constituent of a touch of a new material from the observed ones.

    places: of the materials whose target is known. weights: (α, b). curve: from its value to a probability, for a
    presence; a share has none.
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
    """Fits the heads of one stage and evaluates them on N sampled touches, each held out of the readouts.

    materials: of the touches. z: of the stage, (N, C). known_novelty: the touches' novelty, (N,). new_novelty: the same
    without the touch's own material, (N,).
    """

    def __init__(self, model: Model, stage: int) -> None:
        weighing = model.fitted
        row = weighing.rows[stage]
        found = StageScores(stage, weighing.sample, [model.held_out[scale] for scale in row.scales])
        weights = _weights(model, stage)
        self.space = _space_of(model, stage, found.names)
        self.materials = [found.names[place] for place in found.targets]
        self.z = sum(weight * z for weight, z in zip(weights, np.moveaxis(found.z(), 1, 0), strict=True))
        measures = novelty_measures(found, model.neighbours(row))
        self.known_novelty, self.new_novelty = map(row.calibration.novelty, measures)
        self._systems: dict[tuple[float, bytes], RidgeSystem] = {}

    def fit(self, targets: Mapping[str, Target]) -> StageHeads:
        """The heads of all constituents, and how novelty is to be read."""
        values = np.concatenate([self.known_novelty, self.new_novelty])
        truth = np.repeat([0.0, 1.0], len(self.materials))
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
        # Ties go to the larger γ, the more regularised head.
        gamma = min(sorted(losses, reverse=True), key=losses.__getitem__) if losses else DEFAULT_GAMMA
        weights = self._system(gamma, places).weights(values)
        # The curve passes one half where the prior does. Leaving a material out makes its constituents rarer among the
        # others, so a fitted offset is biased: with one, 72 % of new letters were right in place of 75.
        curve = fit_curve(*evaluated[gamma], PRESENCE, turning=False) if curved else None
        return ConstituentHead(places, weights, curve)

    def _evaluated(self, known: Mapping[str, float], gamma: float) -> tuple[FloatArray, FloatArray]:
        """The predictions for each touch by a head without its material, and the true targets."""
        places = self.space.places(known)
        predicted, truth = [], []
        if len(places) >= 3:
            values = np.array([known[self.space.names[place]] for place in places], dtype=np.float64)
            system = self._system(gamma, places)
            weights = system.weights(values)
            others = {
                self.space.names[place]: system.weights_without(weights, i)
                for i, place in enumerate(places)
                if np.ptp(np.delete(values, i)) > 0  # otherwise the remaining targets are all equal
            }
            for material, z in zip(self.materials, self.z, strict=True):
                if (head := others.get(material)) is not None:
                    predicted.append(float(head[:-1] @ z[places] + head[-1]))
                    truth.append(float(known[material]))
        return np.array(predicted), np.array(truth)

    def _system(self, gamma: float, places: npt.NDArray[np.intp]) -> RidgeSystem:
        key = gamma, places.tobytes()
        if key not in self._systems:
            self._systems[key] = solve(self.space.gram[np.ix_(places, places)], gamma)
        return self._systems[key]


@dataclass(frozen=True)
class Composer:
    """Heads for every constituent that a description names, at every stage. Made by `Composer.of`."""

    model: Model
    targets: dict[str, Target]
    stages: list[StageHeads]
    spaces: list[MaterialSpace]

    @classmethod
    def of(cls, model: Model, memory: Memory) -> Composer:
        """Fit the heads of all constituents described in a memory, over the model of the same memory."""
        targets = targets_of(memory.descriptions)
        with one_thread():
            fitters = [HeadFitter(model, stage) for stage in range(len(model.fitted.rows))]
            stages = [fitter.fit(targets) for fitter in fitters]
        return cls(model, targets, stages, [fitter.space for fitter in fitters])

    def scales_for(self, steps: int) -> list[Scale]:
        """The scales whose windows the heads read of a touch of so many steps."""
        return self.model.stages[self._stage(steps)]

    def _stage(self, steps: int) -> int:
        return min(len(self.model.plan.stages(steps)), len(self.stages)) - 1

    def compose(
        self, wanted: Sequence[str], feels_like: Mapping[str, float], encoded: Encoded, expected: float
    ) -> tuple[tuple[Constituent, ...], float]:
        """The requested constituents, and the probability that the touch is of a new material.

        feels_like: probability of each observed material. encoded: the touch, with the scales of `scales_for`.
        expected: the prior probability of a new material.
        """
        stage = self._stage(encoded.steps)
        heads = self.stages[stage]
        z = _combined(self.model, stage, self.spaces[stage].names, encoded.means)
        new = float(heads.novel(self.model.novelty(self.model.fitted.rows[stage], encoded.means, self.model.names)))
        # Bayes: the curve was fitted to as many new touches as known ones, a prior of one half.
        odds = new * expected, (1 - new) * (1 - expected)
        unfamiliar = odds[0] / sum(odds) if sum(odds) else expected
        return self._constituents(wanted, heads, feels_like, z, unfamiliar), unfamiliar

    def _constituents(
        self,
        wanted: Sequence[str],
        heads: StageHeads,
        feels_like: Mapping[str, float],
        z: FloatArray,
        unfamiliar: float,
    ) -> tuple[Constituent, ...]:
        constituents = [self._constituent(name, heads, feels_like, z, unfamiliar) for name in self.targets]
        by_name = {constituent.name: constituent for constituent in _summing_to_one(constituents, self.targets)}
        return tuple(by_name[name] for name in wanted)

    def _constituent(
        self, name: str, heads: StageHeads, feels_like: Mapping[str, float], z: FloatArray, unfamiliar: float
    ) -> Constituent:
        target = self.targets[name]

        def weighed(head: ConstituentHead | str, known: Mapping[str, float]) -> float | None:
            if isinstance(head, str):
                return None
            observed = {material: feels_like[material] for material in known if material in feels_like}
            weight = (1 - unfamiliar) * sum(observed.values())
            value = (1 - unfamiliar) * sum(chance * known[material] for material, chance in observed.items())
            return min(max(value + (1 - weight) * head(z), 0.0), 1.0)

        having = [(material, feels_like.get(material, 0.0)) for material, has in target.presence.items() if has]
        evidence = sorted((item for item in having if item[1] > 0), key=lambda item: (-item[1], item[0]))
        presence, share = heads.presence[name], heads.share[name]
        return Constituent(
            name=name,
            presence=weighed(presence, target.presence),
            share=weighed(share, target.share),
            evidence=tuple(evidence[:MOST_EVIDENCE]),
            unlearned=presence if isinstance(presence, str) else "",
        )


def _summing_to_one(constituents: list[Constituent], targets: Mapping[str, Target]) -> list[Constituent]:
    """The constituents with shares scaled to sum to one, or, where some share is unknown, to at most one."""
    shares = [constituent.share for constituent in constituents if targets[constituent.name].share]
    total = sum(share for share in shares if share is not None)
    if total == 0 or (total <= 1 and None in shares):
        return constituents
    return [part if part.share is None else replace(part, share=part.share / total) for part in constituents]


def _space_of(model: Model, stage: int, names: list[str]) -> MaterialSpace:
    """The reference materials of the readouts of a stage, in the order of the names."""
    readouts = [model.readouts[scale] for scale in model.stages[stage]]
    gram = np.zeros((len(names), len(names)))
    for weight, readout in zip(_weights(model, stage), readouts, strict=True):
        places = [readout.places[name] for name in names]
        gram += weight * readout.derived().gram[np.ix_(places, places)]
    return MaterialSpace(names, gram)


def _combined(model: Model, stage: int, names: Sequence[str], means: Mapping[Scale, FloatArray]) -> FloatArray:
    """z of a stage, shape (C,), of a touch's mean features by scale, in the order of the names."""
    total = np.zeros(len(names))
    for weight, scale in zip(_weights(model, stage), model.stages[stage], strict=True):
        readout = model.readouts[scale]
        total += weight * readout.centred(means[scale])[[readout.places[name] for name in names]]
    return total


def _weights(model: Model, stage: int) -> FloatArray:
    """The weight of each scale of a stage, summing to one; equal weights if the calibration's are all zero."""
    weights = model.fitted.rows[stage].calibration.weights
    total = float(weights.sum())
    return weights / total if total > 0 else np.full(len(weights), 1 / len(weights))
