"""Heads over materials and their curves, against ridge regression and an optimiser without gradients."""

import numpy as np
import pytest
from scipy.optimize import minimize

from scroll_tactile.readouts.attributes import Curve, fit_curve, heads_without, solve


def test_without_a_material_is_as_if_it_had_never_been():
    rng = np.random.default_rng(0)
    means, targets = rng.normal(size=(7, 5)), rng.normal(size=7)
    gram = means @ means.T
    for place in range(7):
        others = np.delete(np.arange(7), place)
        # γ is a share of the diagonal's mean: the same ridge for both.
        centred = [part - part.mean(axis=0) for part in (means, means[others])]
        size, smaller = (np.square(part).sum() / len(part) for part in centred)
        found = heads_without(solve(gram, 0.1), targets)[:, place]
        fresh = solve(gram[np.ix_(others, others)], 0.1 * size / smaller)[:, :-1] @ targets[others]
        np.testing.assert_allclose(np.delete(found, place), fresh, atol=1e-9)
        assert found[place] == 0


def test_it_is_ridge_regression_over_the_materials():
    rng = np.random.default_rng(1)
    means, targets = rng.normal(size=(6, 9)), rng.normal(size=6)
    centred = means - means.mean(axis=0)
    ridge = 0.3 * np.square(centred).sum() / 6
    slope = np.linalg.solve(centred.T @ centred + ridge * np.eye(9), centred.T @ (targets - targets.mean()))
    head = solve(means @ means.T, 0.3)[:, :-1] @ targets
    new = rng.normal(size=9)
    expected = targets.mean() + (new - means.mean(axis=0)) @ slope
    assert head[:-1] @ (means @ new) + head[-1] == pytest.approx(expected)


def test_a_curve_follows_the_touches_and_begins_at_its_prior():
    prior = Curve(6.0, -3.0)
    assert fit_curve([], [], prior) == prior
    rng = np.random.default_rng(2)
    values = rng.uniform(-1, 2, 4000)
    truth = rng.uniform(size=4000) < 1 / (1 + np.exp(-(3 * values - 1)))
    curve = fit_curve(values, truth, prior)
    assert (curve.slope, curve.offset) == pytest.approx((3, -1), abs=0.3)
    assert fit_curve(values, ~truth, prior).slope == pytest.approx(0, abs=1e-6)  # never the wrong way round
    steady = fit_curve(values, truth, prior, turning=False)
    assert steady(0.5) == pytest.approx(0.5)
    assert steady.slope < prior.slope


@pytest.mark.parametrize("prior", [Curve(6.0, -3.0), Curve(0.3, 1.0)])
@pytest.mark.parametrize("touches", [1, 3, 40])
def test_a_curve_is_that_of_least_loss_whatever_the_prior(touches, prior):
    """Log loss, and 1 / 2 · ‖(slope, offset at the prior's half) − the prior's‖², in units of the prior's slope."""
    rng = np.random.default_rng(touches)
    values, truth = rng.normal(0.5, 2, touches), rng.integers(0, 2, touches)
    half = -prior.offset / prior.slope

    def loss(point):
        slope, above = abs(point[0]) * prior.slope, point[1] * prior.slope
        logits = slope * (values - half) + above
        pull = np.square([abs(point[0]) - 1, point[1]]).sum()
        return float(np.sum(np.logaddexp(0, logits) - truth * logits)) + pull / 2

    expected = minimize(loss, [1.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-13}).x
    found = fit_curve(values, truth, prior)
    slope = found.slope / prior.slope
    np.testing.assert_allclose(
        [slope, found.offset / prior.slope + slope * half], [abs(expected[0]), expected[1]], atol=1e-3
    )
