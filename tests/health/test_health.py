"""Health: whether the sensor is still the one that learned, which channels changed, and nothing else that alarms."""

import json
import re
import typing
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run

from scroll_tactile import Health, Kernels, Scene, Sensor, TactileLearner, errors, sensors
from scroll_tactile.clients.report import memory_page
from scroll_tactile.health.channel_numbers import channel_numbers, from_text, to_text
from scroll_tactile.health.diagnosis import advice, in_words
from scroll_tactile.health.watch import JUMP, STAKES, Bets, Watch, ranks
from scroll_tactile.results import ChangeKind
from scroll_tactile.signals.stream import Stream, validate

PAD = Sensor(name="pad", channels=8, rate=50.0, low=0.0, high=1000.0, unit="counts", duration=1.0)
SCENE = Scene(sensor=PAD, seed=3)
NAMES = SCENE.materials[:5]
CHANNEL = 3

Change = Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]]


def touch(name: str, repetition: int, change: Change | None = None, **how: float) -> Stream:
    stream = SCENE.touch(name, repetition, **how)
    if change is None:
        return stream
    return validate(np.clip(change(stream.readings.astype(np.float64)), 0, 1000).astype(np.float32), PAD)


def on_channel(what: Change) -> Change:
    def change(readings: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        readings[:, CHANNEL] = what(readings[:, CHANNEL])
        return readings

    return change


def noisier(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return values + np.random.default_rng(0).normal(0, 12, values.shape)


def watched(touches: Iterable[tuple[str, Stream]], bound: float = 0.01) -> Watch:
    watch = Watch(PAD.channels, bound)
    for sequence, (name, stream) in enumerate(touches, 1):
        numbers = channel_numbers(stream)
        assert numbers is not None
        watch.take(sequence, name, len(stream), numbers)
    return watch


def sound(rounds: int, first: int = 0) -> list[tuple[str, Stream]]:
    return [(name, touch(name, i)) for i in range(first, first + rounds) for name in NAMES]


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("gain", lambda values: 0.95 * values),
        ("offset", lambda values: values + 20),
        ("dead", lambda values: 0 * values),
        ("noisier", noisier),
    ],
)
def test_a_changed_channel_is_named(kind: str, change: Change) -> None:
    changed = [(name, touch(name, i, on_channel(change))) for i in range(30, 50) for name in NAMES]
    watch = watched([*sound(30), *changed])
    assert watch.change is not None
    assert (watch.change.kind, watch.change.channels) == (kind, (CHANNEL,))
    assert watch.alarmed is not None
    assert 150 < watch.alarmed <= 150 + 60
    assert abs(watch.change.since - 150) <= 20


def test_a_channel_that_changed_in_two_ways_is_called_by_the_greater() -> None:
    weaker = on_channel(lambda values: 0.8 * values + 60)
    change = watched([*sound(30), *[(name, touch(name, i, weaker)) for i in range(30, 50) for name in NAMES]]).change
    assert change is not None
    assert (change.kind, change.channels) == ("gain", (CHANNEL,))


@pytest.mark.parametrize(
    "touches",
    [
        sound(30, 30),
        [(NAMES[0], touch(NAMES[0], i)) for i in range(30, 130)],
        [(name, touch(name, i)) for name in SCENE.materials[5:10] for i in range(20)],
        [(name, touch(name, i, seconds=0.5)) for i in range(60, 80) for name in NAMES],
        [(name, touch(name, i, force=2.0)) for i in range(30, 50) for name in NAMES],
        [(name, touch(name, i, speed=80.0)) for i in range(30, 50) for name in NAMES],
    ],
    ids=["the same", "one material", "new materials", "half as long", "firmer", "faster"],
)
def test_no_mixture_of_touches_is_a_change(touches: list[tuple[str, Stream]]) -> None:
    # Speeds and forces are known from before; only their mixture is new.
    hows: list[dict[str, float]] = [{"force": 2.0}, {"speed": 80.0}]
    known = [(name, touch(name, 200 + i, **how)) for name in NAMES for i in range(6) for how in hows]
    learned = [*sound(20), *known, *sound(10, 20)]
    assert watched([*learned, *touches]).alarmed is None


