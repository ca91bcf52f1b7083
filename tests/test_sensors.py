import pytest
from pydantic import ValidationError

from scroll_tactile import sensors
from scroll_tactile.sensors import BIOTAC, CONTACTILE, GELSIGHT, ROBOSKIN, Sensor

FIELDS = {
    "name": "skin", "channels": 6, "rate": 50.0, "low": 0.0, "high": 1.0, "unit": "counts", "duration": 5.0,
}  # fmt: skip


def test_known_sensors_by_name():
    assert sensors.known() == {s.name: s for s in (BIOTAC, ROBOSKIN, CONTACTILE, GELSIGHT)}
    assert set(sensors.known()) == {"biotac", "roboskin", "contactile", "gelsight"}


@pytest.mark.parametrize(
    ("sensor", "shape", "readings"),
    [(BIOTAC, (19,), 400), (ROBOSKIN, (60,), 75), (CONTACTILE, (27,), 599), (GELSIGHT, (480, 640, 3), 25)],
)
def test_nominal_shapes(sensor, shape, readings):
    assert sensor.shape == shape
    assert sensor.readings == readings


def test_own_sensor_in_one_line_and_back_from_json():
    skin = Sensor(**FIELDS, layout=(2, 3))
    assert skin.readings == 250
    assert Sensor.model_validate_json(skin.model_dump_json()) == skin
    assert hash(skin) == hash(Sensor(**FIELDS, layout=[2, 3]))


def test_a_sensor_is_frozen():
    with pytest.raises(ValidationError, match="frozen"):
        BIOTAC.rate = 50.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": ""}, "at least 1 character"),
        ({"name": "\ud800"}, "valid string"),
        ({"channels": 0}, "greater than or equal to 1"),
        ({"rate": 0.0}, "greater than 0"),
        ({"rate": float("inf")}, "finite"),
        ({"duration": -1.0}, "greater than 0"),
        ({"low": float("nan")}, "finite"),
        ({"low": 1.0}, "low must lie below high; they are 1 and 1"),
        ({"low": -1e300, "high": 1e300}, "too wide for float32"),
        ({"low": -3e38, "high": 3e38}, "too wide for float32"),
        ({"low": 1e9, "high": 1e9 + 1}, "the same number in float32: rescale"),
        ({"layout": (2, 4)}, r"layout \(2, 4\) holds 8 values, but channels is 6"),
        ({"camera": True}, r"a camera needs layout=\(height, width, 3\); it is None"),
        ({"camera": True, "layout": (3, 2, 1)}, r"it is \(3, 2, 1\)"),
        ({"duration": 0.001}, "0.001 s at 50 Hz holds no reading"),
        ({"colour": "red"}, "Extra inputs"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_reason(change, message):
    with pytest.raises(ValueError, match=message):
        Sensor(**(FIELDS | change))
