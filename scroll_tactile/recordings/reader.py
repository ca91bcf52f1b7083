"""The way in: `read` gives a recording, `iterate` its blocks, `describe` what a file has."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import ChannelCountError, InputError, RecordingError
from scroll_tactile.recordings import presets
from scroll_tactile.recordings.blocks import Block, Contents, Request, Source, guarded
from scroll_tactile.recordings.bounds import require_file
from scroll_tactile.recordings.decoding import definitions_of
from scroll_tactile.recordings.locations import local
from scroll_tactile.recordings.recording import Episode, Gap, Recording, Report, longest_step, only_columns, resampled

__all__ = ["describe", "find", "iterate", "read"]

_DEEPEST = 64  # folders within each other in which recordings are looked for
# Messages come in batches where the median step is below so many seconds, and the latest twentieth of all steps are so
# many times as long: the pauses between batches are no gaps.
_FAST, _BATCH, _LATE = 0.002, 5, 0.95

_Address = str | PathLike[str]
_Definitions = Mapping[str, str] | str | PathLike[str] | None
_Times = npt.NDArray[np.float64]


def read(
    path: _Address,
    *,
    topic: str | None = None,
    field: str | None = None,
    clock: str | None = None,
    columns: str | None = None,
    preset: str | None = None,
    rate: float | None = None,
    labels: str | None = None,
    annotate: Sequence[str] = (),
    resample: float | None = None,
    header: bool | None = None,
    delimiter: str | None = None,
    decimal: str | None = None,
    definitions: _Definitions = None,
) -> Recording:
    """All readings of a file, or of a folder that is one recording.

    path: a ROS 1 `.bag`; a ROS 2 `.db3` or `.mcap`, or the folder of a bag; a LeRobotDataset v2 or v3; `.parquet`
        and `.feather`; HDF5, as robomimic's; a Zarr replay buffer; `.npy`, `.npz` and `.mat`; tables of
        text, `.csv`, `.tsv`, `.txt` and `.dat`; JSON and lines of JSON. Bags in a folder whose names differ in a last
        number alone are one that was split. On this machine, or an address that fsspec knows.
    topic, field: where the numbers are. Of messages and JSON `field` is a path such as `tactiles[0].electrodes`, see
        `paths`; of tables it names columns (`e1:e19`, `e*`, `a,b`), of others an array, with an index behind it
        (`[0:19]`); arrays that a pattern finds in several groups (`run/*/tactile`), and entries of a stack (`x[*]`),
        are episodes, see `arraystores`.
    clock: "device", "header", "publish" or "log"; or a field, column or array with times. Without it the first of these
        that runs; see `Report`.
    columns: those of the readings that are taken, by their places from 0, such as "25:44" or "0,3,5:9".
    preset: a known sensor, in place of topic and field, see `presets`; of a file without topics it is only the sensor.
    rate: in Hz, counts times where a file has no clock.
    labels: a topic with texts, a column, or an array of one text, one an episode, or one a reading: they name episodes.
    annotate: columns or arrays that say something of touches, as headings such as "force [N]" or
        "slip [label]", with " from observation.wrench[2]" behind it where the data set calls it otherwise; they become
        `annotations`.
    resample: a rate in Hz; see `resampled` for the rule. Readings are left as they are without it.
    header, delimiter, decimal: how a table is written, where it does not show.
    definitions: of messages that a bag does not define, a folder of .msg files (`package/msg/Name.msg`, or flat), or
        their texts by the types' names. Presets bring those of their drivers.

    Raises FieldError where topic or field are not there or not given, listing what there is; RecordingError where the
    file is not there, damaged, ragged, empty, of no known format, or claims to hold more than one of its size can (see
    `bounds`); MissingLibraryError where it needs a library that is not installed; ChannelCountError where a preset is
    of another sensor; InputError for a clock that is not there.
    """
    request = Request(
        topic,
        field,
        clock,
        rate,
        labels,
        header,
        delimiter,
        decimal,
        None,
        definitions_of(definitions),
        tuple(annotate),
    )
    address = fspath(path)
    with local(address) as place, guarded(address):
        source = _open(place, address, request, preset)
        whole = _joined(_timed(source, request), source)
        recording = _recording(whole, source, _clock(whole, request.clock), columns)
    _require(recording, preset)
    return recording if resample is None else resampled(recording, resample)


def iterate(
    path: _Address,
    *,
    topic: str | None = None,
    field: str | None = None,
    clock: str | None = None,
    columns: str | None = None,
    preset: str | None = None,
    rate: float | None = None,
    labels: str | None = None,
    header: bool | None = None,
    delimiter: str | None = None,
    decimal: str | None = None,
    definitions: _Definitions = None,
) -> Iterator[Recording]:
    """The readings of a file block by block, as recordings of at most 4096 readings: for files beyond memory.

    Arguments and errors are those of `read`. Blocks come in the order of the file, and each has the report of its own
    readings; the clock is chosen from the first.
    """
    request = Request(
        topic, field, clock, rate, labels, header, delimiter, decimal, definitions=definitions_of(definitions)
    )
    address = fspath(path)
    with local(address) as place:
        with guarded(address):
            source = _open(place, address, request, preset)
            blocks, name = _timed(source, request), request.clock
        while True:
            with guarded(address):
                block = next(blocks, None)
                if block is None:
                    return
                name = _clock(block, name)
                recording = _recording(block, source, name, columns)
                _require(recording, preset)
            yield recording


def describe(path: _Address, *, definitions: _Definitions = None) -> Contents:
    """What a file has: its topics and fields with their shapes and rates, and a line to copy.

    Of a bag the first 2000 messages are looked at. Raises RecordingError as `read` does.
    """
    address = fspath(path)
    with local(address) as place, guarded(address):
        return _open(place, address, Request(definitions=definitions_of(definitions))).contents()


def find(path: _Address) -> list[Path]:
    """The recordings in a local folder and the folders inside it, in the order of their names.

    A file is a recording by its suffix (`.txt`, `.dat` and `.json` where they hold readings), and so is a folder that
    says it is one, as a ROS 2 bag does by its metadata.yaml. Bags beside each other are recordings of their own,
    however they are numbered; `read` takes their folder as one that was split. Raises RecordingError for a path where
    nothing is.
    """
    place = Path(path)
    if not place.exists():
        raise RecordingError(f"expected recordings in {place}; it is not there")
    return _found(place, 0)


def _found(place: Path, depth: int) -> list[Path]:
    from scroll_tactile.recordings import rosbag

    bags_alone = place.is_dir() and not (place / "metadata.yaml").exists() and rosbag.is_rosbag(place)
    if _kind(place) is not None and not bags_alone:
        return [place]
    found: list[Path] = []
    for inside in sorted(place.iterdir()) if place.is_dir() else ():
        if inside.is_symlink() and inside.is_dir():
            continue  # it may lead back here
        if inside.is_dir() and not inside.name.startswith("."):
            found += _found(inside, depth + 1) if depth < _DEEPEST else []
        elif (kind := _kind(inside)) is not None and kind.holds_some(inside):
            found.append(inside)
    return found


def _open(path: Path, address: str, request: Request, preset: str | None = None) -> Source:
    """The reader that knows this file's format, by its name or by what a folder holds.

    A preset says where messages have the numbers; of a file without topics it is only the sensor.
    """
    known = None if preset is None else presets.find(preset)
    kind = _kind(path)
    if kind is None:
        what = "a folder that is none of these" if path.is_dir() else repr(path.name)
        raise RecordingError(
            "expected a recording: .bag, .db3, .mcap, .npy, .npz, .mat, .csv, .json, .parquet, .feather, .h5, .zarr, "
            f"the folder of a ROS 2 bag with its metadata.yaml, or of a LeRobot data set; came {what} at {address}"
        )
    if not path.is_dir():
        require_file(path)
    if known is not None and kind.topics:
        request = replace(request, field=request.field or known.field, likely=known.topic)
    source = kind(path, address, request)
    for name, value, takes in (("topic", request.topic, source.topics), ("labels", request.labels, source.labels)):
        if value is not None and not takes:
            raise InputError(
                f"{address} has no {name}; came {name}={value!r}: give field= alone", argument=f"{name} field"
            )
    if request.annotate and not source.annotate:
        raise InputError(
            f"{address} has no columns to annotate touches by; expected arrays; came "
            f"annotate={request.annotate[0]!r}: give values and labels in a table of intervals=",
            argument="annotate intervals",
        )
    return source


def _kind(path: Path) -> type[Source] | None:
    from scroll_tactile.recordings import arraystores, columnar, delimited, jsonfile, rosbag, zarrfile

    if rosbag.is_rosbag(path):
        return rosbag.RosBag
    if path.is_dir() and columnar.is_lerobot(path):
        return columnar.LeRobot
    if zarrfile.is_zarr(path):
        return zarrfile.ZarrBuffer
    suffix = "" if path.is_dir() else path.suffix.lower()
    readers: dict[type[Source], tuple[str, ...]] = {
        arraystores.Hdf5: (".h5", ".hdf5", ".hdf"),
        arraystores.Npy: (".npy",),
        arraystores.Npz: (".npz",),
        arraystores.Mat: (".mat",),
        columnar.Columnar: (".parquet", ".feather"),
        delimited.Delimited: delimited.SUFFIXES,
        jsonfile.JsonFile: jsonfile.SUFFIXES,
    }
    return next((reader for reader, suffixes in readers.items() if suffix in suffixes), None)


def _timed(source: Source, request: Request) -> Iterator[Block]:
    """The blocks, with times counted at a rate where they have none; from 0 in each episode."""
    if request.rate is not None and not (np.isfinite(request.rate) and request.rate > 0):
        raise InputError(f"expected a positive rate in Hz; came {request.rate!r}")
    last, count = None, 0
    for block in source.blocks():
        if request.rate is not None and not block.clocks:
            length = len(block.readings)
            numbers = block.episodes
            if numbers is None or source.continuous:
                numbers = np.zeros(length, np.int64)
            index = np.arange(count, count + length)
            for begin in np.flatnonzero(np.diff(numbers, prepend=numbers[0] if last is None else last)):
                index[begin:] = np.arange(length - begin)
            last, count = numbers[-1], index[-1] + 1
            block.clocks["rate"] = index / request.rate
        yield block


def _joined(blocks: Iterator[Block], source: Source) -> Block:
    """All blocks as one; raises RecordingError where there are none, or more than a file of this size can hold."""
    parts = []
    for block in blocks:
        source.claim(block.readings.nbytes + sum(column.nbytes for column in block.annotations.values()))
        parts.append(block)
    if not parts:
        raise RecordingError(f"{source.address} holds no readings")
    if len(parts) == 1:
        return parts[0]
    if len({part.readings.shape[1:] for part in parts}) > 1:
        shapes = sorted({part.readings.shape[1:] for part in parts})
        raise RecordingError(f"{source.address}: readings are ragged: they have {shapes} values")

    def whole(name: str) -> dict[str, Any]:
        columns = [getattr(part, name) for part in parts]
        return {key: np.concatenate([column[key] for column in columns]) for key in columns[0]}

    episodes = None if parts[0].episodes is None else np.concatenate([part.episodes for part in parts])
    readings = np.concatenate([part.readings for part in parts])
    return Block(readings, whole("clocks"), whole("counters"), episodes, whole("annotations"))


def _recording(block: Block, source: Source, clock: str | None, columns: str | None) -> Recording:
    readings, times, episodes, report = assemble(block, clock, source)
    report = replace(report, cut_off=source.cut_off, notes=tuple(source.notes))
    within = source.address, source.topic, source.field()
    recording = Recording(*within, readings, times, episodes, report, block.annotations, _names(source, readings))
    return recording if columns is None else only_columns(recording, columns)


def _names(source: Source, readings: npt.NDArray[Any]) -> tuple[str, ...]:
    """The names of a table's columns, as its field lists them; none where it has none, or the field was requested."""
    names = tuple(name.strip() for name in source.field().split(","))
    own = source.request.field is None and not source.topics and readings.ndim == 2
    own = own and 1 < len(names) == len(set(names)) == readings.shape[1]
    return names if own and not all(name.isdigit() for name in names) else ()


