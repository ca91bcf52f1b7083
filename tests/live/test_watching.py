"""A live session calls back when the sensor is no longer the one that learned."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scroll_tactile_store import StoreError

from scroll_tactile import Health, Kernels, Scene, Sensor, TactileLearner
from scroll_tactile.live.answers import LiveTouch
from scroll_tactile.live.session import HealthNotes
from scroll_tactile.results import Prediction
from scroll_tactile.signals.stream import Stream, validate

PAD = Sensor(name="pad", channels=6, rate=50.0, low=0.0, high=1000.0, unit="counts", duration=1.0)
SCENE = Scene(sensor=PAD, seed=3)
NAMES = SCENE.materials[:3]
RANDOM = np.random.default_rng(0)


def rest(gain: float = 1.0) -> Stream:
    level = gain * np.linspace(80, 200, 6) + RANDOM.normal(0, 2, 6)
    return validate((level + RANDOM.normal(0, 6, (25, 6))).astype(np.float32), PAD)


def ended(
    stream: Stream, material: str | None, *, known: bool | None = True, decided: bool = True, **how: Any
) -> LiveTouch:
    return LiveTouch(stream, Prediction(material, 0.99, (), 0.0, known, 1.0), decided, 0.0, "released", **how)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("watching") / "memory"
    with TactileLearner.open(path, sensor=PAD, embedding=Kernels(dimension=64)) as learner, learner.batch():
        for i in range(20):
            for name in NAMES:
                learner.observe(name, SCENE.touch(name, i))
    return path


@pytest.fixture
def memory(made: Path, tmp_path: Path) -> Path:
    with TactileLearner.open(made, mode="read") as learner:
        learner.backup(tmp_path / "memory")
    return tmp_path / "memory"


def test_known_touches_and_rest_are_noted_and_a_change_is_told_once(memory: Path) -> None:
    told = list[Health]()
    with TactileLearner.open(memory) as learner, learner.batch():
        notes = HealthNotes(learner, told.append, pytest.fail)
        counts = [learner.health().touches]

        def takes(touch: LiveTouch | None) -> int:
            notes.take(touch)
            counts.append(learner.health().touches)
            return counts[-1] - counts[-2]

        one, two = (SCENE.touch(NAMES[0], 90 + i) for i in range(2))
        assert takes(ended(one, NAMES[0], rest=rest())) == 1  # the rest; the touch may be learned yet
        learner.observe(NAMES[0], one)
        assert takes(ended(two, NAMES[0])) == 1  # what was learned is not noted, too
        assert takes(ended(SCENE.touch(NAMES[1], 92), NAMES[1], known=False)) == 1
        assert takes(ended(SCENE.touch(NAMES[1], 93), NAMES[1], decided=False)) == 0
        assert takes(ended(SCENE.touch(NAMES[1], 94), NAMES[1], known=None)) == 0
        assert takes(None) == 0
        for i in range(40):
            takes(ended(SCENE.touch(NAMES[i % 3], 100 + i), NAMES[i % 3], rest=rest()))
        assert told == []
        for i in range(60):
            takes(ended(SCENE.touch(NAMES[i % 3], 200 + i), NAMES[i % 3], rest=rest(0.85)))
        assert [found.kind for found in told] == ["all gains"]
        assert told[0] == learner.health()


def test_by_an_axis_rest_alone_is_noted_and_a_failure_is_warned_of_once(
    memory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warned = list[str]()
    with TactileLearner.open(memory) as learner:
        notes = HealthNotes(learner, None, warned.append, materials=False)
        before = learner.health().touches
        for i in range(2):
            notes.take(ended(SCENE.touch(NAMES[0], 90 + i), "north", rest=rest()))
        assert learner.health().touches == before + 2

        def full(*row: Any) -> None:
            raise StoreError("no space left on device")

        monkeypatch.setattr(TactileLearner, "sense", full)
        for _ in range(3):
            notes.take(ended(SCENE.touch(NAMES[0], 93), "north", rest=rest()))
        assert warned == ["the health of the sensor cannot be told: no space left on device"]


def test_a_damaged_row_is_warned_of_once_and_ends_no_session(memory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told, warned = list[Health](), list[str]()
    with TactileLearner.open(memory) as learner:
        before, rows = learner.health().touches, learner.health

        def damaged() -> Health:
            raise StoreError("row 7 is damaged")

        monkeypatch.setattr(learner, "health", damaged)
        notes = HealthNotes(learner, told.append, warned.append)
        for _ in range(2):
            notes.take(ended(SCENE.touch(NAMES[0], 93), None, known=False, rest=rest()))
        assert warned == ["the health of the sensor cannot be told: row 7 is damaged"]
        assert rows().touches == before + 2


def test_a_session_calls_back(memory: Path) -> None:
    told = list[Health]()
    with TactileLearner.open(memory) as learner:
        before = learner.health().touches
        with learner.live(contact="manual", changed=told.append) as session:
            for i in range(2):
                session.begin()
                session.push(SCENE.touch(NAMES[0], 70 + i).readings)
                state = session.end()
            noted = state.touches[0].decided and state.touches[0].prediction.known is True
        assert learner.health().touches >= before + (2 if noted else 0)
        with learner.batch():
            for i in range(100):
                learner.sense(rest(1.0 if i < 40 else 0.85))
        assert learner.health().since is not None
        with learner.live(contact="manual", changed=told.append) as session:
            for _ in range(2):
                session.begin()
                session.push(SCENE.touch(NAMES[0], 80).readings)
                session.end()
            assert told == [learner.health()]  # once a session, also what was seen before it
