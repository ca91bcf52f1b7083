"""What a touch is made of: heads for each constituent over the readouts of a model, and how far they are believed.

A touch may be of a material that was felt: then what it is made of is what that one is made of, weighed by what the
touch feels like. Or it is of one never felt: then the heads speak, ridge regressions over the materials. Which of the
two is told by the novelty. All three are measured on the pool's touches, each scored by readouts of the folds that it
is not in, and by heads that never felt its material. All of it is a function of the statistics, the pool and the
descriptions: a material described after the touching gives the same as one described before, to the bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.descriptions import Description, Target, targets_of
from scroll_tactile.model import Model
from scroll_tactile.prediction import Constituent
from scroll_tactile.ridge.attributes import GAMMAS, Curve, Solved, fit_curve, solve
from scroll_tactile.ridge.moments import one_thread
from scroll_tactile.ridge.pool import Pool, Touch
from scroll_tactile.ridge.readouts import Readout
from scroll_tactile.ridge.statistics import fold_of

__all__ = ["Composer"]

FloatArray = npt.NDArray[np.float64]

DEFAULT_GAMMA = 0.1  # where no touch could be held out
PRESENCE = Curve(6.0, -3.0)  # of a head whose targets are 0 and 1, before any touch was held out
NOVEL = Curve(1.0, -2.0)  # of a novelty in spreads, likewise
MOST_EVIDENCE = 5  # materials


@dataclass(frozen=True)
class _Space:
    """The materials as a stage's readouts see them: names, and G of all its scales, weighted, shape (C, C)."""

    names: list[str]
    gram: FloatArray

    def places(self, known: Mapping[str, object]) -> npt.NDArray[np.intp]:
        """The places of the materials that are known."""
        return np.array([at for at, name in enumerate(self.names) if name in known], dtype=np.intp)


@dataclass(frozen=True)
class _Trial:
    """A touch of the pool, judged by the folds that it is not in: z of its stage, shape (C,), and its novelty.

    familiar: among all materials. unfamiliar: among all but its own.
    """

    fold: int
    material: str
    z: FloatArray
    familiar: float
    unfamiliar: float


@dataclass(frozen=True)
class _Head:
    """places: of the materials that it knows. weights: (α, b). curve: from its value to a probability, for a presence.

    A share has no curve.
    """

    places: npt.NDArray[np.intp]
    weights: FloatArray
    curve: Curve | None

    def __call__(self, z: FloatArray) -> float:
        value = float(self.weights[:-1] @ z[self.places] + self.weights[-1])
        return min(max(value, 0.0), 1.0) if self.curve is None else float(self.curve(value))


@dataclass(frozen=True)
class _Stage:
    """The heads of one stage: constituent → its head, or in words why there is none."""

    novel: Curve
    presence: dict[str, _Head | str]
    share: dict[str, _Head | str]