def _clock(block: Block, requested: str | None) -> str | None:
    # Arrays and columns call their clock by the name that was requested, or by their only one.
    if requested is not None and requested not in block.clocks and len(block.clocks) == 1 and "log" not in block.clocks:
        return next(iter(block.clocks))
    return choose(block.clocks, requested)


def _require(recording: Recording, name: str | None) -> None:
    """Raises ChannelCountError where the readings are not those of the preset's sensor, naming one that has as many."""
    if name is None:
        return
    sensor, shape = presets.find(name).sensor, recording.readings.shape[1:]
    if sensor.camera != (len(shape) == 3) or (not sensor.camera and shape != sensor.shape):
        alike = [other for other, preset in presets.PRESETS.items() if preset.sensor.shape == shape]
        raise ChannelCountError(
            f"expected readings of {name!r}, shape {sensor.shape}; {recording.place} has {shape}"
            + (f", as of {' or '.join(alike)}" if alike else "")
            + f". {recording.cure(sensor)}",
            argument="columns",
        )


# From blocks to readings with times: which clock to believe, the episodes, the report of gaps and lost readings.


def choose(clocks: dict[str, _Times], requested: str | None) -> str | None:
    """The name of the clock to use: the one requested, or the first that runs; None where there is none.

    Raises InputError for a clock that the recording does not have.
    """
    if requested is not None:
        if requested not in clocks:
            raise InputError(
                f"expected a clock of this recording, {', '.join(clocks) or 'it has none'}; came {requested!r}"
            )
        return requested
    for name, times in clocks.items():
        seen = len(times) and np.isfinite(times).all()
        if name not in {"device", "header"} or (seen and _is_running(name, times)):
            return name
    return None


