"""The exported judge: the reduced judge of a scene, in whole numbers, so that a chip gives the same answer to the bit.

It judges a touch by its windows alone: no views of the whole touch, no kept touches, no f*. Its C, native/judge.c,
follows this file; both read the same tables. A feature lies in 0 … 2¹⁵. With X_f the sum of one over the n windows of a
scale, V the weights of the readout (`readouts.readout`), and all divisions rounded down:

    z_y = ⌊⌊Σ_f V_yf X_f / n⌋ / 2^shift⌋ + c_y,    s_y = z_y − h_y,
    distance = ⌊Σ_y z_y ⌊Σ_r H_yr z_r / 2^…⌋ / 2¹⁶⌋ − 2 max_y s_y    (relative Mahalanobis),

and of the scales of a stage the scores are weighed by its calibration, and the distances standardised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.convolution import LEVELS, to_levels
from scroll_tactile.embeddings.kernels import Kernels
from scroll_tactile.errors import InputError
from scroll_tactile.prediction.features import Readings
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import validate
from scroll_tactile.signals.windows import Scale, WindowPlan

__all__ = [
    "ANGLES",
    "CHANCES",
    "MISSING_LEVEL",
    "MOST_MATERIALS",
    "ONE",
    "ExportedAnswer",
    "ExportedJudge",
    "ExportedScale",
    "ExportedStage",
]

Integers = npt.NDArray[np.int64]
LevelRows = npt.NDArray[np.int16]

# As judge.h has them.
MISSING_LEVEL = -(2**15)
ONE = 2**15
ANGLE_STEPS = 4096
MOST_CHANCES = 768
MOST_MATERIALS = 64
MOST_Z, MOST_U, MOST_DISTANCE = 2**26, 2**30, 2**32
FIXED_BYTES = 3624  # of tactile_touch with 32-bit pointers

ANGLES = np.rint(ONE * (2 / np.pi) * np.arcsin(np.sqrt(np.arange(ANGLE_STEPS + 1) / ANGLE_STEPS))).astype(np.uint16)
CHANCES = np.rint(65535 * np.exp(-np.arange(MOST_CHANCES) / 64)).astype(np.uint16)


@dataclass(frozen=True)
class ExportedScale:
    """How the windows of one width are weighed, for M materials; see `tactile_scale` in native/judge.h.

    weights: (F, M). shift: z is a weighed mean less so many bits.
    offsets: c, halves: h, (M,). background: H, (M, M), and its shift.
    """

    scale: Scale
    weights: npt.NDArray[np.int16]
    shift: int
    offsets: Integers
    halves: Integers
    background: npt.NDArray[np.int32]
    background_shift: int

    def settled(self, sums: Integers, windows: int) -> tuple[Integers, int]:
        """z of the materials, (M,), from weighed sums over so many windows, and the relative distance."""
        z = (sums // windows >> self.shift) + self.offsets
        z = z.clip(-MOST_Z, MOST_Z)
        u = (self.background.astype(np.int64) @ z >> self.background_shift).clip(-MOST_U, MOST_U)
        distance = (int(u @ z) >> 16) - 2 * int((z - self.halves).max())
        return z, max(-MOST_DISTANCE, min(MOST_DISTANCE, distance))


@dataclass(frozen=True)
class ExportedStage:
    """How a touch of `least` readings or more is judged; see `tactile_stage` in native/judge.h.

    weights: of the scores of the first scales, to 2⁻²⁴ logits. distance_weights, distance_shifts: of their distances,
    to 2⁻¹⁶ spreads. threshold: of what is unknown. detects: whether new materials would be noticed.
    """

    least: int
    detects: bool
    weights: tuple[int, ...]
    distance_weights: tuple[int, ...]
    distance_shifts: tuple[int, ...]
    threshold: int


@dataclass(frozen=True)
class ExportedAnswer:
    """What the exported judge says of a touch, equal to the chip's.

    material: the likeliest; None where the touch is too short. known: False: never felt; None: cannot be told.
    probability: in steps of 1/65535. scores: 2⁻²⁴ logits of the materials, before a common constant; none for a touch
    that is too short. novelty: in 2⁻¹⁶ spreads, unknown above 0. readings: that it rests on.
    """

    material: str | None
    known: bool | None
    probability: float
    scores: tuple[int, ...]
    novelty: int
    readings: int


@dataclass(frozen=True)
class ExportedJudge:
    """The reduced judge of a scene: made by `TactileLearner.exported`, written as C by `write_firmware`.

    digest: of the memory. materials: of the scene, in alphabetical order. capacity: readings that a touch can have,
    those of the longest that was learned; later ones are not read. scales, stages: ascending.
    """

    sensor: Sensor
    digest: str
    embedding: Kernels
    plan: WindowPlan
    materials: tuple[str, ...]
    capacity: int
    scales: tuple[ExportedScale, ...]
    stages: tuple[ExportedStage, ...]

    def levels(self, readings: Readings) -> LevelRows:
        """What the chip is given of a touch: int16 of shape (T, n), the sensor's range as ±2048, T up to the capacity.

        readings: as for `TactileLearner.predict`. Raises StreamError.
        """
        stream = validate(readings, self.sensor)
        return np.ascontiguousarray(to_levels(tactile_image(stream)).T[: self.capacity]).astype(np.int16)

    def predict(self, readings: Readings) -> ExportedAnswer:
        """Judge a touch in the sensor's unit. Raises StreamError."""
        return self.answer(self.levels(readings))

    def answer(self, levels: LevelRows) -> ExportedAnswer:
        """Judge a touch by its levels, int16 of shape (T, n).

        Where a level is −32768, nothing was read: the channel's last one counts again, at first 0. Others outside of
        ±2048 count as the nearest within. Raises InputError for another shape or type.
        """
        if levels.ndim != 2 or levels.shape[1] != self.sensor.channels or levels.dtype != np.int16:
            raise InputError(
                f"expected levels int16 of shape (T, {self.sensor.channels}); came {levels.dtype} {levels.shape}"
            )
        taken = _repeated(levels[: self.capacity]).clip(-LEVELS, LEVELS).T.astype(np.float32)
        steps = taken.shape[1]
        reached = [stage for stage in self.stages if stage.least <= steps]
        if not reached:
            return ExportedAnswer(None, None, 0.0, (), 0, readings=steps)
        stage = reached[-1]
        novelty, scores = -stage.threshold, np.zeros(len(self.materials), np.int64)
        among = self.scales[: len(stage.weights)]
        for i, (scale, sums) in enumerate(zip(among, self._sums(taken, among), strict=True)):
            z, distance = scale.settled(*sums)
            novelty += stage.distance_weights[i] * distance >> stage.distance_shifts[i]
            scores += stage.weights[i] * (z - scale.halves)
        behind = (scores.max() - scores) >> 18
        total = int(CHANCES[behind[behind < MOST_CHANCES]].sum(dtype=np.int64))
        probability = 65535 * int(CHANCES[0]) // total / 65535
        known, best = False if novelty > 0 else True if stage.detects else None, self.materials[scores.argmax()]
        return ExportedAnswer(best, known, probability, tuple(scores.tolist()), novelty, readings=steps)

    def _sums(self, levels: npt.NDArray[np.float32], among: Sequence[ExportedScale]) -> list[tuple[Integers, int]]:
        """For each scale the weighed sums of its features over its windows, (M,), and how many windows these are."""
        steps = levels.shape[1]
        extent, places = self.plan.extent(steps), self.plan.places(steps)
        windows = {one.scale.width: [extent[one.scale.width][place] for place in places[one.scale]] for one in among}
        found, sums = self.embedding.window_counts(levels, windows), []
        for one in among:
            width, starts = one.scale.width, windows[one.scale.width]
            parts = [_angled(counts, places).sum(axis=0, dtype=np.int64) for counts, places in found[width]]
            if (features := self.embedding.level_features(levels, width, starts)) is not None:
                parts.append((features * np.float32(ONE)).astype(np.int64).sum(axis=0))
            sums.append((np.concatenate(parts) @ one.weights.astype(np.int64), len(starts)))
        return sums

    @property
    def ram_bytes(self) -> int:
        """Bytes of the touch and what it is judged in; see `tactile_touch` in native/judge.h. The stack takes 2 kB."""
        channels = self.sensor.channels
        made = [self.embedding.triangles(channels, one.scale.width) for one in self.scales]
        most = max((len(each.phases) for each in made if each is not None), default=0)
        return 2 * channels * self.capacity + 16 * self.capacity + 4 * most + 16 * channels + FIXED_BYTES


def _angled(counts: npt.NDArray[np.integer], places: int) -> Integers:
    """The features of counts out of so many places."""
    return ANGLES[(counts.astype(np.int64) * ANGLE_STEPS + places // 2) // places].astype(np.int64)


def _repeated(levels: LevelRows) -> LevelRows:
    """Levels (T, n) with a channel's last one where nothing was read, 0 where there is none before."""
    missing = levels == MISSING_LEVEL
    last = np.maximum.accumulate(np.where(missing, -1, np.arange(len(levels))[:, None]), axis=0)
    filled = np.take_along_axis(levels, last.clip(0), axis=0)
    return np.where(last < 0, np.int16(0), filled).astype(np.int16)
