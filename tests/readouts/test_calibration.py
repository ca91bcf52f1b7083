"""Weights, temperature and thresholds on touches made for it."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.special import logsumexp

from scroll_tactile.readouts.calibration import (
    AHEAD,
    PRIOR_WEIGHT,
    Calibration,
    calibrate_stage,
    fit_weights,
    scale_weights,
)
from scroll_tactile.readouts.leave_one_out import StageScores, held_out_scores
from scroll_tactile.readouts.novelty import FEWEST, Neighbours, NoveltyThresholds, novelty_measures
from scroll_tactile.readouts.task import Task
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.sample import SampledTouch, TouchSample
from scroll_tactile.statistics.statistics import Statistics

DIMENSION, SCALES = 8, (Scale("window", 10), Scale("window", 40))
STAGES = [[SCALES[0]], [*SCALES]]
REACHED = [{SCALES[0]: [[0]]}, {SCALES[0]: [[1]], SCALES[1]: [[0]]}]


def scene(noises=(20_000, 20_000), materials=6, touches=120, seed=0, unit=40_000):
    """A memory of touches that reached both stages; noises: their spread at each scale."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(len(SCALES), materials, DIMENSION)) * unit
    statistics, pool = Statistics(DIMENSION, SCALES), TouchSample()
    for i in range(touches):
        material, key = i % materials, rng.bytes(32)
        codes = {
            scale: np.rint(means[place, material] + rng.normal(size=(2 - place, DIMENSION)) * noise).astype(np.int32)
            for place, (scale, noise) in enumerate(zip(SCALES, noises, strict=True))
        }
        statistics.add(str(material), codes)
        pool.add(str(material), key, SampledTouch.of(REACHED, codes))
    return statistics, pool


def stages_of(statistics, pool, kind="lda", stages=STAGES):
    scales = sorted({scale for stage in stages for scale in stage})
    tasks = [Task.of(statistics, scale, statistics.names(scale)) for scale in scales]
    readouts = {task.scale: task.solve() for task in tasks}
    apart = {scale: held_out_scores(readout, pool, stages, kind) for scale, readout in readouts.items()}
    return [
        calibrate_stage(
            StageScores(stage, pool, [apart[scale] for scale in scales]), [readouts[scale] for scale in scales], kind
        )
        for stage, scales in enumerate(stages)
    ]


def calibrated(kind="lda", **settings):
    return stages_of(*scene(**settings), kind)


def documented_loss(weights, scores, targets, prior):
    """Held-out log loss, and half a touch's worth of (w / prior − 1)² / 2 for each scale."""
    value = 0.25 * float(np.square(weights / prior - 1).sum())
    for row, target in zip(scores, targets, strict=True):
        logits = weights @ row
        value += float(logsumexp(logits) - logits[target])
    return value


@pytest.mark.parametrize("prior", [[0.05, 0.05], [10.0, 0.3], [1.0, 4.0]])
@pytest.mark.parametrize("touches", [1, 4, 30])
def test_the_weights_are_those_of_least_loss_whatever_the_prior(touches, prior):
    prior = np.array(prior)
    rng = np.random.default_rng(touches)
    scores = rng.normal(size=(touches, 2, 4)) / prior[:, None]
    targets = rng.integers(4, size=touches).tolist()
    found = fit_weights(scores, targets, prior)
    # Without gradients: Nelder and Mead's simplex, in units of the prior, the bound by |·|.
    expected = minimize(
        lambda shares: documented_loss(np.abs(shares) * prior, scores, targets, prior),
        np.ones(2),
        method="Nelder-Mead",
        options={"xatol": 1e-7, "fatol": 1e-12, "maxiter": 5000, "maxfev": 5000},
    )
    assert documented_loss(found, scores, targets, prior) == pytest.approx(expected.fun, rel=1e-6)
    np.testing.assert_allclose(found / prior, np.abs(expected.x), atol=2e-3)


def test_scales_that_say_the_same_share_the_weight():
    """However far their common weight lies from the prior, and none runs into a corner."""
    rng = np.random.default_rng(0)
    common = rng.normal(size=(200, 1, 5)) * 3
    targets = [int(rng.choice(5, p=np.exp(row) / np.exp(row).sum())) for row in common[:, 0]]
    scores = common + rng.normal(size=(200, 4, 5)) * 0.05
    weights = scale_weights(scores, targets, 0.1 / 4)
    assert weights.sum() == pytest.approx(1, abs=0.25)
    assert weights.min() > 0.1


