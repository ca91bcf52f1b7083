"""How the exported judge is made: readouts and calibration of a scene's windows, rounded to whole numbers once.

A weight keeps 15 bits and a sign: of each scale the largest decides the unit. Everything else (offsets, the background
matrix, calibration) keeps 30 bits or more, so the weights are what the rounding costs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from scroll_tactile.clients.firmware.exported_judge import (
    MOST_MATERIALS,
    ONE,
    ExportedJudge,
    ExportedScale,
    ExportedStage,
)
from scroll_tactile.embeddings.kernels import SHORTEST, Kernels
from scroll_tactile.errors import InputError
from scroll_tactile.memory.state import Memory
from scroll_tactile.readouts.calibration import Calibration, calibrate_stage
from scroll_tactile.readouts.leave_one_out import StageScores, held_out_scores
from scroll_tactile.readouts.readout import Readout
from scroll_tactile.readouts.task import Task
from scroll_tactile.recipe import Recipe
from scroll_tactile.settings import candidates_of
from scroll_tactile.signals.windows import ENOUGH, Scale
from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.moments import one_thread

__all__ = ["exported_judge"]

FloatArray = npt.NDArray[np.float64]

SCORE_BITS = 8  # of a logit's fraction, where the weights leave so many
LOGIT_BITS = 24
SPREAD_BITS = 16
FACTOR_BITS = 30
MOST_SHIFT = 62
MOST_THRESHOLD = 2**61
MOST_SCALES = 2  # as judge.h has it
MOST_WIDTH = 46_340  # readings: the sums of a wider window's squares are no exact float64, and overflow in judge.c
MOST_CHANNELS = 2**14  # four statistics of each are numbered in 16 bits
MOST_VALUES = 2**31 - 1  # of a touch, or of what it is judged in: int32 counts them
LEAST_BITS = -SCORE_BITS  # of a score: at 2⁸ logits a unit, materials lie so far apart that nothing can be told


def exported_judge(recipe: Recipe, memory: Memory, scene: Sequence[str] | None) -> ExportedJudge:
    """The exported judge of a scene, by a memory as it is now; see `TactileLearner.exported`."""
    names = candidates_of(scene, sorted(memory.statistics.materials), memory.statistics.materials.keys())
    _require_exportable(recipe, names, memory.statistics.longest)
    embedding = recipe.embedding
    assert isinstance(embedding, Kernels)
    with one_thread():
        readouts = _readouts(memory, names)
        stages = _calibrations(memory, readouts)
    scales, bits = zip(*map(_quantised, readouts), strict=True)
    return ExportedJudge(
        sensor=recipe.sensor,
        digest=memory.digest(),
        embedding=embedding,
        plan=recipe.plan,
        materials=tuple(names),
        capacity=memory.statistics.longest,
        scales=scales,
        stages=tuple(
            _stage(least, calibration, bits, recipe.settings.false_alarms, several=len(names) > 1)
            for least, calibration in stages
        ),
    )


def _require_exportable(recipe: Recipe, names: Sequence[str], longest: int) -> None:
    if not isinstance(recipe.embedding, Kernels) or recipe.sensor.camera or len(recipe.plan.widths) > MOST_SCALES:
        raise InputError(
            f"only memories of the default embedding, Kernels, can be exported as C; this one's is "
            f"{recipe.embedding!r} for {recipe.sensor.name}. Carry it over with reembed(Kernels())"
        )
    sensor, width = recipe.sensor, max(recipe.plan.widths)
    slower = f"Learn one reading in {-(-width // MOST_WIDTH)}, of a sensor with a lower rate="
    for what, came, most, cure, argument in (
        ("readings in a window", width, MOST_WIDTH, slower, "rate"),
        ("channels", sensor.channels, MOST_CHANNELS, "Learn fewer channels=, or means of neighbours", "channels"),
        ("readings in a touch", longest, MOST_VALUES // max(4, sensor.channels), "Learn touches cut shorter", None),
    ):
        if came > most:
            beyond = f"expected at most {most} {what}, which a chip's whole numbers hold; {sensor.name} has {came}"
            raise InputError(f"{beyond}. {cure}", argument=argument)
    if not 0 < len(names) <= MOST_MATERIALS:
        raise InputError(
            f"expected a scene of 1 to {MOST_MATERIALS} materials; came {len(names)}. Name those that can be there"
        )


def _readouts(memory: Memory, names: Sequence[str]) -> list[Readout]:
    """Of each width of windows that all of the materials have, ascending; touches are compared with the scene alone."""
    statistics = memory.statistics
    widths = [scale for scale in memory.plan.windows if not set(names) - set(statistics.names(scale))]
    if not widths:
        raise InputError(f"expected materials with a touch of {memory.plan.widths[0]} readings; {names} have none")
    return [Task.of(statistics, scale, names, memory.plan.shrinkage).solve() for scale in widths]


def _calibrations(memory: Memory, readouts: Sequence[Readout]) -> list[tuple[int, Calibration]]:
    """The least readings of each stage that these windows judge, and its calibration by the scene's sampled touches."""
    plan, names = memory.plan, set(readouts[0].reference)
    sample = [touch for touch in memory.sample if touch[0] in names]
    judging = [plan.judging(length) for length in plan.milestones()]
    stages = [[*scales, *plan.views] for scales in judging]  # a sampled touch's rows are numbered so
    held_out = [held_out_scores(readout, sample, stages, "lda") for readout in readouts]
    found = []
    begins = [max(SHORTEST, math.ceil(ENOUGH * plan.widths[0])), *plan.milestones()[1:]]
    for number, (least, scales) in enumerate(zip(begins, judging, strict=True)):
        if len(scales) <= len(readouts):
            scores = StageScores(number, sample, held_out[: len(scales)])
            found.append((least, calibrate_stage(scores, readouts[: len(scales)], "lda")))
    return found


