"""Matching: a touch is compared with kept ones, reading by reading, by the likelihood of what happened to it.

A mean over windows forgets where a reading passes the noise's edge; kept touches do not:

    score_c = max over kept i of c of Σ L_a[y, x_i],    a the noise under which a kept touch is likeliest.

The sum is over all values that were read. A channel that never changes, where hardly any kept touch is still for so
long, is stuck: it says nothing and is left out, as are values that are missing. Beside the kept touches of a material
stand blends of those that are likely: what is felt lies between them. A touch is compared with the prefixes of kept
ones, in their own time, or with the whole of each brought to its length: made at another speed, it has another length.

All is a function of the set of kept touches, in any order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.matching.comparing import log_sums
from scroll_tactile.matching.kept_arrays import Blocks, KeptArrays, first_changes, weighted_means
from scroll_tactile.matching.likelihood import (
    CLEAN,
    LEVELS,
    MISSING,
    UNIT,
    LevelArray,
    Likelihood,
    Noise,
    Table,
    noise_at,
)
from scroll_tactile.matching.match import (
    Match,
    NaturalDeviation,
    negative_entropy,
    noise_share,
    shape_of,
    without_zero,
)

__all__ = ["Beside", "Query", "TouchMatcher"]

FloatArray = npt.NDArray[np.float64]
Rows = npt.NDArray[np.intp]

SHORTLIST = 64  # kept touches that are compared value by value; with 32 six in 100 more are wrong through noise
NEAR = 3 * SHORTLIST  # of which the means of wide blocks are near
ROUGH = (CLEAN, *(Noise(step) for step in (210, 317, 393, 441)))  # under each of which one kept touch is nearest
FINER = 5  # kept touches nearest under that noise, by which it is sought again: five in 200 more are right so
WARMTHS = (0.03, 0.1, 0.3)  # of blends: how steeply the weight of a kept touch falls with its log-likelihood
EXPECTED = 0.1  # the same, of what is expected where channels are stuck
BLENDED = 3  # materials, the likeliest, that have blends
RARELY = 20  # kept touches, of which fewer than one is still for as long: then a channel that is so is stuck
PAIRS = 64  # kept touches by which the spread is measured
ASSUMED = (10.0, 10.0)  # coherence and energy, unless measured: about what RoboSkin's and BioTac's touches have
PRIOR_VALUES, PRIOR_SPREAD = 50, 2.0  # of the spread at each level: where hardly any value was read


@dataclass(frozen=True)
class Query:
    """A touch that is compared.

    levels: (C, T'), MISSING where a channel is stuck; of a touch longer than the kept ones their beginning, or every
    `step`-th column where it is `whole`. columns: T, of the touch that came. stuck: the channels that are, (C,). seen:
    the values that count, (C, T'). blocks: see `KeptArrays.blocks`. rows: of the kept touches that it may be like.
    entropy: of its own values.
    """

    levels: LevelArray
    columns: int
    step: int
    whole: bool
    stuck: npt.NDArray[np.bool_]
    seen: npt.NDArray[np.bool_]
    blocks: list[Blocks]
    rows: Rows
    entropy: float

    @property
    def values(self) -> int:
        """How many values count."""
        return int(np.count_nonzero(self.seen))


@dataclass(frozen=True)
class Beside:
    """A touch beside the nearest kept touches, under one noise.

    rows: of them, ascending. others: their levels, (rows, C, T'). logs: log-likelihoods of the touch by each, (rows,).
    both: the values that the touch and the likeliest have, (C, T'). gain, excess: see `log_likelihood_gain` and
    `excess_loss` of a Match.
    """

    query: Query
    noise: Noise
    table: Table
    rows: Rows
    others: LevelArray
    logs: FloatArray
    both: npt.NDArray[np.bool_]
    gain: float
    excess: float

    @property
    def best(self) -> LevelArray:
        """The levels of the likeliest, (C, T')."""
        return np.asarray(self.others[int(self.logs.argmax())])


class TouchMatcher:
    """Compares a touch with kept touches. deviation: of these kept touches from each other, or of most of them.

    Any number of threads may use it at once; nothing of it changes.
    """

    def __init__(self, kept: KeptArrays, deviation: NaturalDeviation) -> None:
        self.kept, self.deviation = kept, deviation

    @classmethod
    def of(cls, kept: KeptArrays) -> TouchMatcher:
        """With tables of the kept touches' own spread, and coherence and energy as most sets have them."""
        return cls(kept, NaturalDeviation(_likelihood(kept), *ASSUMED))

    def followed(self, kept: KeptArrays) -> TouchMatcher:
        """Another, of other kept touches, with the same deviation."""
        return TouchMatcher(kept, self.deviation)

    def measured(self, coherence: float, energy: float, most: float) -> TouchMatcher:
        """Another, with the same tables and a deviation that was measured; see `NaturalDeviation`."""
        return TouchMatcher(self.kept, replace(self.deviation, coherence=coherence, energy=energy, most=most))

    def match(
        self, levels: LevelArray, *, whole: bool = False, held_out: int | None = None, noise: Noise | None = None
    ) -> Match:
        """Compare a touch, levels of shape (C, T), with all that are kept, but for the row `held_out`.

        noise: what came over it; the likeliest unless given. whole: with the whole of each kept touch brought to its
        length, and not with their prefixes. Raises InputError for other channels.
        """
        return self.result(self.beside(self.query(levels, whole=whole, held_out=held_out), noise))

    def query(self, levels: LevelArray, *, whole: bool = False, held_out: int | None = None) -> Query:
        """A touch as it is compared; see `match`."""
        kept = self.kept
        if levels.ndim != 2 or len(levels) != kept.channels:
            raise InputError(f"expected levels of shape ({kept.channels}, T); came {levels.shape}")
        full = levels.shape[1]
        step = max(1, -(-full // kept.longest)) if whole else 1
        own = levels[:, ::step].copy() if whole else levels[:, : kept.longest].copy()
        rows = np.arange(len(kept))
        if held_out is not None:
            rows = np.delete(rows, held_out)
        until = kept.columns[rows] if whole else np.minimum(own.shape[1], kept.columns[rows])
        still = np.count_nonzero(kept.first[rows] >= until[:, None], axis=0)
        stuck = (first_changes(own) == own.shape[1]) & (RARELY * still < max(len(rows), 1))
        own[stuck] = MISSING
        seen = own != MISSING
        return Query(own, full, step, whole, stuck, seen, kept.blocks(own, whole), rows, -negative_entropy(own[seen]))

    def beside(self, query: Query, noise: Noise | None) -> Beside:
        """The touch beside the nearest kept ones under a noise; None: under the likeliest."""
        first = self._likeliest_noise(query, self._roughly_near(query)) if noise is None else noise
        nearest = self._nearest(query, first)
        if noise is None:
            noise = self._likeliest_noise(query, nearest[:FINER]) if first != CLEAN else CLEAN
        table, rows = self.deviation.likelihood.table(noise), np.sort(nearest)
        others = self._others(rows, query)
        logs = self._logs(query.levels, others, table)
        if not len(rows):
            return Beside(query, noise, table, rows, others, logs, np.zeros_like(query.seen), 0.0, 0.0)
        best = others[int(logs.argmax())]
        both = query.seen & (best != MISSING)
        gain = float(logs.max()) / max(query.values, 1)
        return Beside(
            query,
            noise,
            table,
            rows,
            others,
            logs,
            both,
            gain + query.entropy,
            _mean(table.expected[best[both]]) - gain,
        )

    def result(self, beside: Beside) -> Match:
        """What the nearest kept touches say of a touch."""
        query, table, natural = beside.query, beside.table, self.deviation
        scores, expected = self._scores(beside)
        deviation = np.zeros(query.levels.shape)
        if beside.both.any():
            read = beside.both
            deviation[read] = query.levels[read] - table.mean[beside.best[read]]
        energy, coherence = shape_of(deviation, beside.both)
        return Match(
            scores=scores,
            information=table.information * query.values / (len(query.levels) * self.kept.longest),
            noise=beside.noise,
            stuck=query.stuck,
            expected=expected,
            energy=energy,
            coherence=coherence,
            noise_share=noise_share(energy, coherence, natural),
            moved=energy > natural.most and energy > 2 * without_zero(deviation, beside.both),
            log_likelihood_gain=beside.gain,
            excess_loss=beside.excess,
        )

    def excess_at(self, beside: Beside, steps: Sequence[int]) -> FloatArray:
        """The excess loss of a touch's beginnings of so many columns, ascending, by the same kept touches, (steps,)."""
        query, table = beside.query, beside.table
        sums, had = np.zeros((2, len(steps), len(beside.rows)))
        seen = np.zeros(len(steps))
        for i, part in enumerate(map(slice, (0, *steps[:-1]), steps)):
            own, others = query.levels[:, part], beside.others[:, :, part].reshape(len(beside.rows), -1)
            sums[i] = log_sums(own.ravel(), others, table.logs) / UNIT
            had[i] = np.count_nonzero((others != MISSING) & query.seen[:, part].ravel(), axis=1)
            seen[i] = np.count_nonzero(query.seen[:, part])
        sums, had, seen = (values.cumsum(axis=0) for values in (sums, had, seen))
        found = np.zeros(len(steps))
        if len(beside.rows):
            logs = sums * (seen[:, None] / np.maximum(had, 1))
            for i, (best, until) in enumerate(zip(logs.argmax(axis=1), steps, strict=True)):
                near = beside.others[best, :, :until]
                both = query.seen[:, :until] & (near != MISSING)
                found[i] = _mean(table.expected[near[both]]) - logs[i, best] / max(seen[i], 1)
        return found

    def _others(self, rows: Rows, query: Query) -> LevelArray:
        """The levels that a touch is compared with, of some kept ones, (rows, C, T')."""
        columns = query.levels.shape[1]
        if not query.whole:
            return self.kept.beginnings(rows, columns)
        return self.kept.at_shares(
            rows, np.arange(columns, dtype=np.float64) * (query.step / max(query.columns - 1, 1))
        )

    def _logs(self, own: LevelArray, others: LevelArray, table: Table) -> FloatArray:
        """Log-likelihoods of levels (C, T') by each of others, (others, C, T'); scaled up where some lack values."""
        mine, others = own.ravel(), others.reshape(len(others), own.size)
        return np.asarray(log_sums(mine, others, table.logs) / UNIT * self._weights(mine, others))

    def _weights(self, own: LevelArray, others: LevelArray) -> FloatArray | float:
        """Over how many values a touch has, (values,), for one that others have as well, (others,)."""
        if self.kept.gapless:
            return 1.0
        seen = own != MISSING
        both = np.count_nonzero((others != MISSING) & seen, axis=1)
        return np.asarray(np.count_nonzero(seen) / np.maximum(both, 1))

    def _nearest(self, query: Query, noise: Noise) -> Rows:
        """The rows of the kept touches nearest to the touch as it was before a noise, the nearest first."""
        table, rows = self.deviation.likelihood.table(noise), query.rows
        for count, blocks in zip((NEAR, SHORTLIST)[-len(query.blocks) :], query.blocks, strict=True):
            far = blocks.distances([(table.offset, table.slope)], rows)[:, 0]
            rows = rows[np.argsort(far, kind="stable")[:count]]
        return rows

    def _roughly_near(self, query: Query) -> Rows:
        """The rows of the kept touches nearest under each of ROUGH."""
        tables = [self.deviation.likelihood.table(noise) for noise in ROUGH]
        far = query.blocks[0].distances([(table.offset, table.slope) for table in tables], query.rows)
        return query.rows[sorted(set(far.argmin(axis=0).tolist()))] if len(far) else query.rows

    def _likeliest_noise(self, query: Query, rows: Rows) -> Noise:
        """The noise under which one of some kept touches is likeliest, by a histogram of how far its values lie."""
        own, likelihood = query.levels[query.seen], self.deviation.likelihood
        if not len(rows) or not len(own):
            return CLEAN
        others = self._others(rows, query)[:, query.seen]
        places = np.where(others == MISSING, LEVELS, np.abs(own.astype(np.int16) - others))
        places += (256 * ((own == 0) | (own == LEVELS - 1))).astype(np.int16)
        counts = np.stack([np.bincount(row, minlength=512) for row in places])
        weights = np.broadcast_to(self._weights(own, others), len(rows))
        logs = (counts * weights[:, None]).astype(np.float32) @ likelihood.by_amplitude
        best = int(logs.max(axis=0).argmax())
        clean = (log_sums(own, others, likelihood.table(CLEAN).logs) / UNIT * weights).max()
        return noise_at(best) if logs[:, best].max() > clean else CLEAN

    def _scores(self, beside: Beside) -> tuple[FloatArray, npt.NDArray[np.floating]]:
        """The best log-likelihood of each material, by its kept touches or blends, the least where it has none; and

        what is expected of all values, (C, T).
        """
        query, logs, materials = beside.query, beside.logs, len(self.kept.materials)
        expected = np.full((len(query.levels), query.columns), np.nan, np.float32)
        if not len(logs):
            return np.zeros(materials), expected
        labels = self.kept.labels[beside.rows]
        best = np.full(materials, -np.inf)
        np.maximum.at(best, labels, logs)
        ahead = [place for place in np.argsort(-best, kind="stable")[:BLENDED] if np.count_nonzero(labels == place) > 1]
        weights = [np.exp(EXPECTED * (logs - logs.max()))]
        for place in ahead:
            nearness = np.where(labels == place, logs - best[place], -np.inf)
            weights += [np.exp(warmth * nearness) for warmth in WARMTHS]
        means = weighted_means(beside.others.reshape(len(logs), -1), np.array(weights))
        mean = means[0].reshape(query.levels.shape).repeat(query.step, axis=1)[:, : query.columns]
        expected[:, : mean.shape[1]] = mean
        blends = np.where(np.isnan(means[1:]), MISSING, np.rint(means[1:])).astype(np.uint8)
        found = self._logs(query.levels, blends, beside.table).reshape(len(ahead), len(WARMTHS)).max(axis=1)
        best[ahead] = np.maximum(best[ahead], found)
        return np.where(np.isfinite(best), best, best[np.isfinite(best)].min()), expected


def _mean(values: FloatArray) -> float:
    return float(values.sum()) / max(len(values), 1)


def _likelihood(kept: KeptArrays) -> Likelihood:
    """The tables of the spread by level: the mean deviation from the nearest touch, over levels half to twice as high.

    The mean deviation, and not the standard deviation, which is a quarter more: kept touches that are likelier come
    nearer than the nearest by all values does.
    """
    counts, deviations = np.zeros(LEVELS), np.zeros(LEVELS)
    for row in range(0, len(kept), -(-len(kept) // PAIRS)):  # the rows are in the order of keys: at random
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
    weights = counts + 1 / LEVELS
    return Likelihood(spread, weights / weights.sum())


def _between(values: FloatArray, least: npt.NDArray[np.int_], most: npt.NDArray[np.int_]) -> FloatArray:
    sums = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray(sums[most] - sums[least])
