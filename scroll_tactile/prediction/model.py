"""The model: everything that predictions need of one state of a memory, computed from it and nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.memory.state import Memory, give_back_scratch
from scroll_tactile.prediction.filling import Filling
from scroll_tactile.readouts.calibration import Calibration, calibrate, calibrate_stage
from scroll_tactile.readouts.readout import ReadoutName
from scroll_tactile.readouts.shrinkage import PENALTIES, Selection, select
from scroll_tactile.signals.windows import CHANNELS, NOISE, Scale, WindowPlan
from scroll_tactile.statistics.moments import one_thread

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
    """Everything that predictions need of one state of a memory, so that each answer rests on one state.

    names: the materials. stages: for each, the scales that judge there. selections: scale → its readout. calibrations:
    of the stages, as far as any touch reached them. longest: the columns of the longest touch that was learned. noisy:
    the calibration of touches observed through noise; None where none were learned. filling: fills in dead channels;
    None where the embedding does not ask for that.
    """

    kind: ReadoutName
    names: list[str]
    plan: WindowPlan
    stages: list[list[Scale]]
    selections: dict[Scale, Selection]
    calibrations: list[Calibration]
    longest: int
    noisy: Calibration | None = None
    filling: Filling | None = None

    @classmethod
    def of(cls, memory: Memory, kind: ReadoutName, filling: Filling | None = None) -> Model:
        """Fit the readouts of a memory and calibrate them; filling: see `Filling.of`."""
        statistics = memory.statistics
        scales = statistics.scales
        stages = [memory.plan.judging(length) for length in memory.plan.milestones()]
        with one_thread():
            penalties = memory.plan.penalties or PENALTIES
            chosen = {scale: select(statistics, scale, kind, penalties) for scale in scales if scale != CHANNELS}
            selections = {scale: selection for scale, selection in chosen.items() if selection is not None}
            calibrations = calibrate(memory.sample, stages, selections, kind)
            noisy = None
            if all(scale in selections for scale in NOISE):
                noisy = calibrate_stage(len(stages), memory.sample, [selections[scale] for scale in NOISE], kind)
        give_back_scratch()
        names, longest = list(statistics.materials), statistics.longest
        return cls(kind, names, memory.plan, stages, selections, calibrations, longest, noisy, filling)

    def is_last(self, columns: int) -> bool:
        """Whether a touch of so many columns is judged at the last stage, whose scores f* gives."""
        return min(len(self.plan.stages(columns)), len(self.calibrations)) == len(self.stages)

    def needed(self, candidates: Sequence[str], columns: int) -> list[Scale]:
        """The scales that are read to judge these candidates for a touch of so many columns."""
        decided = self._decided(candidates, len(self.plan.stages(columns)))
        return sorted({scale for stage, _ in decided for scale in self.stages[stage]})

    def judge(
        self,
        candidates: Sequence[str],
        means: Mapping[Scale, FloatArray],
        columns: int,
        tuned: Mapping[str, float] | None = None,
        *,
        noisy: bool = False,
    ) -> Judgement:
        """Weigh the candidates for a touch.

        means: for each scale that is `needed`, or of NOISE where the touch is `noisy`, its mean features in the codes'
        unit, (d,). columns: observed so far. tuned: logits of f*, by material, in place of the last stage's scores.

        A material that was observed at fewer scales is weighed at the last stage that it reached, against all others;
        the probability that is left goes to the others, which later stages weigh again.
        """
        z = {scale: self.selections[scale].readout.project(mean) for scale, mean in means.items()}
        if noisy:
            return self._judge_noisy(candidates, z)
        reached = len(self.plan.stages(columns))
        probability, mass = np.ones(len(candidates)), 1.0
        decided = self._decided(candidates, reached)
        for i, (stage, members) in enumerate(decided):
            names = [candidates[place] for place in members]
            if tuned is not None and stage == len(self.stages) - 1:
                logits = np.array([tuned[name] for name in names])
            else:
                logits = self._weighted(self.stages[stage], self.calibrations[stage], z, names)
            chances = np.exp(logits - logits.max())
            probability[members] = chances / chances.sum() * mass
            later = decided[i + 1][1] if i + 1 < len(decided) else []
            mass = float(probability[later].sum())
        best = int(np.argmax(probability))
        stage = max(stage for stage, members in decided if best in members)
        calibration = self.calibrations[stage]
        distances = [self._distance(scale, z[scale], candidates) for scale in self.stages[stage]]
        return Judgement(probability, float(calibration.novelty(np.array(distances))), calibration)

    def _judge_noisy(self, candidates: Sequence[str], z: Mapping[Scale, FloatArray]) -> Judgement:
        assert self.noisy is not None
        logits = self._weighted(NOISE, self.noisy, z, candidates)
        chances = np.exp(logits - logits.max())
        novelty = self.noisy.novelty(np.array([self._distance(scale, z[scale], candidates) for scale in NOISE]))
        return Judgement(chances / chances.sum(), float(novelty), self.noisy)

    def _decided(self, candidates: Sequence[str], reached: int) -> list[tuple[int, list[int]]]:
        """(stage, places of the candidates weighed there), for each stage that weighs any against each other."""
        groups = [
            self._observed_at(scales, candidates) for scales in self.stages[: min(reached, len(self.calibrations))]
        ]
        return [
            (stage, members)
            for stage, members in enumerate(groups)
            if members and (stage + 1 == len(groups) or len(groups[stage + 1]) < len(members))
        ]

    def _observed_at(self, scales: Sequence[Scale], candidates: Sequence[str]) -> list[int]:
        """The places of the candidates that were observed at all of these scales."""
        known = [self.selections[scale].places for scale in scales]
        return [i for i, name in enumerate(candidates) if all(name in places for places in known)]

    def _weighted(
        self, scales: Sequence[Scale], calibration: Calibration, z: Mapping[Scale, FloatArray], names: Sequence[str]
    ) -> FloatArray:
        logits = np.zeros(len(names))
        for scale, weight in zip(scales, calibration.weights, strict=True):
            selection = self.selections[scale]
            places = [selection.places[name] for name in names]
            logits += weight * selection.readout.scores(z[scale], self.kind)[places]
        return logits

    def _distance(self, scale: Scale, z: FloatArray, candidates: Sequence[str]) -> float:
        selection = self.selections[scale]
        places = np.array([selection.places[name] for name in candidates if name in selection.places])
        return float(selection.readout.novelty(z, places))
