"""Files, folders and addresses as touches with names: where they lie, how each is read and cut, and what is refused."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice, pairwise
from pathlib import Path, PurePosixPath
from typing import Any, Literal, Self

import numpy as np
from scroll_tactile_store.archive import ARCHIVE_BYTES, is_archive
from scroll_tactile_store.layout import CURRENT_FILE, holds_store

from scroll_tactile.embeddings.protocol import capabilities_of
from scroll_tactile.errors import AnnotationError, InputError, RecordingError, SensorMismatchError, printable
from scroll_tactile.learner import TactileLearner
from scroll_tactile.live.detector import contact_spans
from scroll_tactile.quantities import Quantity
from scroll_tactile.recordings import Interval, Recording, Touch, find, iterate, presets, read, resampled, touches
from scroll_tactile.recordings.headings import Heading, Noted, noted_in
from scroll_tactile.recordings.locations import file_system, is_remote
from scroll_tactile.recordings.recording import in_order, require_columns
from scroll_tactile.recordings.touches import require_found
from scroll_tactile.sensors import Sensor
from scroll_tactile.settings import LONGEST_SOURCE, require_name
from scroll_tactile.signals.facts import Fact
from scroll_tactile.signals.stream import Stream
from scroll_tactile.signals.windows import SHORTEST

__all__ = [
    "Cut",
    "Refused",
    "SourceOptions",
    "SourceTouch",
    "find_sources",
    "is_memory",
    "source_touches",
    "stored_source",
]

RECORDINGS = (
    ".bag", ".db3", ".mcap", ".npy", ".npz", ".mat", ".csv", ".tsv", ".jsonl", ".h5", ".hdf5", ".parquet", ".feather",
)  # fmt: skip
PACKED = (".part",)  # what is looked for in a remote folder: the names that packed memories have
_LOOKED = 3  # sources are looked at for the names of columns
WHOLE = ("metadata.yaml", "meta/info.json", ".zgroup", "zarr.json")  # in a folder that is one recording

Cut = Literal["episodes", "intervals", "none", "contact"]

_FOLDER = re.compile(r"folder:(\d{1,4})", re.ASCII)
_BY = ("topic", "file", "folder", "task")


@dataclass(frozen=True)
class SourceOptions:
    """How sources are read, cut into touches, and named.

    topic, field, clock, columns, definitions, delimiter, decimal, preset, labels, annotate: as of `recordings.read`.
    cut: None cuts by the intervals where there are some, by episodes where a recording has some, and not otherwise.
    material: the name of all touches. by: what names each touch, as of `recordings.touches`, or "folder:2", the second
    folder below one of `tops`, see `among`. intervals: the table's. At most one of the three names them; without any,
    episodes name themselves. quantities: that are declared before anything is learned, as the table's headings do
    (`recordings.declared_quantities`), beside those of `annotate`.
    rate: what becomes of a recording that has another rate than the sensor by its times: "keep" takes its numbers as
    they are, whatever its times say, "resample" a reading each step of the sensor's; unless given it is refused where
    they differ by a fifth or more.
    names: the channels' columns, by which tables with names are read, and names_of who has them; see `by_names`.

    The value of a touch in a column that annotates it is the mean of the touch's readings that have a number there, its
    label the one text that they have: a touch with two is refused.

    Raises InputError for what does not fit together, MaterialError for a material that is none.
    """

    topic: str | None = None
    field: str | None = None
    clock: str | None = None
    columns: str | None = None
    definitions: Mapping[str, str] | Path | None = None
    delimiter: str | None = None
    decimal: str | None = None
    preset: str | None = None
    labels: str | None = None
    annotate: Sequence[str] = ()
    cut: Cut | None = None
    material: str | None = None
    by: str | None = None
    intervals: Sequence[Interval] | None = None
    quantities: Sequence[Quantity] = ()
    rate: Literal["keep", "resample"] | None = None
    names: Sequence[str] = ()
    names_of: str = ""
    tops: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if sum(given is not None for given in (self.material, self.by, self.intervals)) > 1:
            raise InputError(
                "touches can be named in one way: by one of material=, by= and intervals=",
                argument="material by intervals",
            )
        if self.by is not None and self.by not in _BY and re.fullmatch(r"(folder|group):\d{1,4}", self.by) is None:
            expected = ", ".join(map(repr, _BY))
            raise InputError(f"expected by={expected}, 'folder:2' or 'group:2'; came {self.by!r:.60}", argument="by")
        if self.material is not None:
            require_name(self.material)
        if self.preset is not None:
            presets.find(self.preset)
        if self.columns is not None:
            require_columns(self.columns)
        if self.rate not in (None, "keep", "resample"):
            raise InputError(f"expected rate='keep' or 'resample'; came {self.rate!r:.60}", argument="rate")
        if self.cut == "intervals" and self.intervals is None:
            raise InputError(
                "cut='intervals' takes intervals=, a table with columns file, begin, end and material",
                argument="cut intervals",
            )
        if self.intervals is not None and self.cut not in (None, "intervals"):
            raise InputError(f"intervals= cuts by itself; came cut={self.cut!r} beside it", argument="intervals cut")
        names = [Heading.parsed(text).name for text in self.annotate]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise InputError(
                f"expected each quantity and axis once in annotate=; came {twice[0]!r} several times",
                argument="annotate",
            )

    def among(self, sources: Sequence[str], paths: Sequence[str]) -> Self:
        """These options for the sources that were found in some paths, below which "folder:2" counts.

        Raises InputError for an interval whose file is none of the sources, or several, and for by="folder" where
        folders name no materials: they are numbers alone, or one name lies in several folders.
        """
        files = [each for each in sources if (self.intervals or self.by == "folder") and not is_memory(each)]
        require_found(self.intervals or (), files)
        placed = replace(self, tops=tuple(paths))
        if self.by == "folder":
            placed._require_folders(files)
        return placed

    def folders(self, source: str) -> list[str]:
        """The folders from the path that was typed down to a source; those in its path where it was typed itself."""
        own, top = _parts(source)[:-1], self._top(source)
        return own[len(top) :] or own[-1:]

    def _top(self, source: str) -> list[str]:
        own, tops = _parts(source)[:-1], map(_parts, self.tops)
        return max((top for top in tops if own[: len(top)] == top), key=len, default=[])

    def _require_folders(self, sources: Sequence[str]) -> None:
        found = [self.folders(source) for source in sources]
        places: dict[tuple[str, str], set[str]] = {}  # of a name below each path that was typed
        for source, folders in zip(sources, found, strict=True):
            if folders:
                places.setdefault((folders[-1], "/".join(self._top(source))), set()).add("/".join(folders[:-1]))
        numbers = [name for name, _ in places if not any(map(str.isalpha, name))]
        several = [name for (name, _), above in places.items() if len(above) > 1]
        if not numbers and not several:
            return
        why = f"{numbers[0]!r} is a number" if numbers else f"{several[0]!r} lies in several folders"
        levels = []
        for level in range(1, max(map(len, found)) + 1):
            names = list(dict.fromkeys(folders[level - 1] for folders in found if len(folders) >= level))
            levels.append(f"by='folder:{level}' for {', '.join(names[:3])}{' …' if len(names) > 3 else ''}")
        raise InputError(
            f"expected folders named by material; {why}. Say which of them name it: {'; '.join(levels)}",
            argument="by",
        )

    @property
    def declared(self) -> list[Quantity]:
        """All quantities that are declared before anything is learned."""
        of_columns = (Heading.parsed(text).quantity for text in self.annotate)
        return [*self.quantities, *filter(None, of_columns)]

    @property
    def _where(self) -> dict[str, Any]:
        names = ("topic", "field", "clock", "definitions", "delimiter", "decimal", "preset", "labels")
        return {name: getattr(self, name) for name in names}

    def by_names(self, sources: Sequence[str], sensor: Sensor) -> SourceOptions:
        """The options with the names of the sensor's columns, or else of those of the first source that can be read."""
        if self.columns is not None or self.names_of or sensor.camera:
            return self
        if sensor.columns:
            return replace(self, names=sensor.columns, names_of=f"sensor {sensor.name!r}")
        for address in islice((source for source in sources if not is_memory(source)), _LOOKED):
            with suppress(InputError, OSError):
                names = next(iterate(address, **self._where)).names
                return replace(self, names=names if len(names) == sensor.channels else (), names_of=address)
        return self

    def recording(self, address: str, sensor: Sensor) -> tuple[Recording, list[Fact]]:
        """A source as the sensor's recording, and what is odd about it.

        Raises what `recordings.read` raises, and RecordingError for another rate and for other columns.
        """
        rate = sensor.rate  # where it has no clock
        recording = read(address, **self._where, columns=self.columns, annotate=self.annotate, rate=rate)
        recording, facts = in_order(recording, self.names, self.names_of)
        for fact in recording.facts(sensor):
            if (fact.kind == "rate" and self.rate is not None) or (fact.argument == "rate" and self.rate == "keep"):
                continue
            if fact.then == "refused":
                raise fact.error()
            facts.append(fact)
        if self.rate == "resample" and recording.report.clock not in (None, "rate"):
            recording = resampled(recording, sensor.rate, recording.breaks(sensor))
        return recording, facts

    def touches_in(self, recording: Recording, learner: TactileLearner) -> tuple[Touch | Refused, ...]:
        """The touches in a recording, each in one piece by its times, and those whose pieces are too short.

        Raises what `recordings.touches` raises.
        """
        if self.intervals is not None:
            found = touches(recording, self.intervals)
        else:
            whole = self.cut == "none" or (self.cut is None and not recording.episodes)
            cut: Any = partial(_contacts, learner) if self.cut == "contact" else "whole" if whole else "episodes"
            found = touches(recording, cut, None if (level := _FOLDER.fullmatch(self.by or "")) else self.by)
            if level:
                name = self._folder(recording.source, int(level[1]))
                found = tuple(replace(touch, material=name) for touch in found)
        breaks = [] if self.rate == "keep" else recording.breaks(learner.sensor)
        return tuple(piece for touch in found for piece in _pieces(touch, breaks, learner.sensor))

    def _folder(self, source: str, level: int) -> str:
        """The name of a folder above a source, counted from the path that was typed. Raises InputError for none."""
        folders = self.folders(source)
        if not 0 < level <= len(folders):
            there = ", ".join(f"by='folder:{i + 1}', {name}" for i, name in enumerate(folders))
            raise InputError(f"it has no folder {level}; expected {there or 'by=file'}", argument="by")
        return folders[level - 1]


