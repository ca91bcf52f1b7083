"""The composition of a touch, by a ridge regression (a head) for each constituent over the readouts of a model.

If a touch is of an observed material, its composition is the mean of the materials' descriptions, weighted by their
probabilities. If it is of a new material, the heads predict it. The novelty weighs these two cases. Heads and novelty
are calibrated on the sampled touches: each is scored by readouts that never observed it, and by heads that never
observed its material. A material described after it was touched gives the same as one described before, to the bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from scroll_tactile.memory.descriptions import Target, targets_of
from scroll_tactile.memory.state import Memory
from scroll_tactile.prediction.features import Encoded
from scroll_tactile.prediction.model import Model
from scroll_tactile.readouts.attributes import GAMMAS, Curve, fit_curve, heads_without, solve
from scroll_tactile.readouts.leave_one_out import StageScores
from scroll_tactile.readouts.novelty import novelty_measures
from scroll_tactile.results import Constituent
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import one_thread

__all__ = ["Composer", "StageHeads", "constituents"]

FloatArray = npt.NDArray[np.float64]
Head = tuple[FloatArray, Curve | None] | str
"""(α, b) over the C materials of a stage, α 0 where nothing is known, and a presence's curve; or why there is none."""

MOST_EVIDENCE = 5  # materials
UNTRIED = GAMMAS.index(0.1)  # γ where no touch could be held out
PRESENCE = Curve(6.0, -3.0)  # of a head whose targets are 0 and 1, before any touch was held out
NOVEL = Curve(1.0, -2.0)  # of a novelty in spreads, likewise


class StageHeads:
    """The heads of one stage over its C materials: constituent → its head, in `presence` and in `share`.

    novel: from standardised novelty to the probability of a new material.
    """

    def __init__(self, model: Model, stage: int, targets: Mapping[str, Target]) -> None:
        self._model, self._row = model, model.fitted.rows[stage]
        found = StageScores(stage, model.fitted.sample, [model.held_out[scale] for scale in self._row.scales])
        weights = self._row.calibration.weights
        total = float(weights.sum())
        self._weights = weights / total if total > 0 else np.full(len(weights), 1 / len(weights))
        self._names = found.names
        z = np.einsum("s,nsc->nc", self._weights, found.z())
        gram = np.zeros((len(found.names), len(found.names)))  # of the reference materials, in the order of the names
        for weight, scale in zip(self._weights, self._row.scales, strict=True):
            places = [model.readouts[scale].places[name] for name in found.names]
            gram += weight * model.readouts[scale].derived().gram[np.ix_(places, places)]
        novelties = [self._row.calibration.novelty(own) for own in novelty_measures(found, model.neighbours(self._row))]
        self.novel = fit_curve(np.concatenate(novelties), np.repeat([0, 1], len(found.targets)), NOVEL)
        head = partial(_head, found, z, gram, {})
        self.presence = {name: head(target.presence, curved=True) for name, target in targets.items()}
        self.share = {name: head(target.share, curved=False) for name, target in targets.items()}

    def read(self, means: Mapping[Scale, FloatArray]) -> tuple[FloatArray, float]:
        """z of a touch's mean features by scale, (C,), and the probability that it is new, by a prior of one half."""
        z = np.zeros(len(self._names))
        for weight, scale in zip(self._weights, self._row.scales, strict=True):
            readout = self._model.readouts[scale]
            z += weight * readout.centred(means[scale])[[readout.places[name] for name in self._names]]
        return z, float(self.novel(self._model.novelty(self._row, means, self._model.names)))


