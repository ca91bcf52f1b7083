"""Kept touches asked about touches that noise, dead channels or gaps came over."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scroll_tactile.errors import InputError
from scroll_tactile.matching.kept_arrays import KeptTouch
from scroll_tactile.matching.likelihood import CLEAN, UNIT
from scroll_tactile.matching.matcher import TouchMatcher
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.levels import LEVELS, MISSING

CHANNELS, READINGS, MATERIALS = 8, 120, 5


def touch(material, seed, readings=READINGS):
    """A slow wave of its material in each channel, and what differs from touch to touch: height, phase and offset."""
    shape, own = np.random.default_rng([1, material]), np.random.default_rng([2, material, seed])
    speed, phase, height = shape.uniform(1, 4, CHANNELS), shape.uniform(0, 6, CHANNELS), shape.uniform(5, 60, CHANNELS)
    along = np.linspace(0, 6, READINGS)[:readings]
    wave = (
        np.sin(speed[:, None] * along + phase[:, None] + own.normal() * 0.1) * height[:, None] * own.uniform(0.9, 1.1)
    )
    made = 70 + wave + own.normal(size=(CHANNELS, 1)) * 2 + own.normal(size=wave.shape)
    return np.clip(np.rint(made), 0, LEVELS - 1).astype(np.uint8)


def kept(each=8, **kwargs):
    return [
        KeptTouch(f"m{material}", bytes([material, seed]) * 16, touch(material, seed, **kwargs))
        for material in range(MATERIALS)
        for seed in range(each)
    ]


def noisy(levels, amplitude, seed, normal=False):
    rng, reach = np.random.default_rng([3, seed]), amplitude * (LEVELS - 1)
    added = rng.normal(size=levels.shape) * reach / 3**0.5 if normal else rng.uniform(-reach, reach, levels.shape)
    return np.clip(np.rint(levels + added), 0, LEVELS - 1).astype(np.uint8)


def matcher_of(touches):
    return TouchMatcher.of(touches)


@pytest.fixture(scope="module")
def matcher():
    return matcher_of(kept())


def same(one, other):
    """Whether two matches are the same bytes."""
    arrays = ("scores", "stuck", "expected")
    numbers = ("information", "noise", "noise_share", "log_likelihood_gain", "excess_loss")
    return all(getattr(one, name).tobytes() == getattr(other, name).tobytes() for name in arrays) and all(
        getattr(one, name) == getattr(other, name) for name in numbers
    )


@pytest.mark.parametrize("amplitude", [0.1, 0.25, 0.5, 0.8])
@pytest.mark.parametrize("normal", [False, True])
def test_the_noise_is_found(matcher, amplitude, normal):
    found = matcher.match(noisy(touch(1, 100), amplitude, 0, normal)).noise
    assert found.normal == normal
    assert found.amplitude == pytest.approx(amplitude, rel=0.15 if normal else 0.03)


def test_noise_is_trusted_to_kept_touches_and_clean_touches_are_not(matcher):
    matcher = matcher.measured(10.0, 10.0, 100.0)
    assert all(matcher.match(noisy(touch(m, 100), 0.3, m)).noise_share > 0.95 for m in range(MATERIALS))
    assert np.mean([matcher.match(touch(m, 100 + i)).noise_share for m in range(MATERIALS) for i in range(4)]) < 0.3


def test_an_offset_is_not_independent_noise(matcher):
    drifted = [np.clip(touch(m, 100).astype(int) + 12, 0, 254).astype(np.uint8) for m in range(MATERIALS)]
    assert all(matcher.match(levels).noise_share < 0.2 for levels in drifted)


def test_matching_is_a_function_of_the_set():
    touches = kept(each=4)
    asked = noisy(touch(2, 100), 0.4, 0)
    first = matcher_of(touches).match(asked)
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(len(touches))
        assert same(matcher_of([touches[i] for i in order]).match(asked), first)


@given(st.lists(st.integers(0, 19), max_size=30), st.randoms(use_true_random=False))
@settings(max_examples=15, deadline=None)
def test_whatever_comes_and_goes_it_holds_what_a_set_would(toggled, rng):
    touches = [KeptTouch(one.material, one.key, one.levels[:, : 80 + 2 * i]) for i, one in enumerate(kept(each=4))]
    held, matcher = {0, 1, 2}, matcher_of(touches[:3])
    for i in toggled:
        before, count = matcher.kept, len(held)
        held = held ^ {i} or {i}
        matcher = matcher.followed([touches[j] for j in held])
        assert len(before) == count
    stays = [touches[i] for i in held]
    rng.shuffle(stays)
    anew = replace(matcher_of(stays), deviation=matcher.deviation)
    assert matcher.kept.touches == anew.kept.touches
    assert matcher.kept.materials == anew.kept.materials
    asked = noisy(touch(rng.randrange(MATERIALS), 100), 0.3, 1)
    for whole in (False, True):
        assert same(matcher.match(asked, whole=whole), anew.match(asked, whole=whole))
    for row, (material, key) in enumerate(matcher.kept.touches):
        mine = next(stay for stay in stays if (stay.material, stay.key) == (material, key))
        assert matcher.kept.rows()[key] == row
        assert matcher.kept.levels[row].tobytes() == mine.levels.tobytes()


def test_a_touch_left_out_is_as_if_it_were_not_kept():
    touches = kept(each=4)
    matcher = matcher_of(touches)
    row = matcher.kept.rows()[touches[6].key]
    without = matcher.followed([stays for stays in touches if stays is not touches[6]])
    asked = matcher.kept.levels[row]
    left_out = matcher.match(asked, held_out=row)
    assert same(left_out, without.match(asked))
    assert left_out.scores.max() < matcher.match(asked).scores.max()


@pytest.mark.parametrize("columns", [READINGS, 70])
def test_excess_loss_of_beginnings_is_that_of_a_touch_that_ends_there(columns):
    """By the same kept touches: of so few materials all are in the shortlist, some of them with gaps."""
    touches = kept(each=4)
    touches[3].levels[2, 10:30] = MISSING
    matcher, steps = matcher_of([*touches, KeptTouch("short", b"s", touch(6, 0)[:, :50])]), [2, 40, 60]
    asked = touch(2, 100)[:, :columns]
    asked[1, 5:9] = MISSING
    found = matcher.beside(matcher.query(asked), CLEAN).excess_at(steps)
    expected = [matcher.match(asked[:, :until], noise=CLEAN).excess_loss for until in steps]
    assert found == pytest.approx(expected)


def test_stuck_channels_and_missing_values_are_left_out_exactly(matcher):
    levels, stuck, missing = touch(3, 100), touch(3, 100), touch(3, 100)
    stuck[2], missing[2] = 254, MISSING
    found = matcher.match(stuck)
    assert found.scores.tobytes() == matcher.match(missing).scores.tobytes()
    assert found.stuck.tolist() == [False, False, True] + [False] * 5
    assert np.abs(found.expected[2] - levels[2]).mean() < 8


@pytest.mark.parametrize(("quiet", "stuck"), [(0, True), (1, True), (8, False)])
def test_a_channel_that_is_often_quiet_is_not_stuck(quiet, stuck):
    """One of twenty kept touches or more: of an array of binary taxels most are quiet."""
    touches = kept()
    for each in touches[:quiet]:
        each.levels[3] = 0
    matcher = matcher_of(touches)
    asked = touch(0, 100)
    asked[3] = 0
    assert matcher.match(asked).stuck.tolist() == [False] * 3 + [stuck] + [False] * 4
    if quiet == 8:
        few = matcher_of([touches[0], touches[1], *touches[8:]])
        assert not few.match(asked).stuck[3]  # two of 34 kept touches; without one of those there is one of 33
        assert few.match(asked, held_out=few.kept.rows()[touches[0].key]).stuck[3]


def test_a_channel_that_changes_late_is_stuck_only_once_others_have_changed():
    touches = kept()
    for each in touches:
        each.levels[3, :60] = 0
    asked = touch(0, 100)
    asked[3] = 0
    matcher = matcher_of(touches)
    assert not matcher.match(asked[:, :60]).stuck.any()
    assert matcher.match(asked[:, :61]).stuck[3]


def test_channels_that_are_often_quiet_are_not_dead():
    """Three of eight channels are quiet in half of the kept touches; in another touch the others died."""
    touches = kept()
    for each in touches[::2]:
        each.levels[:3] = 0
    matcher = matcher_of(touches)
    for material in range(MATERIALS):
        quiet = next(each for each in touches[::2] if each.material == f"m{material}")
        asked = touch(material, 100)
        asked[:3] = 0
        assert not matcher.match(asked).stuck.any()  # kept touches of its material are so
        dead = touch(material, 100)
        dead[5:] = 0
        found = matcher.match(dead)
        assert found.stuck.tolist() == [False] * 5 + [True] * 3
        assert matcher.kept.materials[int(found.scores.argmax())] == quiet.material


def test_scores_are_sums_over_all_values():
    alone = kept(each=1)
    matcher = matcher_of(alone)
    asked = noisy(touch(3, 100), 0.3, 1)
    asked[1, 5:9] = MISSING
    found = matcher.match(asked)
    table = matcher.deviation.likelihood.table(found.noise)
    for place, material in enumerate(matcher.kept.materials):
        levels = next(alike.levels for alike in alone if alike.material == material)
        total = sum(int(table.logs[256 * int(y) + int(x)]) for y, x in zip(asked.ravel(), levels.ravel(), strict=True))
        assert found.scores[place] == pytest.approx(total / UNIT, rel=1e-12)
    assert found.information == pytest.approx(table.information * (1 - 4 / asked.size), rel=1e-12)


def test_readings_are_filled_in_where_they_lack(matcher):
    sensor = Sensor(name="s", channels=CHANNELS, rate=50, low=0, high=254, unit="", duration=1)
    levels = touch(2, 100)
    readings = levels.T.astype(np.float32)
    readings[:, 4], readings[10:20, 1] = 0, np.nan
    asked = levels.copy()
    asked[4], asked[1, 10:20] = 0, MISSING
    filled = matcher.match(asked).filled(readings, sensor)
    untouched = np.ones(readings.shape, bool)
    untouched[:, 4], untouched[10:20, 1] = False, False
    assert np.array_equal(filled[untouched], readings[untouched])
    assert np.abs(filled - levels.T).mean() < 3


@pytest.mark.parametrize(
    "asked",
    [
        np.zeros((CHANNELS, READINGS), np.uint8),
        np.full((CHANNELS, READINGS), MISSING, np.uint8),
        np.full((CHANNELS, 1), 80, np.uint8),
        touch(0, 100)[:, :2],
        np.tile(touch(0, 100), 5),
        np.where(np.arange(CHANNELS)[:, None] == 3, touch(0, 100), 0).astype(np.uint8),
    ],
    ids=["dead", "missing", "one reading", "two readings", "long", "one channel"],
)
def test_whatever_is_left_of_a_touch_has_an_answer(matcher, asked):
    found = matcher.match(asked)
    assert np.isfinite([*found.scores, found.noise_share, found.log_likelihood_gain, found.excess_loss]).all()
    assert found.expected.shape == asked.shape
    if found.stuck.all():
        assert np.ptp(found.scores) < np.log(2) or found.noise == CLEAN


def test_touches_of_other_lengths_and_one_touch_alone():
    ragged = matcher_of(
        [*kept(each=3), *(KeptTouch("short", bytes([8, i]) * 16, touch(6, i)[:, :50]) for i in range(3))]
    )
    assert ragged.kept.materials[np.argmax(ragged.match(touch(6, 100)[:, :50]).scores)] == "short"
    assert ragged.kept.materials[np.argmax(ragged.match(noisy(touch(6, 100), 0.2, 0)).scores)] == "short"
    assert ragged.kept.materials[np.argmax(ragged.match(noisy(touch(1, 100), 0.2, 0)).scores)] == "m1"
    for wrong, said in (
        ([], "one or more"),
        ([*kept(each=1), KeptTouch("o", b"o", np.zeros((3, 9), np.uint8))], "same"),
    ):
        with pytest.raises(InputError, match=said):
            matcher_of(wrong)
    with pytest.raises(InputError, match=r"shape \(8, T\)"):
        ragged.match(np.zeros((3, 10), np.uint8))
    single = matcher_of(kept(each=1)[:1])
    assert single.match(touch(0, 100)).scores.shape == (1,)


@pytest.mark.parametrize("noise", [CLEAN, None])
@pytest.mark.parametrize("whole", [False, True])
def test_the_only_kept_touch_held_out_leaves_nothing_to_compare_with(noise, whole):
    """As where one kept touch alone has a label of an axis (`predict(of=)`): every answer is the same."""
    single = matcher_of(kept(each=1)[:1])
    found = single.match(single.kept.levels[0], whole=whole, held_out=0, noise=noise)
    assert found.scores.tolist() == [0.0]
    assert np.isnan(found.expected).all()
    assert (found.noise_share, found.log_likelihood_gain, found.excess_loss, found.moved) == (0.0, 0.0, 0.0, False)


def test_a_channel_that_is_often_still_is_quiet_or_dead_as_is_the_likelier():
    """The touches of one material of five leave a channel still, and a dead one reads as it does there."""

    def still(material, seed):
        levels = touch(material, seed)
        levels[0] = 0
        return levels

    known = [replace(one, levels=still(0, one.key[1])) if one.material == "m0" else one for one in kept()]
    matcher = matcher_of(known)
    for material in range(MATERIALS):
        found = [matcher.match(still(material, seed)) for seed in range(50, 55)]
        assert [int(match.scores.argmax()) for match in found] == [material] * 5
        assert [bool(match.stuck[0]) for match in found] == [material != 0] * 5
