"""Whether each channel of a sensor still measures: by the touches that a memory keeps, or by one recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.likelihood import LEVELS, MISSING, LevelArray

__all__ = ["DEAD", "DRIFTING", "LATELY", "SATURATED", "ChannelSummary", "channels_of", "drift"]

FloatArray = npt.NDArray[np.float64]

DEAD = 0.8  # of the touches, in which a channel never changes
SATURATED = 0.05  # of the readings, at an end of the range
DRIFTING = 0.05  # of the range, from the first touch to the last …
CERTAIN = 4.0  # … and as many standard errors
LATELY = 20  # touches: a channel that died is seen in these
STEADY = 0.5  # of a channel that lives, in as many touches at most it may be still


@dataclass(frozen=True)
class ChannelSummary:
    """One channel, its levels as shares of its range.

    number: from 1. middle: the median; low, high: where 5 and 95 % of the readings lie. still: share of the touches in
    which it never changes, and of the last ones. bottom, top: share of its readings at either end of the range. signed:
    whether zero lies inside the range, so that its bottom is an end, too. missing: share that was not read. drift: from
    the first touch to the last, beside what the materials explain, and its standard error; None where it cannot be
    measured.
    """

    number: int
    middle: float
    low: float
    high: float
    still: float
    still_lately: float
    bottom: float
    top: float
    signed: bool
    missing: float
    drift: tuple[float, float] | None

    @property
    def faults(self) -> list[str]:
        """What is wrong with it, in words."""
        found = []
        if self.still >= DEAD:
            found.append("dead")
        elif self.still_lately >= DEAD and self.still_lately - self.still > STEADY / 2:
            found.append("died lately")
        elif max(self.top, self.bottom if self.signed else 0.0) >= SATURATED:
            found.append("saturated")
        if self.drift is not None and not found and self.drifts:
            found.append("drifting")
        if self.missing >= SATURATED:
            found.append("missing readings")
        return found

    @property
    def drifts(self) -> bool:
        """Whether its level moved, and by more than chance."""
        return (
            self.drift is not None and abs(self.drift[0]) >= DRIFTING and abs(self.drift[0]) >= CERTAIN * self.drift[1]
        )


def channels_of(
    touches: Sequence[LevelArray], materials: Sequence[str], signed: npt.NDArray[np.bool_], *, ordered: bool
) -> list[ChannelSummary]:
    """The channels of some touches, levels (C, T) each.

    signed: whether zero lies inside the range of each, (C,). ordered: whether the touches come as they were observed.
    """
    count = len(touches[0])
    still = np.array([_still(levels) for levels in touches])
    means = np.array([_mean(levels) for levels in touches])
    counts = np.zeros((count, 256), np.int64)
    for levels in touches:
        placed = np.arange(count)[:, None] * 256 + levels
        counts += np.bincount(placed.ravel(), minlength=counts.size).reshape(counts.shape)
    drifts = drift(means, materials) if ordered else [None] * count
    lately = still[-LATELY:].mean(axis=0) if ordered else still.mean(axis=0)
    return [
        _channel(i, counts[i], (float(still[:, i].mean()), float(lately[i])), drifts[i], signed=bool(signed[i]))
        for i in range(count)
    ]


def _channel(
    i: int,
    counts: npt.NDArray[np.int64],
    still: tuple[float, float],
    moved: tuple[float, float] | None,
    *,
    signed: bool,
) -> ChannelSummary:
    total, read = int(counts.sum()), counts[:MISSING]
    reached = np.cumsum(read) / max(int(read.sum()), 1)
    low, middle, high = (float(np.searchsorted(reached, share)) / (LEVELS - 1) for share in (0.05, 0.5, 0.95))
    bottom, top = float(read[0]) / max(int(read.sum()), 1), float(read[LEVELS - 1]) / max(int(read.sum()), 1)
    missing = float(counts[MISSING]) / max(total, 1)
    return ChannelSummary(i + 1, middle, low, high, *still, bottom, top, signed, missing, moved)


def _still(levels: LevelArray) -> npt.NDArray[np.bool_]:
    """Which channels never change in a touch, (C,)."""
    read = levels != MISSING
    high, low = np.where(read, levels, 0).max(axis=1), np.where(read, levels, LEVELS).min(axis=1)
    return np.asarray(high <= low)


def _mean(levels: LevelArray) -> FloatArray:
    """The mean of each channel as a share of its range, (C,); NaN where nothing was read."""
    read = levels != MISSING
    sums = np.where(read, levels, 0).sum(axis=1, dtype=np.int64)
    with np.errstate(invalid="ignore"):
        return np.asarray(sums / read.sum(axis=1) / (LEVELS - 1))


def drift(means: FloatArray, materials: Sequence[str]) -> list[tuple[float, float] | None]:
    """How far each channel's level moves from the first touch to the last, and its standard error.

    means: (touches, C), in the order of observation. It is the slope over the place in that order of what the materials
    do not explain (Frisch and Waugh 1933): materials taught one after the other do not look like drift, and where each
    was touched at one time only there is nothing to see it by.
    """
    count = len(means)
    none: list[tuple[float, float] | None] = [None] * means.shape[1]
    if count < LATELY:
        return none
    own = np.unique(np.array(materials), return_inverse=True)[1]
    place = np.linspace(-0.5, 0.5, count)
    place = place - (np.bincount(own, place) / np.bincount(own))[own]
    free, spread = count - int(own.max()) - 2, float(place @ place)
    if free < 8 or spread < 0.01 * count / 12:
        return none
    found = none
    for i, level in enumerate(means.T):
        if np.isfinite(level).all():
            rest = level - (np.bincount(own, level) / np.bincount(own))[own]
            slope = float(place @ rest) / spread
            left = rest - slope * place
            found[i] = slope, float(np.sqrt(max(left @ left, 0.0) / free / spread))
    return found
