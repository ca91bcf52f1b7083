"""Streams in files: `.npy` arrays and `.csv` tables, one row a reading."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.sensors import Sensor, known

__all__ = ["read_sensor", "read_stream", "require_readable"]


def read_stream(path: Path) -> npt.NDArray[Any]:
    """The readings in a file: the array of a `.npy`, or the cells of a `.csv`, float64 of shape (T, n).

    A first row of a table without any number in it is a header and is left out. Cells are separated by commas,
    semicolons or tabs.

    Raises InputError for another kind of file, one that is not there or cannot be read, and for a cell that is no
    number, naming its row (from 1, as an editor shows it) and column.
    """
    if not path.is_file():
        raise InputError(f"expected a stream in {path}; " + ("it is a folder" if path.is_dir() else "it is not there"))
    if path.suffix.lower() == ".npy":
        return _read_npy(path)
    if path.suffix.lower() == ".csv":
        return _read_csv(path)
    raise InputError(f"expected a stream in a .npy or .csv file; came {path.name!r}")


def _read_npy(path: Path) -> npt.NDArray[Any]:
    try:
        array = np.load(path, allow_pickle=False)
    except Exception as error:  # damaged bytes make numpy's parser fail in many ways
        raise InputError(f"{path} cannot be read as .npy, and may be damaged or half copied: {error}") from error
    if not isinstance(array, np.ndarray):
        raise InputError(f"expected one array in {path}; it is an archive of several, an .npz")
    return array


def _read_csv(path: Path) -> npt.NDArray[np.float64]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read as text: {error}") from error
    first = text.partition("\n")[0]
    separator = next((mark for mark in ";\t" if mark in first), ",")
    reader = csv.reader(text.splitlines(), delimiter=separator)
    try:
        lines = [(reader.line_num, cells) for cells in reader if any(cell.strip() for cell in cells)]
    except csv.Error as error:
        raise InputError(f"{path} cannot be read as a table: {error}. Is a quotation mark never closed?") from error
    if lines and not any(_is_number(cell) for cell in lines[0][1]):
        lines = lines[1:]
    if not lines:
        raise InputError(f"expected readings in {path}, one row each; there are none")
    width = len(lines[0][1])
    rows = np.empty((len(lines), width))
    for i, (line, cells) in enumerate(lines):
        if len(cells) != width:
            raise InputError(f"{path}, row {line}: expected {width} cells as in the rows before it; came {len(cells)}")
        for column, cell in enumerate(cells):
            if not _is_number(cell):
                raise InputError(f"{path}, row {line}, column {column + 1}: expected a number; came {cell!r:.60}")
            rows[i, column] = float(cell)
    return rows


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def require_readable(readings: npt.NDArray[Any], sensor: Sensor) -> None:
    """Raise StreamError for readings that a new memory of the sensor would refuse."""
    from scroll_tactile.learner import TactileLearner

    TactileLearner(sensor=sensor).predict(readings)  # without anything observed it embeds nothing


def read_sensor(text: str) -> Sensor:
    """A sensor by its name, or from a JSON file of its fields.

    Raises InputError for an unknown name, a file that is not there, or fields that do not fit together.
    """
    sensors = known()
    if text in sensors:
        return sensors[text]
    path = Path(text)
    if not path.is_file():
        raise InputError(f"expected a sensor, one of {', '.join(sensors)}, or a JSON file of its fields; came {text!r}")
    try:
        return Sensor.model_validate_json(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:  # pydantic's errors are ValueErrors, of a line for each field
        what = "; ".join(line.strip() for line in str(error).splitlines() if not line.strip().startswith("For further"))
        raise InputError(f"{path} does not describe a sensor: {what}") from error