def _pieces(touch: Touch, breaks: Sequence[int], sensor: Sensor) -> Iterator[Touch | Refused]:
    """A touch, or those parts of it between breaks that are long enough; it is refused where none is."""
    inside = [at for at in breaks if touch.begin < at < touch.end]
    parts = list(pairwise([touch.begin, *inside, touch.end]))
    long = [part for part in parts if not inside or part[1] - part[0] >= max(2, SHORTEST * sensor.rate)]
    if not long:
        why = (
            f"gaps in its times, or steps back, leave {len(parts)} parts of it, none of {SHORTEST:g} s: give another "
            "clock=, or take it in one, rate='keep'"
        )
        yield Refused(stored_source(f"{touch.source}[{touch.begin}:{touch.end}]"), why, "clock rate")
    for begin, end in long:
        own = slice(begin - touch.begin, end - touch.begin)
        yield replace(touch, begin=begin, end=end, readings=touch.readings[own], times=touch.times[own])


def _contacts(learner: TactileLearner, recording: Recording) -> list[tuple[int, int]]:
    """Begin and end of each contact in a recording; raises InputError for none, and for another sensor's readings."""
    sensor, rest = learner.sensor, capabilities_of(learner.embedding).rest
    gaps = [gap.index for gap in recording.report.gaps]
    if recording.readings[:1].size != sensor.channels:
        recording.numbers(sensor)
    kind = np.float32 if sensor.camera else np.float64
    readings = recording.readings.reshape(len(recording), *sensor.shape).astype(kind, copy=False)
    spans = contact_spans(sensor, rest, readings, gaps)
    if not spans:
        raise InputError(
            f"no contact was found in {recording.source}: it has to begin at rest, for two seconds or more, from which "
            "the sensor's noise is learned. For a file of one touch take cut='none'",
            argument="cut",
        )
    return spans


