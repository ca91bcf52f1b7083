"""Matching: a touch is compared with kept ones, reading by reading, by the likelihood of what happened to it.

A mean over windows forgets where a reading passes the noise's edge; kept touches do not:

    score_c = max over kept i of c of Σ L_a[y, x_i],    a the noise under which a kept touch is likeliest.

The sum is over all values that were read. A channel that never changes, where hardly any kept touch has it so, is
stuck: it says nothing of its own and is left out, as are values that are missing. Where it is often quiet, it says
something by being so, unless the values are likelier without it. Beside the kept touches of a material stand blends of
those that are likely: what is felt lies between them. A touch is compared with the prefixes of kept ones, in their
own time, or with the whole of each brought to its length: made at another speed, it has another length.

All is a function of the set of kept touches, in any order.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Sized
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.matching.comparing import compiled, log_sums_by_c, log_sums_by_numpy
from scroll_tactile.matching.kept_arrays import KeptArrays, blends, block_means, unchanging, weighted_means
from scroll_tactile.matching.likelihood import CLEAN, LEVELS, MISSING, UNIT, LevelArray, Likelihood, Noise, Table
from scroll_tactile.matching.match import (
    KeptTouch,
    Match,
    NaturalDeviation,
    independent,
    negative_entropy,
    noise_share,
    shape_of,
    without_zero,
)

__all__ = ["TouchMatcher", "matcher_of", "spaced"]

FloatArray = npt.NDArray[np.float64]
Rows = npt.NDArray[np.intp]

SHORTLIST = 64  # kept touches that are compared value by value; with all 800 no more is right
FIRST = 3  # candidates for each rough amplitude, and for the finer ones
FIRST_VALUES = 1000  # of a touch, by which the rough amplitude is found
ROUGH = (CLEAN, *(Noise(step) for step in (420, 632, 784, 880)))
COARSE = tuple(Noise(step) for step in range(120, 924, 32)), tuple(Noise(step, True) for step in range(5, 41, 2))
STRIDE = 4  # coarse amplitudes in one at first: the likelihood has one peak over them
WARMTHS = (0.03, 0.1, 0.3)  # of blends: how steeply the weight of a kept touch falls with its likelihood
BLENDED = 6  # materials, the likeliest, that have blends
RARELY = 20  # kept touches, of which fewer than one has a channel unchanging: then one that is so is stuck
PAIRS, HELD_OUT = 200, 64  # kept touches by which the spread is measured, and the rest
FEWEST = 8  # touches held out; with fewer nothing is measured
ASSUMED = (10.0, 10.0)  # coherence and energy then: about what RoboSkin's and BioTac's touches have
WITHIN = 0.95  # of touches held out: one in twenty is noisy itself
EVEN = 2.0  # times the noise amplitude that those stay below: there the share of noise is a half
ROUNDING = 1 / 12  # squared levels: the noise of rounding to levels
PRIOR_VALUES, PRIOR_SPREAD = 50, 2.0  # of the spread at each level: where hardly any value was read


@dataclass(frozen=True)
class _Query:
    """A touch that is compared: its levels (C, T), as far as the longest kept touch goes where it is not `whole`.

    seen: which values count, (C, T). stuck: the channels that are. full: the columns that
    it is a part of. values: how many count. share: the part of all that do. held_out: the row of the kept touch that it
    is, if it is one.
    """

    levels: LevelArray
    seen: npt.NDArray[np.bool_]
    stuck: npt.NDArray[np.bool_]
    full: int
    whole: bool
    held_out: int | None

    @classmethod
    def of(
        cls, levels: LevelArray, longest: int, whole: bool, quiet: npt.NDArray[np.bool_], held_out: int | None
    ) -> _Query:
        """quiet: the channels that are no less whole where they never change, (C,)."""
        full = levels.shape[1] if whole else longest
        grid = levels[:, :full].copy()
        stuck = unchanging(grid) & ~quiet
        grid[stuck] = MISSING
        return cls(grid, grid != MISSING, stuck, full, whole, held_out)

    @property
    def values(self) -> int:
        return int(np.count_nonzero(self.seen))

    @property
    def share(self) -> float:
        return self.values / (len(self.levels) * self.full)


@dataclass(frozen=True)
class _Pairs:
    """Values of a touch, levels (values,), beside those of some others, (others, values).

    weights: of each other's sum: by the same number of values, where some lack, (others,).
    """

    own: LevelArray
    others: LevelArray
    weights: FloatArray

    @cached_property
    def places(self) -> Rows:
        """256 · level + other level, (others, values)."""
        return (self.own.astype(np.intp) << 8) | self.others

    def logs(self, table: Table) -> FloatArray:
        """Log-likelihood of the touch by each of the others, (others,)."""
        if compiled():
            sums = log_sums_by_c(self.own, self.others, table.logs)
        else:
            sums = log_sums_by_numpy(self.places, table.logs)
        return np.asarray(sums / UNIT * self.weights)

    def logs_by(self, likelihood: Likelihood, noise: Noise) -> FloatArray:
        """What `logs` gives with the table of a noise, without making it: by the pairs of levels that occur."""
        distinct, counts = self._distinct
        return np.asarray(counts @ likelihood.entries(noise, distinct) / UNIT * self.weights)

    @cached_property
    def _distinct(self) -> tuple[Rows, npt.NDArray[np.int64]]:
        """The places that occur, ascending, and how often each does, (others, places)."""
        counts = np.stack([np.bincount(row, minlength=256 * 256) for row in self.places])
        distinct = np.flatnonzero(counts.any(axis=0))
        return distinct, counts[:, distinct]


@dataclass(frozen=True)
class _Others:
    """The kept touches that a touch is compared with value by value.

    rows: of them, (others,). levels: their own, (others, C · T). logs: log-likelihoods of the touch by each, (others,).
    """

    rows: Rows
    levels: LevelArray
    logs: FloatArray


class TouchMatcher:
    """Compares a touch with kept touches. deviation: of these kept touches from each other, or of most of them.

    Any number of threads may use it at once. The kept touches follow where nobody uses it: otherwise those of a copy.
    """

    def __init__(self, kept: KeptArrays, deviation: NaturalDeviation) -> None:
        self.kept, self.deviation = kept, deviation

    def copy(self) -> TouchMatcher:
        """Another with a copy of the kept touches."""
        return TouchMatcher(self.kept.copy(), self.deviation)

    def match(
        self, levels: LevelArray, *, whole: bool = False, held_out: int | None = None, noise: Noise | None = None
    ) -> Match:
        """Compare a touch, levels of shape (C, T), with all that are kept, but for the row `held_out`.

        noise: what came over it; the likeliest unless given.

        whole: with each of them brought to its length, and not with their prefixes; then what is beyond the longest
        is left out. Raises InputError for other channels.
        """
        if levels.ndim != 2 or len(levels) != self.kept.channels:
            raise InputError(f"expected levels of shape ({self.kept.channels}, T); came {levels.shape}")
        quiet = self._quiet(held_out)
        query = _Query.of(levels, self.kept.longest, whole, quiet, held_out)
        found = self._match(query, noise, levels.shape[1])
        if not quiet.any():
            return found
        stuck = _Query.of(levels, self.kept.longest, whole, np.zeros_like(quiet), held_out)
        if np.array_equal(stuck.stuck, query.stuck):
            return found
        # Channels that are often quiet are quiet here, too, or dead: as a value is the likelier.
        dead = self._match(stuck, noise, levels.shape[1])
        return found if found.likelihood >= dead.likelihood else dead

    def _match(self, query: _Query, given: Noise | None, columns: int) -> Match:
        noise = self._rough_noise(query) if given is None else given
        rows = self._shortlist([noise], query, SHORTLIST)[:, 0]
        levels = self._others(rows, query)
        pairs = self._pairs(levels, query)
        logs = pairs.logs(self._table(noise))
        for stride in () if given or noise == CLEAN else (1,) if noise.normal else (8, 2, 1):
            finer = self._finer_noise(_Others(rows, levels, logs), query, noise, stride)
            if finer != noise:
                noise, logs = finer, pairs.logs(self._table(finer))
        return self._result(query, _Others(rows, levels, logs), noise, columns)

    def deviation_of(self, row: int) -> tuple[float, float]:
        """Energy and coherence (see NaturalDeviation) of how a kept touch deviates from the nearest other one."""
        query = _Query.of(self.kept.levels(row), self.kept.longest, False, self._quiet(row), row)
        levels = self._others(self._shortlist([CLEAN], query, SHORTLIST)[:, 0], query)
        best = levels[np.argmax(self._pairs(levels, query).logs(self._table(CLEAN)))]
        return shape_of(*self._deviation(query, best, CLEAN))

    def _quiet(self, held_out: int | None) -> npt.NDArray[np.bool_]:
        """The channels that never change in one of RARELY kept touches or more, (C,)."""
        own = 0 if held_out is None else self.kept.unchanging(held_out)
        return np.asarray(RARELY * (self.kept.quiet - own) >= max(len(self.kept) - (held_out is not None), 1))

    def _others(self, rows: Rows, query: _Query) -> LevelArray:
        """The levels that a touch is compared with, of some kept ones, (rows, C · T)."""
        columns = query.levels.shape[1]
        return self.kept.brought_to(rows, columns) if query.whole else self.kept.prefixes(rows, columns)

    def _shortlist(self, noises: Sequence[Noise], query: _Query, count: int) -> Rows:
        """Rows of the kept touches nearest to the touch as it was before each noise, (count, noises), ascending."""
        means, known = block_means(query.levels, self.kept.edges(query.levels.shape[1], query.whole))
        tables = [self._table(noise) for noise in noises]
        guess = np.stack([(means - table.offset) / table.slope * known for table in tables]).reshape(len(noises), -1)
        far = self.kept.distances(guess, known.ravel(), query.whole)
        if query.held_out is not None:
            far[query.held_out] = np.inf
        count = min(count, len(far) - (query.held_out is not None))
        return np.sort(np.argsort(far, axis=0, kind="stable")[:count], axis=0)

    def _table(self, noise: Noise) -> Table:
        return self.deviation.likelihood.table(noise)

    def _pairs(self, others: LevelArray, query: _Query, values: slice | Rows = slice(None)) -> _Pairs:
        own, others = query.levels.ravel()[values], np.ascontiguousarray(others[:, values])
        if self.kept.gapless:
            return _Pairs(own, others, np.ones(len(others)))
        seen = query.seen.ravel()[values]
        both = np.count_nonzero((others != MISSING) & seen, axis=1)
        return _Pairs(own, others, np.count_nonzero(seen) / np.maximum(both, 1))

    def _rough_noise(self, query: _Query) -> Noise:
        # Each row once, ascending; numpy's own way imports a fiftieth of a second of masked arrays.
        rows = np.flatnonzero(np.bincount(self._shortlist(ROUGH, query, FIRST).ravel()))
        others = self._others(rows, query)
        values = np.flatnonzero(query.seen)
        values = values[:: max(1, len(values) // FIRST_VALUES)]
        if not len(values) or not len(others):
            return CLEAN
        pairs = self._pairs(others, query, values)

        def likelihood(noise: Noise) -> float:
            return float(pairs.logs(self._table(noise)).max())

        found = [CLEAN]
        for noises in COARSE:
            best = max(range(0, len(noises), STRIDE), key=lambda i: likelihood(noises[i]))
            found.append(max(noises[max(0, best - STRIDE + 1) : best + STRIDE], key=likelihood))
        return max(found, key=likelihood)

    def _finer_noise(self, others: _Others, query: _Query, noise: Noise, stride: int) -> Noise:
        """The likeliest amplitude near a noise: by kept touches at first, then by blends, that come nearer."""
        if stride > 2:
            nearest = others.levels[np.argsort(-others.logs, kind="stable")[:FIRST]]
        else:
            labels = self.kept.labels[others.rows]
            same = labels == labels[np.argmax(others.logs)]
            nearest = blends(others.levels[same], others.logs[same], WARMTHS[:2])
        pairs = self._pairs(nearest, query)
        likelihood = self.deviation.likelihood
        return max(noise.near(stride), key=lambda near: float(pairs.logs_by(likelihood, near).max()))

    def _result(self, query: _Query, others: _Others, noise: Noise, columns: int) -> Match:
        table, natural, logs = self._table(noise), self.deviation, others.logs
        expected = np.full((self.kept.channels, columns), np.nan)
        mean = weighted_means(others.levels, np.exp(WARMTHS[1] * (logs - logs.max()))[None])[0]
        mean = mean.reshape(self.kept.channels, -1)
        expected[:, : mean.shape[1]] = mean[:, :columns]
        best = others.levels[np.argmax(logs)]
        deviation, both = self._deviation(query, best, noise)
        mean_log = table.expected[best.reshape(both.shape)[both]].sum() / max(int(np.count_nonzero(both)), 1)
        likelihood = float(logs.max()) / max(query.values, 1)
        energy, coherence = shape_of(deviation, both)
        return Match(
            scores=self._scores(query, others, noise),
            information=table.information * query.share,
            noise=noise,
            stuck=query.stuck,
            expected=expected,
            noise_share=noise_share(energy, coherence, natural),
            moved=energy > max(natural.most, 2 * without_zero(deviation, both)),
            likelihood=likelihood,
            log_likelihood_gain=likelihood - negative_entropy(query.levels[query.seen]),
            excess_loss=float(mean_log) - likelihood,
        )

    def _deviation(self, query: _Query, best: LevelArray, noise: Noise) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """How a touch deviates from what a kept one reads through noise, (C, T), 0 where one lacks; and where not."""
        near = best.reshape(query.seen.shape)
        both = query.seen & (near != MISSING)
        mean = self._table(noise).mean[np.where(both, near, 0)]
        return np.where(both, query.levels - mean, 0.0), both

    def _scores(self, query: _Query, others: _Others, noise: Noise) -> FloatArray:
        """The best log-likelihood of each material, by its kept touches or blends; the least, where it has none."""
        labels, logs = self.kept.labels[others.rows], others.logs
        best = np.full(len(self.kept.materials), float(logs.min()))
        np.maximum.at(best, labels, logs)
        for material in np.argsort(-best, kind="stable")[:BLENDED].tolist():
            own = labels == material
            if np.count_nonzero(own) > 1:
                pairs = self._pairs(blends(others.levels[own], logs[own], WARMTHS), query)
                best[material] = max(best[material], float(pairs.logs(self._table(noise)).max()))
        return best


def matcher_of(touches: Iterable[KeptTouch]) -> TouchMatcher:
    """The matcher of kept touches, with their natural deviation: each of some is held out and compared with the others.

    Raises InputError for touches of different channels, and for none.
    """
    kept = KeptArrays.of(touches)
    return TouchMatcher(kept, _measured(TouchMatcher(kept, NaturalDeviation(_likelihood(kept), *ASSUMED))))


def spaced(touches: Sized, count: int) -> list[int]:
    """Places of at most so many touches, spread evenly over their keys: at random, but the same of the same set."""
    return list(range(0, len(touches), max(1, -(-len(touches) // count))))


def _likelihood(kept: KeptArrays) -> Likelihood:
    """The tables of the spread by level: the mean deviation from the nearest touch, over levels half to twice as high.

    The mean deviation, and not the standard deviation, which is a quarter more: kept touches that are likelier come
    nearer than the nearest by all values does.
    """
    counts, deviations = np.zeros(LEVELS), np.zeros(LEVELS)
    for row in spaced(kept, PAIRS):
        pair = kept.nearest_alike(row)
        if pair is None:
            continue
        both = (pair[0] != MISSING) & (pair[1] != MISSING)
        mine, near = (levels[both].astype(np.int64) for levels in pair)
        counts += np.bincount(near, minlength=LEVELS)
        deviations += np.bincount(near, np.abs(mine - near), minlength=LEVELS)
    levels = np.arange(LEVELS)
    least, most = np.floor(levels / 1.5 - 1).clip(0).astype(int), np.ceil(levels * 1.5 + 2).clip(0, LEVELS).astype(int)
    typical = (deviations.sum() + PRIOR_SPREAD) / (counts.sum() + 1)
    spread = (_between(deviations, least, most) + PRIOR_VALUES * typical) / (
        _between(counts, least, most) + PRIOR_VALUES
    )
    return Likelihood(spread, counts + 1 / LEVELS)


def _between(values: FloatArray, least: npt.NDArray[np.int_], most: npt.NDArray[np.int_]) -> FloatArray:
    sums = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray(sums[most] - sums[least])


def _measured(matcher: TouchMatcher) -> NaturalDeviation:
    rows = spaced(matcher.kept, HELD_OUT)
    if len(matcher.kept) < 2 or len(rows) < FEWEST:
        return matcher.deviation
    shapes = [matcher.deviation_of(row) for row in rows]
    natural = float(np.median([coherence for _, coherence in shapes]))
    noise = [independent(energy, coherence, natural) for energy, coherence in shapes]
    most = EVEN**2 * float(np.quantile(noise, WITHIN))
    energy = float(np.quantile([energy for energy, _ in shapes], WITHIN))
    return NaturalDeviation(matcher.deviation.likelihood, natural, max(most, ROUNDING), max(energy, ROUNDING))
