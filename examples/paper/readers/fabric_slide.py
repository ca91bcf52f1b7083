"""FabricSlide: seven fabrics slid over by a capacitive finger at set forces and speeds, 966 slides.

Published as github.com/wngfra/FabricSlide (MIT licence), in this layout::

    data/fabric/{fabric}_F{force}_V{speed}mmps_{repetition}.csv

with a header, then timestamp (ms), two proximities and 16 channels at about 36 Hz. Force 120 to 250 is in the
publisher's unit; the speed, 10 to 150 mm/s, is negative one way and positive the other. A slide covers the same
distance at any speed, so the slower it is the longer: 4 to 59 s.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from examples.paper.readers.labelled import Recordings
from scroll_tactile.errors import DatasetError, InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream, validate

__all__ = ["BALANCED", "CPM_FINGER", "CPM_RATIOS", "FABRICS", "Slides", "load", "protocol_of", "ratios"]

SOURCE = "github.com/wngfra/FabricSlide"
FABRICS = ("BeigeCotton", "BrownCotton", "Canvas", "Denim", "DenimFlex", "Linen", "WovenFabric")
BALANCED = ("BeigeCotton", "BrownCotton", "Canvas", "Linen")
"""The fabrics slid over at every force and speed, 180 slides each; of the others some are missing."""

CPM_FINGER = Sensor(
    name="cpm-finger",
    channels=16,
    rate=36.0,  # 28 or 29 ms between two readings
    low=0.0,
    high=700.0,  # the published slides lie between 20 and 619
    unit="counts",
    duration=4.0,  # of the fastest slides
)
"""The 16 capacitive channels of the finger."""

CPM_RATIOS = Sensor(
    name="cpm-finger-ratios",
    channels=16,
    rate=36.0,  # of a slide of 4 s; of others it is the distance between two readings that is the same
    low=-1.5,
    high=1.5,
    unit="ln",
    duration=5.3,  # so that the widest window, three quarters of it, is a slide
)
"""The finger's channels as natural logarithms of their ratios to the mean of all, over distance."""

_PLACES = 144  # readings of a slide over distance: those of a fast one
_FOLDS = 5
_FIRST = 3  # columns before the channels
_NAME = re.compile(r"(?P<fabric>[A-Za-z]+)_F(?P<force>\d+)_V(?P<speed>-?\d+)mmps_(?P<repetition>\d+)")


@dataclass(frozen=True, eq=False)
class Slides:
    """recordings: the streams. force: in the publisher's unit, and speed: in mm/s, signed, both int of shape (N,)."""

    recordings: Recordings
    force: npt.NDArray[np.int64]
    speed: npt.NDArray[np.int64]


def protocol_of(path: Path) -> tuple[str, int, int, int]:
    """Fabric, force, speed and repetition, as a file's name tells them. Raises DatasetError where it does not."""
    found = _NAME.fullmatch(path.stem)
    if found is None:
        raise DatasetError(f"expected a name such as Linen_F120_V-50mmps_0.csv; came {path}")
    return found["fabric"], int(found["force"]), int(found["speed"]), int(found["repetition"])


def load(root: str | Path, fabrics: Collection[str] = BALANCED, seed: int = 0) -> Slides:
    """Read the slides over some fabrics: streams of (141 to 2117, 16) counts.

    root: the folder of the data set, or the one it lies in. seed: deals each fabric's slides into five folds.

    Raises DatasetError for a folder that is not there or holds no slide over one of the fabrics, a name that tells no
    force and speed, and a file that is not as published; InputError for a negative seed or a fabric that there is not.
    """
    if seed < 0:
        raise InputError(f"expected a seed of 0 or more; came {seed}")
    strange = sorted(set(fabrics) - set(FABRICS))
    if strange or not fabrics:
        raise InputError(f"expected fabrics out of {list(FABRICS)}; came {strange or 'none'}")
    folder = _find(Path(root).expanduser())
    found = sorted((protocol_of(path), path) for path in folder.glob("*.csv"))
    chosen = [(protocol, path) for protocol, path in found if protocol[0] in fabrics]
    missing = sorted(set(fabrics) - {protocol[0] for protocol, _ in chosen})
    if missing:
        raise DatasetError(f"expected slides over {missing} in {folder}; there are none. Get them from {SOURCE}")
    names = [protocol[0] for protocol, _ in chosen]
    within = np.concatenate([np.arange(names.count(name)) for name in dict.fromkeys(names)])
    fold = np.concatenate(
        [
            np.random.default_rng([seed, FABRICS.index(name)]).permutation(np.arange(names.count(name)) % _FOLDS)
            for name in dict.fromkeys(names)
        ]
    )
    streams = [_read(path) for _, path in chosen]
    recordings = Recordings("FabricSlide", CPM_FINGER, streams, names, within, fold, ordered=False)
    force, speed = (np.array([protocol[i] for protocol, _ in chosen], dtype=np.int64) for i in (1, 2))
    return Slides(recordings, force, speed)


def ratios(slide: Stream) -> Stream:
    """A slide without its speed and force: (144, 16) logarithms of ratios, at places evenly spread over the distance.

    Pressing harder raises all channels together, which the logarithm of each one's ratio to their geometric mean
    leaves out; going faster makes the same distance shorter, and each place is the mean of the readings there.

    slide: of `CPM_FINGER`, at least 2 readings. Raises InputError for another sensor's stream.
    """
    slide = validate(slide, CPM_FINGER)
    logs = np.log(np.maximum(slide.readings.astype(np.float64), 1.0))
    logs -= logs.mean(axis=1, keepdims=True)
    # The integral of the readings, taken between the places' edges: exact for slow slides and for fast ones.
    total = np.concatenate([np.zeros((1, logs.shape[1])), np.cumsum(logs, axis=0)])
    edges = np.linspace(0, len(logs), _PLACES + 1)
    totals = np.stack([np.interp(edges, np.arange(len(total)), column) for column in total.T], axis=1)
    return validate(np.diff(totals, axis=0) * (_PLACES / len(logs)), CPM_RATIOS)


def _read(path: Path) -> Stream:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [row for row in csv.reader(file) if row]
        header, cells = [cell.strip() for cell in rows[0]], np.array(rows[1:], dtype=np.float64)
    except (OSError, ValueError, IndexError, UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(
            f"expected a header and rows of numbers in {path}; it cannot be read, and may be damaged: {error}"
        ) from error
    width = _FIRST + CPM_FINGER.channels
    if len(header) != width or header[_FIRST] != "channel1" or cells.ndim != 2 or cells.shape[1] != width:
        raise DatasetError(
            f"expected {width} columns in {path}, timestamp, two proximities and channel1 to channel16; came "
            f"{len(header)}: {header[:4]} …, and rows of shape {cells.shape}"
        )
    try:
        return validate(cells[:, _FIRST:], CPM_FINGER)
    except InputError as error:
        raise DatasetError(f"{path} holds no sound readings: {error}") from error


def _find(root: Path) -> Path:
    for folder in (root / "data" / "fabric", root / "FabricSlide" / "data" / "fabric"):
        if folder.is_dir():
            return folder
    raise DatasetError(
        f"expected {root} to be the folder FabricSlide, with data/fabric in it, or to hold it; "
        + ("it is and does not" if root.is_dir() else "there is no such folder")
        + f". Get it from {SOURCE}"
    )
