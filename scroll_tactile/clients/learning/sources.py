"""Files and folders as touches with names: what is read of each source, how it is cut, and what cannot be taken."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.protocol import Embedding, capabilities_of
from scroll_tactile.errors import AnnotationError, InputError, RecordingError, SensorMismatchError, printable
from scroll_tactile.learner import TactileLearner
from scroll_tactile.live.detector import contact_spans
from scroll_tactile.quantities import Quantity
from scroll_tactile.recordings import Interval, Recording, Touch, find, presets, read, touches
from scroll_tactile.recordings.headings import Heading, Noted, noted_in
from scroll_tactile.recordings.locations import is_remote
from scroll_tactile.recordings.recording import require_columns
from scroll_tactile.sensors import Sensor
from scroll_tactile.settings import LONGEST_SOURCE, require_name
from scroll_tactile.signals.stream import Stream

__all__ = [
    "Cut",
    "Refused",
    "SourceOptions",
    "SourceTouch",
    "find_sources",
    "has_touches",
    "readings_of",
    "source_touches",
    "stored_source",
]

Cut = Literal["episodes", "intervals", "none", "contact"]


@dataclass(frozen=True)
class SourceOptions:
    """How sources are read, cut into touches, and named.

    topic, field, clock, columns, preset, labels, annotate: as of `recordings.read`. cut: None cuts by the intervals
    where there are some, by episodes where a recording has some, and not otherwise.
    material: the name of all touches. by: what names each touch, as of `recordings.touches`. intervals: the table's.
    At most one of the three names them; without any, episodes name themselves. quantities: that are declared before
    anything is learned, as the table's headings do (`recordings.declared_quantities`), beside those of `annotate`.

    The value of a touch in a column that annotates it is the mean of the touch's readings that have a number there, its
    label the one text that they have: a touch with two is refused.

    Raises InputError for what does not fit together, MaterialError for a material that is none.
    """

    topic: str | None = None
    field: str | None = None
    clock: str | None = None
    columns: str | None = None
    preset: str | None = None
    labels: str | None = None
    annotate: Sequence[str] = ()
    cut: Cut | None = None
    material: str | None = None
    by: Literal["topic", "file", "folder", "task"] | None = None
    intervals: Sequence[Interval] | None = None
    quantities: Sequence[Quantity] = ()

    def __post_init__(self) -> None:
        if sum(given is not None for given in (self.material, self.by, self.intervals)) > 1:
            raise InputError("touches can be named in one way: by one of material=, by= and intervals=")
        if self.material is not None:
            require_name(self.material)
        if self.preset is not None:
            presets.find(self.preset)
        if self.columns is not None:
            require_columns(self.columns)
        if self.cut == "intervals" and self.intervals is None:
            raise InputError("cut='intervals' takes intervals=, a table with columns file, begin, end and material")
        if self.intervals is not None and self.cut not in (None, "intervals"):
            raise InputError(f"intervals= cuts by itself; came cut={self.cut!r} beside it")
        names = [Heading.parsed(text).name for text in self.annotate]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise InputError(f"expected each quantity and axis once in annotate=; came {twice[0]!r} several times")

    @property
    def declared(self) -> list[Quantity]:
        """All quantities that are declared before anything is learned."""
        of_columns = (Heading.parsed(text).quantity for text in self.annotate)
        return [*self.quantities, *(quantity for quantity in of_columns if quantity is not None)]

    def touches_in(self, address: str, learner: TactileLearner) -> tuple[Recording, tuple[Touch, ...]]:
        """A source and the touches in it; raises what `recordings.read` and `recordings.touches` raise."""
        recording = read(
            address,
            topic=self.topic,
            field=self.field,
            clock=self.clock,
            columns=self.columns,
            preset=self.preset,
            rate=learner.sensor.rate,  # where it has no clock
            labels=self.labels,
            annotate=self.annotate,
        )
        if self.intervals is not None:
            return recording, touches(recording, self.intervals)
        if self.cut == "contact":
            return recording, touches(recording, partial(_contacts, learner), self.by)
        whole = self.cut == "none" or (self.cut is None and not recording.episodes)
        return recording, touches(recording, "whole" if whole else "episodes", self.by)


def _contacts(learner: TactileLearner, recording: Recording) -> list[tuple[int, int]]:
    """Begin and end of each contact in a recording; raises InputError for none, and for another sensor's readings."""
    sensor, rest = learner.sensor, capabilities_of(learner.embedding).rest
    gaps = [gap.index for gap in recording.report.gaps]
    spans = contact_spans(sensor, rest, readings_of(sensor, recording), gaps)
    if not spans:
        raise InputError(
            f"no contact was found in {recording.source}: it has to begin at rest, for two seconds or more, from which "
            "the sensor's noise is learned. For a file of one touch take cut='none'"
        )
    return spans


