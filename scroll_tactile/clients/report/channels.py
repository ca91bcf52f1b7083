"""Whether each channel of a sensor measures: by the touches that a memory keeps and its health, or by one recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.likelihood import LEVELS, MISSING, LevelArray
from scroll_tactile.results import ChangeKind, Health

__all__ = ["DEAD", "DRIFTING", "LATELY", "SATURATED", "ChannelSummary", "changed_in", "channels_of", "drift"]

FloatArray = npt.NDArray[np.float64]

DEAD = 0.8  # of the touches, in which a channel never changes
SATURATED = 0.05  # of the readings, at an end of the range
DRIFTING = 0.05  # of the range, from the first part of a recording to the last …
CERTAIN = 4.0  # … and as many standard errors
LATELY = 20  # parts: a channel that died is seen in these
STEADY = 0.5  # of a channel that lives, in as many parts at most it may be still
CHANGED: dict[ChangeKind, str] = {
    "gain": "another gain",
    "offset": "another offset",
    "dead": "dead",
    "noisier": "noisier",
    "slower": "slower",
    "gains": "another gain",
    "all gains": "another gain",
    "all offsets": "another offset",
}


@dataclass(frozen=True)
class ChannelSummary:
    """One channel, its levels as shares of its range.

    number: from 0. middle: the median; low, high: where 5 and 95 % of the readings lie. still: share of the touches in
    which it never changes, and of the last ones. bottom, top: share of its readings at either end of the range. signed:
    whether zero lies inside the range, so that its bottom is an end, too. missing: share that was not read. drift: of a
    recording, from its first part to its last, and its standard error; None where it cannot be measured. change: what
    the memory's health says became of it; "" where nothing did.
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
    change: str = ""

    @property
    def faults(self) -> list[str]:
        """What is wrong with it, in words."""
        found = []
        if self.change:
            found.append(self.change)
        elif self.still >= DEAD:
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


def channels_of(touches: Sequence[LevelArray], signed: npt.NDArray[np.bool_], *, ordered: bool) -> list[ChannelSummary]:
    """The channels of some touches, or of the parts of one recording, levels (C, T) each.

    signed: whether zero lies inside the range of each, (C,). ordered: whether they follow each other, as parts do.
    """
    count = len(touches[0])
    still = np.array([_still(levels) for levels in touches])
    means = np.array([_mean(levels) for levels in touches])
    counts = np.zeros((count, 256), np.int64)
    for levels in touches:
        placed = np.arange(count)[:, None] * 256 + levels
        counts += np.bincount(placed.ravel(), minlength=counts.size).reshape(counts.shape)
    drifts = drift(means) if ordered else [None] * count
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
    return ChannelSummary(i, middle, low, high, *still, bottom, top, signed, missing, moved)


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


def drift(means: FloatArray) -> list[tuple[float, float] | None]:
    """How far each channel's level moves from the first part of a recording to the last, and its standard error.

    means: (parts, C), in order: the slope over the place in that order.
    """
    count = len(means)
    found: list[tuple[float, float] | None] = [None] * means.shape[1]
    if count < LATELY:
        return found
    place = np.linspace(-0.5, 0.5, count)
    spread = float(place @ place)
    for i, level in enumerate(means.T):
        if np.isfinite(level).all():
            rest = level - level.mean()
            slope = float(place @ rest) / spread
            left = rest - slope * place
            found[i] = slope, float(np.sqrt(max(left @ left, 0.0) / (count - 2) / spread))
    return found


def changed_in(channels: Sequence[ChannelSummary], health: Health | None) -> list[ChannelSummary]:
    """The channels, and what a memory's health says became of them."""
    if health is None or health.since is None or health.kind not in CHANGED:
        return list(channels)
    what = f"{CHANGED[health.kind]} since observation {health.since}"
    return [replace(own, change=what) if own.number in health.channels else own for own in channels]
