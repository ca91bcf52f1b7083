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

from scroll_tactile.memory.descriptions import Target, targets_of
from scroll_tactile.memory.state import Memory
from scroll_tactile.prediction.constituents import Bench, Head, Stage, combined, space_of
from scroll_tactile.prediction.model import Model
from scroll_tactile.results import Constituent
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import one_thread

__all__ = ["Composer"]

FloatArray = npt.NDArray[np.float64]

MOST_EVIDENCE = 5  # materials


@dataclass(frozen=True)
class Composer:
    """Heads for every constituent that a description names, at every stage. Made by `Composer.of`."""

    model: Model
    targets: dict[str, Target]
    stages: list[Stage]

    @classmethod
    def of(cls, model: Model, memory: Memory) -> Composer:
        """Fit the heads of what is described in a memory over what was felt there, and the model made of it."""
        targets = targets_of(memory.descriptions)
        with one_thread():
            stages = [Bench(model, memory, stage).fit(targets) for stage in range(len(model.calibrations))]
        return cls(model, targets, stages)

    def needed(self, columns: int) -> list[Scale]:
        """The scales whose windows the heads read of a touch of so many columns."""
        return self.model.stages[self._reached(columns)]

    def _reached(self, columns: int) -> int:
        return min(len(self.model.plan.stages(columns)), len(self.stages)) - 1

    def compose(
        self,
        wanted: Sequence[str],
        feels_like: Mapping[str, float],
        means: Mapping[Scale, FloatArray],
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
        space = space_of(self.model, at)
        z = combined(self.model, at, space.names, projected)
        distances = [float(self.model.selections[scale].readout.novelty(projected[scale])) for scale in scales]
        told = float(stage.novel(self.model.calibrations[at].novelty(np.array(distances))))
        # Bayes: the curve is that of as many new touches as known ones.
        odds = told * expected, (1 - told) * (1 - expected)
        unfamiliar = odds[0] / sum(odds) if sum(odds) else expected
        feels_like = _sharpened(feels_like, stage.sharpness)
        whole = [self._constituent(name, stage, feels_like, z, unfamiliar) for name in self.targets]
        made_of = {one.name: one for one in _summing_to_one(whole, self.targets)}
        return tuple(made_of[name] for name in wanted), unfamiliar

    def through_noise(self, wanted: Sequence[str], feels_like: Mapping[str, float]) -> tuple[Constituent, ...]:
        """Each constituent that is wanted, of a touch felt through noise: by the described materials it feels like.

        The heads read what noise hides, so they are not asked.
        """
        whole = [self._constituent(name, self.stages[-1], feels_like, None, 0.0) for name in self.targets]
        made_of = {one.name: one for one in _summing_to_one(whole, self.targets)}
        return tuple(made_of[name] for name in wanted)

    def _constituent(
        self, name: str, stage: Stage, feels_like: Mapping[str, float], z: FloatArray | None, unfamiliar: float
    ) -> Constituent:
        target = self.targets[name]

        def weighed(head: Head | str, known: Mapping[str, float]) -> float | None:
            if isinstance(head, str):
                return None
            felt = {material: feels_like[material] for material in known if material in feels_like}
            believed = (1 - unfamiliar) * sum(felt.values())
            told = (1 - unfamiliar) * sum(chance * known[material] for material, chance in felt.items())
            if z is None:
                return min(told / believed, 1.0) if believed else None
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


def _sharpened(chances: Mapping[str, float], sharpness: float) -> Mapping[str, float]:
    if sharpness == 1:
        return chances
    raised = {name: chance**sharpness for name, chance in chances.items()}
    total = sum(raised.values())
    return {name: chance / total for name, chance in raised.items()} if total > 0 else chances


def _summing_to_one(told: list[Constituent], targets: Mapping[str, Target]) -> list[Constituent]:
    """Shares made parts of one: of all that is a mass, or, where some share is not known, not more than one."""
    shares = [one.share for one in told if targets[one.name].share]
    total = sum(share for share in shares if share is not None)
    if total == 0 or (total <= 1 and None in shares):
        return told
    return [one if one.share is None else replace(one, share=one.share / total) for one in told]
