"""Heads for quantities: held-out residuals against heads that were fitted without the touch or the material."""

import math

import numpy as np
import pytest

from scroll_tactile.readouts.regression import LAMBDAS, RegressionHead, Spectrum, fit_head, stacked

RNG = np.random.default_rng(0)
TOUCHES, FEATURES = 40, 12
MATERIALS = np.repeat(np.arange(4), 10)
ROWS = [RNG.normal(size=(TOUCHES, FEATURES)) * RNG.uniform(1, 900, FEATURES) for _ in range(3)]
TRUTH = ROWS[0][:, 0] / 100 + 3 * ROWS[1][:, 2] / 100 + RNG.normal(size=TOUCHES) + 5


def fitted_without(spectrum: Spectrum, targets: np.ndarray, group: np.ndarray, penalty: float) -> np.ndarray:
    """A dumb model: primal ridge on all touches but a group, with an intercept of its own; residuals of the group."""
    rest = np.setdiff1d(np.arange(len(targets)), group)
    rows = spectrum.rows
    centre, mean = rows[rest].mean(axis=0), targets[rest].mean()
    own = rows[rest] - centre
    weights = np.linalg.solve(own.T @ own + penalty * np.eye(rows.shape[1]), own.T @ (targets[rest] - mean))
    return targets[group] - mean - (rows[group] - centre) @ weights


@pytest.mark.parametrize("groups", [np.arange(TOUCHES), MATERIALS])
def test_residuals_are_those_of_a_head_fitted_without_the_group(groups: np.ndarray) -> None:
    spectrum = Spectrum.of(ROWS[0])
    members = [np.flatnonzero(groups == number) for number in np.unique(groups)]
    for penalty, residuals in zip(LAMBDAS, spectrum.held_out(TRUTH, groups), strict=True):
        expected = np.concatenate([fitted_without(spectrum, TRUTH, group, penalty) for group in members])
        np.testing.assert_allclose(residuals, expected, rtol=1e-6, atol=1e-9)
    penalty = LAMBDAS[10]
    weights, intercept = spectrum.solve(TRUTH, penalty)
    # The head itself is one without a touch that came to it with a row of its own.
    rows = (np.vstack([ROWS[0], ROWS[0][:1]]) - spectrum.center) * spectrum.unit
    more = Spectrum(rows, spectrum.center, spectrum.unit, np.empty(0), np.empty(0))
    said = -fitted_without(more, np.append(TRUTH, 0.0), np.array([TOUCHES]), penalty)[0]
    assert ROWS[0][0] @ weights + intercept == pytest.approx(said, rel=1e-9)


def test_a_residual_is_taken_at_what_is_best_for_other_touches() -> None:
    spectra = [Spectrum.of(rows) for rows in ROWS]
    head = fit_head(spectra, TRUTH, MATERIALS)
    paths = np.stack([spectrum.held_out(TRUTH, MATERIALS) for spectrum in spectra])
    for group in (np.flatnonzero(number == MATERIALS) for number in range(4)):
        others = np.setdiff1d(np.arange(TOUCHES), group)
        best = [int(np.square(path[:, others]).sum(axis=1).argmin()) for path in paths]
        own = np.stack([path[at] for path, at in zip(paths, best, strict=True)], axis=1)
        assert head.residuals[group].tobytes() == (own[group] @ stacked(own[others])).tobytes()


def test_scales_are_weighed_by_what_they_say() -> None:
    head = fit_head([Spectrum.of(rows) for rows in ROWS], TRUTH)
    shares = [
        float(own[0] / alone.weights[0][0])
        for own, alone in zip(head.weights, (fit_head([Spectrum.of(rows)], TRUTH) for rows in ROWS), strict=True)
    ]
    assert shares[0] > 0.02 and shares[1] > shares[0] and sum(shares) == pytest.approx(1)
    best = min(float(np.square(fit_head([Spectrum.of(rows)], TRUTH).residuals).sum()) for rows in ROWS)
    assert float(np.square(head.residuals).sum()) < best
    said = [head([rows[i] for rows in ROWS]) for i in range(TOUCHES)]
    assert np.square(said - TRUTH).sum() < best


def test_the_best_weights_of_all_that_are_not_negative() -> None:
    residuals = RNG.normal(size=(100, 3)) @ np.array([[1, 0.9, 0], [0, 0.3, 0], [0, 0, 2.0]])
    products = residuals.T @ residuals + np.diag(np.square(residuals).sum(axis=0)) * 0.02
    found = stacked(residuals)
    grid = [(a, b, 1 - a - b) for a in np.linspace(0, 1, 101) for b in np.linspace(0, 1 - a, 101)]
    least = min(float(w @ products @ w) for w in map(np.array, grid))
    assert float(found @ products @ found) <= least + 1e-9 and (found >= 0).all()
    assert stacked(np.zeros((5, 2))).tolist() == [0.5, 0.5]


def head_of(residuals: np.ndarray, mass: np.ndarray) -> RegressionHead:
    return RegressionHead(np.zeros((1, 1)), 0.0, residuals, mass)


@pytest.mark.parametrize(("touches", "risk", "rank"), [(19, 0.05, 19), (18, 0.05, None), (9, 0.1, 9), (100, 0.1, 91)])
def test_the_quantile_is_the_exact_one_and_infinite_where_touches_are_too_few(
    touches: int, risk: float, rank: int | None
) -> None:
    residuals = RNG.permutation(np.arange(1.0, touches + 1)) * RNG.choice([-1, 1], touches)
    half = head_of(residuals, np.full(touches, 1 / touches)).half_width(risk)
    assert half == (math.inf if rank is None else rank)


def test_materials_count_alike_however_many_touches_they_have() -> None:
    residuals = np.concatenate([np.full(90, 1.0), np.arange(1.0, 11.0)])
    mass = np.concatenate([np.full(90, 1 / 180), np.full(10, 1 / 20)])
    assert head_of(residuals, mass).half_width(0.1) == 9
    assert head_of(residuals, np.full(100, 0.01)).half_width(0.1) == 1


def test_the_same_touches_give_the_same_bits_and_equal_features_say_nothing() -> None:
    first, second = (fit_head([Spectrum.of(rows) for rows in ROWS], TRUTH, MATERIALS) for _ in range(2))
    assert (
        first.weights.tobytes() == second.weights.tobytes() and first.residuals.tobytes() == second.residuals.tobytes()
    )
    equal = fit_head([Spectrum.of(np.ones((5, 3), np.int32))], np.arange(5.0))
    assert equal([np.ones(3)]) == 2.0 and np.abs(equal.residuals).max() == pytest.approx(2.5)
