"""Some columns of arrays and tables; and presets where there are no topics."""

import h5py
import numpy as np
import pytest

from scroll_tactile import sensors
from scroll_tactile.errors import ChannelCountError, FieldError
from scroll_tactile.recordings import iterate, read
from scroll_tactile.recordings.recording import places

ROWS = np.arange(6 * 44, dtype=np.float64).reshape(6, 44)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The same 44 columns in each format without topics; the table has times before them."""
    folder = tmp_path_factory.mktemp("columns")
    np.save(folder / "t.npy", ROWS)
    table = np.column_stack([np.arange(6) / 100, ROWS])
    names = ",".join(["time", *(f"e{i}" for i in range(44))])
    np.savetxt(folder / "t.csv", table, delimiter=",", header=names, comments="", fmt="%.17g")
    with h5py.File(folder / "t.h5", "w") as file:
        file["tactile"] = ROWS
    return folder


@pytest.mark.parametrize("name", ["t.npy", "t.csv", "t.h5"])
def test_columns_are_taken_by_their_places(folder, name):
    recording = read(folder / name, columns="25:44")
    np.testing.assert_array_equal(recording.readings, ROWS[:, 25:44])
    several = read(folder / name, columns="0, 3,5:9,42:")
    np.testing.assert_array_equal(several.readings, ROWS[:, [0, 3, 5, 6, 7, 8, 42, 43]])
    np.testing.assert_array_equal(
        np.concatenate([part.readings for part in iterate(folder / name, columns=":2")]), ROWS[:, :2]
    )


@pytest.mark.parametrize("name", ["t.npy", "t.csv", "t.h5"])
def test_a_preset_is_its_sensor_where_there_are_no_topics(folder, name):
    assert read(folder / name, preset="biotac", columns="25:44").stream(sensors.BIOTAC).readings.shape == (6, 19)
    said = r"expected readings of 'biotac', shape \(19,\); .*has \(44,\)\. .*Some of its columns .* columns='0:19'"
    with pytest.raises(ChannelCountError, match=said):
        read(folder / name, preset="biotac")
    with pytest.raises(ChannelCountError, match="columns='0:19'"):
        read(folder / name).stream(sensors.BIOTAC)


@pytest.mark.parametrize("columns", ["44", "25:45", "9:9", "9:8", "0,44", "100000:"])
def test_columns_that_are_not_there_are_refused(folder, columns):
    with pytest.raises(FieldError, match=r"t\.npy: columns \S+ are not there: expected places from 0 to 43"):
        read(folder / "t.npy", columns=columns)


@pytest.mark.parametrize("columns", ["", "a", "-1", "1:2:3", "1;2", "1,", "9" * 40])
def test_what_names_no_columns_is_refused(columns):
    with pytest.raises(FieldError, match="expected columns such as 25:44"):
        places(columns, 10)


def test_pictures_have_no_columns(tmp_path):
    np.save(tmp_path / "p.npy", np.zeros((2, 4, 5, 3), np.uint8))
    with pytest.raises(FieldError, match="has pictures"):
        read(tmp_path / "p.npy", columns="0:2")
