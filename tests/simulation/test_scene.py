import random as python_random

import numpy as np
import pytest
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.model_selection import cross_val_score
from sklearn.neighbors import NearestCentroid
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from scroll_tactile.errors import InputError, StreamTooShortError, UnknownMaterialError
from scroll_tactile.sensors import BIOTAC, CONTACTILE, GELSIGHT, ROBOSKIN, Sensor
from scroll_tactile.simulation.scene import EVENT_SKIN, LIGHT_PAD, MATERIALS, Scene

SCENE = Scene(sensor=BIOTAC)


SMALL = {"rate": 33.0, "low": 0, "high": 1, "unit": "counts", "duration": 1}


@pytest.mark.parametrize(
    "sensor", [BIOTAC, ROBOSKIN, CONTACTILE, *(Sensor(name="s", channels=n, **SMALL) for n in (1, 300))]
)
def test_a_touch_is_a_sound_stream_of_the_usual_duration(sensor):
    stream = Scene(sensor=sensor).touch("wool", 3)
    assert stream.readings.shape == (sensor.readings, sensor.channels)
    assert stream.clipped == 0
    assert (stream.readings.std(axis=0) > 0).all()
    if sensor is BIOTAC:
        assert np.array_equal(stream.readings, np.round(stream.readings))  # counts are whole
    if sensor.high == 1:
        assert len(np.unique(stream.readings)) > 10  # a range of 0 to 1 is not read in whole counts


def test_a_touch_depends_on_its_arguments_alone():
    state, numpy_state = python_random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002 the state must stay
    first = SCENE.touch("tile", 4)
    SCENE.touch("bark", 0)
    Scene(sensor=ROBOSKIN, seed=5).touch("tile", 4)
    assert Scene(sensor=BIOTAC, seed=0).touch("tile", 4) == first
    assert python_random.getstate() == state
    assert np.random.get_state()[1].tolist() == numpy_state  # noqa: NPY002 see above
    touches = [SCENE.touch("tile", 5), SCENE.touch("wool", 4), Scene(sensor=BIOTAC, seed=1).touch("tile", 4)]
    assert len({stream.key for stream in [first, *touches]}) == 4
    assert len({SCENE.touch(material, 0).key for material in SCENE.materials}) == len(MATERIALS) == 20
    assert Scene(sensor=BIOTAC, response="pressure").touch("tile", 4).key == first.key


def test_seconds_speed_and_force_do_what_they_say():
    assert SCENE.touch("linen", 0, seconds=1.5).readings.shape == (150, 19)
    soft, hard = (SCENE.touch("linen", 0, force=force).readings[100:].mean() for force in (0.5, 2.0))
    assert soft < hard
    slow, fast = (SCENE.touch("linen", 0, speed=speed).readings[100:] for speed in (10.0, 80.0))
    changes = [np.abs(np.diff(readings, axis=0)).mean() for readings in (slow, fast)]
    assert changes[0] < 0.7 * changes[1]


@pytest.mark.parametrize("heading", [0.0, 180.0])
def test_channels_farther_along_feel_the_surface_earlier(heading):
    line = Sensor(name="line", channels=3, rate=500, low=0, high=4095, unit="counts", duration=4, layout=(1, 3))
    touch = Scene(sensor=line).touch("nylon", 0, speed=20.0, heading=heading)
    readings = touch.readings[500:].astype(float)
    readings -= readings.mean(axis=0)
    near, far = readings[:, 1], readings[:, 0 if heading else 2]  # 14/3 mm apart: 0.233 s at 20 mm/s, 117 readings
    lags = np.arange(60, 180)
    matched = [np.corrcoef(far[:-lag], near[lag:])[0, 1] for lag in lags]
    assert max(matched) > 0.9
    assert abs(lags[int(np.argmax(matched))] - 117) < 8


