"""How beginnings are judged: moments, weights fitted to what was said of touches left out, and the odd ones."""

from dataclasses import replace

import numpy as np
import pytest

from scroll_tactile.readouts.early import FEWEST, Heard, early_of, moments_of

COUNT, MATERIALS = 200, 5


def test_moments_are_few_and_hold_the_milestones():
    biotac = moments_of(100.0, (30, 77, 195), 400, 2)
    assert biotac == (10, 20, 30, 50, 77, 100, 195)
    assert moments_of(100.0, (30, 77, 195), 11, 2) == (10,)
    assert moments_of(10.0, (3,), 100, 2) == (2, 3, 5, 10, 20, 50)
    assert len(moments_of(2200.0, (660, 5000), 2_000_000, 2)) == 12
    assert moments_of(1.0, (), 2, 2) == ()


def heard(rng, *, sharpness, odd=0.0, columns=10, touches=COUNT):
    """Logs of which a part of `sharpness` is true, beside scores that are pure noise; some touches are of another."""
    targets = rng.integers(0, MATERIALS, touches)
    seen = np.where(rng.random(touches) < odd, rng.integers(0, MATERIALS, touches), targets)
    logits = rng.normal(size=(touches, MATERIALS)) + 2.0 * np.eye(MATERIALS)[seen]
    logs = 2.0 * logits / sharpness  # normal ones of unit spread, a step of 2 apart: 2 · logits are the true ones
    noise = rng.normal(size=(touches, MATERIALS))
    return Heard(columns, np.arange(touches), targets, logs, 10.0 * noise, 0.5, rng.normal(3.0, 2.0, touches)), targets


@pytest.mark.parametrize("sharpness", [0.25, 1.0, 4.0])
def test_probabilities_are_what_they_say_however_sharp_the_model(sharpness):
    rng = np.random.default_rng(0)
    said, targets = heard(rng, sharpness=sharpness)
    early = early_of([said], targets)
    assert early.moments[0].trusted == pytest.approx(sharpness, rel=0.3)
    fresh, truth = heard(rng, sharpness=sharpness, touches=2000)
    rehearsed = early.rehearsed([fresh], truth)
    chances = rehearsed.chances[:, 0]
    right = chances.argmax(axis=1) == truth
    assert abs(chances.max(axis=1).mean() - right.mean()) < 0.04
    sure = chances.max(axis=1) > 0.9
    assert right[sure].mean() == pytest.approx(chances.max(axis=1)[sure].mean(), abs=0.04)


def test_nothing_is_surer_than_so_many_touches_can_show():
    rng = np.random.default_rng(1)
    clean, odd = (early_of(*_pair(heard(rng, sharpness=0.1, odd=share))).moments[0].odd for share in (0.0, 0.3))
    assert clean < odd < 0.5
    plain, targets = heard(rng, sharpness=1.0)
    obvious = replace(plain, logs=20.0 * np.eye(MATERIALS)[targets])
    early = early_of([obvious], targets)
    assert 0 < early.moments[0].odd <= 1 / COUNT
    assert early.fitted.chances.max() <= 1 - early.moments[0].odd * (1 - 1 / MATERIALS)


def _pair(found):
    return [found[0]], found[1]


def test_novelty_is_in_units_of_that_of_known_touches():
    rng = np.random.default_rng(2)
    early = early_of(*_pair(heard(rng, sharpness=1.0)))
    standard = early.fitted.novelty[:, 0]
    assert standard.mean() == pytest.approx(0.0, abs=1e-9) and standard.std() == pytest.approx(1.0)
    assert (np.diff(early.moments[0].novelties) >= 0).all()


def test_moments_that_few_touches_reached_are_left_out():
    rng = np.random.default_rng(3)
    first, targets = heard(rng, sharpness=1.0, columns=10)
    few = np.arange(FEWEST - 1)
    short = Heard(20, few, targets[few], first.logs[few], first.scores[few], 0.5, first.novelty[few])
    half = np.arange(0, COUNT, 2)
    later = Heard(40, half, targets[half], first.logs[half], first.scores[half], 0.5, first.novelty[half])
    early = early_of([first, short, later], targets)
    assert [moment.columns for moment in early.moments] == [10, 40]
    assert [early.at(columns).columns for columns in (2, 10, 39, 40, 500)] == [10, 10, 10, 40, 40]
    assert np.isnan(early.fitted.chances[1::2, 1]).all() and not np.isnan(early.fitted.chances[:, 0]).any()
    assert early_of([short], targets) is None