def _is_running(name: str, times: _Times) -> bool:
    if len(times) == 1 or name == "header":
        return bool((times != 0).all())  # a header that nobody filled in is zero
    return bool(np.ptp(times) > 0)  # a device's clock may begin at zero


def assemble(
    block: Block, clock: str | None, source: Source
) -> tuple[npt.NDArray[Any], npt.NDArray[np.float64], tuple[Episode, ...], Report]:
    """Readings, times by this clock, episodes and the report, from one block.

    Messages are sorted by the time they were logged, as all players do.
    """
    readings, clocks, counters = block.readings, block.clocks, block.counters
    if "log" in clocks and (np.diff(clocks["log"]) < 0).any():
        order = np.argsort(clocks["log"], kind="stable")
        readings = readings[order]
        clocks = {name: times[order] for name, times in clocks.items()}
        counters = {name: counts[order] for name, counts in counters.items()}
    episodes = _spans(clocks["log"], source.marks) if source.marks else _numbered(block.episodes, source)
    begins = [] if source.marks or source.continuous else [episode.begin for episode in episodes if episode.begin]
    times = np.full(len(readings), np.nan) if clock is None else unwrapped(clocks[clock])
    unset = int(np.count_nonzero(clocks["header"] == 0)) if "header" in clocks else 0
    return readings, times, episodes, reported(times, clock, counters, np.array(begins, np.int64), unset)


