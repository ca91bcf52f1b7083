"""The truth, in FLINT's integers and balls, from the rows themselves and by the textbook's dense formulas.

`exact_weights` solves a ridge regression of doubles; `TrueReadout` answers as a readout does that has no rounding. They
share no formula with what is measured: sums are formed at once from all rows, and every matrix is solved by itself.
The tests hold both against mpmath.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from flint import arb, arb_mat, ctx, fmpq, fmpz, fmpz_mat

__all__ = ["Answers", "TrueReadout", "exact_weights"]

FloatArray = npt.NDArray[np.float64]
LongArray = npt.NDArray[np.longdouble]
Integers = npt.NDArray[np.object_]

FIRST_BITS, ENOUGH_BITS = 256, 80


def whole(values: npt.NDArray[Any]) -> tuple[Integers, int]:
    """Doubles or integers as integers times 2^exponent, exactly, with one exponent for all."""
    if values.dtype.kind == "i":
        return values.astype(object), 0
    mantissa, exponent = np.frexp(values)
    digits = np.ldexp(mantissa, 53).astype(np.int64).astype(object)
    places = np.where(mantissa == 0, 0, exponent - 53)
    least = int(places.min(initial=0))
    return digits << (places - least).astype(object), least


def exact_weights(rows: FloatArray, targets: FloatArray, penalty: float, repeats: int = 1) -> LongArray | None:
    """W of shape (d, C), exact and then rounded to long doubles; of rows that were given `repeats` times.

    None where λ = 0 and the rows leave weights open.
    """
    # Columns in units of their own, A_ij = 2^(p_i + p_j) gram_ij: so λ counts 2^(−2 p_i) λ on the diagonal.
    (x, places), (y, above) = ([*zip(*map(whole, table.T), strict=True)] for table in (rows, targets))
    digits, wanted = fmpz_mat([list(column) for column in x]), fmpz_mat([list(column) for column in y])
    gram, right = repeats * (digits * digits.transpose()), repeats * (digits * wanted.transpose())
    if not penalty and gram.rank() < len(places):
        return None
    with ctx.workprec(4 * FIRST_BITS):
        ridge = [arb(penalty) * arb((1, -2 * place)) for place in places]
        solution = certain(arb_mat(gram) + _diagonal(ridge), arb_mat(right))
    weights = np.zeros((len(places), len(above)), dtype=np.longdouble)
    for row, column in np.ndindex(weights.shape):
        weights[row, column] = _long(solution[row, column], above[column] - places[row])
    return weights


def certain(matrix: arb_mat, right: arb_mat) -> arb_mat:
    """The solution of a system that is not singular, in balls of which the middle is right to 80 bits."""
    bits = FIRST_BITS
    while True:
        with ctx.workprec(bits):
            try:
                found = matrix.solve(right)
            except ZeroDivisionError:  # balls too wide to tell it from a singular one
                bits *= 2
                continue
            largest = [max(abs(value.mid()) for value in column) for column in found.transpose().tolist()]
            small = arb((1, -ENOUGH_BITS))
            if all(
                value.rad() <= small * max(abs(value.mid()), top * small)
                for row in found.tolist()
                for value, top in zip(row, largest, strict=True)
            ):
                return found
        bits *= 2


def _long(value: arb, exponent: int) -> Any:
    """value · 2^exponent as a long double, whatever its exponent."""
    with ctx.workprec(128):
        middle = value.mid()
        if not middle:
            return np.longdouble(0)
        mantissa, place = middle.man_exp()
    digits = int(mantissa)
    cut = max(0, digits.bit_length() - 64)
    high, low = divmod(digits >> cut if digits > 0 else -(-digits >> cut), 2**32)
    return np.ldexp(np.longdouble(high) * np.longdouble(2**32) + np.longdouble(low), int(place) + cut + exponent)


@dataclass(frozen=True)
class Answers:
    """True answers for m rows and C materials, each rounded once.

    lda: about their mean over the materials, (m, C); ridge: (m, C); distances: relative Mahalanobis distances if that
    material were the nearest, (m, C); novelty: their least, (m,).
    """

    lda: FloatArray
    ridge: FloatArray
    distances: FloatArray
    novelty: FloatArray


class TrueReadout:
    """Discriminants of rows (n, d), doubles or integers, with places of their materials, P and γ.

    K = S_w + P I and T = S_w + Σ n_y (m_y − μ)(m_y − μ)ᵀ + P I, with μ the mean of all rows.
    """

    def __init__(self, rows: npt.NDArray[Any], places: npt.NDArray[np.intp], penalty: float, gamma: float) -> None:
        table, self._unit = whole(rows)
        counts = np.bincount(places).tolist()
        sums = fmpz_mat([[int(v) for v in table[places == y].sum(axis=0)] for y in range(len(counts))])
        digits = fmpz_mat(table.tolist())
        second = digits.transpose() * digits
        self.counts, self._gamma = counts, gamma
        total = sum(counts)
        self._mean = [fmpq(sum(column, start=fmpz(0)), total) for column in sums.transpose().tolist()]
        with ctx.workprec(4 * FIRST_BITS):
            self._means = arb_mat([
                [arb(fmpq(v, n) - m) for v, m in zip(row, self._mean, strict=True)]
                for row, n in zip(sums.tolist(), counts, strict=True)
            ])  # fmt: skip
            shares = [[arb(v) / n for v in row] for row, n in zip(sums.tolist(), counts, strict=True)]
            scatter = arb_mat(second) - arb_mat(shares).transpose() * arb_mat(sums)
            ridge = arb(penalty) * arb((1, -2 * self._unit))
            self._scatter, self._within = scatter, scatter + _diagonal([ridge] * sums.ncols())
            weighed = _diagonal([arb(n) for n in counts]) * self._means
            self._whole = self._within + self._means.transpose() * weighed
            self._pull = weighed.transpose()
            self._solved = certain(self._within, self._means.transpose())
            self._sizes = [
                _dot(m, s) for m, s in zip(self._means.tolist(), self._solved.transpose().tolist(), strict=True)
            ]

    def share(self, touches: int, least: float, largest: float) -> float:
        """ρ by equation 23 of Chen et al. 2010, within limits, of so many touches; 0 where there is no scatter."""
        d = self._scatter.nrows()
        with ctx.workprec(4 * FIRST_BITS):
            entries = self._scatter.entries()
            trace, squares = self._scatter.trace(), _dot(entries, entries)
            spread, part = squares - trace * trace / d, 1 - arb(2) / d
            if not spread > 0:
                return largest if trace > 0 else 0.0
            ratio = (part * squares + trace * trace) / ((touches + part) * spread)
        return min(max(float(ratio.mid()), least), largest)

    def weights(self) -> FloatArray:
        """γ K⁻¹ mᵀ about their mean over the materials, (d, C), in the rows' own unit."""
        with ctx.workprec(2 * FIRST_BITS):
            scale = arb(self._gamma) * arb((1, -self._unit))
            return _floats([[scale * v for v in _centred(row)] for row in self._solved.tolist()])

    def _away(self, rows: npt.NDArray[Any]) -> arb_mat:
        """Rows (m, d) about the mean."""
        table, unit = whole(rows)
        shift = arb((1, unit - self._unit))
        return arb_mat([[shift * int(v) - m for v, m in zip(row, self._mean, strict=True)] for row in table.tolist()])

    def far(self, rows: npt.NDArray[Any], place: int) -> FloatArray:
        """The squared Mahalanobis distance of rows (m, d) from the material at a place, (m,)."""
        with ctx.workprec(4 * FIRST_BITS):
            away, gamma = self._away(rows), arb(self._gamma)
            within, z = _dots(away, certain(self._within, away.transpose())), (away * self._solved).tolist()
            found = [gamma * (near - 2 * row[place] + self._sizes[place]) for near, row in zip(within, z, strict=True)]
            return np.asarray(_floats([found])[0])

    def answers(self, rows: npt.NDArray[Any]) -> Answers:
        """The answers for rows of shape (m, d)."""
        total, gamma = sum(self.counts), arb(self._gamma)
        with ctx.workprec(4 * FIRST_BITS):
            away = self._away(rows)
            down = away.transpose()
            z = (away * self._solved).tolist()
            within = _dots(away, certain(self._within, down))
            behind = certain(self._whole, _beside(self._pull, down))
            pulled = arb_mat([row[: len(self.counts)] for row in behind.tolist()])
            beyond = arb_mat([row[len(self.counts) :] for row in behind.tolist()])
            whole_length = _dots(away, beyond)
            lda = [_centred([gamma * (v - g / 2) for v, g in zip(row, self._sizes, strict=True)]) for row in z]
            ridge = [
                [v + arb(n) / total for v, n in zip(row, self.counts, strict=True)] for row in (away * pulled).tolist()
            ]
            distances = [
                [gamma * (near - 2 * v + g - far) for v, g in zip(row, self._sizes, strict=True)]
                for row, near, far in zip(z, within, whole_length, strict=True)
            ]
            found = _floats(distances)
            return Answers(_floats(lda), _floats(ridge), found, found.min(axis=1))


def _diagonal(values: list[arb]) -> arb_mat:
    return arb_mat([[value if i == j else arb(0) for j in range(len(values))] for i, value in enumerate(values)])


def _beside(left: arb_mat, right: arb_mat) -> arb_mat:
    return arb_mat([[*a, *b] for a, b in zip(left.tolist(), right.tolist(), strict=True)])


def _dot(left: list[arb], right: list[arb]) -> arb:
    return sum((a * b for a, b in zip(left, right, strict=True)), start=arb(0))


def _dots(rows: arb_mat, columns: arb_mat) -> list[arb]:
    return [_dot(row, column) for row, column in zip(rows.tolist(), columns.transpose().tolist(), strict=True)]


def _centred(row: list[arb]) -> list[arb]:
    middle = sum(row, start=arb(0)) / len(row)
    return [value - middle for value in row]


def _floats(table: list[list[arb]]) -> FloatArray:
    return np.array([[float(value.mid()) for value in row] for row in table], dtype=np.float64)
