"""Matching: a touch is compared with kept ones, reading by reading, by the likelihood of what happened to it.

A mean over windows forgets where a reading passes the noise's edge; kept touches do not:

    score_c = max over kept i of c of Σ L_a[y, x_i],    a the noise under which a kept touch is likeliest.

The sum is over all values that were read. A channel that never changes, where hardly any kept touch is still for so
long, is stuck: it says nothing and is left out, as are values that are missing. Beside the kept touches of a material
stand blends of those that are likely: what is felt lies between them. A touch is compared with the prefixes of kept
ones, in their own time, or with the whole of each brought to its length: made at another speed, it has another length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.matching.conformal import Conformal
from scroll_tactile.matching.kept_arrays import Blocks, KeptArrays, KeptTouch, first_changes
from scroll_tactile.matching.likelihood import CLEAN, NOISES, Likelihood, Noise, Table
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.levels import LEVELS, MISSING, LevelArray

__all__ = ["Beside", "Match", "NaturalDeviation", "Query", "TouchMatcher", "independent"]

FloatArray = npt.NDArray[np.float64]
Known = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]

SHORTLIST = 64  # kept touches that are compared value by value; with 32 six in 100 more are wrong through noise
NEAR = 3 * SHORTLIST  # of which the means of wide blocks are near
ROUGH = (CLEAN, *(Noise(step) for step in (210, 317, 393, 441)))  # under each of which one kept touch is nearest
FINER = 5  # kept touches nearest under that noise, by which it is sought again: five in 200 more are right so
WARMTHS = (0.03, 0.1, 0.3)  # of blends: how steeply the weight of a kept touch falls with its log-likelihood
EXPECTED = 0.1  # the same, of what is expected where channels are stuck
BLENDED = 3  # materials, the likeliest, that have blends
NEGLIGIBLE = 1e-6  # of the largest weight in a mean
RARELY = 20  # kept touches, of which fewer than one is still for as long: then a channel that is so is stuck
LONG = 9  # readings: a channel that is still for fewer is not asked whether it is dead
PAIRS = 64  # kept touches by which the spread is measured
ASSUMED = (10.0, 10.0)  # coherence and energy, unless measured: about what RoboSkin's and BioTac's touches have
PRIOR_VALUES, PRIOR_SPREAD = 50, 2.0  # of the spread at each level: where hardly any value was read


@dataclass(frozen=True)
class NaturalDeviation:
    """How touches of one material deviate from each other in a set of kept touches.

    likelihood: its tables. coherence: how much larger the deviation of a channel's mean is, squared and times T, than
    that of a value; 1 for independent noise. energy: of independent noise that is even odds to be natural, in squared
    levels. most: the energy of a deviation that 19 of 20 stay below; infinite where too few touches are kept to say.
    """

    likelihood: Likelihood
    coherence: float
    energy: float
    most: float = np.inf


@dataclass(frozen=True)
class Query:
    """A touch that is compared.

    levels: (C, T'), MISSING where a channel is stuck; of a touch longer than the kept ones their beginning, or every
    `step`-th column where it is `whole`. columns: T, of the touch that came. stuck: the channels that are, (C,). seen:
    the values that count, (C, T'), and values: how many. entropy: of their own frequencies. blocks: see
    `KeptArrays.blocks`. rows: of the kept touches that it may be like.
    """

    levels: LevelArray
    columns: int
    step: int
    whole: bool
    stuck: Known
    seen: Known
    values: int
    entropy: float
    blocks: list[Blocks]
    rows: Rows


@dataclass(frozen=True)
class Beside:
    """A touch beside the nearest kept touches, under one noise.

    rows: of them, ascending. others: their levels, (rows, C, T'). logs: log-likelihoods of the touch by each, (rows,).
    """

    query: Query
    table: Table
    rows: Rows
    others: LevelArray
    logs: FloatArray

    @property
    def gain(self) -> float:
        """`log_likelihood_gain` of its match."""
        return float(self.logs.max()) / max(self.query.values, 1) + self.query.entropy if len(self.rows) else 0.0

    @property
    def excess(self) -> float:
        """`excess_loss` of its match."""
        return self._excess(self.logs, self.query.values) if len(self.rows) else 0.0

    def excess_at(self, steps: Sequence[int]) -> FloatArray:
        """The excess loss of beginnings of so many columns, ascending, by the same kept touches, (steps,)."""
        sums, had, seen, found = np.zeros(len(self.rows)), np.zeros(len(self.rows)), 0, []
        for first, until in pairwise((0, *steps)):
            own, others = self.query.levels[:, first:until], self.others[:, :, first:until]
            sums += self.table.log_sums(own, others)
            had += np.count_nonzero((others != MISSING) & (own != MISSING), axis=(1, 2))
            seen += int(np.count_nonzero(own != MISSING))
            found.append(self._excess(sums * (seen / np.maximum(had, 1)), seen, until))
        return np.array(found)

    def _excess(self, logs: FloatArray, values: int, until: int | None = None) -> float:
        best = self.others[logs.argmax(), :, :until]
        expected = self.table.expected[best[self.query.seen[:, :until] & (best != MISSING)]]
        return float(expected.sum() / max(len(expected), 1) - logs.max() / max(values, 1))


@dataclass(frozen=True)
class Match:
    """A touch beside kept touches.

    scores: log-likelihood of each material, in the order of `KeptArrays.materials`, (M,). information: Fisher's on the
    values that were read, in units of the natural spread; about 1 of a clean touch as long as the longest kept one.
    noise: what most likely came over it. stuck: the channels that never change, (C,). expected: levels of all values by
    the kept touches, (C, T); NaN where none of them reaches. energy, coherence: of the touch's deviation from the
    likeliest kept one. noise_share: in [0, 1], how much of that is independent noise beyond the natural. moved: whether
    it deviates more than touches do, and at least half of that is its channels' zeros, which may drift.
    log_likelihood_gain: the log-likelihood per value less the negative entropy of the touch's own values; not above 0
    where nothing that is kept explains the touch. excess_loss: the negative log-likelihood per value less the expected
    one of a touch of the set.
    """

    scores: FloatArray
    information: float
    noise: Noise
    stuck: Known
    expected: npt.NDArray[np.float32]
    energy: float
    coherence: float
    noise_share: float
    moved: bool
    log_likelihood_gain: float
    excess_loss: float

    def filled(self, readings: npt.NDArray[np.floating], sensor: Sensor) -> npt.NDArray[np.float32]:
        """The readings, shape (T, C) in the sensor's unit, with what is missing or stuck as kept touches have it."""
        low, high = sensor.limits
        expected = low + (high - low) * (self.expected.T / np.float32(LEVELS - 1))
        lacking = (np.isnan(readings) | self.stuck) & np.isfinite(expected)
        return np.where(lacking, expected, readings).astype(np.float32)


@dataclass(frozen=True)
class TouchMatcher:
    """Compares a touch with kept touches; for any number of threads. deviation: of most of these from each other."""

    kept: KeptArrays
    conformal: Conformal
    deviation: NaturalDeviation

    @classmethod
    def of(cls, touches: Sequence[KeptTouch], before: TouchMatcher | None = None) -> TouchMatcher:
        """With tables of the touches' own spread, and coherence and energy as most sets have them.

        before: a matcher of other touches; what it has of these is not made again. Raises InputError for no touch, and
        for touches of different channels.
        """
        kept = KeptArrays(touches, None if before is None else before.kept)
        conformal = Conformal(kept, None if before is None else before.conformal)
        return cls(kept, conformal, NaturalDeviation(_likelihood(kept), *ASSUMED))

    def followed(self, touches: Sequence[KeptTouch]) -> TouchMatcher:
        """Another, of other touches, with the same deviation. Raises InputError as `of`."""
        if {(touch.material, touch.key) for touch in touches} == self.kept.touches.keys():
            return self
        kept = KeptArrays(touches, self.kept)
        return TouchMatcher(kept, Conformal(kept, self.conformal), self.deviation)

    def measured(self, coherence: float, energy: float, most: float) -> TouchMatcher:
        """Another, with the same tables and a deviation that was measured; see `NaturalDeviation`."""
        return replace(self, deviation=NaturalDeviation(self.deviation.likelihood, coherence, energy, most))

    def scores_of(self, names: Sequence[str], match: Match) -> FloatArray:
        """The scores of some materials, (names,); the least of all for those of which nothing is kept."""
        return self.kept.by_name(match.scores, names, match.scores.min())

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
        step = max(1, -(-levels.shape[1] // kept.longest)) if whole else 1
        own = levels[:, ::step][:, : kept.longest]
        rows = np.delete(np.arange(len(kept)), [] if held_out is None else held_out)
        until = kept.columns[rows] if whole else np.minimum(own.shape[1], kept.columns[rows])
        rare = RARELY * np.count_nonzero(kept.parts.first[rows] >= until[:, None], axis=0) < max(len(rows), 1)
        still = first_changes(own) == own.shape[1]

        def without(stuck: Known) -> Query:
            mine = np.where(stuck[:, None], np.uint8(MISSING), own)
            counts = np.bincount(mine.ravel(), minlength=LEVELS + 1)[:LEVELS]
            values, shares = int(counts.sum()), counts[counts > 0] / max(counts.sum(), 1)
            entropy, seen = -float((shares * np.log(shares)).sum()), mine != MISSING
            blocks = kept.blocks(mine, whole)
            return Query(mine, levels.shape[1], step, whole, stuck, seen, values, entropy, blocks, rows)

        found = without(still & rare)
        if held_out is not None or not len(rows) or own.shape[1] < LONG or not (still & ~rare).any():
            return found
        dead = without(still)  # channels that are often still are so here, too, or dead: as a value is the likelier
        either = [self.beside(each, CLEAN).logs.max() / max(each.values, 1) for each in (found, dead)]
        return dead if dead.values and either[1] > either[0] else found

    def beside(self, query: Query, noise: Noise | None) -> Beside:
        """The touch beside the nearest kept ones under a noise; None: under the likeliest."""
        sought, tables = noise is None, self.deviation.likelihood.table
        if noise is None:
            far = query.blocks[0].distances(list(map(tables, ROUGH)), query.rows)
            roughly = np.unique(np.argsort(far, axis=0, kind="stable")[:1])
            noise = self._likeliest_noise(query, query.rows[roughly])
        nearest = self._nearest(query, tables(noise))
        if sought and noise != CLEAN:
            noise = self._likeliest_noise(query, nearest[:FINER])
        table, rows = tables(noise), np.sort(nearest)
        others = self._others(rows, query)
        return Beside(query, table, rows, others, table.log_likelihoods(query.levels, others))

    def result(self, beside: Beside) -> Match:
        """What the nearest kept touches say of a touch."""
        query, table, natural = beside.query, beside.table, self.deviation
        scores, expected = self._scores(beside)
        best = beside.others[beside.logs.argmax()] if len(beside.rows) else np.full_like(query.levels, MISSING)
        seen = query.seen & (best != MISSING)
        deviation = np.where(seen, query.levels - table.mean.take(best, mode="clip"), 0.0)
        energy, coherence, of_zeros = _shape(deviation, seen)
        noise = independent(energy, coherence, natural.coherence) if np.isfinite(natural.most) else 0.0
        return Match(
            scores=scores,
            information=table.information * query.values / (len(query.levels) * self.kept.longest),
            noise=table.noise,
            stuck=query.stuck,
            expected=expected,
            energy=energy,
            coherence=coherence,
            noise_share=noise**2 / (noise**2 + natural.energy**2) if noise else 0.0,
            moved=energy > natural.most and of_zeros > energy / 2,
            log_likelihood_gain=beside.gain,
            excess_loss=beside.excess,
        )

    def _others(self, rows: Rows, query: Query) -> LevelArray:
        """The levels that a touch is compared with, of some kept ones, (rows, C, T')."""
        columns = query.levels.shape[1]
        if not query.whole:
            return self.kept.beginnings(rows, columns)
        return self.kept.at_shares(
            rows, np.arange(columns, dtype=np.float64) * (query.step / max(query.columns - 1, 1))
        )

    def _nearest(self, query: Query, table: Table) -> Rows:
        """The rows of the kept touches nearest to the touch as it was before a noise, the nearest first."""
        rows = query.rows
        for count, blocks in zip((NEAR, SHORTLIST)[-len(query.blocks) :], query.blocks, strict=True):
            far = blocks.distances([table], rows)[:, 0]
            rows = rows[np.argsort(far, kind="stable")[:count]]
        return rows

    def _likeliest_noise(self, query: Query, rows: Rows) -> Noise:
        """The noise under which one of some kept touches is likeliest, by a histogram of how far its values lie."""
        own, others, likelihood = query.levels, self._others(rows, query), self.deviation.likelihood
        if not len(rows) or not query.values:
            return CLEAN
        away = np.where(query.seen & (others != MISSING), np.abs(own.astype(np.int16) - others), LEVELS)
        places = away + 256 * ((own == 0) | (own == LEVELS - 1))
        counts = np.stack([np.bincount(each.ravel(), minlength=512) for each in places])
        both = own.size - counts[:, [LEVELS, 256 + LEVELS]].sum(axis=1, keepdims=True)
        logs = (counts * (query.values / np.maximum(both, 1))).astype(np.float32) @ likelihood.by_amplitude
        best, clean = int(logs.max(axis=0).argmax()), likelihood.table(CLEAN).log_likelihoods(own, others).max()
        return NOISES[best] if logs[:, best].max() > clean else CLEAN

    def _scores(self, beside: Beside) -> tuple[FloatArray, npt.NDArray[np.float32]]:
        """`scores`, by kept touches and blends, the least where a material has none; and `expected`; see `Match`."""
        query, logs, materials = beside.query, beside.logs, len(self.kept.materials)
        expected = np.full((len(query.levels), query.columns), np.nan, np.float32)
        if not len(logs):
            return np.zeros(materials), expected
        labels, best = self.kept.labels[beside.rows], np.full(materials, -np.inf)
        np.maximum.at(best, labels, logs)
        ahead = [place for place in np.argsort(-best, kind="stable")[:BLENDED] if np.count_nonzero(labels == place) > 1]
        weights = [np.exp(EXPECTED * (logs - logs.max()))]
        for place in ahead:
            nearness = np.where(labels == place, logs - best[place], -np.inf)
            weights += [np.exp(warmth * nearness) for warmth in WARMTHS]
        means = _weighted_means(beside.others.reshape(len(logs), -1), np.array(weights))
        means = means.reshape(len(weights), *query.levels.shape)
        mean = means[0].repeat(query.step, axis=1)[:, : query.columns]
        expected[:, : mean.shape[1]] = mean
        blends = np.where(np.isnan(means[1:]), MISSING, np.rint(means[1:])).astype(np.uint8)
        found = beside.table.log_likelihoods(query.levels, blends).reshape(len(ahead), len(WARMTHS)).max(axis=1)
        best[ahead] = np.maximum(best[ahead], found)
        return np.where(np.isfinite(best), best, best[np.isfinite(best)].min()), expected


def independent(energy: float, coherence: float, natural: float) -> float:
    """The energy σ² of independent noise in a deviation of some energy v and coherence w.

    natural: the coherence of natural deviations, of which the rest is made: w v = σ² + natural · (v − σ²).
    """
    return energy * min(max((natural - coherence) / (natural - 1), 0.0), 1.0) if natural > 1 else energy


def _shape(deviation: FloatArray, seen: Known) -> tuple[float, float, float]:
    """Energy and coherence of a deviation (C, T), 0 where not seen; the energy of its channels' means and slopes."""
    counts, time = seen.sum(axis=1), np.arange(seen.shape[1])
    values, among = max(int(counts.sum()), 1), np.maximum(counts, 1)
    away = (time - (seen @ time / among)[:, None]) * seen
    means = np.square(deviation.sum(axis=1)) / among
    slopes = np.square((deviation * away).sum(axis=1)) / np.maximum(np.square(away).sum(axis=1), 1)
    energy, together = float(np.square(deviation).sum()) / values, float(means.sum())
    coherence = together / np.count_nonzero(counts) / energy if energy else 1.0
    return energy, coherence, (together + float(slopes.sum())) / values


def _weighted_means(levels: LevelArray, weights: FloatArray) -> npt.NDArray[np.float32]:
    """Means of touches (n, C · T) by weights (means, n), of which the largest are 1; NaN where no touch has a value."""
    keep = weights.max(axis=0) > NEGLIGIBLE
    single, levels = weights[:, keep].astype(np.float32), levels[keep]
    known = levels != MISSING
    if known.all():
        return np.asarray((single / single.sum(axis=1, keepdims=True)) @ levels.astype(np.float32))
    total = single @ known.astype(np.float32)
    return np.asarray(single @ (levels * known).astype(np.float32) / np.where(total > 0, total, np.float32(np.nan)))


def _likelihood(kept: KeptArrays) -> Likelihood:
    """The tables of the spread by level: the mean deviation from the nearest touch, over levels half to twice as high.

    Not the standard deviation, a quarter more: likelier kept touches come nearer than the nearest by all values does.
    """
    counts, deviations = np.zeros(LEVELS), np.zeros(LEVELS)
    for row in range(0, len(kept), -(-len(kept) // PAIRS)):  # the rows are in the order of keys: at random
        if (other := kept.nearest_alike(row)) is not None:
            pair = kept.beginnings([row, other], kept.longest)
            mine, near = pair[:, (pair != MISSING).all(axis=0)].astype(np.int64)
            counts += np.bincount(near, minlength=LEVELS)
            deviations += np.bincount(near, np.abs(mine - near), minlength=LEVELS)
    levels = np.arange(LEVELS)
    alike = (levels >= np.floor(levels / 1.5 - 1)[:, None]) & (levels < np.ceil(levels * 1.5 + 2)[:, None])
    typical = (deviations.sum() + PRIOR_SPREAD) / (counts.sum() + 1)
    spread = (alike @ deviations + PRIOR_VALUES * typical) / (alike @ counts + PRIOR_VALUES)
    weights = counts + 1 / LEVELS
    return Likelihood(spread, weights / weights.sum())
