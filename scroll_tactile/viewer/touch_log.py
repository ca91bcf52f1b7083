"""What a live session meets, written to a stream of Rerun as it comes: readings, contacts, and answers as they grow."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.live.answers import LiveState, LiveTouch
from scroll_tactile.results import Estimate, Prediction
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.image import scaled_down, tactile_image
from scroll_tactile.viewer.streams import Colours, entity, in_words, layout, rerun

__all__ = ["TIME", "TouchLog"]

TIME = "time"
FIRST_DATE = 1e8  # seconds since 1970: less are counted from some other moment
SHOWN = 5  # likeliest materials of each answer; those shown go on to the end of a touch
BLOCK = 1.0  # seconds of readings in one tensor
FRAME = (120, 160)  # of a camera's picture

Rows = npt.NDArray[Any]


class TouchLog:
    """Writes to a stream of Rerun; `take` each reading, and `show` the state after it.

    sensor: whose readings they are. prefix: of the entities' paths. Below it: `readings` (a tensor for each second, of
    a camera pictures) with their `level`, `contact`, `touch` (the tactile image of each touch, at its beginning),
    `answer/probability/NAME`, `answer/novelty`, `answer/known`, `estimate/QUANTITY` (value, low, high), and `events`.
    """

    def __init__(self, stream: Any, sensor: Sensor, prefix: str = "") -> None:
        self._stream, self._sensor, self._prefix, self._rr = stream, sensor, prefix, rerun()
        self._rows: list[Rows] = []
        self._times: list[float] = []
        self._names: dict[str, None] = {}  # of the touch under way, as they came
        self._before: LiveState | None = None
        self._dated: bool | None = None
        self._lines: set[str] = set()
        self._colours = Colours()
        left = [("Tensor", "touch", "touch"), ("Tensor", "readings", "readings"), ("TextLog", "events", "events")]
        if sensor.camera:
            left[1] = ("Spatial2D", "readings", "readings")
        right = [
            ("Share", "probability", "answer/probability"),
            ("TimeSeries", "novelty", "answer/novelty"),
            ("TimeSeries", "level", "level"),
            ("Share", "contact", "contact"),
        ]
        stream.send_blueprint(layout(prefix, left, right, TIME))
        steps = self._rr.SeriesLines(interpolation_mode="StepAfter")
        stream.log(self._path("contact"), steps, static=True)

    def take(self, reading: Rows, at: float) -> None:
        """A reading of the sensor, at a time in seconds."""
        self._rows.append(np.asarray(reading).reshape(self._sensor.shape))
        self._times.append(at)
        if len(self._rows) >= max(1, round(BLOCK * self._sensor.rate)) or self._sensor.camera:
            self._flush()

    def show(self, now: LiveState, at: float) -> None:
        """What is new in the state of the session after a reading at this time."""
        for ended in now.touches:
            self._ended(ended)
        before = self._before if self._before is not None and self._before.contact and not now.ended else None
        if self._before is None or self._before.contact != now.contact:
            self._log("contact", self._rr.Scalars(float(now.contact)), at)
        self._before = now
        if not now.contact or now.prediction is None:
            return
        if before is None or before.prediction is not now.prediction:
            self._answer(now.prediction, at)
            self._estimates(now.estimates, at)
        if now.decided and (before is None or not before.decided):
            self.event(f"decided after {now.seconds:.2f} s: {in_words(now.prediction)}", at)

    def event(self, text: str, at: float, level: str = "INFO") -> None:
        """A line in the log of events."""
        self._log("events", self._rr.TextLog(text, level=level), at)

    def close(self) -> None:
        """Write what was taken and is not yet written."""
        self._flush()

    def _ended(self, touch: LiveTouch) -> None:
        image = tactile_image(touch.stream)
        self._log("touch", self._rr.Tensor(image, dim_names=("channel", "time"), value_range=(-1, 1)), touch.at)
        end = touch.at + touch.stream.seconds
        state = "decided" if touch.decided else "undecided"
        if touch.revised is not None:
            state = f"revised, it was decided as: {in_words(touch.revised)}"
        answer = f"{in_words(touch.prediction)}, {state}"
        level = "INFO" if touch.decided and touch.revised is None and touch.prediction.known is not False else "WARN"
        self.event(f"touched for {touch.stream.seconds:.2f} s: {answer}", end, level)
        if touch.prediction.material is not None:
            self._answer(touch.prediction, end)
        self._estimates(touch.estimates, end)
        gap = end + 0.5 / self._sensor.rate  # no line leads from one touch to the next
        for name in (*(entity("answer", "probability", own) for own in self._names), "answer/novelty", "answer/known"):
            if name in self._lines:
                self._scalar(name, math.nan, gap)
        self._names.clear()

    def _answer(self, prediction: Prediction, at: float) -> None:
        chances = dict(prediction.ranking)
        self._names |= dict.fromkeys(name for name, _ in prediction.ranking[:SHOWN])
        for name in self._names:
            path = entity("answer", "probability", name)
            if path not in self._lines:
                lines = self._rr.SeriesLines(colors=[self._colours.of(name)])
                self._stream.log(self._path(path), lines, static=True)
            self._scalar(path, chances.get(name, 0.0), at)
        if math.isfinite(prediction.novelty):
            self._scalar("answer/novelty", prediction.novelty, at)
        if prediction.known is not None:
            self._scalar("answer/known", float(prediction.known), at)

    def _estimates(self, estimates: Any, at: float) -> None:
        own: Estimate
        for name, own in estimates.items():
            if own.value is not None:
                path = entity("estimate", name)
                if path not in self._lines:
                    self._lines.add(path)
                    lines = self._rr.SeriesLines(names=["value", "low", "high"])
                    self._stream.log(self._path(path), lines, static=True)
                self._log(path, self._rr.Scalars([own.value, own.low, own.high]), at)

    def _scalar(self, path: str, value: float, at: float) -> None:
        self._lines.add(path)
        self._log(path, self._rr.Scalars(value), at)

    def _flush(self) -> None:
        """The readings since the last time, as one tensor of shape (n, k) or a picture, and their mean levels."""
        if not self._rows:
            return
        rows, times = np.stack(self._rows).astype(np.float32), np.array(self._times)
        self._rows, self._times = [], []
        low, high = self._sensor.limits
        shares, read = (rows - low) / (high - low), np.isfinite(rows)
        level = np.where(read, shares, 0).reshape(len(rows), -1).sum(axis=1) / np.maximum(
            read.reshape(len(rows), -1).sum(axis=1), 1
        )
        if self._sensor.camera:
            shown: Any = self._rr.Image(np.clip(scaled_down(rows, *FRAME)[0], 0, 255).astype(np.uint8))
        else:
            shown = self._rr.Tensor(rows.T, dim_names=("channel", "time"))
        self._log("readings", shown, float(times[0]))
        column = self._rr.TimeColumn(TIME, **{self._clock(times[0]): times})
        self._stream.send_columns(self._path("level"), [column], self._rr.Scalars.columns(scalars=level))

    def _log(self, path: str, what: Any, at: float) -> None:
        self._stream.set_time(TIME, **{self._clock(at): at})
        self._stream.log(self._path(path), what)

    def _clock(self, at: float) -> str:
        """What the times of this stream are, by the first: dates, or seconds since some moment."""
        if self._dated is None:
            self._dated = at > FIRST_DATE
        return "timestamp" if self._dated else "duration"

    def _path(self, path: str) -> str:
        return f"{self._prefix}/{path}" if self._prefix else path
