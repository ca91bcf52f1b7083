"""Fabrics under a Contactile array, touched by a robot and by hand: what a published data set has to look like.

The paper's set (Zandonati et al. 2023: 32 fabrics, six constituents; protocol 1, a robot, 40 touches of each, protocol
2, a hand, 10 of each; 27 channels for 599 readings at 100 Hz) is not public. This reads it, and any of its kind with
other numbers of fabrics, touches, readings and constituents, from a folder such as::

    compositions.csv              fabric,cotton,elastane,polyester,…   one line for each fabric
    protocol1/denim/00.npy        one file for each touch, .npy or .csv
    protocol2/denim/00.npy

**Files.** The path below the folder says fabric and protocol, in one of three ways, or in one's own (`pattern`)::

    protocol1/denim/00.npy        denim/protocol1/00.npy        denim_protocol1_00.npy

The protocol is called protocol1, protocol_1, p1 or robot; protocol2, protocol_2, p2 or hand; case is of no account. An
array is (T, 27), (27, T) or (T, 9, 3): nine pillars of three axes, pillar by pillar, x, y and z. A .csv has one reading
a line, or one channel a line, with or without a line of names; a first column called t, time or timestamp is left out.

**Compositions.** Shares by mass, as parts of one or as percent, in the whole table alike. 0 is absent; an empty cell is
unknown, which is not the same. Shares of a fabric sum to one, to within a rounding of 1 %, and are then made to; those
of a fabric with empty cells sum to one at most.

**Range.** The array's range is not published either, so CONTACTILE's ±10 N is wide. Where readings lie outside it, or
use next to none of it, `limits` gives the true one; it is in whatever unit the files are in.
"""

from __future__ import annotations

import csv
import logging
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from examples.paper.fabric.compositions_table import read_compositions
from examples.paper.readers.labelled import Recordings
from scroll_tactile.errors import DatasetError, InputError
from scroll_tactile.sensors import CONTACTILE, Sensor
from scroll_tactile.signals.stream import Stream, validate

__all__ = ["LAYOUTS", "TABLE", "Fabrics", "load"]

logger = logging.getLogger(__name__)

TABLE = "compositions.csv"
_PROTOCOL = r"(?P<protocol>protocol[ _-]?[12]|p[12]|robot|hand)"
LAYOUTS = tuple(
    form.format(protocol=_PROTOCOL, fabric="(?P<fabric>[^/]+)", sample=r"(?P<sample>[^/]+)")
    for form in (
        "(?:.*/)?{protocol}/{fabric}/{sample}",
        "(?:.*/)?{fabric}/{protocol}/{sample}",
        "(?:.*/)?{fabric}[_-]{protocol}[_-]{sample}",
    )
)
"""The paths that are understood, without their ending: regular expressions, of which the first that fits counts."""

_FOLDS = 5
_AXES = 3
_MOST_CLIPPED = 0.001  # of all values: more is another range, not a glitch
_LEAST_USED = 0.02  # of the range, by the largest reading of all


@dataclass(frozen=True, eq=False)
class Fabrics:
    """recordings: of N touches. protocol: 1 or 2, int of shape (N,).

    compositions: of each fabric, constituent → share by mass, 0 where it is absent and None where it is unknown.
    """

    recordings: Recordings
    protocol: npt.NDArray[np.int64]
    compositions: dict[str, dict[str, float | None]]

    @property
    def constituents(self) -> tuple[str, ...]:
        """Their names, in the order of the table."""
        return tuple(next(iter(self.compositions.values())))