def test_one_material_that_changed_is_no_sensor() -> None:
    worn = on_channel(lambda values: 0.9 * values)
    changed = [(NAMES[1], touch(NAMES[1], i, worn)) for i in range(30, 90)]
    mixed = [each for i, own in enumerate(changed) for each in ([own, *sound(1, 30 + i)[2:3]] if i % 3 == 0 else [own])]
    change = watched([*sound(30), *mixed]).change
    assert change is not None
    assert (change.kind, change.channels, change.materials) == ("material", (), (NAMES[1],))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("kind", "channels", "noise", "gain", "shift"),
    [
        ("noisier", (CHANNEL,), np.where(np.arange(8) == CHANNEL, 2.0, 1.0), 1.0, 0.0),
        ("slower", (CHANNEL,), np.where(np.arange(8) == CHANNEL, 0.4, 1.0), 1.0, 0.0),
        ("noisier", tuple(range(8)), 2.0, 1.0, 0.0),
        ("all gains", tuple(range(8)), 1.0, 0.5, 0.0),
        ("all offsets", tuple(range(8)), 1.0, 1.0, 20.0),
    ],
)
def test_at_rest_noise_is_told_from_levels_and_dated(
    kind: str, channels: tuple[int, ...], noise: Any, gain: float, shift: float, seed: int
) -> None:
    random = np.random.default_rng(seed)

    def rest(noise: Any, gain: float, shift: float) -> Stream:
        readings = gain * np.linspace(80, 200, 8) + shift + random.normal(0, 6, (25, 8)) * noise
        return validate(readings.astype(np.float32), PAD)

    change = watched([("", rest(*how)) for how in [(1.0, 1.0, 0.0)] * 100 + [(noise, gain, shift)] * 60]).change
    assert change is not None
    assert (change.kind, change.channels, change.since) == (kind, channels, pytest.approx(101, abs=2))


def test_a_sensor_dead_from_the_first_day_and_few_touches_are_sound() -> None:
    dead = on_channel(lambda values: 0 * values)
    assert watched((name, touch(name, i, dead)) for i in range(40) for name in NAMES).alarmed is None
    assert watched(sound(1)).evidence == 0.0
    assert watched([]).change is None


def test_numbers_are_read_back_and_none_of_another_sensor() -> None:
    numbers = channel_numbers(touch(NAMES[0], 0))
    assert numbers is not None
    found = from_text(to_text(numbers), 8)
    assert found is not None
    assert found.tobytes() == numbers.tobytes()
    assert from_text(to_text(numbers), 9) is from_text("=", 8) is from_text(None, 8) is None
    assert from_text(to_text(numbers), 7) is None
    readings = touch(NAMES[0], 0).readings
    assert channel_numbers(validate(readings[:2], PAD)) is None is not channel_numbers(validate(readings[:3], PAD))


@pytest.fixture(scope="module")
def memory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """25 rounds of touches of a sound sensor, then 12 with a weaker channel."""
    path = tmp_path_factory.mktemp("health") / "memory"
    weaker = on_channel(lambda values: 0.9 * values)
    with TactileLearner.open(path, sensor=PAD) as learner, learner.batch():
        for i in range(37):
            for name in NAMES:
                learner.observe(name, touch(name, i, weaker if i >= 25 else None), source="a" if i < 25 else "b")
    return path


def test_health_is_a_function_of_the_journal(memory: Path) -> None:
    with TactileLearner.open(memory, mode="read") as learner:
        digest, found = learner.digest(), learner.health()
        assert (found.kind, found.channels) == ("gain", (CHANNEL,))
        assert found.alarmed is not None
        part = learner.health(until=140)
        assert part.since is None
        assert learner.health() == found  # after another stretch, from the beginning
        assert learner.health(until=140) == part
        assert learner.health(after=125).since is None  # the new sensor alone
        assert learner.health(source="b").since is None  # two streams: each is sound
        assert learner.digest() == digest
    with TactileLearner.open(memory, mode="read") as again:
        again.health(until=100)
        assert again.health() == found  # the same evidence, to the bit, after a restart


def test_what_is_learned_later_or_retracted_counts(memory: Path, tmp_path: Path) -> None:
    with TactileLearner.open(memory, mode="read") as learner:
        learner.backup(tmp_path / "memory")
        before = learner.health(until=125)
    with TactileLearner.open(tmp_path / "memory") as learner:
        assert learner.health().since is not None
        learner.forget(source="b")
        assert learner.health() == before
        learner.compact()
        assert learner.health() == before  # the numbers stay where readings were given up
        learner.sense(touch(NAMES[0], 99), NAMES[0])
        learner.sense(touch(NAMES[0], 99))
        assert learner.health().touches == before.touches + 2
        found = learner.health()
    with TactileLearner.open(tmp_path / "memory", mode="read") as learner:
        assert learner.health() == found


