"""What follows from a readout at one moment: its materials' Gram matrix, and what ridge and novelty need of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from scroll_tactile.statistics.moments import one_thread

if TYPE_CHECKING:
    from scroll_tactile.readouts.readout import Readout

__all__ = ["Derived"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Derived:
    """What follows from a readout at one moment.

    gram: G of the reference materials about their mean, shape (R, R). background: H. towards: what is taken off z
    beside its mean to bring it about the mean of the reference materials, shape (R,). size: γ μᵀ K⁻¹ μ of that mean.
    """

    gram: FloatArray
    background: FloatArray
    towards: FloatArray
    size: float

    @classmethod
    def of(cls, readout: Readout) -> Derived:
        """Derive it from a readout as it is."""
        shares, (means, solved) = readout.shares, readout.means_solved()
        with one_thread():
            gram = readout.gamma * (means @ solved.T)
            gram = (gram + gram.T) / 2
            onto = gram @ shares
            size = float(shares @ onto)
            gram = gram - onto[:, None] - onto + size
            background = np.linalg.inv(np.diag(1.0 / ((1 - readout.share) * shares)) + gram)
        return cls(gram, (background + background.T) / 2, onto - size, size)
