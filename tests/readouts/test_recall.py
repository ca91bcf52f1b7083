"""Kept touches asked about touches that noise, dead channels or gaps came over."""

import numpy as np
import pytest

from scroll_tactile.errors import InputError
from scroll_tactile.readouts.deviation import recall_of
from scroll_tactile.readouts.likelihood import CLEAN, LEVELS, MISSING, UNIT
from scroll_tactile.readouts.recall import Recall
from scroll_tactile.readouts.recollection import Kept
from scroll_tactile.sensors import Sensor

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
        Kept(f"m{material}", bytes([material, seed]) * 16, touch(material, seed, **kwargs))
        for material in range(MATERIALS)
        for seed in range(each)
    ]


def noisy(levels, amplitude, seed, normal=False):
    rng, reach = np.random.default_rng([3, seed]), amplitude * (LEVELS - 1)
    added = rng.normal(size=levels.shape) * reach / 3**0.5 if normal else rng.uniform(-reach, reach, levels.shape)
    return np.clip(np.rint(levels + added), 0, LEVELS - 1).astype(np.uint8)


@pytest.fixture(scope="module")
def recall():
    return recall_of(kept())


def same(one, other):
    return (
        one.scores.tobytes() == other.scores.tobytes()
        and one.expected.tobytes() == other.expected.tobytes()
        and (one.noise, one.trust, one.evidence, one.surprise)
        == (other.noise, other.trust, other.evidence, other.surprise)
    )


def right(recall, change):
    asked = [(material, touch(material, 100 + seed)) for material in range(MATERIALS) for seed in range(6)]
    return np.mean(
        [
            np.argmax(recall.recollect(change(levels, i)).scores) == material
            for i, (material, levels) in enumerate(asked)
        ]
    )


@pytest.mark.parametrize(
    "change",
    [
        lambda levels, seed: levels,
        lambda levels, seed: noisy(levels, 0.5, seed),
        lambda levels, seed: noisy(levels, 0.25, seed),
        lambda levels, seed: noisy(levels, 0.5, seed, normal=True),
        lambda levels, seed: np.where(np.arange(CHANNELS)[:, None] % 3 == seed % 3, 0, levels).astype(np.uint8),
        lambda levels, seed: np.where(np.arange(CHANNELS)[:, None] % 3 == seed % 3, 254, levels).astype(np.uint8),
        lambda levels, seed: levels[:, :30],
    ],
    ids=["clean", "half", "quarter", "normal", "dead", "stuck", "short"],
)
def test_materials_are_recalled_whatever_came_over_the_touch(recall, change):
    assert right(recall, change) >= 0.9


@pytest.mark.parametrize("amplitude", [0.1, 0.25, 0.5, 0.8])
@pytest.mark.parametrize("normal", [False, True])
def test_the_noise_is_found(recall, amplitude, normal):
    found = recall.recollect(noisy(touch(1, 100), amplitude, 0, normal)).noise
    assert found.normal == normal
    assert found.amplitude == pytest.approx(amplitude, rel=0.15 if normal else 0.03)


def test_noise_is_trusted_to_recall_and_clean_touches_are_not(recall):
    assert all(recall.recollect(noisy(touch(m, 100), 0.3, m)).trust > 0.95 for m in range(MATERIALS))
    assert np.mean([recall.recollect(touch(m, 100 + i)).trust for m in range(MATERIALS) for i in range(4)]) < 0.3


def test_an_offset_is_not_independent_noise(recall):
    drifted = [np.clip(touch(m, 100).astype(int) + 12, 0, 254).astype(np.uint8) for m in range(MATERIALS)]
    assert all(recall.recollect(levels).trust < 0.2 for levels in drifted)


def test_noise_alone_is_explained_by_nothing_that_is_kept(recall):
    rng = np.random.default_rng(0)
    alone = [rng.integers(0, LEVELS, (CHANNELS, READINGS)).astype(np.uint8) for _ in range(8)]
    known = [noisy(touch(m, 100), 0.3, m) for m in range(MATERIALS)]
    assert max(recall.recollect(levels).evidence for levels in alone) < 0
    assert min(recall.recollect(levels).evidence for levels in known) > 0


def test_recall_is_a_function_of_the_set():
    touches = kept(each=4)
    asked = noisy(touch(2, 100), 0.4, 0)
    first = recall_of(touches).recollect(asked)
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(len(touches))
        assert same(recall_of([touches[i] for i in order]).recollect(asked), first)


