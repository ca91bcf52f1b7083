"""What a change of the sensor looks like, from the touches since it began, and what to do about it.

Touches scatter about the means of their cells; P is the inverse of that scatter. What a gain, an offset and noise of a
channel do to the numbers of a touch is known, and the one that explains most of δᵀ P δ is the change.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile.health.channel_numbers import FLOOR, KINDS, UNIT
from scroll_tactile.results import ChangeKind, Health

__all__ = ["Deviation", "Floats", "Rows", "Scatter", "SensorChange", "advice", "diagnose", "diagnose_rest", "in_words"]

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int16]

PRIOR = 0.02  # of a logarithm: the assumed deviation of a number, which counts as one touch for each number
DEAD = -1.5  # of a logarithm: spread and noise of a channel that fell by so much say nothing any more
FEWEST = 3  # touches of each of two materials, from which one alone can be said to have changed
LEAST = 0.1  # of what the greatest explains: less is a correlation that is not known so well
MANY = 0.5  # of the channels
FEWEST_CHANNELS = 3  # from which many of them can be told from one

_SEEN = {
    "gain": "reads stronger or weaker by a factor",
    "offset": "reads higher or lower by a constant",
    "dead": "says nothing any more",
    "noisier": "is noisier",
    "slower": "is duller or slower",
    "gains": "changed, each in its own way",
    "all gains": "changed by one factor",
    "all offsets": "changed by one constant",
}
_FEW = "look at its contact, its wire and its amplifier"
_ALL = "look whether the skin, the unit, its supply or its temperature is another"


class Scatter:
    """The inverse of the prior plus the scatter of touches about the means of their cells, updated by each touch
    (Sherman, Morrison 1950)."""

    def __init__(self, channels: int) -> None:
        self.channels, size = channels, KINDS * channels + 1
        self.inverse: Floats = np.eye(size) / (size * PRIOR**2)
        self.count = 0

    def take(self, away: Floats, among: int) -> None:
        """Add a touch that lies so far from the mean of the others of its cell, (size,) in logarithms, so many."""
        self.count += 1
        taken = away * math.sqrt(among / (among + 1))
        moved = self.inverse @ taken
        # A product of matrices takes half the time of one with broadcasting, and is the same to the bit.
        self.inverse -= np.dot(moved[:, None], (moved / (1 + taken @ moved))[None])

    def without(self, away: Floats, among: npt.NDArray[np.int64]) -> Scatter:
        """That of the other touches: away and among are those of some that were taken, (k, size) and (k,)."""
        taken = away * np.sqrt(among / (among + 1))[:, None]
        other = Scatter(self.channels)
        other.count = self.count - len(away)
        # I − A P Aᵀ is positive but for rounding (Woodbury).
        inside = np.eye(len(away)) - taken @ self.inverse @ taken.T
        moved = self.inverse @ taken.T
        other.inverse = self.inverse + moved @ np.linalg.solve(inside, moved.T)
        return other

    def signatures(self) -> Floats:
        """How a gain, an offset and noise of each channel move the numbers, (size, 3 n).

        A louder channel raises the mean over channels, too, from which the levels are counted.
        """
        n, one = self.channels, np.eye(self.channels)
        level = np.zeros((KINDS * n + 1, n))
        level[:n], level[-1] = one - 1 / n, 1 / n
        gain, noise = level.copy(), np.zeros_like(level)
        gain[n : 2 * n] = gain[2 * n : 3 * n] = noise[2 * n : 3 * n] = one
        return np.concatenate([gain, level, noise], axis=1)

    def scores(self, rows: Rows) -> Floats:
        """Of rows (k, size) the scores of each channel, (k, 3 n): gain, offset and noise told from what else moves."""
        n = self.channels
        level, spread, noise = (self.inverse[:, at : at + n] for at in (0, n, 2 * n))
        offset = level - level.mean(axis=1, keepdims=True) + self.inverse[:, -1:] / n
        return np.asarray((rows * UNIT) @ np.concatenate([offset + spread + noise, offset, noise], axis=1))


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
        size = float(np.median(sizes[own]))
        grown = np.cumsum((size * (sizes - size / 2))[::-1])[::-1]
        own = np.arange(len(sizes)) >= grown.argmax()  # where sizes change from 0 to their median: the most likely
    lively = away[own, n : 2 * n] + away[own, 2 * n : 3 * n]
    if n >= FEWEST_CHANNELS:
        lively -= np.median(lively, axis=1, keepdims=True)
    dead = tuple(np.flatnonzero(np.median(lively, axis=0) < 2 * DEAD).tolist())  # their spread and noise fell so far
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
    if n >= FEWEST_CHANNELS and len(found) > min(2, MANY * n):
        alike = len({size > 0 for _, _, size in found}) == 1
        return "all gains" if alike and len(found) > MANY * n else "gains"
    if kind == KINDS - 1:
        return "noisier" if size > 0 else "slower"
    return "offset" if kind else "gain"


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
    sums = np.cumsum((level if levels else noise)[::-1], axis=0)[::-1]
    likely = np.square(sums).sum(axis=1) / np.arange(len(sums), 0, -1)
    own = np.arange(len(sums)) >= likely.argmax()  # where the mean changes from 0: the most likely, if normal
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


def _far(sizes: Floats) -> tuple[int, ...]:
    """The channels that moved a quarter as far as the one that moved most, or farther."""
    return tuple(np.flatnonzero(np.abs(sizes) > np.abs(sizes).max() / 4).tolist())


def in_words(health: Health, name: Callable[[str], str] = str) -> str:
    """One sentence: what changed, and since when. name: how the name of a material is written."""
    if not health.grew:
        return "nothing can be told yet: no touch has an earlier one of its material, length and level"
    if health.since is None:
        return f"no change of the sensor is seen in {health.touches} touches and rest readings"
    when = "" if health.time is None else f", {datetime.fromtimestamp(health.time, UTC):%Y-%m-%d %H:%M} UTC"
    since = f"since observation {health.since}{when}"
    if health.kind == "material":
        return f"{since} {', '.join(map(name, health.materials))} feels otherwise, and no other material does"
    many = "channel" if len(health.channels) == 1 else "channels"
    return f"{since} {many} {', '.join(map(str, health.channels))}: {_SEEN[health.kind]}"


def advice(health: Health) -> str:
    """What to do about it; "" where nothing is wrong."""
    if health.since is None:
        return ""
    if health.kind == "material":
        return (
            "it wore off, or another thing has its name: `scroll-tactile memory relabel` puts a wrong name right, and "
            f"--after {health.alarmed} asks about later touches alone"
        )
    look = _FEW if health.kind in ("gain", "offset", "dead", "noisier", "slower") else _ALL
    return (
        f"{look}; answers to touches since then may be wrong. Mended, --after {health.alarmed} asks about later "
        "touches alone; if it cannot be mended, about five touches of known materials take it over: `scroll-tactile "
        f"memory adapt`, with --until {health.since - 1}"
    )
