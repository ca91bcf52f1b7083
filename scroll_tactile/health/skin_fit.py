"""What became of a skin, from a few touches of known materials: a gain and an offset of each channel.

The changed skin reads y = low + g (x − low) + o. Of a touch of a known material the numbers of its channels (see
`channel_numbers`), read from y through a guess of g and o, should lie about the mean of that material as touches of it
always did. Log gains are normal, and offsets in units of what a channel's readings span:

    ½ Σ_touches rᵀ P r / (1 + 1 / n) + ½ Σ_channels (log g / σ)² + (o / (τ s))²,

r the numbers less the mean of n touches of their material, P the inverse of the scatter within materials, s four
standard deviations of a channel's readings. The least of it (Levenberg 1944, Marquardt 1963) is the posterior mode. σ
and τ are those under which the touches are likeliest (Laplace's approximation; MacKay, Neural Computation 4, 1992).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.health.channel_numbers import FLOOR, KINDS, UNIT, Numbers
from scroll_tactile.signals.correction import GREATEST_GAIN, corrected

__all__ = ["Fitted", "Reference", "fitted", "guess_of_lost"]

Floats = npt.NDArray[np.float64]

SIGMAS = (0.03, 0.12)  # of log gains: units of one make, and other ones
TAUS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)  # of offsets, of what readings of a channel span
OWN = 0.02  # of a logarithm: added, in squares, to the standard deviation of each number
IDLE = 1.0  # times the floor of spreads: a channel below it says nothing of its gain
CLIPPED, MOSTLY = 0.1, 0.4  # of the readings: more of them at an end of the range than before; that usually are there
DEAD = -3.0  # of the logarithms of spread and noise, together: a channel that fell by so much reads nothing any more
BLOCKS = 16  # of touches, one of which is left out: beyond, each is one of several
STEP, ROUNDS, ENOUGH = 1e-3, 30, 1e-3  # of derivatives; of the search, and what is no progress


class Reference:
    """How the numbers of channels lie about the means of their materials: taken in, touch by touch."""

    def __init__(self, channels: int) -> None:
        self.channels, self._size = channels, KINDS * channels + 1
        self.counts: dict[str, int] = defaultdict(int)
        self._sums: dict[str, Floats] = defaultdict(lambda: np.zeros(self._size))
        self._squares: Floats = np.zeros((self._size, self._size))
        self._powers: Floats = np.zeros((2, channels))

    def take(self, material: str, numbers: Numbers) -> None:
        """Take in a touch of a material."""
        n, whole = self.channels, numbers.astype(np.float64)  # whole numbers: their sums are exact
        self.counts[material] += 1
        self._sums[material] += whole
        self._squares += np.outer(whole, whole)
        level = np.exp((whole[:n] + whole[-1]) * UNIT)
        self._powers += level, level**2 + np.exp(2 * whole[n : 2 * n] * UNIT)

    @property
    def total(self) -> int:
        """The touches that were taken in."""
        return sum(self.counts.values())

    def mean(self, material: str) -> Floats:
        """The mean numbers of a material, (3 n + 1,), in logarithms."""
        return self._sums[material] * (UNIT / self.counts[material])

    @property
    def spans(self) -> Floats:
        """Four standard deviations of all readings of each channel, (n,), as shares of the range."""
        mean, square = self._powers / self.total
        return np.asarray(4 * np.sqrt(np.maximum(square - mean**2, FLOOR**2)))

    @property
    def scatter(self) -> Floats:
        """The covariance within materials, drawn to its diagonal where few touches are known."""
        size, total = self._size, self.total
        between = sum(np.outer(own, own) / self.counts[name] for name, own in self._sums.items())
        found = (self._squares - between) * (UNIT**2 / max(total - len(self.counts), 1))
        own = np.diagonal(found).copy()
        found *= total / (total + size)
        found[np.diag_indices(size)] = own + OWN**2
        return np.asarray(found)

    @property
    def idle(self) -> npt.NDArray[np.bool_]:
        """The channels that hardly ever read anything, (n,)."""
        n = self.channels
        spread = np.sum(list(self._sums.values()), axis=0)[n : 2 * n] * (UNIT / self.total)
        return np.asarray(spread < np.log((1 + IDLE) * FLOOR))


@dataclass(frozen=True)
class Fitted:
    """gains, offsets: (n,), offsets as shares of the range. lost: channels that read nothing any more, (n,).

    before, after: rᵀ P r of the touches over the numbers of their known channels, as they are and each corrected by the
    others: about 1 of a skin that did not change. gained: the logarithm of how much likelier that makes them.
    """

    gains: Floats
    offsets: Floats
    lost: npt.NDArray[np.bool_]
    before: float
    after: float
    gained: float


class _PosteriorFit:
    """Touches as shares of the range, (T, n) each, beside what is known of their materials."""

    def __init__(self, reference: Reference, touches: Sequence[Floats], materials: Sequence[str], ends: Floats) -> None:
        n = self.n = reference.channels
        self.touches, self.spans = touches, reference.spans
        self.means = np.array([reference.mean(name) for name in materials])
        self.weights = np.array([1 / (1 + 1 / reference.counts[name]) for name in materials])
        none = np.zeros(n)
        away = self._joined(self._measured(none, none)) - self.means
        lively = away[:, n : 2 * n] + away[:, 2 * n : 3 * n]
        clipped = np.mean([((shares <= 0) | (shares >= 1)).mean(axis=0) for shares in touches], axis=0)
        clipped = (clipped > ends + CLIPPED) & (ends < MOSTLY)
        self.lost = ~reference.idle & (clipped | (np.median(lively, axis=0) < DEAD))
        self.known = ~reference.idle & ~self.lost
        chosen = np.flatnonzero(np.concatenate([np.tile(self.known, KINDS), [True]]))
        self.whitened = np.zeros((len(chosen), self.means.shape[1]))
        self.whitened[:, chosen] = np.linalg.inv(np.linalg.cholesky(reference.scatter[np.ix_(chosen, chosen)]))
        self.dimension = len(chosen)

    def _measured(self, logs: Floats, offsets: Floats) -> Floats:
        """Level, log spread and log noise of each touch and channel, corrected: (touches, 3, n); offsets in spans."""
        found = np.empty((len(self.touches), KINDS, self.n))
        for own, shares in zip(found, self.touches, strict=True):
            values = corrected(shares, np.exp(logs), offsets * self.spans)
            own[0] = values.mean(axis=0)
            own[1] = np.log(values.std(axis=0) + FLOOR)
            own[2] = np.log(np.abs(np.diff(values, 2, axis=0)).mean(axis=0) + FLOOR / 4)
        return found

    def _joined(self, measured: Floats) -> Floats:
        """The numbers of the touches, (touches, 3 n + 1)."""
        level, spread, noise = measured.transpose(1, 0, 2)
        total = np.log(level.mean(axis=1, keepdims=True) + FLOOR)
        return np.concatenate([np.log(level + FLOOR) - total, spread, noise, total], axis=1)

    def loss(self, logs: Floats, offsets: Floats) -> Floats:
        """rᵀ P r of each touch, (touches,)."""
        away = (self._joined(self._measured(logs, offsets)) - self.means) @ self.whitened.T
        return np.asarray(np.square(away).sum(axis=1))

    def _slopes(self, logs: Floats, offsets: Floats) -> tuple[Floats, Floats]:
        """The numbers less their means, and by each log gain and offset, (touches, 3 n + 1, 2 n)."""
        n, one = self.n, np.arange(self.n)
        here = self._measured(logs, offsets)
        level = here[:, 0]
        found = np.zeros((len(here), KINDS * n + 1, 2 * n))
        for which, (gain, offset) in enumerate(((STEP, 0.0), (0.0, STEP))):
            ahead = self._measured(logs + gain, offsets + offset)
            behind = self._measured(logs - gain, offsets - offset)
            slope, column = (ahead - behind) / (2 * STEP), one + which * n
            share = slope[:, 0] / (n * (level.mean(axis=1, keepdims=True) + FLOOR))  # a channel in the mean of all
            found[:, :n, which * n : which * n + n] = -share[:, None, :]
            found[:, one, column] += slope[:, 0] / (level + FLOOR)
            found[:, n + one, column], found[:, 2 * n + one, column] = slope[:, 1], slope[:, 2]
            found[:, -1, which * n : which * n + n] = share
        return self._joined(here) - self.means, found

    def mode(self, sigma: float, tau: float, start: Floats, leave: int | None = None) -> tuple[Floats, float]:
        """The posterior mode (2 n,), log gains and offsets in spans, and the evidence; leave: a block left out."""
        n, free = self.n, np.flatnonzero(np.tile(self.known, 2))
        prior = np.repeat([1 / sigma**2, 1 / tau**2], n)
        weights = self.weights.copy()
        if leave is not None:
            weights[leave::BLOCKS] = 0.0

        def objective(at: Floats) -> float:
            return float(weights @ self.loss(at[:n], at[n:]) + (prior * at**2).sum()) / 2

        at, damping = start, 1e-2
        least, curved = objective(at), np.eye(len(free))
        for _ in range(ROUNDS):
            away, slopes = self._slopes(at[:n], at[n:])
            away = (np.sqrt(weights)[:, None] * away @ self.whitened.T).ravel()
            slopes = (np.sqrt(weights)[:, None, None] * (self.whitened @ slopes[:, :, free])).reshape(len(away), -1)
            curved = slopes.T @ slopes + np.diag(prior[free])
            slope = slopes.T @ away + prior[free] * at[free]
            before = least
            while damping < 1e6:
                moved = at.copy()
                moved[free] -= np.linalg.solve(curved + damping * np.diag(np.diag(curved)), slope)
                if (there := objective(moved)) < least:
                    at, least, damping = moved, there, max(damping / 4, 1e-6)
                    break
                damping *= 4
            if before - least < ENOUGH:
                break
        volume = np.linalg.slogdet(curved)[1] - np.log(prior[free]).sum()
        return at, -least - float(volume) / 2


def fitted(reference: Reference, touches: Sequence[Floats], materials: Sequence[str], ends: Floats) -> Fitted:
    """What became of each channel, by touches as shares of the range, (T, n) each, of these materials.

    The materials were taken into the reference. ends: the share of earlier readings of each channel that lie at an end
    of the range, (n,): one that is clipped more often now is lost, as what it reads is not known.
    `before` and `after` say whether it explains the touches better.
    """
    n, fit = reference.channels, _PosteriorFit(reference, touches, materials, ends)
    none = np.zeros(2 * n)
    best, evidence, how, at = none, -np.inf, (SIGMAS[0], TAUS[0]), none
    for sigma in SIGMAS:
        for tau in TAUS:
            at, likely = fit.mode(sigma, tau, at)
            if likely > evidence:
                best, evidence, how = at, likely, (sigma, tau)
    before = fit.loss(none[:n], none[n:])
    after = np.empty(len(touches))
    for leave in range(min(len(touches), BLOCKS)):
        held = fit.mode(*how, best, leave)[0]
        after[leave::BLOCKS] = fit.loss(held[:n], held[n:])[leave::BLOCKS]
    limit = np.log(GREATEST_GAIN)
    gains = np.where(fit.known, np.exp(np.clip(best[:n], -limit, limit)), 1.0)
    offsets = np.where(fit.known, np.clip(best[n:] * reference.spans, -1.0, 1.0), 0.0)
    return Fitted(
        gains,
        offsets,
        fit.lost,
        before=float(before.mean()) / fit.dimension,
        after=float(after.mean()) / fit.dimension,
        gained=float((before - after).sum()) / 2,
    )


def guess_of_lost(touches: Iterable[Floats], lost: npt.NDArray[np.bool_], step: float) -> npt.NDArray[np.float32]:
    """The weights (m, n − m + 1) by which m lost channels are guessed from the others, the last of each a constant.

    Least squares over all readings of earlier touches, (T, n) each, shares of the range in steps of `step`; what
    rounding to them adds, step² / 12, is the ridge. Where there are no touches the weights are 0.
    """
    n, m = len(lost), int(np.count_nonzero(lost))
    count, total, squares = 0, np.zeros(n), np.zeros((n, n))
    for shares in touches if m else ():
        count, total, squares = count + len(shares), total + shares.sum(axis=0), squares + shares.T @ shares
    if not count:
        return np.zeros((m, n - m + 1), np.float32)
    mean = total / count
    covariance = squares / count - np.outer(mean, mean)
    others = covariance[np.ix_(~lost, ~lost)] + np.diag(np.full(n - m, step**2 / 12))
    weights = np.linalg.solve(others, covariance[np.ix_(~lost, lost)]).T
    constants = mean[lost] - weights @ mean[~lost]
    return np.concatenate([weights, constants[:, None]], axis=1).astype(np.float32)
