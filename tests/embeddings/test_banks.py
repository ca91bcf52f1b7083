"""The thresholds that come with the package are those that would be made. Run as a script, it writes them."""

import numpy as np
import pytest

from scroll_tactile import Scene, TactileLearner, sensors
from scroll_tactile.embeddings import convolution

PRESETS = [sensor for sensor in sensors.known().values() if not sensor.camera]


def thresholds(name: str) -> np.ndarray:
    """As made anew, in whole numbers: half less than they are."""
    _, seed, channels, dilation = map(int, name.split("-"))
    convolution.bank.cache_clear()
    made = convolution.bank(seed, channels, dilation).thresholds - np.float32(0.5)
    assert (made == np.rint(made)).all()
    return made.astype(np.int32)


def learn_and_ask(sensor: sensors.Sensor) -> None:
    scene = Scene(sensor=sensor)
    with TactileLearner(sensor=sensor) as learner:
        for material in ("felt", "oak"):
            learner.observe(material, scene.touch(material, 0))
        for seconds in (0.3, sensor.duration):
            learner.predict(scene.touch("oak", 1).first(seconds))


@pytest.mark.parametrize("sensor", PRESETS, ids=lambda sensor: sensor.name)
def test_a_preset_makes_no_thresholds(sensor, monkeypatch):
    monkeypatch.setattr(convolution, "_thresholds", lambda *_: pytest.fail("made"))
    monkeypatch.setattr(convolution, "_kept_thresholds", lambda *_: pytest.fail("from the cache"))
    convolution.bank.cache_clear()
    learn_and_ask(sensor)


def test_they_are_what_would_be_made(monkeypatch):
    shipped = dict(np.load(convolution.SHIPPED))
    monkeypatch.setattr(convolution, "_shipped_thresholds", lambda _: None)
    monkeypatch.setattr(convolution, "_kept_thresholds", lambda *_: None)
    assert shipped
    assert all(np.array_equal(thresholds(name), kept) for name, kept in shipped.items())
    convolution.bank.cache_clear()


if __name__ == "__main__":
    convolution._shipped_thresholds = convolution._kept_thresholds = lambda *_: None
    asked: list[str] = []
    convolution._keep = lambda name, _: asked.append(name)
    for preset in PRESETS:
        learn_and_ask(preset)
    np.savez_compressed(convolution.SHIPPED, **{name: thresholds(name) for name in sorted(set(asked))})
