"""Files of readings and of sensors."""

from pathlib import Path

import numpy as np
import pytest

from scroll_tactile import sensors
from scroll_tactile.errors import InputError
from scroll_tactile.recordings.arrays import read_sensor, read_stream


def test_a_table_with_and_without_a_header(tmp_path: Path) -> None:
    for name, text in (("plain", "1,2\n3,4\n"), ("head", "\ufeffa;b\n1;2\n\n3;4\n"), ("tabs", "x\ty\n1\t2\n3\t4")):
        (tmp_path / f"{name}.csv").write_text(text, encoding="utf-8")
        np.testing.assert_array_equal(read_stream(tmp_path / f"{name}.csv"), [[1, 2], [3, 4]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n3,x\n", r"row 3, column 2: expected a number; came 'x'"),
        ("1,\n", r"row 1, column 2: expected a number; came ''"),
        ("1,2\n\n3\n", r"row 3: expected 2 cells"),
        ("a,b\n", "there are none"),
        ("", "there are none"),
        ('"' + "1,2\n" * 50_000, "table: field larger than"),  # a quotation mark that never closes
    ],
)
def test_a_bad_cell_is_named_by_row_and_column(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_stream(tmp_path / "t.csv")


def test_files_that_are_no_streams(tmp_path: Path) -> None:
    (tmp_path / "bad.npy").write_bytes(b"\x93NUMPY broken")
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "t.txt").write_text("1")
    np.savez(tmp_path / "z.npz", a=np.zeros(3))
    (tmp_path / "z.npz").rename(tmp_path / "z.npy")
    np.save(tmp_path / "o.npy", np.array([{}], dtype=object), allow_pickle=True)
    for name in ("bad.npy", "b.csv", "t.txt", "z.npy", "o.npy", "none.npy", ""):
        with pytest.raises(InputError):
            read_stream(tmp_path / name)


def test_a_sensor_by_name_or_file(tmp_path: Path) -> None:
    assert read_sensor("roboskin") == sensors.ROBOSKIN
    (tmp_path / "s.json").write_text(sensors.CONTACTILE.model_dump_json())
    assert read_sensor(str(tmp_path / "s.json")) == sensors.CONTACTILE
    (tmp_path / "s.json").write_text('{"name": "x", "channels": 0}')
    with pytest.raises(InputError, match="channels"):
        read_sensor(str(tmp_path / "s.json"))
    with pytest.raises(InputError, match="one of biotac"):
        read_sensor("biotacc")