def _quantised(readout: Readout) -> tuple[ExportedScale, int]:
    """A readout of one width in whole numbers, and the bits of a score's fraction: a unit is 2^-bits logits."""
    derived, width = readout.derived(), readout.scale.width
    # z about the mean of the scene's materials, for features in 0 … 1.
    weights = derived.weights * 2.0**BITS
    offsets = -(derived.weights @ (readout.origin + derived.middle))
    largest, top = float(np.abs(weights).max()), float(np.abs(derived.background).max())
    unit = 30 if largest == 0 else min(30, math.floor(math.log2((ONE - 1) / largest)))
    bits = min(SCORE_BITS, unit + 15)
    if bits < LEAST_BITS:
        raise InputError(
            f"materials whose touches are all alike cannot be weighed in 16 bits: a feature of {width} readings weighs "
            f"{largest:.0e} logits. Observe touches that differ as those to come will"
        )
    # u in 2⁻¹⁶: H counts in 2^-shift of a unit of scores.
    fine = FACTOR_BITS - (math.frexp(top)[1] if top else 0)
    shift = fine + bits - SPREAD_BITS
    fine, shift = fine - max(0, shift - MOST_SHIFT), min(shift, MOST_SHIFT)
    made = ExportedScale(
        scale=Scale("window", width),
        weights=np.rint(weights.T * 2.0**unit).astype(np.int16),
        shift=15 + unit - bits,
        offsets=np.rint(offsets * 2.0**bits).astype(np.int64),
        halves=np.rint(np.diagonal(derived.gram) / 2 * 2.0**bits).astype(np.int64),
        background=np.rint(derived.background * 2.0**fine).astype(np.int32),
        background_shift=shift,
    )
    return made, bits


def _stage(
    least: int, calibration: Calibration, bits: Sequence[int], false_alarms: float, *, several: bool
) -> ExportedStage:
    mean, spread = calibration.scale_novelty.T
    weights = [
        min(round(float(weight) * 2.0 ** (LOGIT_BITS - own)), 2**31 - 1)
        for weight, own in zip(calibration.weights, bits, strict=False)
    ]
    factors = [
        _factor(2.0 ** (SPREAD_BITS - own) / (float(one) * len(spread))) for one, own in zip(spread, bits, strict=False)
    ]
    threshold = 2.0**SPREAD_BITS * (calibration.thresholds.above("", false_alarms) + float((mean / spread).mean()))
    return ExportedStage(
        least=least,
        detects=several and calibration.thresholds.detects(false_alarms),
        weights=tuple(weights),
        distance_weights=tuple(factor for factor, _ in factors),
        distance_shifts=tuple(shift for _, shift in factors),
        threshold=round(max(-MOST_THRESHOLD, min(MOST_THRESHOLD, threshold))),
    )


def _factor(value: float) -> tuple[int, int]:
    """A factor as a whole number below 2³⁰ and the shift that follows it."""
    mantissa, exponent = math.frexp(value)
    shift = FACTOR_BITS - exponent
    if shift < 0:
        return 2**FACTOR_BITS - 1, 0
    return (min(round(mantissa * 2.0**FACTOR_BITS), 2**FACTOR_BITS - 1), shift) if shift <= MOST_SHIFT else (0, 0)
