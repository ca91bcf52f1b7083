"""A bet against exchangeability: conformal p-values, and martingales that grow where these are not uniform.

Of each channel three scores are ranked, by what a change of it would do: the linear statistics dᵀ P x that tell a
gain, an offset and noise from what else moves, P the inverse of the scatter of touches within materials. P contains
the touch itself and treats it as the others, so that its rank among the touches of its own material and length is
uniform and independent of all before it, whatever mixture of materials comes (transductive, Mondrian: Vovk, Gammerman,
Shafer, Algorithmic Learning in a Random World, 2005). A simple jumper bets on each score (Volkhonskiy and others,
COPA 2017): factors 1 + ε (p − 1/2), capital moved between the ε at a rate J. The mean of all martingales is one, too,
and reaches 1/bound with a probability of at most the bound, ever (Ville).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scroll_tactile.health.channel_numbers import KINDS, UNIT, Numbers

__all__ = ["Bets", "Scatter", "tie_break"]

Floats = npt.NDArray[np.float64]

STAKES = np.array([-1.5, -0.75, 0.0, 0.75, 1.5])[:, None]
JUMP = 0.01
PRIOR = 0.02  # of a logarithm: the scatter that is assumed of a number before any touch, counted as one touch each


class Bets:
    """One martingale for each of `count` scores. log: the natural logarithm of each, shape (count,)."""

    def __init__(self, count: int) -> None:
        self._shares = np.full((len(STAKES), count), 1 / len(STAKES))
        self.log: Floats = np.zeros(count)

    def take(self, ranks: Floats) -> None:
        """Bet on p-values (count,)."""
        shares = (1 - JUMP) * self._shares + JUMP / len(STAKES)
        shares *= 1 + STAKES * (ranks - 0.5)
        total = shares.sum(axis=0)
        self._shares = shares / total
        self.log = self.log + np.log(total)

    def evidence(self) -> float:
        """The natural logarithm of the mean martingale."""
        most = float(self.log.max())
        return most + float(np.log(np.mean(np.exp(self.log - most))))


class Scatter:
    """The inverse of prior + Σ (x − mean of its cell)(x − mean)ᵀ, updated touch by touch (Sherman and Morrison 1950)."""

    def __init__(self, channels: int) -> None:
        self.channels, size = channels, KINDS * channels + 1
        self.inverse: Floats = np.eye(size) / (size * PRIOR**2)

    def take(self, row: Numbers, cell: npt.NDArray[np.int16]) -> None:
        """Add a touch (size,) to a cell that has the rows (k, size)."""
        count = len(cell)
        if count:
            away = (row - cell.mean(axis=0)) * (UNIT * np.sqrt(count / (count + 1)))
            moved = self.inverse @ away
            self.inverse -= np.outer(moved, moved / (1 + away @ moved))

    def scores(self, rows: npt.NDArray[np.int16]) -> Floats:
        """Of rows (k, size): how far each channel's gain, its offset and its noise stand out, (k, 3 n)."""
        n = self.channels
        level, spread, noise = (self.inverse[:, at : at + n] for at in (0, n, 2 * n))
        return np.asarray((rows * UNIT) @ np.concatenate([level + spread + noise, level, noise], axis=1))


def tie_break(sequence: int) -> float:
    """A number in [0, 1) that ties are broken by: the golden ratio's multiples, of a row's place in the journal."""
    return (sequence * 0.6180339887498949) % 1.0
