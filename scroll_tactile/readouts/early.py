"""Early answers: a model and the kept touches believed beside each other at some moments, by touches left out of both.

Which of them is right depends on how much was felt: of BioTac's touches the kept ones are after 0.1 s in 81 % and the
model in 54, after 0.5 s in 83 and 94. So at each moment t of a touch that may go on

    p_y = (1 − ε_t) q_y + ε_t / C,    q_y ∝ exp(g_t log d_y + β_t S_y),

d the model's probabilities, S the log-likelihoods of the kept touches, and (g_t, β_t) ≥ 0 of least log loss on the
beginnings of touches left out, drawn to those of this moment and of the ones next to it together: by themselves they
are at times too sure, and shared alone they lose answers. So a probability is what it says at each moment; ε_t is the
share of touches that are unlike all others of their material, and no less than n of them can rule out. Novelty has the
mean and the spread of theirs. A beginning is judged as at the latest moment that it reached.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.calibration import FEWEST, Calibration, fit_weights
from scroll_tactile.readouts.pooled import Pooled, recalled_of

__all__ = ["Early", "Heard", "Moment", "early_of", "moments_of"]

FloatArray = npt.NDArray[np.float64]

SECONDS = (1.0, 2.0, 5.0)  # times 0.1, 1, 10 …: with twice as many no answer is sooner right
MOST_MOMENTS = 12  # of a touch
NEAR = 1.25  # times a milestone, or one over it: then that is the moment
PRIOR = np.array([0.5, 0.03])  # g and β: about what both sensors' beginnings come to
PRIOR_TOUCHES = 0.05  # that it counts as: of short touches with few channels β is ten times as much
SHARED_TOUCHES = 10.0  # that the weights of a moment and those next to it count as
LEAST_PRIOR = 1e-3
ODD = 0.5  # touches more than those left out that are odd
LEAST_SPREAD = 1e-9
STEPS = 100  # of EM


@dataclass(frozen=True)
class Heard:
    """What was said at one moment of N beginnings, each left out; C materials.

    columns: of each. touches: which of those left out reached it, (N,). targets: their materials, (N,). logs: g's part,
    scores: β's, both (N, C). certainty: of the kept touches. novelty: (N,).
    """

    columns: int
    touches: npt.NDArray[np.intp]
    targets: npt.NDArray[np.intp]
    logs: FloatArray
    scores: FloatArray
    certainty: float
    novelty: FloatArray


@dataclass(frozen=True)
class Moment:
    """How the beginning of a touch is judged that has so many columns.

    trusted, recalled: g and r, see `prediction.recalling`. odd: ε. usual, spread: of the novelty of known touches.
    novelties: theirs, in these units, ascending.
    """

    columns: int
    trusted: float
    recalled: float
    odd: float
    usual: float
    spread: float
    novelties: FloatArray

    def believed(self, pooled: Pooled) -> Pooled:
        """The kept touches beside the model, as they are believed at this moment."""
        return replace(pooled, trusted=self.trusted, recalled=self.recalled, familiar=np.inf)

    def chances(self, said: Heard) -> FloatArray:
        """The probability of the materials for beginnings left out at this moment, (N, C)."""
        steepness = 1 / (1 + (1 / self.recalled - 1) * said.certainty)
        logits = self.trusted * said.logs + steepness * said.scores
        chances = np.exp(logits - logits.max(axis=1, keepdims=True))
        return self.tempered(chances / chances.sum(axis=1, keepdims=True))

    def tempered(self, chances: FloatArray) -> FloatArray:
        """Probabilities (…, C) of which a share is left for touches that are unlike all others."""
        return np.asarray((1 - self.odd) * chances + self.odd / chances.shape[-1])

    def novelty(self, novelty: float) -> float:
        """A novelty in units of that of known touches at this moment."""
        return (novelty - self.usual) / self.spread

    def calibrated(self, calibration: Calibration) -> Calibration:
        """A calibration with the threshold of this moment."""
        return replace(calibration, novelties=self.novelties)


@dataclass(frozen=True)
class Early:
    """How beginnings are judged: all moments, ascending; and what is said there of the touches they were fitted to."""

    moments: tuple[Moment, ...]
    fitted: Rehearsal

    def at(self, columns: int) -> Moment:
        """The latest moment that so many columns reached; the first, where they reached none."""
        return self.moments[max(0, bisect_right([moment.columns for moment in self.moments], columns) - 1)]

    def rehearsed(self, heard: Sequence[Heard], targets: npt.NDArray[np.intp]) -> Rehearsal:
        """What is then said of touches left out. heard: at each of the moments. targets: of all touches."""
        chances = [moment.chances(said) for moment, said in zip(self.moments, heard, strict=True)]
        novelty = [
            (said.novelty - moment.usual) / moment.spread for moment, said in zip(self.moments, heard, strict=True)
        ]
        among = [
            np.stack([_among(of, said.touches, len(targets)) for of, said in zip(values, heard, strict=True)], axis=1)
            for values in (chances, novelty)
        ]
        return Rehearsal(among[0], among[1], targets)


@dataclass(frozen=True)
class Rehearsal:
    """What is said of N touches left out at each of m moments; NaN where one did not reach it.

    chances: probability of the C materials, (N, m, C). novelty: (N, m). targets: the material of each, (N,).
    """

    chances: FloatArray
    novelty: FloatArray
    targets: npt.NDArray[np.intp]


def moments_of(rate: float, milestones: Sequence[int], least: int, fewest: int) -> tuple[int, ...]:
    """The moments at which beginnings are measured, in columns: `fewest` or more, and below `least`.

    rate: columns a second. milestones: lengths at which a touch is judged otherwise than before.
    """
    fixed = [columns for columns in milestones if fewest <= columns < least]
    grid, tenth = [], rate / 10
    while tenth < least:
        grid += [round(step * tenth) for step in SECONDS]
        tenth *= 10
    free = [
        columns
        for columns in grid
        if fewest <= columns < least and all(not 1 / NEAR < columns / other < NEAR for other in fixed)
    ]
    moments = sorted({*fixed, *free})
    if len(moments) <= MOST_MOMENTS:
        return tuple(moments)
    return tuple(moments[i] for i in np.linspace(0, len(moments) - 1, MOST_MOMENTS).round().astype(int))


def early_of(heard: Sequence[Heard], targets: npt.NDArray[np.intp]) -> Early | None:
    """Fit every moment that enough touches reached; None where none has. targets: the materials of all touches."""
    enough = [said for said in heard if len(said.touches) >= FEWEST]
    if not enough:
        return None
    moments = tuple(_fitted(said, enough[max(0, i - 1) : i + 2]) for i, said in enumerate(enough))
    nobody = Rehearsal(np.empty((0, len(moments), 0)), np.empty((0, len(moments))), targets[:0])
    return replace(Early(moments, nobody), fitted=Early(moments, nobody).rehearsed(enough, targets))


def _fitted(said: Heard, near: Sequence[Heard]) -> Moment:
    """A moment; near: what was said at the moments near it, this one among them."""
    shared = np.maximum(_weights(near, PRIOR, PRIOR_TOUCHES), LEAST_PRIOR)
    trusted, steepness = _weights([said], shared, SHARED_TOUCHES).tolist()
    recalled = recalled_of(steepness, said.certainty)
    usual, spread = float(said.novelty.mean()), max(float(said.novelty.std()), LEAST_SPREAD)
    moment = Moment(said.columns, trusted, recalled, 0.0, usual, spread, np.sort((said.novelty - usual) / spread))
    own = moment.chances(said)[np.arange(len(said.targets)), said.targets]
    return replace(moment, odd=_odd(own, said.logs.shape[1]))


def _weights(said: Sequence[Heard], prior: FloatArray, touches: float) -> FloatArray:
    """g and β for what was said at some moments together."""
    scores = np.concatenate([np.stack([heard.logs, heard.scores], axis=1) for heard in said])
    return fit_weights(scores, np.concatenate([heard.targets for heard in said]).tolist(), prior, touches)


def _odd(own: FloatArray, materials: int) -> float:
    """ε of least log loss, where touches have such probabilities for their own material without it (EM)."""
    odd = ODD / (len(own) + 1)
    for _ in range(STEPS):
        by_chance = odd / materials
        share = float((by_chance / ((1 - odd) * own + by_chance)).sum())
        odd = (share + ODD) / (len(own) + 1)
    return odd


def _among(values: FloatArray, touches: npt.NDArray[np.intp], count: int) -> FloatArray:
    """Values of some touches among all, NaN for the others."""
    among = np.full((count, *values.shape[1:]), np.nan)
    among[touches] = values
    return among
