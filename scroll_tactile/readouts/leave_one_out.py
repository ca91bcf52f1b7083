"""Leave-one-out scores: of each touch by a readout that never observed it, its row taken out of the statistics.

Readouts of folds know two thirds of what was observed, and are wrong more often than the one that answers; scores that
are calibrated on theirs are not sharp enough. Let S = S_w + N λ V, W = N S⁻¹ Mᵀ and G = M W as in `readouts`. A row x
of a material with n rows and mean m, u = x − m and q = uᵀ S⁻¹ u, leaves by

    S⁻¹ + f S⁻¹ u uᵀ S⁻¹,  f = k / (1 − k q),  k = n / (n − 1)     (Sherman and Morrison 1950; Bartlett 1951)

and its material's mean becomes m − u / (n − 1). With g = Wᵀ u / N all scores follow from G, g and q, so that the
whole takes one factorisation. The ridge N λ V stays what it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.readout import Readout, centred_means, require_definite
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import one_thread, within_scatter
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["leave_one_out_scores"]

FloatArray = npt.NDArray[np.float64]


def leave_one_out_scores(
    statistics: Statistics, scale: Scale, readout: Readout, rows: FloatArray, places: Sequence[int]
) -> FloatArray:
    """Scores, shape (N, C), that `lda` would give rows of a scale had each, alone, never been observed.

    readout: of all the statistics of the scale. rows: in codes, shape (N, d), each one that was added to them.
    places: of their materials among the readout's classes, each of two rows or more, shape (N,).

    Raises numpy.linalg.LinAlgError where the scatter with its ridge is not positive definite to working precision.
    """
    from scipy.linalg.lapack import dpotrf, dpotrs

    counts, sums = statistics.totals(scale)
    total = int(counts.sum())
    _, means = centred_means(counts, sums)
    own = np.asarray(places, dtype=np.intp)
    apart = rows - readout.center - means[own]
    system = within_scatter(statistics.total_second(scale), counts, sums)
    system[np.diag_indices_from(system)] += readout.penalties
    with one_thread():
        factor, failed = dpotrf(np.asfortranarray(system), lower=0, overwrite_a=1)
        require_definite(readout.penalty, failed)
        solved, _ = dpotrs(factor, apart.T, lower=0)
    length = np.einsum("nd,dn->n", apart, solved)
    along, gram = apart @ readout.weights / total, readout.gram / total
    i, count = np.arange(len(own)), counts[own].astype(np.float64)
    gain = count / (count - 1)
    gain = gain / (1 - gain * length)
    # The products of the other materials' means with the row, then that of its own, which has lost it.
    onto = gram[own] + along
    reach = along.copy()  # S⁻¹ u on each mean
    mean, share = along[i, own], 1 / (count - 1)
    onto[i, own] -= share * (mean + length)
    reach[i, own] -= share * length
    sizes = np.tile(np.diagonal(gram), (len(own), 1))
    sizes[i, own] += share * (share * length - 2 * mean)
    onto += (gain * (mean + length))[:, None] * reach
    sizes += gain[:, None] * np.square(reach)
    scores: FloatArray = total * (onto - sizes / 2)
    return scores