def _head(
    found: StageScores,
    z: FloatArray,
    gram: FloatArray,
    inverses: dict[bytes, list[FloatArray]],
    known: Mapping[str, float],
    *,
    curved: bool,
) -> Head:
    """The head of one constituent. found: the sampled touches, held out, with z, (N, C). gram: of the C materials.

    inverses: B of the materials known at each γ, made once for all constituents that are known of these. known:
    material → target. curved: whether it is a presence.
    """
    names = [name for name in found.names if name in known]
    places, values = np.searchsorted(found.names, names), np.array([known[name] for name in names], dtype=np.float64)
    if len(places) < 2:
        return f"it is known of {len(places)} of the materials observed for long enough; a head takes two or more"
    if np.ptp(values) == 0:
        return f"{'every' if values[0] else 'no'} material observed for long enough has it, as far as known"
    solved = inverses.setdefault(places.tobytes(), [])
    if not solved:
        solved += [solve(gram[np.ix_(places, places)], gamma) for gamma in GAMMAS]
    # A head is tried by touches of materials whose others differ, without these.
    differing = [place for i, place in enumerate(places) if np.ptp(np.delete(values, i)) > 0]
    tried = np.flatnonzero(np.isin(found.targets, differing))
    own, asked = np.searchsorted(places, found.targets[tried]), z[np.ix_(tried, places)]
    heads = [heads_without(inverse, values)[:, own] for inverse in solved]
    predicted = np.array([np.einsum("nk,kn->n", asked, head[:-1]) + head[-1] for head in heads])
    best = int(np.square(predicted - values[own]).sum(axis=1).argmin()) if len(tried) else UNTRIED
    weights = np.zeros(len(found.names) + 1)
    weights[[*places, -1]] = solved[best][:, :-1] @ values
    # The curve passes one half where the prior does. Leaving a material out makes its constituents rarer among the
    # others, so a fitted offset is biased: with one, 72 % of new letters were right in place of 75.
    return weights, fit_curve(predicted[best], values[own], PRESENCE, turning=False) if curved else None


@dataclass(frozen=True)
class Composer:
    """Heads for every constituent that a description names, at every stage. Made by `Composer.of`."""

    model: Model
    targets: dict[str, Target]
    stages: list[StageHeads]

    @classmethod
    def of(cls, model: Model, memory: Memory) -> Composer:
        """Fit the heads of all constituents described in a memory, over the model of the same memory."""
        targets = targets_of(memory.descriptions)
        with one_thread():
            return cls(model, targets, [StageHeads(model, stage, targets) for stage in range(len(model.fitted.rows))])

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
        heads = self.stages[self._stage(encoded.steps)]
        z, new = heads.read(encoded.means)
        # Bayes: the curve was fitted to as many new touches as known ones, a prior of one half.
        odds = new * expected, (1 - new) * (1 - expected)
        unfamiliar = odds[0] / sum(odds) if sum(odds) else expected
        found = constituents(self.targets, heads.presence, heads.share, feels_like, z, unfamiliar)
        return tuple(found[name] for name in wanted), unfamiliar


def constituents(
    targets: Mapping[str, Target],
    presences: Mapping[str, Head],
    shares: Mapping[str, Head],
    feels_like: Mapping[str, float],
    z: FloatArray,
    unfamiliar: float,
) -> dict[str, Constituent]:
    """All constituents by name: by the observed materials, and by heads as far as the touch is of a new one.

    Shares are scaled to sum to one, or, where some share is unknown, to at most one.
    """

    def weighed(head: Head, known: Mapping[str, float]) -> float | None:
        if isinstance(head, str):
            return None
        weights, curve = head
        value = float(weights[:-1] @ z + weights[-1])
        value = min(max(value, 0.0), 1.0) if curve is None else float(curve(value))
        observed = {material: feels_like[material] for material in known if material in feels_like}
        weight = (1 - unfamiliar) * sum(observed.values())
        familiar = (1 - unfamiliar) * sum(chance * known[material] for material, chance in observed.items())
        return min(max(familiar + (1 - weight) * value, 0.0), 1.0)

    found = {}
    for name, target in targets.items():
        having = ((material, feels_like.get(material, 0.0)) for material, has in target.presence.items() if has)
        evidence = sorted((item for item in having if item[1] > 0), key=lambda item: (-item[1], item[0]))
        found[name] = Constituent(
            name=name,
            presence=weighed(presences[name], target.presence),
            share=weighed(shares[name], target.share),
            evidence=tuple(evidence[:MOST_EVIDENCE]),
            unlearned=why if isinstance(why := presences[name], str) else "",
        )
    known = [found[name].share for name, target in targets.items() if target.share]
    total = sum(share for share in known if share is not None)
    if total == 0 or (total <= 1 and None in known):
        return found
    return {name: one if one.share is None else replace(one, share=one.share / total) for name, one in found.items()}