def readings_of(sensor: Sensor, recording: Recording) -> npt.NDArray[Any]:
    """The readings as this sensor's. Raises ChannelCountError for another's."""
    if recording.readings[:1].size != sensor.channels:
        recording.stream(sensor)
    kind = np.float32 if sensor.camera else np.float64
    return recording.readings.reshape(len(recording), *sensor.shape).astype(kind, copy=False)


@dataclass(frozen=True)
class Refused:
    """A source, or a touch in one, that could not be taken, and why."""

    source: str
    why: str


@dataclass(frozen=True)
class SourceTouch:
    """A touch out of a source: where it comes from, what names it (None where nothing does), its stream, and its notes.

    values, labels: as of `TactileLearner.observe`.
    """

    source: str
    material: str | None
    stream: Stream
    values: Mapping[str, float] = field(default_factory=dict)
    labels: Mapping[str, str] = field(default_factory=dict)


def find_sources(paths: Sequence[str]) -> tuple[list[str], list[Refused]]:
    """The recordings in files, folders and addresses, each once and in order; and the paths where there are none."""
    found: dict[object, str] = {}
    refused = []
    for path in paths:
        if is_remote(path):
            found.setdefault(path, path)
            continue
        try:
            inside = find(path)
            if not inside:
                what = "there is none in this folder" if Path(path).is_dir() else "a file of this kind is none"
                raise RecordingError(f"expected recordings: {what}")
            for recording in inside:
                found.setdefault(recording.resolve(), str(recording))
        except (InputError, OSError) as error:
            refused.append(Refused(path, str(error)))
    return list(found.values()), refused


def source_touches(
    learner: TactileLearner, address: str, options: SourceOptions, *, named: bool = True
) -> Iterator[SourceTouch | Refused]:
    """The touches in a source, sound for this learner; what is not is refused.

    named: whether a touch that nothing names is refused.
    """
    try:
        recording, found = options.touches_in(address, learner)
    except (InputError, OSError) as error:
        yield Refused(address, str(error))
        return
    for touch in found:
        source = _source(recording, touch, options)
        try:
            material = options.material if options.material is not None else touch.material
            if named and material is None:
                raise InputError("nothing names it: give material= for all, by='folder', by='file' or intervals=")
            part = replace(recording, readings=touch.readings, times=touch.times, episodes=())
            stream = learner.stream(part.stream(learner.sensor))
            noted = Noted(touch.values, touch.labels) + noted_in(recording.annotations, touch.begin, touch.end)
            values, name = _values(noted, learner.quantities), material if material is None else require_name(material)
            yield SourceTouch(source, name, stream, values, dict(noted.labels))
        except (InputError, SensorMismatchError) as error:
            yield Refused(source, str(error))


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


def has_touches(
    sensor: Sensor, sources: Iterable[str], options: SourceOptions, embedding: Embedding | None = None
) -> bool:
    """Whether there is anything to learn for a new memory of this sensor, and embedding."""
    learner = TactileLearner(sensor=sensor, embedding=embedding)
    return any(isinstance(each, SourceTouch) for path in sources for each in source_touches(learner, path, options))