@pytest.mark.parametrize("unit", [40_000, 160_000])
def test_where_every_material_has_one_touch_its_own_mean_is_ahead_by_a_little(unit):
    """However far the materials lie apart: within-class scatter is of one touch alone and says nothing of others."""
    statistics, sample = scene(materials=6, touches=6, unit=unit)
    for stage, scales in zip(stages_of(statistics, sample), STAGES, strict=True):
        ahead = np.zeros((6, 6))
        for weight, scale in zip(stage.weights, scales, strict=True):
            readout = Task.of(statistics, scale, statistics.names(scale)).solve()
            own = [readout.scores(mean, range(6), "lda") for mean in readout.means() + readout.origin]
            ahead += weight * (np.diagonal(own)[:, None] - own)
        np.fill_diagonal(ahead, np.inf)
        assert np.median(ahead.min(axis=1)) == pytest.approx(AHEAD, rel=1e-6)


def test_with_few_touches_a_threshold_is_as_far_from_the_class_means_as_they_are_large():
    statistics, sample = scene(materials=2, touches=4)
    (stage,) = stages_of(statistics, sample, stages=STAGES[:1])
    assert len(stage.thresholds.novelties) == 0
    readout = Task.of(statistics, SCALES[0], ["0", "1"]).solve()
    means = statistics.sums(SCALES[0], ["0", "1"]) / statistics.counts(SCALES[0], ["0", "1"])[:, None]
    typical = np.mean([readout.novelty(mean, [0, 1]) for mean in means])
    size = np.diagonal(readout.derived().gram).mean()
    assert stage.novelty(np.array([typical])) == pytest.approx(0, abs=1e-6)
    assert stage.novelty(np.array([typical + size])) == pytest.approx(stage.thresholds.above("", 0.05))


@pytest.mark.parametrize("kind", ["lda", "ridge"])
def test_the_novelty_of_known_touches_is_standardised(kind):
    for stage in calibrated(kind):
        assert len(stage.thresholds.novelties) == 120
        assert np.mean(stage.thresholds.novelties) == pytest.approx(0, abs=1e-6)
        assert np.std(stage.thresholds.novelties) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("materials", [1, 2, 3])
@pytest.mark.parametrize("touches", [1, 2, 4, 6, 7, 8, 9, 15])
def test_novelty_is_measured_by_eight_touches_or_more_of_materials_that_have_others(materials, touches):
    statistics, sample = scene(materials=materials, touches=touches)
    counts = statistics.materials
    left_out = sum(counts[material] > 1 for material, *_ in sample) if len(counts) > 1 else 0
    for stage in stages_of(statistics, sample):
        assert len(stage.thresholds.novelties) == (left_out if left_out >= FEWEST else 0)
        if not left_out:
            # All scales alike, and no more than by the prior, which is of the scores of all of them together.
            assert len(set(stage.weights.tolist())) == 1
            assert 0 < stage.weights.sum() <= PRIOR_WEIGHT["lda"] * (1 + 1e-12)


def test_a_touch_counts_only_where_every_scale_left_it_out():
    """At the wide scale some materials have one touch alone, or none."""
    rng = np.random.default_rng(0)
    statistics, sample = Statistics(DIMENSION, SCALES), TouchSample()
    for material, touches, wide in (("a", 8, 4), ("b", 6, 1), ("c", 5, 0), ("d", 8, 6)):
        for i in range(touches):
            codes = {SCALES[0]: rng.integers(-1000, 1000, (1 + (i < wide), DIMENSION), dtype=np.int32)}
            if i < wide:
                codes[SCALES[1]] = rng.integers(-1000, 1000, (1, DIMENSION), dtype=np.int32)
            statistics.add(material, codes)
            sample.add(material, rng.bytes(32), SampledTouch.of(REACHED[: len(codes)], codes))
    narrow, wide = stages_of(statistics, sample)
    assert len(narrow.thresholds.novelties) == 27
    assert len(wide.thresholds.novelties) == 10  # four of a and six of d


