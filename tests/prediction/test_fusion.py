"""The weights of readouts and kept touches at each moment, fitted to held-out touches."""

from dataclasses import replace

import numpy as np
import pytest
from scroll_tactile.prediction.fusion import (
    PRIOR_OUTLIERS,
    HeldOutMoment,
    chosen_of,
    full_match_weight,
    fuse,
    moments_of,
)
from scroll_tactile.prediction.moment_table import tempered

from scroll_tactile.matching.likelihood import CLEAN
from scroll_tactile.matching.match import KeptTouch, Match
from scroll_tactile.matching.matcher import matcher_of
from scroll_tactile.readouts.calibration import FEWEST, Calibration, HeldOutProbabilities

NAMES = [f"m{i}" for i in range(5)]
C = len(NAMES)
TRUE = 2.0  # logits by which the sharpest truth is ahead


def touches(each=24):
    """Kept touches of which only the keys and materials matter."""
    rng = np.random.default_rng(0)
    return [
        KeptTouch(name, bytes([i, seed]) * 16, rng.integers(0, 254, (2, 8)).astype(np.uint8))
        for i, name in enumerate(NAMES)
        for seed in range(each)
    ]


MATCHER = matcher_of(touches())
KEYS = sorted(touch.key for touch in touches())
OWN = {touch.key: NAMES.index(touch.material) for touch in touches()}


def evidence(rng, keys, step=TRUE, odd=0.0):
    """Log-likelihoods of which the softmax is the truth: normal, a step higher for what is felt. odd: felt as any."""
    felt = np.array([int(rng.integers(C)) if rng.random() < odd else OWN[key] for key in keys], dtype=np.intp)
    return step * (rng.normal(size=(len(keys), C)) + step * np.eye(C)[felt])


def match(scores, information=0.5, noise_share=0.0):
    unseen = np.full((2, 8), np.nan)
    return Match(scores, information, CLEAN, np.zeros(2, bool), unseen, noise_share, False, -1.0, 1.0, 0.0)


def judged(columns, logits, scores, keys=KEYS, information=0.5):
    """What readouts (logits) and kept touches (scores) say of some touches; either may be None, and says nothing."""
    logs = np.zeros((len(keys), C)) if logits is None else logits
    logs = logs - np.log(np.exp(logs).sum(axis=1, keepdims=True))
    novelty = np.random.default_rng(columns).normal(size=len(keys))
    calibration = Calibration(np.ones(1), np.array([[0.0, 1.0]]), np.ones(1), np.sort(novelty), np.sort(novelty) + 9)
    targets = np.array([OWN[key] for key in keys], dtype=np.intp)
    held = HeldOutProbabilities(NAMES, [*range(len(keys))], list(keys), targets, logs, np.ones(len(keys)), novelty)
    said = np.zeros((len(keys), C)) if scores is None else scores
    matches = {key: match(row, information=information) for key, row in zip(keys, said, strict=True)}
    return HeldOutMoment(columns, 0, calibration, held, matches)


def fused(*moments, keys=KEYS):
    return fuse(MATCHER, moments, moments[-1:], keys, dict.fromkeys(keys, 1.0), 1.0)


def beta(moment, information=0.5):
    return 1 / (1 + (1 / moment.match_weight - 1) * information)


def test_moments_are_few_and_hold_the_milestones():
    assert moments_of((30, 77, 195), 400, matched=False) == (30, 77, 195)
    assert moments_of((30, 77, 195), 400, matched=True) == (10, 20, 30, 48, 77, 123, 195, 279)
    assert moments_of((30, 77, 195), 100, matched=False) == (30, 77)
    assert moments_of((30,), 20, matched=True) == (10,)
    assert moments_of((4,), 2, matched=True) == moments_of((4,), 2, matched=False) == ()


@pytest.mark.parametrize("sharpness", [0.25, 1.0, 4.0])
def test_the_readouts_are_believed_as_far_as_they_are_right(sharpness):
    rng = np.random.default_rng(0)
    fusion = fused(judged(10, evidence(rng, KEYS) / sharpness, None))
    assert fusion.complete.model_weight == pytest.approx(sharpness, rel=0.35)


@pytest.mark.parametrize("useless", ["readouts", "kept touches"])
def test_what_says_nothing_of_the_material_gets_no_weight(useless):
    rng = np.random.default_rng(1)
    sound, noise = evidence(rng, KEYS, 1.5), 3.0 * rng.normal(size=(len(KEYS), C))
    fusion = fused(judged(10, noise, sound) if useless == "readouts" else judged(10, sound, noise))
    moment = fusion.complete
    if useless == "readouts":
        assert moment.model_weight < 0.1
        assert beta(moment) > 0.3
    else:
        assert beta(moment) < 0.1
        assert moment.model_weight > 0.5


def test_no_fewer_outliers_are_assumed_than_so_many_touches_can_rule_out():
    rng = np.random.default_rng(2)
    obvious = 40.0 * np.eye(C)[[OWN[key] for key in KEYS]]
    for keys in (KEYS, KEYS[::4], KEYS[::10]):
        rows = [KEYS.index(key) for key in keys]
        moment = fused(judged(10, obvious[rows], None, keys), keys=keys).complete
        assert PRIOR_OUTLIERS / (len(keys) + 1) <= moment.outlier_rate < 2 / len(keys)
        assert PRIOR_OUTLIERS / (len(keys) + 1) <= moment.model_outlier_rate < 2 / len(keys)
    odd = fused(judged(10, evidence(rng, KEYS, 8.0, odd=0.3), None)).complete
    assert 0.1 < odd.model_outlier_rate < 0.6