def _parts(address: str) -> list[str]:
    """The parts of a path or an address, without what stands for this folder or the root."""
    path = PurePosixPath(address.partition("://")[2] if is_remote(address) else Path(address).as_posix())
    return [part for part in path.parts if part not in ("/", "..", ".")]


@dataclass(frozen=True)
class Refused:
    """A source, or a touch in one, that could not be taken, and why. argument: as of the error that says so."""

    source: str
    why: str
    argument: str | None = None

    @classmethod
    def by(cls, error: Exception, source: str) -> Refused:
        """What an error refuses."""
        return cls(source, str(error).removeprefix(f"{source}: "), getattr(error, "argument", None))

    def error(self) -> InputError:
        """The error of a command that has this source alone."""
        why = self.why if self.source in self.why else f"{self.source}: {self.why}"
        return InputError(why, argument=self.argument)


@dataclass(frozen=True)
class SourceTouch:
    """A touch out of a source: where it comes from, what names it (None where nothing does), its stream, and its notes.

    values, labels: as of `TactileLearner.observe`. facts: what is odd about it; with the first of a recording also what
    is odd about that.
    """

    source: str
    material: str | None
    stream: Stream
    values: Mapping[str, float] = field(default_factory=dict)
    labels: Mapping[str, str] = field(default_factory=dict)
    facts: Sequence[Fact] = ()