positive = st.floats(1e-3, 1e6)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.floats(0, 9), positive, st.floats(0, 1e6)), min_size=1, max_size=4))
def test_a_scale_is_weighed_less_the_further_away_a_touch_is_in_it(scales):
    weights, medians, away = map(np.array, zip(*scales, strict=True))
    calibration = Calibration(weights, np.ones((len(weights), 2)), medians)
    expected = [w if s <= u else w * (u / s) for w, u, s in scales]
    np.testing.assert_allclose(calibration.weights_at(away), expected)
    further = calibration.weights_at(2 * away + 1)
    assert (further <= calibration.weights_at(away)).all()
    assert calibration.weights_at(np.stack([away, away])).shape == (2, len(weights))
    never = np.full(len(weights), np.inf)
    undoubted = Calibration(weights, np.ones((len(weights), 2)), never)
    assert undoubted.weights_at(away).tolist() == weights.tolist()


def test_new_touches_are_told_where_most_of_them_lie_above_the_threshold():
    known, of = np.arange(1.0, 100.0), np.repeat([0, 1], [50, 49])
    new = {share: np.where(np.arange(99) < 99 * share, 200.0, 0.0) for share in (0.4, 0.6)}
    found = {share: NoveltyThresholds(("a", "b"), of, known, values) for share, values in new.items()}
    assert {share: one.detects(0.05) for share, one in found.items()} == {0.4: False, 0.6: True}


@pytest.mark.parametrize("kind", ["lda", "ridge"])
def test_views_are_calibrated_on_scores_that_are_doubted_as_those_of_a_touch_will_be(kind):
    statistics, sample = scene(noises=(20_000, 60_000), touches=60)
    readouts = [Task.of(statistics, scale, statistics.names(scale)).solve() for scale in SCALES]
    apart = [held_out_scores(readout, sample, STAGES, kind) for readout in readouts]
    materials = [material for material, *_ in sample]
    found = StageScores(1, sample, apart)
    plain, viewed = (calibrate_stage(found, readouts, kind, viewed=flag) for flag in (False, True))
    assert np.isinf(plain.median_distances).all()
    away = np.array([[left.diagonal_distances[left.rows[i, 1]] for left in apart] for i in range(60)])
    assert viewed.median_distances.tolist() == np.median(away, axis=0).tolist()
    scores = np.array([[left.scores[left.rows[i, 1]] for left in apart] for i in range(60)])
    doubted = scores * np.minimum(1, viewed.median_distances / away)[:, :, None]
    targets = [apart[0].names.index(material) for material in materials]
    expected = scale_weights(doubted, targets, PRIOR_WEIGHT[kind] / 2)
    np.testing.assert_allclose(viewed.weights, expected, rtol=1e-9)
    logs, distance = viewed.held_out(found, SCALES)
    logits = (doubted * viewed.weights[:, None]).sum(axis=1)
    np.testing.assert_allclose(logs, logits - logsumexp(logits, axis=1, keepdims=True), atol=1e-9)
    np.testing.assert_allclose(distance, (away / viewed.median_distances).min(axis=1))
    # Every scale has a part in the novelty, viewed or not.
    near, by_first, by_second = np.array([3.0, 5.0]), np.array([10.0, 5.0]), np.array([3.0, 12.0])
    for calibration in (viewed, plain):
        assert len({float(calibration.novelty(distances)) for distances in (near, by_first, by_second)}) == 3
    assert np.std(viewed.thresholds.novelties) == pytest.approx(1, abs=1e-6)


def local_novelty(touch, others):
    """Of the module's docstring: touches and their distances in the readout's scaled units."""
    near = min(range(len(others)), key=lambda place: np.linalg.norm(touch - others[place]))
    around = sorted(np.linalg.norm(others[near] - other) for place, other in enumerate(others) if place != near)
    return np.log(np.linalg.norm(touch - others[near])) - np.log(np.mean(around[:5]))


def neighbours(statistics, sample, stage=1, scale=1):
    readout = Task.of(statistics, SCALES[scale], statistics.names(SCALES[scale])).solve()
    scaled = {
        place: (touch.rows[-1] - readout.origin) * np.sqrt(readout.precision)
        for place, (*_, touch) in enumerate(sample)
    }
    return Neighbours(readout, sample, STAGES, stage), readout, scaled


