"""The composition of a touch: heads for each constituent over the readouts of a model, and their weights.

A touch may be of a material that was observed: then its composition is that material's, weighed by the probabilities
of the materials. Or it is of one never observed: then the heads answer, ridge regressions over the materials. The
novelty tells the two apart. All are measured on the sampled touches, each scored by readouts that never observed it,
and by heads that never observed its material. A material described after it was touched gives the same as one described
before, to the bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.memory.descriptions import Target, targets_of
from scroll_tactile.memory.state import Memory
from scroll_tactile.prediction.constituents import ConstituentHead, HeadFitter, MaterialSpace, StageHeads, combined
from scroll_tactile.prediction.features import Encoded
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
    stages: list[StageHeads]
    spaces: list[MaterialSpace]

    @classmethod
    def of(cls, model: Model, memory: Memory) -> Composer:
        """Fit the heads of what is described in a memory over what was observed there, and the model made of it."""
        targets = targets_of(memory.descriptions)
        with one_thread():
            fitters = [HeadFitter(model, stage) for stage in range(len(model.calibrations))]
            stages = [fitter.fit(targets) for fitter in fitters]
        return cls(model, targets, stages, [fitter.space for fitter in fitters])

    def scales_for(self, columns: int) -> list[Scale]:
        """The scales whose windows the heads read of a touch of so many columns."""
        return self.model.stages[self._stage(columns)]

    def _stage(self, columns: int) -> int:
        return min(len(self.model.plan.stages(columns)), len(self.stages)) - 1

    def compose(
        self, wanted: Sequence[str], feels_like: Mapping[str, float], encoded: Encoded, expected: float
    ) -> tuple[tuple[Constituent, ...], float]:
        """Each constituent that is wanted, and the probability that the touch is of a material never observed.

        feels_like: probability of each material observed. encoded: the touch, with the scales of `scales_for`.
        expected: the probability of a material never observed before the touch.
        """
        stage = self._stage(encoded.columns)
        heads = self.stages[stage]
        z = combined(self.model, stage, self.spaces[stage].names, encoded.means)
        new = float(heads.novel(self.model.novelty(stage, encoded.means, self.model.names)))
        # Bayes: the curve is that of as many new touches as known ones.
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
            name,
            weighed(presence, target.presence),
            weighed(share, target.share),
            tuple(evidence[:MOST_EVIDENCE]),
            presence if isinstance(presence, str) else "",
        )


def _summing_to_one(constituents: list[Constituent], targets: Mapping[str, Target]) -> list[Constituent]:
    """Shares that sum to one; where some share is unknown, to at most one."""
    shares = [constituent.share for constituent in constituents if targets[constituent.name].share]
    total = sum(share for share in shares if share is not None)
    if total == 0 or (total <= 1 and None in shares):
        return constituents
    return [part if part.share is None else replace(part, share=part.share / total) for part in constituents]