def load(
    root: str | Path,
    seed: int = 0,
    *,
    table: str | Path | None = None,
    pattern: str | None = None,
    limits: tuple[float, float] | None = None,
    constituents: Collection[str] | None = None,
) -> Fabrics:
    """Read the touches of a folder and the compositions of what was touched; see the module for the layout.

    seed: deals the touches of each fabric, under each protocol, into five folds. table: the file of compositions,
    `compositions.csv` in the folder where none is given. pattern: a regular expression for the path of a touch below
    the folder, without its ending and with / between folders; its groups `fabric` and `protocol` say what it is.
    limits: least and largest reading that the array gives, in the files' unit. constituents: which columns of the table
    these are; all but the first where none are named.

    Raises DatasetError, which names the file, for a folder or table that is not there, files whose path says no fabric
    and protocol, arrays of other shapes, not numbers or not finite, readings outside the limits, fabrics that the table
    does not have or that only it has, and a table that does not say compositions; InputError for a negative seed, a
    pattern without these groups, or limits that are none.
    """
    if seed < 0:
        raise InputError(f"expected a seed of 0 or more; came {seed}")
    folder = Path(root).expanduser()
    patterns = _patterns(pattern)
    sensor = _sensor(limits)
    if not folder.is_dir():
        raise DatasetError(f"expected a folder of touches at {folder}; there is none. {_WANTED}")
    source = folder / TABLE if table is None else Path(table).expanduser()
    compositions = read_compositions(source, constituents)
    touches = sorted(_named(folder, source, patterns))
    if not touches:
        raise DatasetError(f"expected touches, .npy or .csv, in {folder}; there are none. {_WANTED}")
    _require_same(folder, source, {fabric for fabric, *_ in touches}, compositions)
    read = [_read(path, sensor) for *_, path in touches]
    streams = [stream for stream, *_ in read]
    clipped = sum(stream.clipped for stream in streams) / sum(stream.readings.size for stream in streams)
    _require_range(folder, min(least for _, least, _ in read), max(most for *_, most in read), clipped, sensor)
    groups = [(fabric, protocol) for fabric, protocol, *_ in touches]
    within, fold = _dealt(groups, sorted(compositions), seed)
    names = [fabric for fabric, _ in groups]
    recordings = Recordings(folder.resolve().name, sensor, streams, names, within, fold, ordered=False)
    return Fabrics(recordings, np.array([protocol for _, protocol in groups], dtype=np.int64), compositions)


_WANTED = (
    "Wanted is a folder with compositions.csv and, for example, protocol1/FABRIC/00.npy; "
    "examples.paper.fabric.fabrics_set says what else is taken"
)


def _patterns(pattern: str | None) -> list[re.Pattern[str]]:
    try:
        made = [re.compile(expression, re.IGNORECASE) for expression in ([pattern] if pattern is not None else LAYOUTS)]
    except re.error as error:
        raise InputError(f"expected a regular expression as the pattern; {pattern!r} is none: {error}") from error
    missing = {"fabric", "protocol"} - set(made[0].groupindex)
    if missing:
        raise InputError(
            f"expected a pattern with the groups (?P<fabric>…) and (?P<protocol>…); {pattern!r} lacks {sorted(missing)}"
        )
    return made


def _sensor(limits: tuple[float, float] | None) -> Sensor:
    if limits is None:
        return CONTACTILE
    try:
        return Sensor.model_validate(CONTACTILE.model_dump() | {"low": limits[0], "high": limits[1]})
    except (ValueError, IndexError, TypeError) as error:
        raise InputError(f"expected limits as a least and a larger reading, both finite; came {limits!r}") from error