def test_channels_across_the_heading_feel_the_surface_at_once():
    square = Sensor(name="square", channels=4, rate=500, low=0, high=4095, unit="counts", duration=4, layout=(2, 2))
    for heading, together in ((0.0, (0, 2)), (90.0, (0, 1)), (270.0, (2, 3))):
        touch = Scene(sensor=square).touch("nylon", 0, speed=20.0, heading=heading).readings[500:].astype(float)
        alike = np.corrcoef(touch.T)
        other = {0, 1, 2, 3} - {together[0], 3 - together[0]} - {together[1]}
        assert alike[together] > 0.9 > max(alike[together[0], place] for place in other)
    assert Scene(sensor=square).touch("nylon", 0, heading=360.0) == Scene(sensor=square).touch("nylon", 0)


@pytest.mark.parametrize("sensor", [BIOTAC, ROBOSKIN])
def test_materials_differ_by_spectrum_but_hardly_by_mean(sensor):
    scene = Scene(sensor=sensor)
    streams = [scene.touch(material, repetition) for material in MATERIALS for repetition in range(10)]
    labels = np.repeat(np.arange(20), 10)
    readings = np.stack([stream.readings for stream in streams])
    settled = readings[:, readings.shape[1] // 6 :]
    window = np.hanning(settled.shape[1])[:, None]
    spectra = np.abs(np.fft.rfft((settled - settled.mean(axis=1, keepdims=True)) * window, axis=1)).mean(axis=2)
    mean = make_pipeline(StandardScaler(), NearestCentroid())
    lda = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")
    assert 0.15 < cross_val_score(mean, readings.mean(axis=1), labels).mean() < 0.7
    assert cross_val_score(lda, np.log(spectra + 1e-3), labels).mean() > 0.95


def test_what_cannot_be_simulated_is_refused_with_the_reason():
    with pytest.raises(InputError, match="'gelsight' is a camera, which the simulator does not model"):
        Scene(sensor=GELSIGHT)
    with pytest.raises(InputError, match="pressure, events, light; came 'loud'"):
        Scene(sensor=BIOTAC, response="loud")
    with pytest.raises(InputError, match="seed of 0 or more; came -1"):
        Scene(sensor=BIOTAC, seed=-1)
    with pytest.raises(UnknownMaterialError, match=r"expected one of the scene's materials, bark, .*; came 'jelly'"):
        SCENE.touch("jelly", 0)
    with pytest.raises(InputError, match="repetition of 0 or more; came -1"):
        SCENE.touch("bark", -1)
    for name in ("seconds", "speed", "force"):
        for value in (0.0, -1.0, np.inf, np.nan):
            with pytest.raises(InputError, match=f"expected {name} above 0 and finite; came {value}"):
                SCENE.touch("bark", 0, **{name: value})
    with pytest.raises(InputError, match="expected a finite heading, in degrees; came inf"):
        SCENE.touch("bark", 0, heading=np.inf)
    with pytest.raises(StreamTooShortError, match="at least 2 readings"):
        SCENE.touch("bark", 0, seconds=0.001)


def test_a_skin_of_events_is_binary_and_mostly_quiet():
    scene = Scene(sensor=EVENT_SKIN, response="events")
    touches = np.stack([scene.touch(material, i).readings for material in MATERIALS for i in range(3)])
    assert set(np.unique(touches)) == {0.0, 1.0}
    assert 0.4 < np.mean(touches.max(axis=1) == 0) < 0.9  # of the channels of a touch
    assert touches.sum(axis=(1, 2)).min() > 20
    assert not scene.rest.any()
    assert not scene.noise(np.random.default_rng(0), 5).any()


def test_a_light_contact_is_a_tenth_of_a_usual_one_on_an_offset_that_wanders():
    light, usual = (Scene(sensor=LIGHT_PAD, response=response) for response in ("light", "pressure"))
    spans = [np.ptp(scene.touch("cork", 0).readings, axis=0).mean() / 4095 for scene in (light, usual)]
    assert spans[0] < spans[1] / 2
    offsets = [light.touch("cork", i).readings[-1] - light.touch("cork", i + 1).readings[-1] for i in range(5)]
    assert 0.01 < np.abs(offsets).mean() / 4095 < 0.1
