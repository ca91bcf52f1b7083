"""Tables of what noise makes of a level, against draws of the same noise."""

import numpy as np
import pytest

from scroll_tactile.matching.likelihood import AMPLITUDES, CLEAN, MOST_TABLES, NOISES, UNIT, Likelihood, Noise, _table
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.levels import LEVELS, MISSING, levels_of

SOME = [CLEAN, *(Noise(step) for step in (200, 393, 461)), Noise(137, True), Noise(387, True)]


@pytest.fixture(scope="module")
def likelihood():
    return Likelihood(1 + 0.05 * np.arange(LEVELS), np.full(LEVELS, 1 / LEVELS))


@pytest.mark.parametrize("noise", SOME)
def test_each_level_becomes_some_level_with_certainty(likelihood, noise):
    chances = np.exp(likelihood.table(noise).logs.reshape(256, 256)[:LEVELS, :LEVELS] / UNIT)
    assert np.allclose(chances.sum(axis=0), 1, atol=2e-3)


@pytest.mark.parametrize("noise", SOME)
def test_chances_are_those_of_draws(likelihood, noise, draws=200_000):
    rng, reach = np.random.default_rng(0), noise.amplitude * (LEVELS - 1)
    table = likelihood.table(noise)
    for x in (0, 3, 90, 254):
        natural = x + rng.normal(size=draws) * likelihood.spread[x]
        added = rng.normal(size=draws) * reach / 3**0.5 if noise.normal else rng.uniform(-reach, reach, draws)
        drawn = np.rint(np.clip(natural + added, 0, LEVELS - 1)).astype(int)
        logs = table.logs[256 * drawn + x] / UNIT
        assert logs.mean() == pytest.approx(table.expected[x], abs=0.02)
        assert drawn.mean() == pytest.approx(table.mean[x], abs=0.5)
        seen = np.bincount(drawn, minlength=LEVELS) / draws
        assert np.abs(seen - np.exp(table.logs.reshape(256, 256)[:LEVELS, x] / UNIT)).max() < 0.01


def test_what_is_missing_says_nothing(likelihood):
    logs = likelihood.table(Noise(393)).logs.reshape(256, 256)
    assert not logs[MISSING].any()
    assert not logs[:, MISSING].any()


def test_noise_hides_how_touches_differ(likelihood):
    information = [
        likelihood.table(noise).information for noise in (CLEAN, Noise(91, True), Noise(228, True), Noise(410, True))
    ]
    assert information[0] == pytest.approx(1, abs=0.3)
    assert information == sorted(information, reverse=True)
    assert information[-1] < 0.01


def test_only_the_latest_tables_are_kept(monkeypatch):
    make, made = _table, []
    monkeypatch.setattr("scroll_tactile.matching.likelihood._table", lambda *of: made.append(of[-1]) or make(*of))
    likelihood = Likelihood(np.full(LEVELS, 3.0), np.full(LEVELS, 1 / LEVELS))
    first = likelihood.table(Noise(0)).logs
    for step in range(1, MOST_TABLES + 2):
        likelihood.table(Noise(step))
    assert np.array_equal(likelihood.table(Noise(0)).logs, first)
    assert likelihood.table(Noise(0)).logs is likelihood.table(Noise(0)).logs
    assert made == [*map(Noise, range(MOST_TABLES + 2)), Noise(0)]


def test_log_likelihoods_by_amplitude_are_those_of_the_tables():
    """Where the spread is one for all levels, a value's is that of its deviation, and of how far in the end is."""
    likelihood = Likelihood(np.full(LEVELS, 3.0), np.full(LEVELS, 1 / LEVELS))
    for column in (0, AMPLITUDES - 1, 393, AMPLITUDES + 100):
        logs = likelihood.table(NOISES[column]).logs.reshape(256, 256) / UNIT
        found = likelihood.by_amplitude[:, column]
        away = np.arange(100)
        assert np.allclose(found[away], logs[120 - away // 2, 120 + (away + 1) // 2], atol=1e-3)
        for end, kept in ((0, away), (LEVELS - 1, LEVELS - 1 - away)):
            assert np.allclose(found[256 + away], logs[end, kept], atol=1e-3)
    assert (NOISES[393], NOISES[AMPLITUDES + 100]) == (Noise(393), Noise(100, True))
    assert Noise(AMPLITUDES - 1).amplitude == pytest.approx(1, abs=0.01)
    assert not likelihood.by_amplitude[[255, 511]].any()


def test_levels_of_readings():
    sensor = Sensor(name="s", channels=2, rate=10, low=(0, -1), high=(254, 1), unit="", duration=1)
    readings = np.array([[0, -1], [127, 0], [254, 1], [300, -np.inf], [np.nan, 0.5]])
    assert levels_of(readings, sensor).tolist() == [[0, 127, 254, 254, MISSING], [0, 127, 254, 0, 190]]
