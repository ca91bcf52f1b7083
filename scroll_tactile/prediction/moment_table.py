"""The table by which touches are judged: how readouts and kept touches are weighed, at each moment of a touch.

`prediction.fusion` fits it.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.match import Match
from scroll_tactile.matching.matcher import TouchMatcher
from scroll_tactile.readouts.calibration import Calibration

__all__ = [
    "APART",
    "LEAST_SPREAD",
    "WITHIN",
    "Fusion",
    "Moment",
    "Trajectories",
    "match_scores",
    "match_weight",
    "tempered",
]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.intp]

WITHIN = 0.95  # the share of held-out touches within the limits
SURE = 0.99  # a touch whose highest probability by the readouts is less is matched with kept ones
APART = 1.25  # the least ratio of the steps of neighbouring moments
LEAST_SPREAD = 1e-9
LEAST_DISTANCE_WEIGHT = 0.5  # the least weight at another pace, as a share of that at the distance limit


@dataclass(frozen=True)
class Moment:
    """The weights and thresholds by which a touch is judged from a length on; symbols as in `judging` and `fusion`.

    steps: that length; of the last moment, that of a complete touch. stage: of the readouts that judge. calibration: of
    their scores. model_weight: g. match_weight: r, which is β at an information of 1, see `match_weight_at`.
    lone_match_weight: r where noise or distance leaves the readouts no weight.
    outlier_rate: ε. model_outlier_rate: ε of the readouts' own probabilities. distance_limit: the relative distance
    that 19 of 20 complete touches stay below; infinite in other rows. mean_excess_loss, loss_spread: mean and standard
    deviation of the excess loss of known touches beside the kept ones.
    """

    steps: int
    stage: int
    calibration: Calibration
    model_weight: float
    match_weight: float
    lone_match_weight: float
    outlier_rate: float
    model_outlier_rate: float
    distance_limit: float
    mean_excess_loss: float
    loss_spread: float

    def match_weight_at(self, match: Match, distance_weight: float) -> float:
        """β, between `match_weight` (readouts at full weight) and `lone_match_weight` (at none), for a touch.

        Each r counts as 1 / (1 + (1/r − 1) c), c the touch's information. distance_weight: of the readouts.
        """
        beside, alone = (match_weight(r, match.information) for r in (self.match_weight, self.lone_match_weight))
        share = (1 - match.noise_share) * distance_weight
        return share * beside + (1 - share) * alone

    def distance_weight(self, distance: float, own_time: bool) -> float:
        """The weight of the readouts for a touch at a relative distance, in (0, 1]: less, the further it is off.

        own_time: as in `judging`: the weight is then 1 / limit at least, at another pace half of that.
        """
        if not (np.isfinite(self.distance_limit) and np.isfinite(distance)):
            return 1.0
        least = (1.0 if own_time else LEAST_DISTANCE_WEIGHT) / max(self.distance_limit, 1.0)
        return float(np.clip(1.0 / max(distance, LEAST_SPREAD), least, 1.0))

    def suffices(self, probability: float, distance: float) -> bool:
        """Whether the readouts are enough, by their highest probability and by how far off the touch is.

        If no touch could be held out, any probability suffices: every new touch would look noisy to the kept ones.
        """
        return probability >= (SURE if self.model_outlier_rate else 0.0) and distance <= self.distance_limit

    def matched_novelty(self, match: Match) -> float:
        """The excess loss beside the kept touches, in units of its spread over known touches, as novelty is."""
        return (match.excess_loss - self.mean_excess_loss) / self.loss_spread

    def threshold(self, false_alarms: float) -> float:
        """The novelty that a share `false_alarms` of known touches exceeds; see `Calibration.threshold`."""
        return self.calibration.threshold(false_alarms)

    @property
    def novelties(self) -> FloatArray:
        """The novelties of the held-out touches of the calibration, ascending."""
        return self.calibration.novelties


@dataclass(frozen=True)
class Trajectories:
    """Answers to N held-out touches at each of m moments, the last not among them; NaN where a touch ended before.

    chances: probability of the C materials, (N, m, C). novelty: (N, m). targets: the material of each, (N,).
    """

    chances: FloatArray
    novelty: FloatArray
    targets: IntArray


@dataclass(frozen=True)
class Fusion:
    """The table of all moments, ascending, the last "complete"; matcher: the kept touches, None where there are none.

    paced: how complete touches are judged that were made at other paces, ascending by steps. trajectories: of the
    touches that it was fitted to, at all moments before the last.
    """

    moments: tuple[Moment, ...]
    paced: tuple[Moment, ...]
    matcher: TouchMatcher | None
    trajectories: Trajectories

    @property
    def complete(self) -> Moment:
        """How a complete touch is judged."""
        return self.moments[-1]

    def reaches(self, steps: int) -> bool:
        """Whether another pace can explain the length of a complete touch: half to twice the median, about."""
        return self.paced[0].steps <= APART * steps and steps <= APART * self.paced[-1].steps

    def at_pace(self, steps: int) -> Moment:
        """The row for a complete touch made at another pace: the one nearest in length, by ratio."""
        return min(self.paced, key=lambda row: abs(math.log(row.steps / steps)))

    def latest(self, stage: int) -> Moment:
        """The latest moment of a stage; that of complete touches, where the stage has none."""
        return next((moment for moment in reversed(self.moments) if moment.stage == stage), self.complete)

    def at(self, steps: int) -> Moment:
        """The latest moment that so many steps reached; the first, where they reached none."""
        return self.moments[max(0, bisect_right([moment.steps for moment in self.moments], steps) - 1)]


def match_scores(matcher: TouchMatcher, names: Sequence[str], match: Match) -> FloatArray:
    """The kept touches' scores of some materials, (C,); the least of all for materials of which none is kept."""
    places, least = {name: i for i, name in enumerate(matcher.kept.materials)}, float(match.scores.min())
    return np.array([match.scores[places[name]] if name in places else least for name in names])


def tempered(chances: FloatArray, outlier_rate: float) -> FloatArray:
    """Probabilities (…, C) mixed with a uniform share, the outlier rate."""
    return np.asarray((1 - outlier_rate) * chances + outlier_rate / chances.shape[-1])


def match_weight(full: float, information: float) -> float:
    """β of r at this information."""
    return 1 / (1 + (1 / full - 1) * information)
