"""Solvers of the ridge regression on arbitrary doubles, exact and not, for comparison."""
