"""The solvers by name: what `python -m examples.benchmarks numerics` compares."""

from __future__ import annotations

from examples.benchmarks.solvers.exact import Exact, Exact20, Exact24
from examples.benchmarks.solvers.floating import Covariance, CovarianceSymmetric, Gram32, Gram64, SquareRoot
from examples.benchmarks.solvers.solver_protocol import Solver

__all__ = ["SOLVERS"]

SOLVERS: dict[str, type[Solver]] = {
    "covariance": Covariance,
    "covariance-symmetric": CovarianceSymmetric,
    "qr": SquareRoot,
    "gram64": Gram64,
    "gram32": Gram32,
    "exact": Exact,
    "exact24": Exact24,
    "exact20": Exact20,
}
"""Name → class; each is made without arguments and then started."""