def test_another_robots_touches_are_a_stream_of_their_own(memory: Path, tmp_path: Path) -> None:
    other = on_channel(lambda values: 1.1 * values)
    with TactileLearner.open(tmp_path / "other", sensor=PAD) as robot, robot.batch():
        for name, i in [(name, i) for i in range(100, 115) for name in NAMES]:
            robot.observe(name, touch(name, i, other), source="other/touches.npy")
    with TactileLearner.open(memory, mode="read") as learner:
        learner.backup(tmp_path / "memory")
    with TactileLearner.open(tmp_path / "memory") as learner:
        learner.forget(source="b")
        learner.merge(tmp_path / "other")
        assert learner.health().since is not None  # not the sensor that learned
        assert learner.health(source="other").since is learner.health(source="a").since is None


def test_what_cannot_be_told_is_refused(tmp_path: Path) -> None:
    for made in (TactileLearner(sensor=PAD), TactileLearner.open(tmp_path / "memory", sensor=PAD)):
        with made as learner:
            assert learner.has_health and learner.health() == Health(None, None, (), "", 1.0, 0.01, 0, None, (), ())
            for wrong in ({"bound": 0}, {"bound": "1"}, {"after": -1}, {"until": True}):
                with pytest.raises(errors.InputError):
                    learner.health(**wrong)
            with pytest.raises(errors.InputError, match="three readings"):
                learner.sense(touch(NAMES[0], 0).readings[:2])
            with pytest.raises(errors.InputError, match="source"):
                learner.health(source=5)  # type: ignore[arg-type]
    wide = Sensor(name="wide", channels=300, rate=50.0, low=0.0, high=1.0, unit="V", duration=1.0)
    for name, sensor, what in (("camera", sensors.GELSIGHT, "has pixels"), ("wide", wide, "has 300")):
        made = TactileLearner.open(tmp_path / name, sensor=sensor, embedding=Kernels(dimension=64))
        with made as learner, pytest.raises(errors.InputError, match=what):
            assert not learner.has_health
            learner.health()


@pytest.mark.parametrize(("kind", "by"), [("noisier", (0, 0, 300)), ("slower", (0, 0, -300))])
def test_of_a_single_channel_it_is_told_what_changed(kind: str, by: tuple[int, int, int]) -> None:
    random, watch = np.random.default_rng(0), Watch(1, 0.01)
    for sequence in range(1, 400):
        numbers = random.normal(0, 20, 4)
        numbers[:3] += by if sequence > 150 else (0, 0, 0)
        watch.take(sequence, "silk", 100, numbers.astype(np.int16))
    assert watch.change is not None and watch.change.kind == kind and watch.change.channels == (0,)


