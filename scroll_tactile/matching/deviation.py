"""What a set of kept touches says of itself: how touches of one material deviate from each other.

Each of some touches is left out and compared with the others. All is a function of the set.
"""

from __future__ import annotations

from collections.abc import Iterable, Sized

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.kept_arrays import KeptArrays
from scroll_tactile.matching.likelihood import LEVELS, MISSING, Likelihood
from scroll_tactile.matching.match import KeptTouch, NaturalDeviation, independent
from scroll_tactile.matching.matcher import TouchMatcher

__all__ = ["matcher_of", "spaced"]

FloatArray = npt.NDArray[np.float64]

PAIRS, LEFT_OUT = 200, 64  # kept touches by which the spread is measured, and the rest
FEWEST = 8  # touches left out; of fewer nothing is measured
ASSUMED = (10.0, 10.0)  # coherence and energy then: about what RoboSkin's and BioTac's touches have
USUAL = 0.95  # of touches left out: the odd one of them is noisy itself
EVEN = 2.0  # times the amplitude of those: where the share of noise is a half
ROUNDING = 1 / 12  # squared levels: the noise of rounding to levels
PRIOR_VALUES, PRIOR_SPREAD = 50, 2.0  # of the spread at each level: where hardly any value was read


def matcher_of(touches: Iterable[KeptTouch]) -> TouchMatcher:
    """All that can be asked of kept touches, measured by these touches.

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
    rows = spaced(matcher.kept, LEFT_OUT)
    if len(matcher.kept) < 2 or len(rows) < FEWEST:
        return matcher.deviation
    shapes = [matcher.deviation_of(row) for row in rows]
    natural = float(np.median([coherence for _, coherence in shapes]))
    noise = [independent(energy, coherence, natural) for energy, coherence in shapes]
    most = EVEN**2 * float(np.quantile(noise, USUAL))
    energy = float(np.quantile([energy for energy, _ in shapes], USUAL))
    return NaturalDeviation(matcher.deviation.likelihood, natural, max(most, ROUNDING), max(energy, ROUNDING))
