"""The composition of a touch, by a ridge regression (a head) for each constituent over the readouts of a model.

A touch of an observed material has the mean of the materials' descriptions, weighted by their probabilities; one of a
new material what the heads predict. The novelty weighs these two cases. Heads and novelty are calibrated on the sampled
touches: each is scored by readouts that never observed it, and by heads that never observed its material.
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
    """The heads of one stage over its C materials: constituent → those of its presence and of its share.

    novel: from standardised novelty to the probability of a new material.
    """

    def __init__(self, model: Model, stage: int, targets: Mapping[str, Target]) -> None:
        self._model, self._row = model, model.fitted.rows[stage]
        calibration, scales = self._row.calibration, self._row.scales
        found = model.held_out.at(stage, scales)
        total = float(calibration.weights.sum())
        weights = calibration.weights / total if total > 0 else np.full(len(scales), 1 / len(scales))
        self._read = [
            (weight, model.readouts[scale], [model.readouts[scale].places[name] for name in found.names])
            for weight, scale in zip(weights.tolist(), scales, strict=True)
        ]
        grams = [weight * readout.derived().gram[np.ix_(places, places)] for weight, readout, places in self._read]
        novelties = map(calibration.novelty, novelty_measures(found, model.held_out.around(self._row)))
        self.novel = fit_curve(np.concatenate([*novelties]), np.repeat([0, 1], len(found.targets)), NOVEL)
        head = partial(_head, found, np.einsum("s,nsc->nc", weights, found.z()), sum(grams), {})
        self.heads = {
            name: (head(of.presence, curved=True), head(of.share, curved=False)) for name, of in targets.items()
        }

    def read(self, means: Mapping[Scale, FloatArray]) -> tuple[FloatArray, float]:
        """z of a touch's mean features by scale, (C,), and the probability that it is new, by a prior of one half."""
        z = sum(weight * readout.centred(means[readout.scale])[places] for weight, readout, places in self._read)
        return np.asarray(z), float(self.novel(self._model.novelty(self._row, means, self._model.names)))


def _head(
    found: StageScores,
    z: FloatArray,
    gram: FloatArray,
    inverses: dict[bytes, list[FloatArray]],
    known: Mapping[str, float],
    *,
    curved: bool,
) -> Head:
    """The head of one constituent: known, material → target; curved where it is a presence.

    found: the sampled touches, held out, with z, (N, C). gram: of the C materials. inverses: B at each γ, by materials.
    """
    places = np.array([place for place, name in enumerate(found.names) if name in known], dtype=np.intp)
    values = np.array([known[found.names[place]] for place in places], dtype=np.float64)
    if len(places) < 2:
        return f"it is known of {len(places)} of the materials observed for long enough; a head takes two or more"
    if np.ptp(values) == 0:
        return f"{'every' if values[0] else 'no'} material observed for long enough has it, as far as known"
    if places.tobytes() not in inverses:
        inverses[places.tobytes()] = [solve(gram[np.ix_(places, places)], gamma) for gamma in GAMMAS]
    solved = inverses[places.tobytes()]
    # A head is tried by touches of materials whose others differ, without these.
    differing = [place for i, place in enumerate(places) if np.ptp(np.delete(values, i)) > 0]
    tried = np.flatnonzero(np.isin(found.targets, differing))
    own, asked = np.searchsorted(places, found.targets[tried]), z[np.ix_(tried, places)]
    heads = (heads_without(inverse, values)[:, own] for inverse in solved)
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
        stage = self.stages[self._stage(encoded.steps)]
        z, new = stage.read(encoded.means)
        # Bayes: the curve was fitted to as many new touches as known ones, a prior of one half.
        odds = new * expected, (1 - new) * (1 - expected)
        unfamiliar = odds[0] / sum(odds) if sum(odds) else expected
        found = constituents(self.targets, stage.heads, feels_like, z, unfamiliar)
        return tuple(found[name] for name in wanted), unfamiliar


def constituents(
    targets: Mapping[str, Target],
    heads: Mapping[str, tuple[Head, Head]],
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
        familiar = sum(chance * known[material] for material, chance in observed.items())
        weight = (1 - unfamiliar) * sum(observed.values())
        return min(max((1 - unfamiliar) * familiar + (1 - weight) * value, 0.0), 1.0)

    found = {}
    for name, target in targets.items():
        presence, share = heads[name]
        having = [(-feels_like.get(material, 0.0), material) for material, has in target.presence.items() if has]
        found[name] = Constituent(
            name=name,
            presence=weighed(presence, target.presence),
            share=weighed(share, target.share),
            evidence=tuple((material, -less) for less, material in sorted(having)[:MOST_EVIDENCE] if less),
            unlearned=presence if isinstance(presence, str) else "",
        )
    known = [found[name].share for name, target in targets.items() if target.share]
    total = sum(share for share in known if share is not None)
    if total == 0 or (total <= 1 and None in known):
        return found
    return {name: one if one.share is None else replace(one, share=one.share / total) for name, one in found.items()}