def test_a_touch_is_as_new_as_it_is_far_from_the_nearest_beside_what_lies_around_that_one():
    statistics, sample = scene(touches=30)
    found, readout, scaled = neighbours(statistics, sample)
    assert found.places == list(range(30))
    features = np.random.default_rng(1).normal(size=DIMENSION) * 60_000
    touch = (features - readout.origin) * np.sqrt(readout.precision)
    assert found.novelty(features) == pytest.approx(local_novelty(touch, [*scaled.values()]), abs=1e-4)
    materials = [material for material, *_ in sample]
    of_two = [scaled[place] for place in scaled if materials[place] in ("1", "4")]
    assert found.novelty(features, {"1", "4"}) == pytest.approx(local_novelty(touch, of_two), abs=1e-4)


def test_a_held_out_touch_is_as_new_as_without_it_or_without_its_material():
    statistics, sample = scene(touches=30)
    found, _, scaled = neighbours(statistics, sample)
    materials, places = [material for material, *_ in sample], [3, 4, 11, 29]
    known, if_new = found.held_out(places)
    for i, place in enumerate(places):
        touch = scaled[place]
        others = [scaled[other] for other in scaled if other != place]
        strangers = [scaled[other] for other in scaled if materials[other] != materials[place]]
        assert known[i] == pytest.approx(local_novelty(touch, others), abs=1e-4)
        assert if_new[i] == pytest.approx(local_novelty(touch, strangers), abs=1e-4)


@pytest.mark.parametrize("materials", [1, 2])
@pytest.mark.parametrize("touches", [1, 2, 3])
def test_few_neighbours_give_numbers(materials, touches):
    statistics, sample = scene(materials=materials, touches=touches)
    found, *_ = neighbours(statistics, sample)
    for values in (found.novelty(np.zeros(DIMENSION)), *found.held_out(found.places)):
        assert np.isfinite(values).all()


def test_touches_that_are_all_alike_are_as_new_as_each_other():
    statistics, sample = Statistics(DIMENSION, SCALES), TouchSample()
    codes = {SCALES[0]: np.full((1, DIMENSION), 9, np.int32)}
    for i in range(9):
        statistics.add("ab"[i % 2], codes)
        sample.add("ab"[i % 2], bytes([i]) * 32, SampledTouch.of(REACHED[:1], codes))
    readout = Task.of(statistics, SCALES[0], ["a", "b"]).solve()
    found = Neighbours(readout, sample, STAGES, 0)
    for values in found.held_out(found.places):
        assert values.tolist() == [0.0] * 9
    assert found.novelty(np.full(DIMENSION, 1e5)) > 5


NAMES = ["a", "b", "c"]


def thresholds(novelties, if_new=None):
    """Of materials a, b, c by their held-out touches' novelties."""
    targets = np.repeat(np.arange(len(novelties)), [len(own) for own in novelties])
    values = np.concatenate(novelties).astype(float)
    new = values + 100 if if_new is None else np.concatenate(if_new).astype(float)
    return NoveltyThresholds(NAMES[: len(novelties)], targets, values, new)


@pytest.mark.parametrize("touches", [8, 9, 19, 20, 99, 100, 256])
@pytest.mark.parametrize("share", [0.01, 0.05, 0.1, 0.3, 0.5])
def test_both_thresholds_keep_the_conformal_promise_and_are_the_closest_that_do(touches, share):
    """Of n + 1 exchangeable touches the new one lies above rank r with probability (n + 1 − r) / (n + 1)."""
    ranks = np.arange(1.0, touches + 1)
    found = NoveltyThresholds(NAMES, np.arange(touches) % 2, ranks, ranks)
    alarms = [Fraction(touches + 1 - rank, touches + 1) for rank in range(1, touches + 1)]
    kept = [rank for rank, alarm in enumerate(alarms, start=1) if alarm <= Fraction(str(share))]
    if touches % 2 == 0:  # both materials have as many touches
        assert found.above("c", share) == (kept[0] if kept else 2 * touches)
        assert found.below(share) == (touches + 1 - kept[0] if kept else -np.inf)
    own = NoveltyThresholds(NAMES, np.zeros(touches, np.intp), ranks, ranks)
    assert own.above("a", share) == (kept[0] if kept else 2 * touches)


