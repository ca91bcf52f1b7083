import numpy as np
import pytest
from pydantic import ValidationError

from scroll_tactile import sensors
from scroll_tactile.errors import InputError
from scroll_tactile.sensors import BIOTAC, BIOTAC_ALL, CONTACTILE, GELSIGHT, ROBOSKIN, Sensor
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import validate

FIELDS = {
    "name": "skin", "channels": 6, "rate": 50.0, "low": 0.0, "high": 1.0, "unit": "counts", "duration": 5.0,
}  # fmt: skip


def test_known_sensors_by_name():
    assert sensors.known() == {s.name: s for s in (BIOTAC, BIOTAC_ALL, ROBOSKIN, CONTACTILE, GELSIGHT)}
    assert set(sensors.known()) == {"biotac", "biotac-all", "roboskin", "contactile", "gelsight"}


@pytest.mark.parametrize(
    ("sensor", "shape", "readings"),
    [
        (BIOTAC, (19,), 400),
        (BIOTAC_ALL, (25,), 400),
        (ROBOSKIN, (60,), 75),
        (CONTACTILE, (27,), 599),
        (GELSIGHT, (480, 640, 3), 25),
    ],
)
def test_nominal_shapes(sensor, shape, readings):
    assert sensor.shape == shape
    assert sensor.readings == readings


def test_presets_are_what_their_fields_would_make():
    for sensor in sensors.known().values():
        assert Sensor.model_validate(sensor.model_dump()) == sensor


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
        ({"rate": 1e300, "duration": 1e-298}, "less than or equal to 1000000"),
        ({"duration": 1e300}, r"1e\+300 s at 50 Hz holds more readings than can be counted"),
        ({"duration": 1e308}, r"1e\+308 s at 50 Hz holds more readings than can be counted"),
        ({"colour": "red"}, "Extra inputs"),
        ({"low": (0.0,) * 5}, "low has 5 entries for 6 channels: give one, or one each"),
        ({"high": (1.0,) * 7}, "high has 7 entries for 6 channels"),
        ({"unit": ("V",) * 5}, "unit has 5 entries for 6 channels"),
        ({"low": (0.0, 0.0, 0.0, 1.0, 0.0, 0.0)}, "low must lie below high in channel 3; they are 1 and 1"),
        ({"low": 1.0, "high": (2.0, 2.0, 2.0, 2.0, 2.0, 0.5)}, "low must lie below high in channel 5"),
        ({"high": (1e9, 1.0, 1.0, 1.0, 1.0, 1e300)}, "in channel 5 is too wide for float32"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_reason(change, message):
    with pytest.raises(ValueError, match=message):
        Sensor(**(FIELDS | change))


def test_fields_that_are_missing_are_named_in_one_sentence():
    with pytest.raises(InputError) as met:
        Sensor(name="x")
    assert str(met.value) == (
        "sensor 'x' needs channels, rate, low, high, unit and duration, too: `scroll-tactile sensor FILES` guesses "
        "them from recordings of it"
    )


def test_names_of_columns_tell_no_sensors_apart_and_are_kept():
    skin, named = Sensor(**FIELDS), Sensor(**FIELDS, columns=list("abcdef"))
    assert skin == named and hash(skin) == hash(named)
    assert Sensor.model_validate_json(named.model_dump_json()).columns == tuple("abcdef")
    assert "columns" not in skin.model_dump()
    with pytest.raises(InputError, match="columns has 2 entries for 6 channels"):
        Sensor(**FIELDS, columns=("a", "b"))


MIXED = Sensor(
    name="imu", channels=2, rate=50.0, low=(-1.0, 0.0), high=(1.0, 1000.0), unit=("rad/s", "mV"), duration=1.0
)


def test_channels_may_have_ranges_of_their_own():
    readings = np.tile([0.5, 1500.0], (50, 1))
    readings[0] = [-3.0, 250.0]
    stream = validate(readings, MIXED)
    assert stream.clipped == 50  # the first reading's one channel, and the other channel of the other 49
    assert stream.readings[0].tolist() == [-1.0, 250.0]
    image = tactile_image(stream)
    assert image[:, 0].tolist() == [-1.0, -0.5]
    assert image[:, 1].tolist() == [0.5, 1.0]


def test_a_number_means_all_channels_to_the_bit():
    one = Sensor(**FIELDS)
    each = Sensor(**(FIELDS | {"low": (one.low,) * 6, "high": (one.high,) * 6, "unit": (one.unit,) * 6}))
    readings = np.random.default_rng(0).uniform(-20, 300, (50, 6))
    assert tactile_image(validate(readings, one)).tobytes() == tactile_image(validate(readings, each)).tobytes()
    assert Sensor.model_validate_json(each.model_dump_json()) == each
    assert one.model_dump(mode="json")["low"] == one.low


def test_a_sensor_that_misses_values_says_so_in_json():
    skin = Sensor(**FIELDS)
    missing = Sensor(**FIELDS, non_finite="missing")
    assert missing.model_dump(mode="json") == skin.model_dump(mode="json") | {"non_finite": "missing"}
    for sensor in (skin, missing):
        assert Sensor.model_validate_json(sensor.model_dump_json()) == sensor
    assert missing != skin
    with pytest.raises(InputError, match="'refused' or 'missing'"):
        Sensor(**FIELDS, non_finite="ignored")


def test_a_camera_has_one_range():
    fields = {"name": "eye", "channels": 12, "rate": 5.0, "high": 1.0, "unit": "1", "duration": 1.0, "camera": True}
    with pytest.raises(InputError, match="a camera has one low for all its pixels"):
        Sensor(**fields, layout=(2, 2, 3), low=(0.0,) * 12)


def test_a_sensor_is_read_by_its_name_or_from_a_file(tmp_path):
    assert sensors.read_sensor("roboskin") == ROBOSKIN
    (tmp_path / "s.json").write_text(CONTACTILE.model_dump_json())
    assert sensors.read_sensor(str(tmp_path / "s.json")) == CONTACTILE
    (tmp_path / "s.json").write_text('{"name": "x", "channels": 0}')
    with pytest.raises(InputError, match="channels"):
        sensors.read_sensor(str(tmp_path / "s.json"))
    with pytest.raises(InputError, match="one of biotac"):
        sensors.read_sensor("biotacc")