def source_touches(
    learner: TactileLearner, address: str, options: SourceOptions, *, named: bool = True
) -> Iterator[SourceTouch | Refused]:
    """The touches in a source, sound for this learner; what is not is refused.

    named: whether a touch that nothing names is refused.
    """
    try:
        recording, facts = options.recording(address, learner.sensor)
        found = options.touches_in(recording, learner)
    except (InputError, OSError) as error:
        yield Refused.by(error, address)
        return
    for touch in found:
        if isinstance(touch, Refused):
            yield touch
            continue
        source = _source(recording, touch, options)
        try:
            material = options.material if options.material is not None else touch.material
            if named and material is None:
                raise InputError(
                    "nothing names it: give material= for all, by='folder', by='file' or intervals=",
                    argument="material by intervals",
                )
            part = replace(recording, readings=touch.readings, times=touch.times, episodes=())
            stream = learner.stream(part.numbers(learner.sensor))
            noted = Noted(touch.values, touch.labels) + noted_in(recording.annotations, touch.begin, touch.end)
            name = None if material is None else require_name(material)
            yield SourceTouch(
                source=source,
                material=name,
                stream=stream,
                values=_values(noted, learner.quantities),
                labels=dict(noted.labels),
                facts=(*facts, *learner._facts_of(stream, source=source)),
            )
            facts = []
        except (InputError, SensorMismatchError) as error:
            yield Refused.by(error, source)


def _values(noted: Noted, quantities: Mapping[str, Quantity]) -> dict[str, float]:
    """What was measured of a touch. Raises AnnotationError for another unit than a quantity's."""
    for name, unit, value in noted.values:
        if name in quantities and quantities[name].unit != unit:
            raise AnnotationError(
                f"expected {name!r} in {quantities[name].unit}, as it was declared; came {value:g} {unit}: convert the "
                f"column, and head it {name} [{quantities[name].unit}]"
            )
    return {name: value for name, _, value in noted.values}