def unwrapped(times: _Times) -> _Times:
    """Times of a counter of 16 or 32 bits, of s, ms, µs or ns, that goes on from 0 when it is full: as if it had more.

    >>> unwrapped(np.array([65.534, 65.535, 0.0, 0.001])).round(3).tolist()
    [65.534, 65.535, 65.536, 65.537]
    """
    steps = np.diff(times)
    back = np.flatnonzero(steps < 0)
    if len(back) and (steps > 0).any():
        middle = float(np.median(steps[steps > 0]))
        for period in (2.0**bits / unit for bits in (16, 32) for unit in (1, 1e3, 1e6, 1e9)):
            if (abs(steps[back] + period - middle) <= _BATCH * middle).all() and times.max() < period:
                return times + period * np.concatenate([[0], np.cumsum(steps < 0)])
    return times


def _numbered(numbers: npt.NDArray[np.int64] | None, source: Source) -> tuple[Episode, ...]:
    if numbers is None:
        return ()
    borders = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
    spans = [(begin, end, int(numbers[begin])) for begin, end in itertools.pairwise(borders)]
    return tuple(Episode(begin, end, source.names.get(n), source.paths.get(n, "")) for begin, end, n in spans)


def _spans(logged: npt.NDArray[np.float64], marks: list[tuple[float, str]]) -> tuple[Episode, ...]:
    """A label holds from its message to the next; an empty one ends it, and the same again goes on with it."""
    kept: list[tuple[float, str]] = []
    for seconds, text in sorted(marks, key=lambda mark: mark[0]):
        if not kept or kept[-1][1] != text.strip():
            kept.append((seconds, text.strip()))
    begins = np.searchsorted(logged, [seconds for seconds, _ in kept])
    ends = [*begins[1:].tolist(), len(logged)]
    spans = zip(begins.tolist(), ends, kept, strict=True)
    return tuple(Episode(begin, end, text) for begin, end, (_, text) in spans if text and end > begin)


