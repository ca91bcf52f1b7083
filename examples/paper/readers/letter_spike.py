"""letter-spike: Braille letters pressed by an event-based skin, 27 classes of 50 presses each.

Published as github.com/tasbolat1/letter-spike (Telluride 2021, NUSkin on a robot arm), in this layout::

    data/{A..Z,space}/{letter}_{0..49}.csv     events: timestamp (s), isNeg, taxel_id (1..80), adc (0..1023)

A taxel sends its value when it changes, and a harder press is a smaller value. So between two events of a taxel its
value stays what it was: binned, a press is a stream of pressures, 1023 − adc. Each letter is six dots, and each dot a
constituent that is there or not, so letters stand in for fabrics: new letters are known by dots that were pressed.
"""

from __future__ import annotations

import csv
import logging
from pathlib import Path

import numpy as np
import numpy.typing as npt

from examples.paper.readers.labelled import Recordings
from scroll_tactile.errors import DatasetError, InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream, validate

__all__ = ["DOTS", "GRID", "LETTERS", "NUSKIN", "dots_of", "letter_folds", "load", "read_events", "stream_of"]

logger = logging.getLogger(__name__)

SOURCE = "github.com/tasbolat1/letter-spike"
LETTERS = (*"ABCDEFGHIJKLMNOPQRSTUVWXYZ", "space")
DOTS = tuple(f"dot{number}" for number in range(1, 7))
"""The constituents: dots 1 to 3 down the left column of a Braille cell, 4 to 6 down the right one."""

GRID = (8, 10)
"""Rows and columns of taxels under the fingertip, in the order of a stream's channels."""

REST = 1023  # of the converter: no pressure
NUSKIN = Sensor(
    name="nuskin",
    channels=80,
    rate=62.5,  # 16 ms, the shortest time between two events of a taxel
    low=0.0,
    high=float(REST),
    unit="counts",
    duration=4.0,  # from the first contact on; a press and its release take 2.4 to 3.6 s
    layout=GRID,
)
"""The fingertip: 80 taxels, pressures in counts of the converter below its value at rest."""

_FIRST_TEN = ("1", "12", "14", "145", "15", "124", "1245", "125", "24", "245")  # A to J
_FOLDS = 5
_PRESSES = 50
_COLUMNS = ["timestamp", "isNeg", "taxel_id", "adc"]


