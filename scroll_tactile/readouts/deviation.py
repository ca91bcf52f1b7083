"""What a set of kept touches says of itself: how touches of one material deviate from each other.

Each of some touches is left out and compared with the others. All is a function of the set.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.likelihood import CLEAN, LEVELS, MISSING, Likelihood
from scroll_tactile.readouts.recall import Recall
from scroll_tactile.readouts.recollection import Kept, Measured, independent

__all__ = ["recall_of"]

FloatArray = npt.NDArray[np.float64]

PAIRS, LEFT_OUT = 200, 64  # kept touches by which the spread is measured, and the rest
FEWEST = 8  # touches left out; of fewer nothing is measured
ASSUMED = (30.0, 10.0, 10.0)  # doubt, coherence and energy then: about what RoboSkin's and BioTac's touches have
DOUBTS = 2.0 ** np.arange(0.0, 12.0, 0.5)
USUAL = 0.95  # of touches left out: the odd one of them is noisy itself
EVEN = 2.0  # times the amplitude of those: where trust is a half
ROUNDING = 1 / 12  # squared levels: the noise of rounding to levels
PRIOR_VALUES, PRIOR_SPREAD = 50, 2.0  # of the spread at each level: where hardly any value was read


def recall_of(touches: Iterable[Kept]) -> Recall:
    """All that can be asked of kept touches, measured by these touches.

    Raises InputError for touches of different channels, and for none.
    """
    level = np.ones(LEVELS)
    blank = Recall(touches, Measured(Likelihood(level, level), *ASSUMED))
    likelihood = _likelihood(blank)
    recall = Recall(blank.kept, Measured(likelihood, *ASSUMED), blank)
    return Recall(blank.kept, _measured(recall, likelihood), recall)


def _spaced(recall: Recall, count: int) -> list[int]:
    """Places of at most so many touches, spread evenly over their keys: at random, but the same of the same set."""
    return list(range(0, len(recall.kept), max(1, -(-len(recall.kept) // count))))


def _likelihood(recall: Recall) -> Likelihood:
    """The tables of the spread by level: the mean deviation from the nearest touch, over levels half to twice as high.

    The mean deviation, and not the standard deviation, which is a quarter more: kept touches that are likelier come
    nearer than the nearest by all values does.
    """
    counts, deviations = np.zeros(LEVELS), np.zeros(LEVELS)
    for row in _spaced(recall, PAIRS):
        pair = recall.nearest(row)
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


def _measured(recall: Recall, likelihood: Likelihood) -> Measured:
    rows = _spaced(recall, LEFT_OUT)
    if len(recall.kept) < 2 or len(rows) < FEWEST:
        return recall.measured
    apart = [recall.apart(row) for row in rows]
    place = {name: i for i, name in enumerate(recall.materials)}
    own = [place[recall.kept[row].material] for row in rows]
    certainty = likelihood.table(CLEAN).certainty
    losses = [
        _losses(logs, labels == target, 1 / (1 + DOUBTS * certainty * share))
        for (logs, labels, share, *_), target in zip(apart, own, strict=True)
    ]
    doubt = DOUBTS[np.argmin(np.sum(losses, axis=0))] if len(place) > 1 else ASSUMED[0]
    shapes = [shape for _, _, _, *shape in apart]
    natural = float(np.median([coherence for _, coherence in shapes]))
    noise = [independent(energy, coherence, natural) for energy, coherence in shapes]
    most = EVEN**2 * float(np.quantile(noise, USUAL))
    return Measured(likelihood, float(doubt), natural, max(most, ROUNDING))


def _losses(logs: FloatArray, mine: npt.NDArray[np.bool_], steep: FloatArray) -> FloatArray:
    """−log of the probability of a touch's own material, for each β; where none of its is near, of a single touch."""
    behind = steep[:, None] * (logs - logs.max())
    if not mine.any():
        behind, mine = np.column_stack([behind, behind.min(axis=1)]), np.append(mine, True)
    best = behind[:, mine].max(axis=1)
    own = best + np.log(np.exp(behind[:, mine] - best[:, None]).sum(axis=1))
    return np.asarray(np.log(np.exp(behind).sum(axis=1)) - own)
