"""Shrinkage in closed form: how far the scatter within materials is drawn to a multiple of the identity.

With S = S_w / N of n touches, Σ = (1 − ρ) S + ρ (tr S / d) I, and ρ of least expected squared error where features are
normally distributed (the oracle approximating shrinkage of Chen, Wiesel, Eldar and Hero 2010, IEEE Trans. Signal
Processing 58, equation 23):

    ρ = [(1 − 2/d) tr S² + tr² S] / [(n + 1 − 2/d) (tr S² − tr² S / d)].

It needs S alone, so there is nothing to hold out and nothing to choose.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["LARGEST", "LEAST", "shrinkage"]

# Below the first the solution would lose more digits than the 1e-9 that it is good for; above the second nothing would
# be left of S. A memory of a million touches stays above the first.
LEAST, LARGEST = 1e-4, 0.99


def shrinkage(scatter: npt.NDArray[np.float64], touches: int, times: float = 1.0) -> float:
    """ρ, so many times, of a scatter in any unit, (d, d), of which the lower triangle is read, of so many touches."""
    dimension = len(scatter)
    diagonal = np.diagonal(scatter)
    trace = float(diagonal.sum())
    below = sum(float(row[:i] @ row[:i]) for i, row in enumerate(scatter))  # no copy of 8 MB
    squares = 2.0 * below + float(diagonal @ diagonal)
    spread = squares - trace**2 / dimension  # zero where S is a multiple of the identity already
    if not spread > 0:
        return LARGEST
    ratio = ((1 - 2 / dimension) * squares + trace**2) / ((touches + 1 - 2 / dimension) * spread)
    return float(min(max(times * ratio, LEAST), LARGEST))
