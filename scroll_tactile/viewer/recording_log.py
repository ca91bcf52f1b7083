"""A recording in Rerun: what a memory says of it as it is played, or its readings and contacts where there is none."""

from __future__ import annotations

import math
from os import PathLike
from typing import Any

import numpy as np

from scroll_tactile.errors import ChannelCountError, FieldError, InputError, NotFiniteError, printable
from scroll_tactile.learner import TactileLearner
from scroll_tactile.live.answers import LiveState
from scroll_tactile.live.session import LiveSession
from scroll_tactile.recordings import Recording, describe, presets, read
from scroll_tactile.sensors import Sensor
from scroll_tactile.viewer.touch_log import TouchLog

__all__ = ["log_recording", "read_for"]

LONGEST = 60.0  # seconds of a recording without contact that may be one touch, from end to end
RATE = 100.0  # Hz, of a recording without a clock


def read_for(path: str | PathLike[str], sensor: Sensor | None, **chosen: Any) -> tuple[Recording, Sensor]:
    """The readings of a recording that are the sensor's, and the sensor.

    sensor: of a memory; None: that of the preset that is chosen, or whose messages the recording has, or one with the
    range seen. chosen: topic, field and preset, as for `read`; where a file has several and none is named, the first
    that are the sensor's, or a known sensor's.

    Raises what `read` does; ChannelCountError, a StreamError, where they are another sensor's.
    """
    if not any(chosen.values()):
        contents = describe(path)  # before all is read
        fitting = [entry for entry in contents.entries if _fits(entry.shape, entry.kind, sensor)]
        if not fitting:
            whose = "a known sensor" if sensor is None else f"sensor {sensor.name!r}, shape {sensor.shape}"
            raise FieldError(
                f"expected readings of {whose}; none of what is there has them: give topic and field. {contents}"
            )
        chosen = {"topic": fitting[0].topic, "field": fitting[0].field or None}
    recording = read(path, **chosen)
    if sensor is None:
        return recording, _sensor_of(recording, chosen.get("preset"))
    if math.prod(recording.readings.shape[1:]) != sensor.channels:
        raise ChannelCountError(
            f"expected readings of sensor {sensor.name!r}, {sensor.channels} channels; {recording.place} has shape "
            f"{recording.readings.shape[1:]}. {recording.cure(sensor)}"
        )
    return recording, sensor


def _fits(shape: tuple[int, ...], kind: str, sensor: Sensor | None) -> bool:
    if sensor is None:
        return presets.is_known(kind) and "multiarray" not in kind.lower()  # they carry anything
    return shape == sensor.shape or math.prod(shape) == sensor.channels


def _sensor_of(recording: Recording, preset: str | None) -> Sensor:
    """The sensor of a preset, or one for readings of which nothing is known but what was seen."""
    readings, rate = recording.readings, recording.report.rate or RATE
    if preset is not None:
        known = presets.find(preset)
        return known.sensor if known.sensor.camera else known.sized(int(np.prod(readings.shape[1:])))
    if readings.ndim == 4:
        shape = readings.shape[1:]
        frames: dict[str, Any] = {"channels": math.prod(shape), "layout": shape, "camera": True, "low": 0, "high": 255}
        return Sensor(name="camera", rate=rate, unit="counts", duration=1.0, **frames)
    seen = readings[np.isfinite(readings)].astype(np.float64)
    low, high = (float(seen.min()), float(seen.max())) if seen.size else (0.0, 1.0)
    high, channels = high if high > low else low + 1.0, int(np.prod(readings.shape[1:]))
    of_any: dict[str, Any] = {"unit": "", "duration": 4.0, "non_finite": "missing"}
    return Sensor(name="seen", channels=channels, rate=rate, low=low, high=high, **of_any)


def log_recording(
    stream: Any, recording: Recording, learner: TactileLearner, prefix: str = "", *, risk: float = 0.05
) -> None:
    """Play a recording to a learner, as a live session, and write what it meets to a stream of Rerun.

    Its touches are its episodes, or the contacts that are found after two seconds at rest. Where there are neither, one
    of at most a minute is one touch from end to end, and of a longer one there are the readings.

    learner: of the readings' sensor; an empty one finds contacts. risk: as for `TactileLearner.live`.
    """
    log = TouchLog(stream, learner.sensor, prefix)
    play = _Play(log, learner, recording, risk)
    if recording.episodes:
        for episode in recording.episodes:
            play.touch(episode.begin, episode.end, episode.name or "no name")
    elif len(recording):
        found = play.contacts()
        if not found and play.seconds <= LONGEST:
            play.touch(0, len(recording), "no contact was found; all of it as one touch", again=found is not None)
        elif found is None:
            play.readings()
    log.close()


class _Play:
    """A recording that is played to live sessions of a learner, and to a log.

    times: of the readings, ascending; `timed` where they are the recording's own.
    """

    def __init__(self, log: TouchLog, learner: TactileLearner, recording: Recording, risk: float) -> None:
        self.log, self.learner, self.risk, sensor = log, learner, risk, learner.sensor
        self.rows = recording.readings.reshape(len(recording), *sensor.shape)
        times, rate = recording.times, recording.report.rate or 0.0
        steady = np.isfinite(times).all() and not (np.diff(times) < 0).any()  # each episode may begin at 0 again
        self.timed = bool(steady and 0.2 < rate / sensor.rate < 5)  # others count in other units
        self.times = times if self.timed else np.arange(len(recording)) / sensor.rate
        self.seconds = float(self.times[-1] - self.times[0]) if len(recording) else 0.0
        self.lacking = 0

    def contacts(self) -> int | None:
        """Find contacts; returns how many were touches, and None where none can be found: then nothing was logged."""
        try:
            session = self.learner.live(risk=self.risk)
        except InputError as error:  # an embedding to which every frame of a camera counts
            self.log.event(str(error), float(self.times[0]), "WARN")
            return None
        with session:
            self._push(session, 0, len(self.rows))
        self.log.show(LiveState(), float(self.times[-1]))
        return session.report.touches

    def readings(self) -> None:
        """The readings alone."""
        for row, at in zip(self.rows, self.times.tolist(), strict=True):
            self.log.take(row, at)

    def touch(self, begin: int, end: int, name: str, *, again: bool = False) -> None:
        """Take readings [begin, end) as one touch. again: they were logged before."""
        self.log.event(f"begins: {printable(name)}", float(self.times[begin]))
        with self.learner.live(risk=self.risk, contact="manual") as session:
            session.begin()
            self._push(session, begin, end, again=again)
            self.log.show(session.end(), float(self.times[end - 1]))

    def _push(self, session: LiveSession, begin: int, end: int, *, again: bool = False) -> None:
        for row, at in zip(self.rows[begin:end], self.times[begin:end].tolist(), strict=True):
            if not again:
                self.log.take(row, at)
            try:
                self.log.show(session.push(row, at if self.timed else None), at)
            except NotFiniteError as error:  # the sensor of this memory takes none as missing
                self.lacking += 1
                if self.lacking == 1:
                    self.log.event(f"left out, and others like it: {error}", at, "WARN")
