"""The true weights of a ridge regression on given doubles, by ways that share nothing with the solvers measured.

Small cases: the normal equations in whole numbers, solved in fractions by FLINT: exact, and not in ball arithmetic.
Larger ones: Householder's QR of the rows in float64 (LAPACK), then corrections from what
the equations R + XW = Y and XᵀR = λW leave over, formed exactly in Python's integers, until they are below 2⁻⁷⁰ of the
weights. That they shrink, each to a small share of the one before, verifies the answer; else TruthError is raised.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt
from flint import fmpq_mat, fmpz_mat
from scipy.linalg import solve_triangular

__all__ = ["TruthError", "exact_weights", "refined_weights"]

FloatArray = npt.NDArray[np.float64]
LongArray = npt.NDArray[np.longdouble]
Integers = npt.NDArray[np.object_]

VANISHING = 300  # bits: with λ so far below the matrix, a singular system's solution is its smallest to a long double
SMALL = 2.0**-70
STEPS = 40
WORST = 1e12  # condition of the rows: corrections shrink by 10⁻⁴ at least
BITS = 200  # of the weights as integers, below their largest


class TruthError(ArithmeticError):
    """The corrections did not shrink: no truth was found for this case."""


def _integers(values: FloatArray) -> tuple[Integers, int]:
    """Doubles as integers times 2^exponent, exactly, with one exponent for all."""
    mantissa, exponent = np.frexp(values)
    whole = np.ldexp(mantissa, 53).astype(np.int64).astype(object)
    places = np.where(mantissa == 0, 0, exponent - 53)
    least = int(places.min(initial=0))
    return whole << (places - least).astype(object), least


def _by_column(values: FloatArray) -> tuple[Integers, list[int]]:
    """Doubles as integers, with one exponent for each column."""
    parts = [_integers(column) for column in values.T]
    return np.stack([part for part, _ in parts], axis=1), [exponent for _, exponent in parts]


def exact_weights(rows: FloatArray, targets: FloatArray, penalty: float, repeats: int = 1) -> LongArray:
    """W of shape (d, C), exact and then rounded to long doubles; of rows that were given `repeats` times.

    Where λ = 0 and the rows leave weights open, the smallest.
    """
    x, places = _by_column(rows)
    y, above = _by_column(targets)
    gram, right = repeats * (x.T @ x), repeats * (x.T @ y)
    # In units: A_ij = 2^(p_i + p_j) gram_ij, so λ counts 2^(−2 p_i) λ on the diagonal; all brought to whole numbers.
    ridge = [Fraction(penalty) / Fraction(2) ** (2 * place) for place in places]
    solution = _rational(gram, right, ridge)
    if solution is None:
        size = max((Fraction(2) ** (2 * p) * int(gram[j, j]) for j, p in enumerate(places)), default=Fraction(1))
        least = (size or Fraction(1)) / 2**VANISHING
        solution = _rational(gram, right, [least / Fraction(2) ** (2 * place) for place in places])
    assert solution is not None
    weights = np.zeros((len(places), len(above)), dtype=np.longdouble)
    for row, column in np.ndindex(weights.shape):
        found = solution[row, column]
        value = Fraction(int(found.p), int(found.q)) * Fraction(2) ** (above[column] - places[row])
        weights[row, column] = _long(value)
    return weights


def _long(value: Fraction) -> Any:
    """A fraction as a long double, whatever its exponent."""
    if not value:
        return np.longdouble(0)
    shift = 64 - (abs(value.numerator).bit_length() - value.denominator.bit_length())
    whole = round(value * Fraction(2) ** shift)
    high, low = divmod(whole, 2**32)
    return np.ldexp(np.longdouble(high) * np.longdouble(2**32) + np.longdouble(low), -shift)


def _rational(gram: Integers, right: Integers, ridge: list[Fraction]) -> fmpq_mat | None:
    """The solution of (gram + ridge) X = right in fractions; None where the matrix is singular."""
    common = max((value.denominator for value in ridge), default=1)  # powers of two: the largest is a multiple of all
    system = gram * common
    system[np.diag_indices(len(gram))] += np.array([int(value * common) for value in ridge], dtype=object)
    try:
        return fmpq_mat(fmpz_mat(system.tolist())).solve(fmpq_mat(fmpz_mat((right * common).tolist())))
    except ZeroDivisionError:
        return None


def refined_weights(rows: FloatArray, targets: FloatArray, penalty: float) -> LongArray:
    """W of shape (d, C), right to about 2⁻⁷⁰ of its largest entry; λ > 0, entries of moderate size.

    With residuals R as unknowns of their own, R + X W = Y and Xᵀ R − λ W = 0, corrections shrink at a rate of the
    rows' condition times 2⁻⁵³ (Björck 1967, BIT 7); from the gradient alone it would be the condition's square.
    """
    d = rows.shape[1]
    orthogonal, triangle = np.linalg.qr(np.concatenate([rows, np.sqrt(penalty) * np.eye(d)]))
    # Beyond this the factors could be so far off in some direction that corrections would not see an error in it.
    if not np.linalg.cond(triangle) < WORST:
        raise TruthError("the rows are too ill conditioned for QR in float64")
    (x, px), (y, py), (ridge, pr) = _integers(rows), _integers(targets), _integers(np.array([penalty]))
    first = solve_triangular(triangle, orthogonal[: len(rows)].T @ targets)
    of_w = int(np.frexp(np.abs(first).max())[1]) - BITS
    of_r = int(np.frexp(np.abs(targets).max())[1]) - BITS
    weights, residual = np.zeros(first.shape, dtype=object), np.zeros(targets.shape, dtype=object)
    step = np.inf
    for _ in range(STEPS):
        gap = _sum((y, py), (-residual, of_r), (-(x @ weights), px + of_w))
        slope = _sum((ridge[0] * weights, pr + of_w), (-(x.T @ residual), px + of_r))
        inner = solve_triangular(triangle, _floats(*slope), trans="T")
        wanted = np.concatenate([_floats(*gap), np.zeros_like(inner)])
        along = orthogonal.T @ wanted
        correction = solve_triangular(triangle, along - inner)
        weights = weights + _whole(correction, of_w)
        residual = residual + _whole((wanted - orthogonal @ (along - inner))[: len(rows)], of_r)
        before, step = step, float(np.abs(correction).max())
        if step <= SMALL * float(np.abs(_floats(weights, of_w)).max()):
            high = _floats(weights, of_w)
            return high.astype(np.longdouble) + _floats(weights - _whole(high, of_w), of_w)
        if step > 0.5 * before:
            break
    raise TruthError(f"corrections of {before:.1e} and then {step:.1e}: the rows are too ill conditioned for QR")


def _sum(*parts: tuple[Integers, int]) -> tuple[Integers, int]:
    """Integers with the exponents of their units, added exactly."""
    least = min(place for _, place in parts)
    whole, place = parts[0]
    found = whole << (place - least)
    for whole, place in parts[1:]:
        found = found + (whole << (place - least))
    return found, least


def _whole(values: FloatArray, place: int) -> Integers:
    """Doubles in units of 2^place, bits below it cut off."""
    whole, own = _integers(values)
    shifted: Integers = whole << (own - place) if own >= place else whole >> (place - own)
    return shifted


def _floats(whole: Integers, place: int) -> FloatArray:
    """Integers times 2^place as doubles, each rounded once."""
    floats: FloatArray = ((whole << max(place, 0)) / (1 << max(-place, 0))).astype(np.float64)
    return floats