@dataclass(frozen=True)
class Composer:
    """Heads for every constituent that a description names, at every stage. Made by `Composer.of`."""

    model: Model
    targets: dict[str, Target]
    stages: list[_Stage]

    @classmethod
    def of(cls, model: Model, pool: Pool, descriptions: Mapping[str, Description]) -> Composer:
        """Fit the heads of what is described over what was felt."""
        targets = targets_of(descriptions)
        with one_thread():
            stages = [_Bench(model, pool, stage).fit(targets) for stage in range(len(model.calibrations))]
        return cls(model, targets, stages)

    def needed(self, columns: int) -> list[int]:
        """The scales whose windows the heads read of a touch of so many columns."""
        return self.model.stages[self._reached(columns)]

    def _reached(self, columns: int) -> int:
        return min(len(self.model.reading.stages(columns)), len(self.stages)) - 1

    def compose(
        self,
        wanted: Sequence[str],
        feels_like: Mapping[str, float],
        means: Mapping[int, FloatArray],
        columns: int,
        expected: float,
    ) -> tuple[tuple[Constituent, ...], float]:
        """Each constituent that is wanted, and the probability that the touch is of a material never felt.

        feels_like: probability of each material felt. means: for each scale the touch's mean features in the codes'
        unit, (d,). columns: felt so far. expected: the probability of that before the touch.
        """
        at = self._reached(columns)
        stage, scales = self.stages[at], self.model.stages[at]
        projected = {scale: self.model.selections[scale].readout.project(means[scale]) for scale in scales}
        space = _space(self.model, at)
        z = _combined(self.model, at, space.names, projected)
        distances = [float(self.model.selections[scale].readout.novelty(projected[scale])) for scale in scales]
        told = float(stage.novel(self.model.calibrations[at].novelty(np.array(distances))))
        # Bayes: the curve is that of as many new touches as known ones.
        odds = told * expected, (1 - told) * (1 - expected)
        unfamiliar = odds[0] / sum(odds) if sum(odds) else expected
        whole = [self._constituent(name, stage, feels_like, z, unfamiliar) for name in self.targets]
        made_of = {one.name: one for one in _summing_to_one(whole, self.targets)}
        return tuple(made_of[name] for name in wanted), unfamiliar

    def _constituent(
        self, name: str, stage: _Stage, feels_like: Mapping[str, float], z: FloatArray, unfamiliar: float
    ) -> Constituent:
        target = self.targets[name]

        def weighed(head: _Head | str, known: Mapping[str, float]) -> float | None:
            if isinstance(head, str):
                return None
            felt = {material: feels_like[material] for material in known if material in feels_like}
            believed = (1 - unfamiliar) * sum(felt.values())
            told = (1 - unfamiliar) * sum(chance * known[material] for material, chance in felt.items())
            return min(max(told + (1 - believed) * head(z), 0.0), 1.0)

        having = [(material, feels_like.get(material, 0.0)) for material, has in target.presence.items() if has]
        felt = sorted((one for one in having if one[1] > 0), key=lambda one: (-one[1], one[0]))
        presence, share = stage.presence[name], stage.share[name]
        return Constituent(
            name,
            weighed(presence, target.presence),
            weighed(share, target.share),
            tuple(felt[:MOST_EVIDENCE]),
            presence if isinstance(presence, str) else "",
        )


def _summing_to_one(told: list[Constituent], targets: Mapping[str, Target]) -> list[Constituent]:
    """Shares made parts of one: of all that is a mass, or, where some share is not known, not more than one."""
    shares = [one.share for one in told if targets[one.name].share]
    total = sum(share for share in shares if share is not None)
    if total == 0 or (total <= 1 and None in shares):
        return told
    return [one if one.share is None else replace(one, share=one.share / total) for one in told]


