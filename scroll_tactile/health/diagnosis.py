"""What a change of the sensor looks like, from the touches since it began: which channels, and what became of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile.health.betting import Floats, Rows, Scatter
from scroll_tactile.health.channel_numbers import FLOOR, KINDS, UNIT
from scroll_tactile.results import ChangeKind

__all__ = ["Deviation", "SensorChange", "diagnose", "diagnose_rest"]

DEAD = -1.5  # of a logarithm: spread and noise of a channel that fell by so much say nothing any more
FEWEST = 3  # touches of each of two materials, from which one alone can be said to have changed
LEAST = 0.1  # of what the greatest explains: less is a correlation that is not known so well
MANY = 0.5  # of the channels
FEWEST_CHANNELS = 3  # from which many of them can be told from one


@dataclass(frozen=True)
class SensorChange:
    """since: the first row that belongs to it. channels, kind: as in `Health`. materials: that show it."""

    since: int
    channels: tuple[int, ...]
    kind: ChangeKind
    materials: tuple[str, ...]


class Deviation(NamedTuple):
    """A row of the journal, its material ("" at rest), and how far its numbers lie from the mean of its cell, in
    logarithms; among: of how many rows that was.
    """

    row: int
    material: str
    away: Floats
    among: int


def diagnose(
    recent: Sequence[Deviation], behind: Sequence[bool], scatter: Scatter, top: int, bound: float
) -> SensorChange:
    """The change that the last touches show: the signatures that explain their mean.

    Signatures are taken one by one, each time the one that explains most of what is left of δᵀ P δ, until chance would
    explain as much (matching pursuit; χ² with Bonferroni's bound). recent: touches, and behind: whether the martingale
    of the greatest score, top, had begun to grow. P is of the touches before them.
    """
    n, own = scatter.channels, np.array(behind)
    away, among = np.array([each.away for each in recent]), np.array([each.among for each in recent])
    sizes, found = np.zeros(len(away)), list[tuple[int, int, float]]()
    for _ in range(2):  # as the martingale grew, then from where that change most likely began
        before = scatter.without(away[own], among[own])
        found = _explained(away[own], before, bound) or [(top % n, min(top // n, KINDS - 1), 0.0)]
        signature = before.signatures()[:, found[0][1] * n + found[0][0]]
        weighted = before.inverse @ signature
        sizes = away @ weighted / float(signature @ weighted)
        own = _began(sizes, own)
    dead = _dead(away[own], n)
    names = [each.material for each, mine in zip(recent, own, strict=True) if mine]
    row, all_names = recent[int(own.argmax())].row, tuple(sorted(set(names)))
    if dead and (len(dead) < MANY * n or n < FEWEST_CHANNELS):
        return SensorChange(row, dead, "dead", all_names)
    if (alone := _alone(names, sizes[own], found[0][2])) is not None:
        return SensorChange(row, (), "material", (alone,))
    channels = tuple(sorted({channel for channel, _, _ in found}))
    return SensorChange(row, channels, _kind(found, n), all_names)


def _kind(found: Sequence[tuple[int, int, float]], n: int) -> ChangeKind:
    _, kind, size = found[0]
    if n >= FEWEST_CHANNELS and len(found) > MANY * n:
        alike = len({size > 0 for _, _, size in found}) == 1
        return "all gains" if alike else "gains"
    if n >= FEWEST_CHANNELS and len(found) > 2:
        return "gains"
    if kind == KINDS - 1:
        return "noisier" if size > 0 else "slower"
    return "offset" if kind else "gain"


def _dead(away: Floats, n: int) -> tuple[int, ...]:
    """The channels whose spread and noise fell so far below those of the others that they say nothing any more."""
    lively = away[:, n : 2 * n] + away[:, 2 * n : 3 * n]
    if n >= FEWEST_CHANNELS:
        lively = lively - np.median(lively, axis=1, keepdims=True)
    return tuple(np.flatnonzero(np.median(lively, axis=0) < 2 * DEAD).tolist())


def _explained(away: Floats, scatter: Scatter, bound: float) -> list[tuple[int, int, float]]:
    """(channel, signature, size) of the signatures that explain the mean of touches, the greatest first."""
    n, signatures = scatter.channels, scatter.signatures()
    weighted = scatter.inverse @ signatures
    own = np.einsum("ij,ij->j", signatures, weighted)
    left, found = away.mean(axis=0), list[tuple[int, int, float]]()
    enough = 2 * math.log(signatures.shape[1] / bound) / max(scatter.count * len(away), 1)
    for _ in range(n):
        sizes = (weighted.T @ left) / own
        gains = sizes**2 * own
        gains.reshape(KINDS, n)[:, [channel for channel, _, _ in found]] = 0.0
        best = int(gains.argmax())
        enough = max(enough, float(gains[best]) * LEAST)
        if gains[best] < enough:
            break
        found.append((best % n, best // n, float(sizes[best])))
        left = left - signatures[:, best] * sizes[best]
    return found


def _began(sizes: Floats, behind: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Which rows lie behind the place where sizes change from 0 to their median behind: the most likely, if normal."""
    size = float(np.median(sizes[behind]))
    grown = np.cumsum((size * (sizes - size / 2))[::-1])[::-1]
    return np.asarray(np.arange(len(sizes)) >= grown.argmax())


def _alone(names: Sequence[str], sizes: Floats, size: float) -> str | None:
    """The material that shows a change of this size which others, touched as well, do not; None where none does."""
    own = {name: sizes[[other == name for other in names]] for name in names}
    showing = [name for name, each in own.items() if each.mean() * np.sign(size) > abs(size) / 2]
    others = len(names) - sum(len(own[name]) for name in showing)
    return showing[0] if len(showing) == 1 and others >= FEWEST and len(own[showing[0]]) >= FEWEST else None


def diagnose_rest(recent: Sequence[Deviation], rows: Rows, channels: int, *, levels: bool) -> SensorChange:
    """From readings at rest: whether levels moved by what they were (a gain) or all by the same (an offset).

    levels: whether a level showed the change; where none did, noise has.
    """
    n = channels
    away = np.array([each.away for each in recent])
    level, noise = away[:, :n] + away[:, -1:], away[:, 2 * n : 3 * n]
    own = _moved(level if levels else noise)
    row, moved = recent[int(own.argmax())].row, np.median(level[own], axis=0)
    before = np.exp(np.median(rows[:, :n] + rows[:, -1:].astype(np.int32), axis=0) * UNIT)
    shift = before * np.expm1(moved)
    if not levels or np.abs(shift).max() <= FLOOR:
        louder = np.median(noise[own], axis=0)
        kind: ChangeKind = "noisier" if louder[np.abs(louder).argmax()] > 0 else "slower"
        return SensorChange(row, _far(louder), kind, ())
    which = _far(shift)
    if len(which) <= MANY * n or n < FEWEST_CHANNELS:
        return SensorChange(row, which, "offset", ())
    gain = float(shift @ before / (before @ before))
    better = np.square(shift - gain * before).sum() < np.square(shift - shift.mean()).sum()
    return SensorChange(row, which, "all gains" if better else "all offsets", ())


def _moved(sizes: Floats) -> npt.NDArray[np.bool_]:
    """Which rows (k, n) lie behind the place where their mean changes from 0: the most likely, if normal."""
    sums = np.cumsum(sizes[::-1], axis=0)[::-1]
    likely = np.square(sums).sum(axis=1) / np.arange(len(sizes), 0, -1)
    return np.asarray(np.arange(len(sizes)) >= likely.argmax())


def _far(sizes: Floats) -> tuple[int, ...]:
    """The channels that moved a quarter as far as the one that moved most, or farther."""
    return tuple(np.flatnonzero(np.abs(sizes) > np.abs(sizes).max() / 4).tolist())