@pytest.fixture(scope="module")
def changed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A memory whose channel 3 died after 100 touches."""
    folder = tmp_path_factory.mktemp("changed") / "m"
    with TactileLearner.open(folder, sensor=PAD, embedding=Kernels(dimension=64)) as learner, learner.batch():
        dead = [(name, touch(name, i, on_channel(lambda values: 0 * values))) for i in range(20, 30) for name in NAMES]
        for name, stream in [*sound(20), *dead]:
            learner.observe(name, stream)
    return folder


def test_the_command_says_what_changed_and_what_to_do(changed: Path) -> None:
    told = run("memory", "health", changed)
    text = " ".join(told.output.split())
    assert told.exit_code == 1
    found = re.match(r"changed: since observation (\d+), 20.. *", text)
    assert found is not None, text
    assert "channel 3: says nothing any more look at its contact" in text
    after = re.search(r"--after (\d+) asks", text)
    assert after is not None
    later = run("memory", "health", changed, "--after", after[1])
    assert later.exit_code == 0 and "changed:" not in later.output
    few = run("memory", "health", changed, "--after", 148)
    assert few.exit_code == 0 and "too few: nothing can be told yet" in " ".join(few.output.split())
    told = run("memory", "health", changed, "--json")
    record = json.loads(told.output)
    assert record["channels"] == [3] and record["kind"] == "dead" and record["time"] > 1e9
    assert told.exit_code == 1


def test_the_page_shows_the_evidence_as_it_grew(changed: Path, tmp_path: Path) -> None:
    with TactileLearner.open(changed, mode="read") as learner:
        page = memory_page(learner)
        since = learner.health().since
    assert "Evidence that the sensor changed" in page and "channel 3: says nothing any more" in page
    strip = page[page.index('id="channels"') :]
    rows = [" ".join(re.sub("<[^>]+>", " ", row).split()) for row in re.findall("<tr>(.*?)</tr>", strip)]
    assert rows[1].startswith(f"3 dead since observation {since} ") and rows[2].startswith("0 fine ")


def test_what_is_said_of_each_kind_names_what_changed() -> None:
    for kind in typing.get_args(ChangeKind):
        found = Health(7 if kind else None, 0.0, (1, 2), kind, 200.0, 0.01, 9, 12, ("oak",), ((3, 0.1),))
        text = in_words(found, lambda name: f"<{name}>")
        if not kind:
            assert text == "no change of the sensor is seen in 9 touches and rest readings" and advice(found) == ""
        elif kind == "material":
            assert "<oak> feels otherwise" in text and "memory relabel" in advice(found)
        else:
            assert text.startswith("since observation 7, 1970-01-01 00:00 UTC channels 1, 2: ")
            assert "--after 12" in advice(found) and "--until 6" in advice(found)
    assert "nothing can be told yet" in in_words(Health(None, None, (), "", 1.0, 0.01, 1, None, (), ()))


def test_one_material_alone_and_fewer_touches_than_channels() -> None:
    name = NAMES[0]
    alone = [(name, touch(name, i)) for i in range(100)]
    assert watched(alone).alarmed is None
    changed = [(name, touch(name, i, on_channel(lambda values: 0.9 * values))) for i in range(100, 160)]
    change = watched([*alone, *changed]).change
    assert change is not None  # no other material was touched that would show whether it is the material
    assert (change.kind, change.channels, change.materials) == ("gain", (CHANNEL,), (name,))
    few = watched(alone[:6])  # of eight channels
    assert few.alarmed is None and np.isfinite(few.evidence) and len(few.grew) == 5


def test_a_clock_that_jumps_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dead, found = on_channel(lambda values: 0 * values), []
    touches = [(name, touch(name, i, None if i < 20 else dead)) for i in range(30) for name in NAMES]
    for jumps in (False, True):
        with TactileLearner.open(tmp_path / str(jumps), sensor=PAD) as learner, learner.batch():
            for i, (name, stream) in enumerate(touches):
                now = 1e9 + i if not jumps else 2e9 - 1e7 * (i % 7)
                monkeypatch.setattr("time.time", lambda now=now: now)
                learner.sense(stream, name)
            found.append(learner.health())
    steady, jumped = found
    assert steady.time == 1e9 + steady.since - 1
    assert jumped.time == 2e9 - 1e7 * ((jumped.since - 1) % 7)
    assert vars(steady) | {"time": jumped.time} == vars(jumped)


def test_martingales_are_those_of_crepes() -> None:
    martingales = pytest.importorskip("crepes.martingales")
    random = np.random.default_rng(0)
    values = np.concatenate([random.random((80, 6)), random.beta(0.4, 2, (60, 6))])
    bets = Bets(8)
    for row in values:
        bets.take(row, 2)
    jumper = martingales.SimpleJumper(J=JUMP, bf=martingales.EpsilonBettingFunction(STAKES[:, 0].tolist()))
    theirs = [np.log(jumper.apply(column)[-1]) for column in values.T]
    np.testing.assert_allclose(bets.log[2:], theirs, rtol=1e-12, atol=1e-12)
    assert (bets.log[:2] == 0).all()


def test_p_values_are_those_of_crepes() -> None:
    martingales = pytest.importorskip("crepes.martingales")
    scores = np.random.default_rng(0).integers(0, 9, 40).astype(float)
    theirs = martingales.semi_online_p_values(scores, seed=7)
    ties = np.random.RandomState(7).random_sample(len(scores))  # by which crepes breaks its ties
    ours = [ranks(-scores[: i + 1, None], tie)[0] for i, tie in enumerate(ties)]
    np.testing.assert_allclose(ours, theirs, rtol=1e-15)