def reported(
    times: _Times,
    clock: str | None,
    counters: Mapping[str, npt.NDArray[np.int64]],
    borders: npt.NDArray[np.int64],
    unset: int,
) -> Report:
    """What times and counters say of readings. borders: the readings before which time begins anew."""
    inside = np.ones(max(len(times) - 1, 0), bool)
    inside[borders - 1] = False
    missing, repeated = _lost(counters, borders)
    report = Report(len(times), clock, lost=missing, unset=unset)
    steps = np.where(inside, np.diff(times), np.nan)
    forward = steps[steps > 0]
    if not np.isfinite(steps).any():
        return replace(report, repeated=repeated)
    again = int(np.count_nonzero(steps == 0))
    middle = float(np.median(forward)) if len(forward) else 0.0
    late = float(np.nanquantile(steps, _LATE))
    batches = middle < _FAST and late > _BATCH * middle
    longest = longest_step(late if batches else middle)
    regular = forward[forward <= min(longest, 2 * middle)]
    counted = forward[(forward >= middle / 2) & (forward <= 1.5 * middle)]
    if batches or again > len(forward):  # from the first batch, or the first new stamp, to the last
        begins = np.flatnonzero((steps > (_BATCH * middle if batches else 0)) & (steps <= longest))
        counted = steps[begins[0] + 1 : begins[-1] + 1] if len(begins) > 1 else steps
        counted = counted[(counted >= 0) & (counted <= longest)]
    seconds = float(counted.sum())
    return replace(
        report,
        rate=len(counted) / seconds if seconds > 0 else None,
        jitter=float(regular.std()) if len(regular) else None,
        gaps=tuple(Gap(int(i) + 1, float(steps[i])) for i in np.flatnonzero(steps > longest)),
        repeated=repeated or again,
        back=tuple(Gap(int(i) + 1, -float(steps[i])) for i in np.flatnonzero(steps < 0)),
    )


def _lost(counters: Mapping[str, npt.NDArray[np.int64]], borders: npt.NDArray[np.int64]) -> tuple[int | None, int]:
    """Lost and repeated readings by the device's counter, or else by the recorder's, if it counts each topic alone."""
    single = {name: int(np.count_nonzero(np.diff(counts) == 1)) for name, counts in counters.items()}
    for name in ("message", "sequence"):
        if name not in counters or len(counters[name]) < 2 or 2 * single[name] < len(counters[name]) - 1:
            continue  # what seldom goes on by one is no counter
        if name == "sequence" and single["all"] > single[name]:
            continue  # it counts all topics, so that nobody knows whose messages are lost
        found = [lost(part) for part in np.split(counters[name], borders)]
        return sum(missing for missing, _ in found), sum(repeated for _, repeated in found)
    return None, 0


def lost(counts: npt.NDArray[np.int64]) -> tuple[int, int]:
    """How many readings a counter says were lost, and how many came again.

    A counter of 8, 16 or 32 bits wraps; one that goes back anywhere else has begun anew.
    """
    steps = np.diff(counts)
    for bits in (8, 16, 32):
        wraps = (
            (steps < 0)
            & (counts[:-1] >= 2**bits - 2**bits // 8)
            & (counts[:-1] < 2**bits)
            & (counts[1:] < 2**bits // 8)
        )
        steps[wraps] += 2**bits
    return int((steps[steps > 1] - 1).sum()), int(np.count_nonzero(steps == 0))