class _Bench:
    """One stage, where heads are fitted and tried."""

    def __init__(self, model: Model, pool: Pool, stage: int) -> None:
        self.model = model
        self.stage = stage
        self.space = _space(model, stage)
        self.folds: dict[int, _Space] = {}
        self.trials = [trial for one in pool if (trial := self._trial(*one)) is not None]
        self._solved: dict[tuple[int | None, float, bytes], Solved] = {}

    def _trial(self, material: str, key: bytes, touch: Touch) -> _Trial | None:
        model, fold = self.model, fold_of(key)
        means = touch.means(self.stage)
        scales = model.stages[self.stage]
        if means is None or any(fold not in model.selections[scale].held_out for scale in scales):
            return None
        if fold not in self.folds:
            self.folds[fold] = _space(model, self.stage, fold)
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
        return _Trial(fold, material, _combined(model, self.stage, names, z, fold), float(familiar), float(unfamiliar))

    def fit(self, targets: Mapping[str, Target]) -> _Stage:
        """The heads of all constituents, and how novelty is to be read."""
        values = [trial.familiar for trial in self.trials] + [trial.unfamiliar for trial in self.trials]
        truth = [0.0] * len(self.trials) + [1.0] * len(self.trials)
        return _Stage(
            fit_curve(values, truth, NOVEL),
            {name: self._head(dict(target.presence), curved=True) for name, target in targets.items()},
            {name: self._head(target.share, curved=False) for name, target in targets.items()},
        )

    def _head(self, known: Mapping[str, float], *, curved: bool) -> _Head | str:
        places = self.space.places(known)
        values = np.array([known[self.space.names[at]] for at in places], dtype=np.float64)
        if len(places) < 2:
            some = (
                "1 material of which it is known was"
                if len(places) == 1
                else f"{len(places)} of which it is known were"
            )
            return f"{some} felt for long enough; a head takes two or more"
        if np.ptp(values) == 0:
            who = "every" if values[0] else "no"
            return f"{who} material of which it is known and that was felt has it" + (
                "" if curved else f", each with a share of {values[0]:g}"
            )
        tried = {gamma: self._tried(known, gamma) for gamma in GAMMAS}
        lost = {gamma: float(np.square(said - true).sum()) for gamma, (said, true) in tried.items() if len(said)}
        # Ties go to the larger γ, the tamer head.
        gamma = min(sorted(lost, reverse=True), key=lost.__getitem__) if lost else DEFAULT_GAMMA
        weights = self._solve(None, gamma, places).head(values)
        # A half stays a half. Leaving a material out makes what it has rarer among the others, and where presence
        # begins, fitted on few such heads, came out on the wrong side: letters never touched 72 % right in place of 75.
        return _Head(places, weights, fit_curve(*tried[gamma], PRESENCE, turning=False) if curved else None)

    def _tried(self, known: Mapping[str, float], gamma: float) -> tuple[FloatArray, FloatArray]:
        """What heads that never felt a held-out touch's material say of it, and what is true."""
        said, true = [], []
        for fold, space in self.folds.items():
            places = space.places(known)
            if len(places) < 3:
                continue
            values = np.array([known[space.names[at]] for at in places], dtype=np.float64)
            solved = self._solve(fold, gamma, places)
            head = solved.head(values)
            heads = {
                space.names[at]: solved.without(head, place)
                for place, at in enumerate(places)
                if np.ptp(np.delete(values, place)) > 0  # what is left is no task otherwise
            }
            for trial in self.trials:
                if trial.fold == fold and trial.material in heads:
                    left = heads[trial.material]
                    said.append(float(left[:-1] @ trial.z[places] + left[-1]))
                    true.append(float(known[trial.material]))
        return np.array(said), np.array(true)

    def _solve(self, fold: int | None, gamma: float, places: npt.NDArray[np.intp]) -> Solved:
        key = fold, gamma, places.tobytes()
        if key not in self._solved:
            gram = (self.space if fold is None else self.folds[fold]).gram
            self._solved[key] = solve(gram[np.ix_(places, places)], gamma)
        return self._solved[key]


def _readout(model: Model, scale: int, fold: int | None) -> tuple[list[str], Readout]:
    """The materials of a scale's readout, and the readout: of all that was felt, or of all but a fold."""
    selection = model.selections[scale]
    if fold is None:
        return selection.names, selection.readout
    known, readout = selection.held_out[fold]
    return [selection.names[at] for at in known], readout


def _space(model: Model, stage: int, fold: int | None = None) -> _Space:
    readouts = [_readout(model, scale, fold) for scale in model.stages[stage]]
    names = sorted(set.intersection(*(set(known) for known, _ in readouts)))
    gram = np.zeros((len(names), len(names)))
    for weight, (known, readout) in zip(_weights(model, stage), readouts, strict=True):
        places = [known.index(name) for name in names]
        gram += weight * readout.gram[np.ix_(places, places)]
    return _Space(names, gram)


def _combined(
    model: Model, stage: int, names: Sequence[str], z: Mapping[int, FloatArray], fold: int | None = None
) -> FloatArray:
    total = np.zeros(len(names))
    for weight, scale in zip(_weights(model, stage), model.stages[stage], strict=True):
        places = {name: at for at, name in enumerate(_readout(model, scale, fold)[0])}
        total += weight * z[scale][[places[name] for name in names]]
    return total


def _weights(model: Model, stage: int) -> FloatArray:
    """How far each scale of a stage is believed, summing to one; equally, where the calibration believes none."""
    weights = model.calibrations[stage].weights
    total = float(weights.sum())
    return weights / total if total > 0 else np.full(len(weights), 1 / len(weights))


def _others(model: Model, scale: int, known: npt.NDArray[np.intp], out: str | None) -> npt.NDArray[np.intp]:
    names = model.selections[scale].names
    return np.array([place for place, at in enumerate(known) if names[at] != out], dtype=np.intp)
