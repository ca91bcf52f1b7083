"""A memory in Rerun: its kept touches by material, what it says of them held out, and how its sensor is."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from scroll_tactile.clients.report.facts import MemoryFacts
from scroll_tactile.errors import ScrollTactileError, printable
from scroll_tactile.health.diagnosis import advice, in_words
from scroll_tactile.learner import TactileLearner
from scroll_tactile.matching.likelihood import LEVELS
from scroll_tactile.matching.match import KeptTouch
from scroll_tactile.prediction.judging import HeldOutTouch
from scroll_tactile.results import Health, Observation
from scroll_tactile.viewer.streams import Colours, entity, layout, rerun

__all__ = ["log_memory"]

OBSERVATION, OBSERVED = "observation", "observed"  # the row of the journal, and when it was written
MOST_MATERIALS = 200  # of which each has lines of its own; of more those with the most touches


def log_memory(stream: Any, learner: TactileLearner, prefix: str = "") -> None:
    """Write what a memory knows to a stream of Rerun, on timelines of its observations.

    prefix: of the entities' paths. Below it: `about`, a page of text; `touch` and `touches/MATERIAL`, the levels of
    kept touches as tensors (channel, time) of 255 steps of the range; `count/MATERIAL`; `held_out/MATERIAL`, the
    probability of its own name to each sampled touch, held out, with its `novelty`; `health/evidence` beside
    `health/alarm`, as powers of ten, and the channels that `health/changed`; `events`.
    """
    _MemoryLog(stream, learner, prefix).write()


class _MemoryLog:
    def __init__(self, stream: Any, learner: TactileLearner, prefix: str) -> None:
        self.stream, self.learner, self.prefix, self.rr = stream, learner, prefix, rerun()
        self.facts = MemoryFacts(learner, risk=0.05)
        self.learned = [row for row in self.facts.journal if row.state != "retracted"]
        self.rows = {(row.material, row.key): row for row in self.learned}  # one touch can be of several materials
        most = sorted(self.facts.counts, key=lambda name: (-self.facts.counts[name], name))
        self.names = set(most[:MOST_MATERIALS])
        self.colours = Colours()

    def write(self) -> None:
        """All of it; what takes longest comes last."""
        left = [("Tensor", "touch", "touch"), ("TextDocument", "about", "about"), ("TextLog", "events", "events")]
        right = [
            ("Share", "probability of its own name, held out", "held_out"),
            ("TimeSeries", "novelty, held out", "novelty"),
            ("TimeSeries", "touches", "count"),
            ("TimeSeries", "evidence that the sensor changed, power of ten", "health"),
        ]
        self.stream.send_blueprint(layout(self.prefix, left, right, OBSERVATION))
        self._counts()
        self._kept()
        health = self._health()
        self._about(health)
        self._held_out()
        if self.facts.missing:
            self._about(health)

    def _about(self, health: Health | None) -> None:
        facts, sensor = self.facts, self.learner.sensor
        lines = [f"{printable(sensor.name)}, {sensor.channels} channels, {sensor.rate:g} readings a second.", ""]
        lines += [f"{sum(facts.counts.values())} touches of {len(facts.counts)} materials.", ""]
        if health is not None:
            lines += [f"Sensor: {in_words(health, printable)}. {advice(health)}", ""]
        if len(self.names) < len(facts.counts):
            lines += [f"Lines are shown of the {len(self.names)} materials with the most touches.", ""]
        lines += [f"- not shown: {printable(why)}" for why in facts.missing]
        # As Markdown a name that came from elsewhere could have the viewer fetch a picture.
        text = self.rr.TextDocument("\n".join(lines), media_type="text/plain")
        self.stream.log(self._path("about"), text, static=True)

    def _counts(self) -> None:
        """How many touches of each material there were after each row."""
        points: dict[str, list[tuple[int, float]]] = {}
        for row in self.learned:
            if row.material in self.names:
                points.setdefault(row.material, []).append((row.sequence, row.time))
        for name, own in points.items():
            sequences, times = zip(*own, strict=True)
            columns = [
                self.rr.TimeColumn(OBSERVATION, sequence=sequences),
                self.rr.TimeColumn(OBSERVED, timestamp=times),
            ]
            path = self._path(entity("count", name))
            self.stream.log(
                path, self.rr.SeriesLines(colors=[self.colours.of(name)], interpolation_mode="StepAfter"), static=True
            )
            counts = self.rr.Scalars.columns(scalars=np.arange(1.0, len(own) + 1))
            self.stream.send_columns(path, columns, counts)

    def _kept(self) -> None:
        for place, touch in enumerate(self.facts.kept, start=1):
            self._at(touch, place)
            tensor = self.rr.Tensor(touch.levels, dim_names=("channel", "time"), value_range=(0, LEVELS - 1))
            self.stream.log(self._path("touch"), tensor)
            if touch.material in self.names:
                self.stream.log(self._path(entity("touches", touch.material)), tensor)
            row = self._row(touch)
            source = "" if row is None or row.source is None else f", from {printable(row.source)}"
            self._event(f"kept: {printable(touch.material)}{source}")

    def _held_out(self) -> None:
        try:
            found = self.facts.held_out
        except ScrollTactileError as error:
            self.facts.missing.append(f"answers to touches held out: {error}")
            return
        place = {touch.key: i for i, touch in enumerate(self.facts.kept, start=1)}
        styled: set[str] = set()
        for touch in sorted(found, key=lambda touch: (self._place(touch, place.get(touch.key, 0)), touch.key)):
            self._at(touch, place.get(touch.key, 0))
            path = entity("held_out", touch.material)
            if touch.material in self.names:
                if path not in styled:
                    styled.add(path)
                    self.stream.log(
                        self._path(path), self.rr.SeriesPoints(colors=[self.colours.of(touch.material)]), static=True
                    )
                self.stream.log(self._path(path), self.rr.Scalars(_own(touch)))
            if math.isfinite(touch.novelty):
                self.stream.log(self._path("novelty/novelty"), self.rr.Scalars(touch.novelty))
                if math.isfinite(touch.threshold):
                    self.stream.log(self._path("novelty/unknown_above"), self.rr.Scalars(touch.threshold))
            if touch.answer != touch.material:
                what = f"{printable(touch.answer)}, {touch.confidence:.1%}"
                self._event(f"held out, a touch of {printable(touch.material)} is taken for {what}", "WARN")
            elif not touch.known:
                self._event(f"held out, a touch of {printable(touch.material)} is called unknown", "WARN")

    def _health(self) -> Health | None:
        if not self.learner.has_health:
            return None
        health = self.learner.health()
        if health.grew:
            rows, evidence = (np.array(column) for column in zip(*health.grew, strict=True))
            column = [self.rr.TimeColumn(OBSERVATION, sequence=rows.astype(np.int64))]
            for name, values in (("evidence", evidence), ("alarm", np.full(len(rows), -math.log10(health.bound)))):
                scalars = self.rr.Scalars.columns(scalars=values.astype(np.float64))
                self.stream.send_columns(self._path(f"health/{name}"), column, scalars)
        if health.since is not None:
            self.stream.reset_time()
            self.stream.set_time(OBSERVATION, sequence=health.since)
            self._event(f"{in_words(health, printable)}. {advice(health)}", "ERROR")
            changed = np.isin(np.arange(self.learner.sensor.channels), health.channels).astype(np.uint8)
            self.stream.log(self._path("health/changed"), self.rr.BarChart(changed))
        return health

    def _event(self, text: str, level: str = "INFO") -> None:
        self.stream.log(self._path("events"), self.rr.TextLog(text, level=level))

    def _row(self, touch: KeptTouch | HeldOutTouch) -> Observation | None:
        return self.rows.get((touch.material, touch.key))

    def _place(self, touch: KeptTouch | HeldOutTouch, place: int) -> int:
        """The row of a touch in the journal; where that is not known, its place among the kept ones."""
        row = self._row(touch)
        return place if row is None else row.sequence

    def _at(self, touch: KeptTouch | HeldOutTouch, place: int) -> None:
        row = self._row(touch)
        self.stream.reset_time()
        self.stream.set_time(OBSERVATION, sequence=self._place(touch, place))
        if row is not None:
            self.stream.set_time(OBSERVED, timestamp=row.time)

    def _path(self, path: str) -> str:
        return f"{self.prefix}/{path}" if self.prefix else path


def _own(touch: HeldOutTouch) -> float:
    """The probability of its own material; 0 where that was not among those it was weighed among."""
    return float(touch.probability[touch.names.index(touch.material)]) if touch.material in touch.names else 0.0
