"""The model: everything that predictions need of one state of a memory, computed from it and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.memory import Memory, give_back_scratch
from scroll_tactile.ridge.calibration import Calibration, calibrate
from scroll_tactile.ridge.moments import one_thread
from scroll_tactile.ridge.readouts import ReadoutName
from scroll_tactile.ridge.selection import Selection, select
from scroll_tactile.windows import fitting, milestones

__all__ = ["Judgement", "Model"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Judgement:
    """probability: of each candidate, shape (C,). novelty: see Prediction. calibration: of the stage judged at."""

    probability: FloatArray
    novelty: float
    calibration: Calibration


@dataclass(frozen=True)
class Model:
    """names: the materials. selections: scale → its readout. stages: for each, the scales that fit there."""

    kind: ReadoutName
    names: list[str]
    scales: Sequence[int]
    stages: list[list[int]]
    selections: dict[int, Selection]
    calibrations: list[Calibration]

    @classmethod
    def of(cls, memory: Memory, kind: ReadoutName) -> Model:
        """Fit the readouts of a memory and calibrate them."""
        statistics = memory.statistics
        scales = statistics.scales
        stages = [fitting(length, scales) for length in milestones(scales)]
        with one_thread():
            chosen = {scale: select(statistics, scale, kind) for scale in scales}
            selections = {scale: selection for scale, selection in chosen.items() if selection is not None}
            calibrations = calibrate(memory.pool, stages, selections, kind)
        give_back_scratch()
        return cls(kind, list(statistics.materials), scales, stages, selections, calibrations)

    def judge(self, candidates: Sequence[str], means: Sequence[FloatArray], reached: int) -> Judgement:
        """Weigh the candidates for a touch.

        means: for each scale that fits the touch its mean codes, shape (d,). reached: how many stages it reached.

        Materials that were felt at fewer scales are weighed against all others at the stage that they share; what
        these leave over is shared out among the others at the finer stages.
        """
        reached = min(reached, len(self.calibrations))
        projected = [
            self.selections[scale].readout.project(mean)
            for scale, mean in zip(self.scales, means, strict=False)
            if scale in self.selections
        ]
        groups = [self._felt_at(scales, candidates) for scales in self.stages[:reached]]
        probability, mass = np.ones(len(candidates)), 1.0
        for at, members in enumerate(groups):
            later = groups[at + 1] if at + 1 < reached else []
            if len(later) < len(members):
                shares = self._shares(at, projected, [candidates[place] for place in members])
                probability[members] = shares * mass
                mass = float(probability[later].sum())
        best = int(np.argmax(probability))
        stage = max(at for at, members in enumerate(groups) if best in members)
        calibration = self.calibrations[stage]
        distances = [
            self._distance(scale, z, candidates) for scale, z in zip(self.stages[stage], projected, strict=False)
        ]
        return Judgement(probability, float(calibration.novelty(np.array(distances))), calibration)

    def _felt_at(self, scales: Sequence[int], candidates: Sequence[str]) -> list[int]:
        """The places of the candidates that were felt at all of these scales."""
        known = [self.selections[scale].places for scale in scales]
        return [at for at, name in enumerate(candidates) if all(name in places for places in known)]

    def _shares(self, stage: int, projected: Sequence[FloatArray], names: Sequence[str]) -> FloatArray:
        logits = np.zeros(len(names))
        for scale, z, weight in zip(self.stages[stage], projected, self.calibrations[stage].weights, strict=False):
            selection = self.selections[scale]
            logits += weight * selection.readout.scores(z, self.kind)[[selection.places[name] for name in names]]
        chances = np.exp(logits - logits.max())
        shares: FloatArray = chances / chances.sum()
        return shares

    def _distance(self, scale: int, z: FloatArray, candidates: Sequence[str]) -> float:
        selection = self.selections[scale]
        places = np.array([selection.places[name] for name in candidates if name in selection.places])
        return float(selection.readout.novelty(z, places))