def test_a_material_of_many_touches_has_its_own_threshold_and_the_others_share_one_in_which_all_count_alike():
    rng = np.random.default_rng(0)
    often, seldom = rng.normal(size=200), rng.normal(size=(2, 12)) + 3
    found = thresholds([often, *seldom])
    assert found.above("a", 0.05) == np.sort(often)[190]
    # 5 % of the weight of 225: a seldom touch weighs 6.2 of them, and a new one 1.
    assert found.above("b", 0.05) == found.above("c", 0.05) == np.sort(seldom.ravel())[-2]
    # With 39 of its own fewer than two would be expected above.
    few = thresholds([often[:39], *seldom])
    assert few.above("a", 0.05) == few.above("b", 0.05)


def test_seldom_felt_materials_are_called_new_no_more_often_than_asked():
    """200 touches of one material and 12 of two others, whose novelty is larger by two spreads."""
    rng = np.random.default_rng(0)
    alarms = []
    for _ in range(200):
        found = thresholds([rng.normal(size=200), *(rng.normal(size=(2, 12)) + 2)])
        alarms.append([rng.normal() + shift > found.above(name, 0.05) for name, shift in (("a", 0), ("b", 2))])
    assert (np.mean(alarms, axis=0) <= 0.12).all()


def told_of(found, novelty):
    """Whether a touch that is answered "a" is known."""
    return False if novelty > found.above("a", 0.05) else True if novelty < found.below(0.05) else None


def test_a_touch_is_known_where_hardly_any_new_one_is_as_near():
    known, new = [np.arange(100.0), np.arange(100.0)], [np.arange(60.0, 160), np.arange(60.0, 160)]
    found = thresholds(known, new)
    assert found.below(0.05) == 64  # of 201 ten at most may lie below, one of them the touch that is asked about
    told = {novelty: told_of(found, novelty) for novelty in (0, 63, 64, 95, 96)}
    assert told == {0: True, 63: True, 64: None, 95: None, 96: False}
    # One material alone: no new one was seen. Too few touches: neither can be said, but of one that is far off.
    assert told_of(thresholds([np.arange(100.0)], [np.full(100, 900.0)]), 1.0) is None
    few = thresholds([np.arange(6.0), np.arange(6.0)], [np.full(6, 900.0)] * 2)
    assert [told_of(few, novelty) for novelty in (0, 9, 10.5)] == [None, None, False]
    assert told_of(NoveltyThresholds(), 4.9) is None


@pytest.mark.parametrize("touches", [6, 60])
def test_a_stage_with_neighbours_measures_novelty_by_both(touches):
    """But with distances alone where too few touches are held out to know how either spreads."""
    statistics, sample = scene(materials=3, touches=touches)
    readouts = [Task.of(statistics, scale, statistics.names(scale)).solve() for scale in SCALES]
    found = StageScores(1, sample, [held_out_scores(readout, sample, STAGES, "lda") for readout in readouts])
    near = [Neighbours(readout, sample, STAGES, 1) for readout in readouts]
    stage = calibrate_stage(found, readouts, "lda", neighbours=near)
    assert len(stage.scale_novelty) == (4 if touches == 60 else 2)
    assert len(stage.thresholds.novelties) == (60 if touches == 60 else 0)
    if touches == 60:
        distances = [found.distances().min(axis=2), *(one.held_out(found.places)[0] for one in near)]
        measures = np.column_stack(distances)
        mean = ((measures - measures.mean(axis=0)) / measures.std(axis=0)).mean(axis=1)
        np.testing.assert_allclose(stage.thresholds.novelties, mean / mean.std(), rtol=1e-6)
        np.testing.assert_array_equal(stage.novelty(novelty_measures(found, near)[0]), stage.thresholds.novelties)
        assert np.mean(stage.thresholds.if_new) > 3
        assert stage.thresholds.names == found.names
        # Any order of observation, the same bits.
        shuffled = TouchSample()
        shuffled.update(list(sample)[::-1])
        again = [Neighbours(readout, shuffled, STAGES, 1).held_out(found.places) for readout in readouts]
        np.testing.assert_array_equal(again, [one.held_out(found.places) for one in near])