def dots_of(letter: str) -> dict[str, bool]:
    """Which of the six dots a letter has, as `TactileLearner.describe` takes it; all False for "space".

    K to T are A to J with dot 3, U, V, X, Y and Z are A to E with dots 3 and 6, and W, which French has not, is J with
    dot 6. Raises InputError for what is no letter here.
    """
    if letter not in LETTERS:
        raise InputError(f"expected a letter out of A to Z, or 'space'; came {letter!r}")
    raised = ""
    if letter == "W":
        raised = _FIRST_TEN[9] + "6"
    elif letter != "space":
        place = "ABCDEFGHIJKLMNOPQRSTUVXYZ".index(letter)
        raised = _FIRST_TEN[place % 10] + ("", "3", "36")[place // 10]
    return {dot: dot[-1] in raised for dot in DOTS}


def letter_folds(folds: int, seed: int = 0) -> list[list[str]]:
    """The letters dealt into so many groups: the letters of a group are evaluated without being observed.

    Raises InputError for fewer than 2 groups, more than there are letters, or a negative seed.
    """
    if not 2 <= folds <= len(LETTERS) or seed < 0:
        raise InputError(
            f"expected 2 to {len(LETTERS)} groups of letters and a seed of 0 or more; came {folds}, {seed}"
        )
    order = np.random.default_rng([seed, folds]).permutation(len(LETTERS))
    return [sorted(LETTERS[i] for i in order[first::folds]) for first in range(folds)]


def load(root: str | Path, seed: int = 0, *, seconds: float = 3.0) -> Recordings:
    """Read all presses as streams of (rate · seconds, 80) pressures, the channels in the order of `GRID`.

    root: the folder of the data set, or the one it lies in. seed: deals each letter's presses into five folds.
    seconds: from the first event on; a press that ends earlier stays as it ended.

    Files without events (two of K are so published) are left out, each with a warning that names it. Raises
    DatasetError for a file that is missing or not as published, InputError for a negative seed or no seconds.
    """
    if seed < 0:
        raise InputError(f"expected a seed of 0 or more; came {seed}")
    folder = _find(Path(root).expanduser())
    streams: list[Stream] = []
    materials: list[str] = []
    repetitions: list[int] = []
    for letter in LETTERS:
        for press in range(_PRESSES):
            path = folder / letter / f"{letter}_{press}.csv"
            events = read_events(path)
            if not len(events):
                logger.warning("%s holds no events, and is left out", path)
                continue
            streams.append(stream_of(events, seconds))
            materials.append(letter)
            repetitions.append(press)
    numbers = np.array(repetitions, dtype=np.int64)
    dealt = {
        letter: np.random.default_rng([seed, i]).permutation(np.arange(_PRESSES) % _FOLDS)
        for i, letter in enumerate(LETTERS)
    }
    fold = np.array([dealt[letter][press] for letter, press in zip(materials, repetitions, strict=True)], np.int64)
    return Recordings("letter-spike", NUSKIN, streams, materials, numbers, fold, ordered=True)


def read_events(path: Path) -> npt.NDArray[np.float64]:
    """The events of one file in the order of time: (time in s, taxel 1 to 80, adc), shape (N, 3), N ≥ 0.

    Events of no taxel (an id of −1, which the hardware sends now and then) are left out. Raises DatasetError.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [row for row in csv.reader(file) if row]
    except FileNotFoundError as error:
        raise DatasetError(
            f"expected events in {path}; there is no such file. The layout is that of {SOURCE}"
        ) from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(f"expected events in {path}; it cannot be read: {error}") from error
    if rows and [cell.strip() for cell in rows[0]] != _COLUMNS:
        raise DatasetError(f"expected {path} to begin with the columns {_COLUMNS}; it begins with {rows[0]}")
    try:
        events = np.array([[float(row[0]), int(row[2]), int(row[3])] for row in rows[1:]]).reshape(-1, 3)
    except (ValueError, IndexError) as error:
        raise DatasetError(f"expected numbers in four columns of {path}; it may be damaged: {error}") from error
    events = events[events[:, 1] > 0]
    if not np.isfinite(events).all() or (events[:, 1] > NUSKIN.channels).any():
        raise DatasetError(f"expected finite numbers, and taxels 1 to {NUSKIN.channels}, in {path}; there are others")
    return events[np.argsort(events[:, 0], kind="stable")]


def stream_of(events: npt.NDArray[np.float64], seconds: float = 3.0) -> Stream:
    """A press as a stream: in each bin of 16 ms from its first event on, the last value that each taxel sent.

    events: as of `read_events`, N ≥ 1. Raises StreamTooShortError, an InputError, for less than two bins.
    """
    count = round(seconds * NUSKIN.rate)
    bins = np.floor((events[:, 0] - events[0, 0]) * NUSKIN.rate).astype(np.int64)
    within = bins < count
    sent = np.zeros((count, NUSKIN.channels), dtype=bool)
    value = np.zeros((count, NUSKIN.channels))
    places = _places()[events[within, 1].astype(np.int64) - 1]
    sent[bins[within], places] = True
    value[bins[within], places] = REST - events[within, 2]  # of several in a bin the last is assigned last
    # Where nothing was sent, the row of the last that was; row 0 holds rest where it was not.
    latest = np.maximum.accumulate(np.where(sent, np.arange(count)[:, None], 0), axis=0)
    return validate(np.take_along_axis(value, latest, axis=0), NUSKIN)


def _places() -> npt.NDArray[np.intp]:
    """Channel of each taxel, in the order of their ids.

    The skin is four blocks of 4 × 5. In the upper ones ids rise along a row and fall from row to row, in the lower ones
    it is the other way about. The publisher draws ids 1 to 40 on the left; a letter that lies across the edge comes out
    in one piece only with them on the right, so they are.
    """
    grid = np.empty(GRID, dtype=np.intp)
    along, rows = np.arange(5), 5 * np.arange(4)[:, None]
    for block, upper, lower in ((slice(5, 10), 36, 5), (slice(0, 5), 56, 65)):
        grid[:4, block] = upper - rows + along
        grid[4:, block] = lower + rows - along
    places = np.empty(NUSKIN.channels, dtype=np.intp)
    places[grid.reshape(-1) - 1] = np.arange(NUSKIN.channels)
    return places


def _find(root: Path) -> Path:
    for folder in (root / "data", root / "letter-spike" / "data"):
        if (folder / "A").is_dir():
            return folder
    raise DatasetError(
        f"expected {root} to be the folder letter-spike, with data/A to data/Z in it, or to hold it; "
        + ("it is and does not" if root.is_dir() else "there is no such folder")
        + f". Get it from {SOURCE}"
    )