def _named(
    folder: Path, table: Path, patterns: Iterable[re.Pattern[str]]
) -> Iterable[tuple[str, int, list[Any], Path]]:
    """Fabric, protocol, a key that puts 10 behind 9, and path of every touch."""
    for path in folder.rglob("*"):
        if path.suffix.lower() not in (".npy", ".csv") or path.resolve() == table.resolve():
            continue
        below = path.relative_to(folder).with_suffix("").as_posix()
        found = next((match for expression in patterns if (match := expression.fullmatch(below))), None)
        if found is None or not found["fabric"] or not found["protocol"]:
            raise DatasetError(
                f"expected the path of {path} to say fabric and protocol, such as protocol1/FABRIC/00.npy, "
                "FABRIC/protocol1/00.npy or FABRIC_protocol1_00.npy. Move it, or give a pattern of your own"
            )
        side = found["protocol"].lower()
        protocol = 1 if side == "robot" else 2 if side == "hand" else int(side[-1]) if side[-1:] in ("1", "2") else 0
        if not protocol:
            raise DatasetError(
                f"expected {path} to be of protocol 1 (robot) or 2 (hand); it says {found['protocol']!r}"
            )
        order = [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", below) if part]
        yield found["fabric"], protocol, order, path


def _require_same(folder: Path, table: Path, touched: set[str], described: Mapping[str, object]) -> None:
    undescribed, untouched = sorted(touched - set(described)), sorted(set(described) - touched)
    if undescribed:
        raise DatasetError(
            f"expected the composition of every fabric in {table}; {_few(undescribed)} of {folder} are not there. It "
            f"has {_few(sorted(described))}"
        )
    if untouched:
        raise DatasetError(
            f"expected touches of every fabric that {table} describes; of {_few(untouched)} there are none in {folder}."
            " Are files missing, or names written otherwise?"
        )


def _few(names: list[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _read(path: Path, sensor: Sensor) -> tuple[Stream, float, float]:
    """A touch, and its least and largest reading before any was clipped."""
    array = _cells(path) if path.suffix.lower() == ".csv" else _array(path)
    channels = sensor.channels
    if array.ndim == 3 and array.shape[1:] == (channels // _AXES, _AXES):
        array = array.reshape(len(array), channels)
    if array.ndim != 2 or (array.shape == (channels, channels)) or channels not in array.shape:
        raise DatasetError(
            f"expected an array of shape (T, {channels}), ({channels}, T) or (T, {channels // _AXES}, {_AXES}), "
            f"usually ({sensor.readings}, {channels}), in {path}; came {array.shape}"
        )
    try:
        stream = validate(array if array.shape[1] == channels else array.T, sensor)
    except InputError as error:
        raise DatasetError(f"{path} holds no sound readings: {error}") from error
    return stream, float(array.min()), float(array.max())


def _array(path: Path) -> npt.NDArray[Any]:
    try:
        array = np.load(path, allow_pickle=False)
    except Exception as error:  # damaged bytes make numpy's reader fail in any way
        raise DatasetError(f"expected an array in {path}; it cannot be read, and may be damaged: {error}") from error
    if not isinstance(array, np.ndarray):
        raise DatasetError(f"expected an array in {path}; it holds a {type(array).__name__}")
    return array


def _cells(path: Path) -> npt.NDArray[np.float64]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [row for row in csv.reader(file) if row]
        timed = bool(rows) and rows[0][0].strip().lower() in ("t", "time", "timestamp")
        # A line of names, or of pandas' names for columns without any: 0, 1, 2 …
        if rows and (not _number(rows[0][-1]) or rows[0][timed:] == [str(i) for i in range(len(rows[0]) - timed)]):
            rows = rows[1:]
        return np.array([row[timed:] for row in rows], dtype=np.float64)
    except (OSError, ValueError, UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(
            f"expected rows of as many numbers in {path}; it cannot be read, and may be damaged: {error}"
        ) from error


def _number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _require_range(folder: Path, least: float, most: float, clipped: float, sensor: Sensor) -> None:
    wanted = f"{sensor.low:g} to {sensor.high:g} {sensor.unit}"
    if clipped > _MOST_CLIPPED:
        raise DatasetError(
            f"expected readings in {folder} from {wanted}; they reach from {least:g} to {most:g}, {100 * clipped:.1f} "
            "% of them outside. Give the limits of the array that they are of"
        )
    if max(abs(least), abs(most)) < _LEAST_USED * float(np.ptp(sensor.limits)) / 2:
        logger.warning(
            "the readings in %s reach from %g to %g only, and are scaled as from %s: give the true limits",
            *(folder, least, most, wanted),
        )


def _dealt(
    groups: list[tuple[str, int]], fabrics: list[str], seed: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """For N touches in order: which of its fabric and protocol each is, and the fold that it is dealt into."""
    within, fold = [], []
    for fabric, protocol in dict.fromkeys(groups):
        count = groups.count((fabric, protocol))
        within.append(np.arange(count))
        random = np.random.default_rng([seed, fabrics.index(fabric), protocol])
        fold.append(random.permutation(np.arange(count) % _FOLDS))
    return np.concatenate(within).astype(np.int64), np.concatenate(fold).astype(np.int64)