def _source(recording: Recording, touch: Touch, options: SourceOptions) -> str:
    """The path as it was given, the readings where they are not all, topic and field where several, and columns."""
    whole = (touch.begin, touch.end) == (0, len(recording))
    where = recording.source + ("" if whole else f"[{touch.begin}:{touch.end}]")
    within = [recording.topic, recording.field] if recording.topic is not None else [options.field]
    return stored_source(" ".join([where, *(part for part in (*within, options.columns) if part)]))


def stored_source(source: str) -> str:
    """What a memory keeps of a source's name: printable, and bounded."""
    text = printable(source)
    return text if len(text) <= LONGEST_SOURCE else f"…{text[1 - LONGEST_SOURCE :]}"


def find_sources(paths: Sequence[str]) -> tuple[list[str], list[Refused]]:
    """The recordings and memories in files, folders and addresses, each once and in order; and where there are none."""
    found: dict[object, str] = {}
    refused = []
    for path in paths:
        try:
            for source in _sources_in(path):
                found.setdefault(source if is_remote(source) else Path(source).resolve(), source)
        except (InputError, OSError) as error:
            refused.append(Refused.by(error, path))
    return list(found.values()), refused


def _sources_in(path: str) -> list[str]:
    """As `find_sources`, at one path. Raises InputError or OSError where there is none."""
    if is_remote(path):
        try:
            listed = _listed(path)
        except RecordingError:
            raise
        except Exception as error:  # each file system has errors of its own
            raise RecordingError(f"it cannot be listed: {type(error).__name__}: {error!s:.300}") from error
        if not listed:
            raise RecordingError("expected recordings or memories; nothing is there")
        return listed
    if is_memory(path):
        return [path]
    if not (inside := find(path)):
        what = "there is none in this folder" if Path(path).is_dir() else "a file of this kind is none"
        raise RecordingError(f"expected recordings: {what}")
    return list(map(str, inside))


def is_memory(address: str) -> bool:
    """Whether an address is that of a memory, in a folder or packed; what cannot be looked at is none."""
    try:
        return _is_remote_memory(address) if is_remote(address) else _is_local_memory(Path(address))
    except Exception:  # each file system has errors of its own; reading it raises what is wrong
        return False


def _is_local_memory(path: Path) -> bool:
    if path.is_dir():
        return holds_store(path)
    if not path.is_file():  # a pipe would be waited for
        return False
    with path.open("rb") as file:
        return is_archive(file.read(ARCHIVE_BYTES))


def _is_remote_memory(address: str) -> bool:
    if address.lower().endswith(RECORDINGS):
        return False
    files, path = file_system(address)
    if files.isdir(path):
        return bool(files.exists(f"{path.rstrip('/')}/{CURRENT_FILE}"))
    with files.open(path, "rb", cache_type="none") as file:
        return is_archive(file.read(ARCHIVE_BYTES))


def _listed(address: str) -> list[str]:
    """What a remote folder holds; the address itself where it is a file, or a folder that is one recording."""
    if address.lower().endswith(RECORDINGS):
        return [address]
    files, path = file_system(address)
    files.invalidate_cache()
    if not files.isdir(path):
        return [address]
    scheme, place = address.partition("://")[0], path.rstrip("/")
    names = sorted(str(name) for name in files.find(place))
    inside = {name[len(place) + 1 :] for name in names}
    if inside & {*WHOLE, CURRENT_FILE}:
        return [address]
    folders = {name.rpartition("/")[0] for name in names if name.endswith((f"/{CURRENT_FILE}", "/metadata.yaml"))}
    alone = [
        name for name in names if name.lower().endswith(RECORDINGS + PACKED) and not name.startswith(tuple(folders))
    ]
    return [f"{scheme}://{name}" for name in sorted({*folders, *alone})]
