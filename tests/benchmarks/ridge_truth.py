"""The ridge regression of doubles in as many digits as are asked for."""

import mpmath


def truth(rows, targets, penalty, digits=60):
    """The weights, (outputs, d), as columns of mpmath's numbers."""
    with mpmath.workdps(digits):
        x, y = mpmath.matrix(rows.tolist()), mpmath.matrix(targets.tolist())
        system = x.T * x + mpmath.mpf(penalty) * mpmath.eye(x.cols)
        return [list(mpmath.lu_solve(system, x.T * y[:, column])) for column in range(y.cols)]