def test_touches_that_come_and_go_leave_what_a_new_recall_would_have():
    touches, more = kept(each=4), [Kept("new", bytes([9, i]) * 16, touch(7, i)) for i in range(3)]
    start = recall_of(touches)
    gone = [touches[3].key, touches[9].key]
    stays = [one for one in touches if one.key not in gone] + more
    followed, anew = start.followed(more, gone), Recall(stays, start.measured)
    for asked in (touch(7, 100), noisy(touch(2, 100), 0.4, 0), touch(1, 50)[:, :40]):
        assert same(followed.recollect(asked), anew.recollect(asked))
    back = followed.followed([touches[3], touches[9]], [one.key for one in more])
    assert same(back.recollect(touch(1, 100)), start.recollect(touch(1, 100)))


def test_longer_touches_that_come_are_as_if_they_had_been_there():
    start, more = recall_of(kept(each=3, readings=60)), kept(each=1)
    assert same(
        start.followed(more, [one.key for one in more]).recollect(touch(0, 100)),
        Recall([*(one for one in start.kept if one.key not in {m.key for m in more}), *more], start.measured).recollect(
            touch(0, 100)
        ),
    )


def test_stuck_channels_and_missing_values_are_left_out_exactly(recall):
    levels, stuck, missing = touch(3, 100), touch(3, 100), touch(3, 100)
    stuck[2], missing[2] = 254, MISSING
    found = recall.recollect(stuck)
    assert found.scores.tobytes() == recall.recollect(missing).scores.tobytes()
    assert found.stuck.tolist() == [False, False, True] + [False] * 5
    assert np.abs(found.expected[2] - levels[2]).mean() < 8


def test_scores_are_sums_over_all_values():
    alone = kept(each=1)
    recall = recall_of(alone)
    asked = noisy(touch(3, 100), 0.3, 1)
    asked[1, 5:9] = MISSING
    found = recall.recollect(asked)
    table = recall.measured.likelihood.table(found.noise)
    steep = 1 / (1 + recall.measured.doubt * table.certainty * (1 - 4 / asked.size))
    for place, material in enumerate(recall.materials):
        levels = next(one.levels for one in alone if one.material == material)
        total = sum(int(table.logs[256 * int(y) + int(x)]) for y, x in zip(asked.ravel(), levels.ravel(), strict=True))
        assert found.scores[place] == pytest.approx(steep * total / UNIT, rel=1e-12)


def test_readings_are_filled_in_where_they_lack(recall):
    sensor = Sensor(name="s", channels=CHANNELS, rate=50, low=0, high=254, unit="", duration=1)
    levels = touch(2, 100)
    readings = levels.T.astype(np.float32)
    readings[:, 4], readings[10:20, 1] = 0, np.nan
    asked = levels.copy()
    asked[4], asked[1, 10:20] = 0, MISSING
    filled = recall.recollect(asked).filled(readings, sensor)
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
def test_whatever_is_left_of_a_touch_has_an_answer(recall, asked):
    found = recall.recollect(asked)
    assert np.isfinite([*found.scores, found.trust, found.evidence, found.surprise]).all()
    assert found.expected.shape == asked.shape
    if found.stuck.all():
        assert np.ptp(found.scores) < np.log(2) or found.noise == CLEAN


def test_touches_of_other_lengths_and_one_touch_alone():
    ragged = recall_of([*kept(each=3), *(Kept("short", bytes([8, i]) * 16, touch(6, i)[:, :50]) for i in range(3))])
    assert ragged.materials[np.argmax(ragged.recollect(touch(6, 100)[:, :50]).scores)] == "short"
    assert ragged.materials[np.argmax(ragged.recollect(noisy(touch(6, 100), 0.2, 0)).scores)] == "short"
    assert ragged.materials[np.argmax(ragged.recollect(noisy(touch(1, 100), 0.2, 0)).scores)] == "m1"
    single = recall_of(kept(each=1)[:1])
    assert single.recollect(touch(0, 100)).scores.shape == (1,)


def test_errors_say_what_was_expected(recall):
    with pytest.raises(InputError, match=r"shape \(8, T\)"):
        recall.recollect(np.zeros((3, 10), np.uint8))
    with pytest.raises(InputError, match="one or more"):
        recall_of([])
    with pytest.raises(InputError, match="same number of channels"):
        recall_of([*kept(each=1), Kept("other", b"o" * 32, np.zeros((3, 10), np.uint8))])
    with pytest.raises(InputError, match="one or more"):
        recall.followed([], [one.key for one in recall.kept])