def test_a_share_of_every_probability_is_left_for_outliers():
    chances = tempered(np.array([1.0, 0.0, 0.0, 0.0]), 0.02)
    assert chances.tolist() == pytest.approx([0.985, 0.005, 0.005, 0.005])


def test_a_moment_is_drawn_to_its_neighbours():
    """The same few touches by themselves, and between two moments at which the readouts have far less weight."""
    rng = np.random.default_rng(3)
    few = KEYS[::10]
    scarce = judged(20, evidence(rng, few), None, few)
    near = [judged(columns, evidence(rng, KEYS) * 8, None) for columns in (10, 30)]
    last = judged(40, evidence(rng, KEYS), None)
    counts = dict.fromkeys(KEYS, 1.0)
    between = fuse(MATCHER, [near[0], scarce, near[1], last], [last], KEYS, counts, 1.0).moments[1]
    alone = fuse(MATCHER, [scarce, last], [last], KEYS, counts, 1.0).moments[0]
    expected = [fuse(MATCHER, [one, last], [last], KEYS, counts, 1.0).moments[0].model_weight for one in near]
    assert max(expected) < between.model_weight < alone.model_weight


@pytest.mark.parametrize("count", [0, 1, FEWEST - 1])
def test_where_too_few_were_held_out_the_readouts_decide(count):
    rng, keys = np.random.default_rng(4), KEYS[:count]
    scores = evidence(rng, keys)
    for own in (judged(10, scores, scores, keys), judged(10, None, scores, keys)):
        moment = fused(own, keys=keys).complete
        assert moment.model_weight == 1.0
        assert beta(moment) < 1e-3
        assert moment.distance_weight(1e9, own_time=True) == 1.0
        assert (moment.outlier_rate > 0) == (moment.model_outlier_rate > 0) == (count > 0)


def test_the_moment_of_a_touch_is_the_latest_that_it_reached():
    rng = np.random.default_rng(6)
    fusion = fused(*(judged(columns, evidence(rng, KEYS), None) for columns in (10, 20, 40)))
    assert [fusion.at(columns).steps for columns in (1, 10, 19, 20, 500)] == [10, 10, 10, 20, 40]
    paced = [judged(columns, evidence(rng, KEYS), None) for columns in (20, 80)]
    fusion = fuse(MATCHER, [paced[0]], paced, KEYS, dict.fromkeys(KEYS, 1.0), 1.0)
    assert [fusion.at_pace(columns).steps for columns in (2, 39, 41, 900)] == [20, 20, 80, 80]


def test_touches_are_chosen_evenly_and_the_least_sure_beside_them(monkeypatch):
    monkeypatch.setattr("scroll_tactile.prediction.fusion.MOST_HELD_OUT", 20)
    rng = np.random.default_rng(9)
    held = judged(10, evidence(rng, KEYS), None).held_out
    chosen, counts = chosen_of(held, MATCHER)
    assert chosen == sorted(chosen) and len(chosen) == 20
    least = [held.keys[i] for i in np.argsort(held.margins)[:5]]
    assert set(least) <= counts.keys() and set(chosen) <= counts.keys()
    assert all(counts[key] == 1.0 for key in least)
    assert sum(counts.values()) == pytest.approx(len(KEYS))
    assert chosen_of(held, None) == ([], {})


@pytest.mark.parametrize("information", [1.0, 0.8, 0.044])
@pytest.mark.parametrize("weight", [1e-7, 1e-4, 0.3])
def test_kept_touches_are_believed_as_was_fitted_where_touches_are_as_certain_as_those(weight, information):
    match = full_match_weight(weight, information)
    assert 1 / (1 + (1 / match - 1) * information) == pytest.approx(weight)


def test_noise_leaves_the_word_to_kept_touches_by_themselves():
    """Beside readouts that know everything they are of no use, and yet they answer where these have nothing to say."""
    rng = np.random.default_rng(10)
    moment = fused(judged(10, evidence(rng, KEYS, 6.0), evidence(rng, KEYS, 2.0))).complete
    assert moment.lone_match_weight > moment.match_weight
    lone = fused(judged(10, None, evidence(np.random.default_rng(3), KEYS, 4.0))).complete.lone_match_weight
    assert 1 / (1 + (1 / lone - 1) * 0.5) > 0.3  # it is fitted: by its prior alone it would be 0.17

    def way(noise_share):
        return match(np.zeros(C), noise_share=noise_share)

    assert moment.match_weight_at(way(0.0), 1.0) == pytest.approx(beta(moment))
    assert moment.match_weight_at(way(1.0), 1.0) == pytest.approx(1 / (1 + (1 / moment.lone_match_weight - 1) * 0.5))
    assert moment.match_weight_at(way(0.0), 0.5) > moment.match_weight_at(way(0.0), 1.0)


def test_the_further_off_a_touch_lies_the_less_the_readouts_weigh_and_at_another_pace_half_as_much():
    limited = replace(fused(judged(10, None, None)).complete, distance_limit=4.0)
    assert [limited.distance_weight(distance, True) for distance in (0.5, 2.0, 9.0, np.inf)] == [1.0, 0.5, 0.25, 1.0]
    assert [limited.distance_weight(distance, False) for distance in (2.0, 9.0)] == [0.5, 0.125]
