"""The solvers of arbitrary doubles by name: what `python -m examples.benchmarks numerics` compares the learner with."""

from __future__ import annotations

from examples.benchmarks.solvers.exact import Exact
from examples.benchmarks.solvers.floating import Gram64, PseudoInverseGram, RecursiveLeastSquares, SquareRoot
from examples.benchmarks.solvers.solver_protocol import RidgeBase

__all__ = ["SOLVERS"]

SOLVERS: dict[str, type[RidgeBase]] = {
    "exact": Exact,
    "square root": SquareRoot,
    "plain sums": Gram64,
    "pseudo-inverse": PseudoInverseGram,
    "recursion": RecursiveLeastSquares,
}
"""Name → class; each is made without arguments and then started."""
