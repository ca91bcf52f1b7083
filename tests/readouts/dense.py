"""The textbook's formulas from the rows themselves: sums in fractions, and matrices in fifty digits."""

from fractions import Fraction

import mpmath
import numpy as np

DIGITS = 50


class Dense:
    """A readout of rows by material, each a pair of a row of integers and how often it counts.

    penalty, share: P and ρ. reference: the materials that novelty and the ridge rest on. total: N, where it is not the
    sum of the counts; excess: N over the counts of the reference, likewise. solved: the readout that this one followed,
    of which it has the scatter within materials, and N.
    """

    def __init__(self, groups, penalty, share, reference=None, total=None, excess=None, solved=None):
        self.groups, self.names, self.penalty, self.share = groups, sorted(groups), penalty, share
        self.reference = self.names if reference is None else list(reference)
        self.counts = {name: sum(Fraction(often) for _, often in rows) for name, rows in groups.items()}
        self.width = len(next(iter(groups.values()))[0][0])
        self.means = {
            name: [sum(often * int(row[j]) for row, often in rows) / self.counts[name] for j in range(self.width)]
            for name, rows in groups.items()
        }
        scatter = [[Fraction(0)] * self.width for _ in range(self.width)]
        for name, rows in groups.items():
            for row, often in rows:
                away = [int(x) - m for x, m in zip(row, self.means[name], strict=True)]
                for i in range(self.width):
                    for j in range(i + 1):
                        scatter[i][j] += often * away[i] * away[j]
        self.scatter = [[scatter[max(i, j)][min(i, j)] for j in range(self.width)] for i in range(self.width)]
        known = sum(self.counts[name] for name in self.reference)
        if solved is not None:
            self.scatter, total = solved.scatter, solved.total
        self.total = sum(self.counts.values()) if total is None else total
        self.shares = {name: self.counts[name] / known for name in self.reference}
        self.center = [
            sum(self.shares[name] * self.means[name][j] for name in self.reference) for j in range(self.width)
        ]
        self.excess = excess = Fraction(self.total) / known if excess is None else excess
        with mpmath.workdps(DIGITS):
            self.within = self.matrix(self.scatter) + self.number(penalty) * mpmath.eye(self.width)
            whole = self.within.copy()
            for name in self.reference:
                away = self.column(self.means[name], self.center)
                whole += self.number(excess * self.counts[name]) * away * away.T
            self.inverse, self.of_whole = mpmath.inverse(self.within), mpmath.inverse(whole)
            self.gamma = self.number(self.total) / (1 - self.number(share))

    @staticmethod
    def number(value):
        exact = value if isinstance(value, Fraction) else Fraction(float(value))
        return mpmath.mpf(exact.numerator) / exact.denominator

    def matrix(self, rows):
        return mpmath.matrix([[self.number(value) for value in row] for row in rows])

    def column(self, row, origin):
        """A row about an origin."""
        return mpmath.matrix([self.number(x) - self.number(o) for x, o in zip(row, origin, strict=True)])

    def lda(self, row, names, origin):
        """m_yᵀ Σ⁻¹ x − m_yᵀ Σ⁻¹ m_y / 2 about an origin."""
        with mpmath.workdps(DIGITS):
            x = self.column(row, origin)
            means = [self.column(self.means[name], origin) for name in names]
            return [float(self.gamma * (m.T * self.inverse * (x - m / 2))[0]) for m in means]

    def ridge(self, row, names):
        """Regression of 0/1 targets with an intercept."""
        with mpmath.workdps(DIGITS):
            onto = self.of_whole * self.column(row, self.center)
            scores = []
            for name in names:
                target = self.number(self.excess * self.counts[name]) * self.column(self.means[name], self.center)
                scores.append(float(self.number(self.shares[name]) + (target.T * onto)[0]))
            return scores

    def length(self, row):
        """The squared Mahalanobis length of a row about the mean: the largest term that a novelty is made of."""
        with mpmath.workdps(DIGITS):
            x = self.column(row, self.center)
            return float(self.gamma * (x.T * self.inverse * x)[0])

    def far(self, row, name):
        """The squared Mahalanobis distance from a material."""
        with mpmath.workdps(DIGITS):
            away = self.column(row, self.means[name])
            return float(self.gamma * (away.T * self.inverse * away)[0])

    def distances(self, row, names):
        """Squared Mahalanobis distances to some materials, each less that to the whole."""
        with mpmath.workdps(DIGITS):
            x = self.column(row, self.center)
            background = (x.T * self.of_whole * x)[0]
            found = []
            for name in names:
                away = self.column(row, self.means[name])
                found.append(float(self.gamma * ((away.T * self.inverse * away)[0] - background)))
            return found


def groups_of(touches):
    """Rows by material, each once, of touches (material, rows)."""
    groups = {}
    for material, rows in touches:
        groups.setdefault(material, []).extend((row.tolist(), 1) for row in rows)
    return groups


def require_near(found, expected, tolerance=1e-9):
    """Within a share of the largest of the expected values, or of 1."""
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() <= tolerance * max(1.0, np.abs(expected).max())
