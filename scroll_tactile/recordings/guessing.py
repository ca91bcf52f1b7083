"""A sensor guessed from recordings of it, with how sure each of its fields is."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from scroll_tactile.errors import ChannelCountError, InputError
from scroll_tactile.recordings.recording import Recording
from scroll_tactile.sensors import Sensor

__all__ = ["guessed_sensor"]

_MOST = 1 << 16  # readings of a recording are looked at for its range
_APART = 3  # times as wide as any channel's range is that of all: then each has its own
_LONG = 30.0  # seconds: a longer recording may hold several touches
_UNIT = re.compile(r".*[\[(](.+)[\])]\s*")


def guessed_sensor(recordings: Sequence[Recording], name: str = "my-sensor") -> tuple[Sensor, list[str]]:
    """A sensor that these recordings could be of, and a sentence on each field: what it is, by what, and how sure.

    The range lies from the first to the 99th percentile of what was read, rounded outwards.

    Raises InputError where there are none, or nothing in them is finite, ChannelCountError where they differ in their
    channels.
    """
    if not recordings:
        raise InputError("expected recordings to guess a sensor from; there are none")
    shapes = {recording.readings.shape[1:]: recording.source for recording in recordings}
    if len(shapes) > 1:
        told = "; ".join(f"{shape} in {source}" for shape, source in list(shapes.items())[:3])
        raise ChannelCountError(f"expected recordings of one sensor; readings have several shapes: {told}")
    shape, files = recordings[0].readings.shape[1:], len(recordings)
    fields: dict[str, Any] = {"name": name, "channels": math.prod(shape)}
    said = [f"channels: {fields['channels']}, sure: so many are in each reading"]
    names = next((recording.names for recording in recordings if recording.names), ())
    units = [match[1] if (match := _UNIT.fullmatch(name)) else None for name in names]
    ranges = _range(recordings, len(shape) == 3, apart=len(set(units)) > 1)
    for found, sentence in (_rate(recordings), ranges, _duration(recordings)):
        fields |= found
        said.append(sentence)
    if names and len(names) == fields["channels"]:
        fields["columns"] = names
        said.append(f"columns: {', '.join(names[:8])}{', …' * (len(names) > 8)}, sure: the table's names")
    if units and None not in units:
        fields["unit"] = units[0] if len(set(units)) == 1 else tuple(map(str, units))
        said.append(f"unit: {fields['unit']}, sure: in the names of the columns")
    else:
        fields["unit"] = "counts"
        said.append("unit: counts, a guess: put in yours")
    if len(shape) == 3:
        fields |= {"layout": shape, "camera": True}
    finite = all(np.isfinite(recording.readings[:_MOST]).all() for recording in recordings)
    if not finite:
        fields["non_finite"] = "missing"
        said.append("non_finite: missing, sure: some values are NaN")
    said.insert(0, f"name: {name}, a guess: put in yours; all of it from {files} recording{'s' * (files > 1)}")
    return Sensor(**fields), said


def _rate(recordings: Sequence[Recording]) -> tuple[dict[str, float], str]:
    rates = [each.report.rate for each in recordings if each.report.rate and each.report.clock != "rate"]
    if not rates:
        return {"rate": 100.0}, "rate: 100 Hz, a guess: no recording has times; put in yours"
    middle = float(np.median(rates))
    near = float(f"{middle:.2g}")
    rate = near if abs(near / middle - 1) < 0.02 else float(f"{middle:.4g}")
    apart = max(rates) / min(rates) - 1
    sure = "sure" if apart < 0.05 else f"unsure: from {min(rates):.4g} to {max(rates):.4g}"
    return {"rate": rate}, f"rate: {rate:g} Hz, {sure}, by the clock {recordings[0].report.clock!r}"


def _range(recordings: Sequence[Recording], camera: bool, apart: bool) -> tuple[dict[str, Any], str]:
    if camera:
        return {"low": 0.0, "high": 255.0}, "low, high: 0 to 255, sure: pictures"
    rows = [each.readings[:: max(1, -(-len(each) // _MOST))] for each in recordings]
    values = np.concatenate(rows).astype(np.float64)
    values[~np.isfinite(values)] = np.nan
    values = np.where(np.isnan(values).all(axis=0), 0.0, values)
    low, high = np.nanquantile(values, (0.01, 0.99), axis=0)
    spans = (high - low)[high > low]
    if not len(spans):
        raise InputError("nothing moves in these recordings: a range cannot be guessed from them")
    each = apart or float(high.max() - low.min()) > _APART * float(spans.max())
    pairs = zip(low, high, strict=True) if each else [(low.min(), high.max())]
    bounds = np.array([_outwards(*pair) for pair in pairs])
    found = {"low": bounds[:, 0].tolist(), "high": bounds[:, 1].tolist()}
    text = f"{bounds[:, 0].min():g} to {bounds[:, 1].max():g}"
    outside = float(np.mean((values < bounds[:, 0]) | (values > bounds[:, 1])))
    how = f"1 and 99 % of what was read; {100 * outside:.2g} % lie outside: put in the sensor's own if you know it"
    if not each:
        return {name: ends[0] for name, ends in found.items()}, f"low, high: {text}, fairly sure: {how}"
    return found, f"low, high: {text}, for each channel its own, fairly sure: {how}"


def _outwards(low: float, high: float) -> tuple[float, float]:
    """Two ends rounded away from what lies between them, by steps of a twentieth to a half of it."""
    span = (high - low) or abs(high) or 1.0
    digits = -math.floor(math.log10(span / 2))
    step = 10.0**-digits
    ends = math.floor(low / step + 1e-9) * step, math.ceil(high / step - 1e-9) * step
    if not ends[0] < ends[1]:
        ends = ends[0] - step, ends[1] + step
    return round(ends[0], max(digits, 0)), round(ends[1], max(digits, 0))


def _duration(recordings: Sequence[Recording]) -> tuple[dict[str, float], str]:
    rate, lengths = _rate(recordings)[0]["rate"], list[int]()
    for each in recordings:
        lengths += [episode.end - episode.begin for episode in each.episodes] or [len(each)]
    seconds = float(f"{max(float(np.median(lengths)), 2) / rate:.2g}")
    unsure = seconds > _LONG
    why = "unsure: they may hold several touches each; put in how long one lasts" if unsure else "fairly sure"
    return {"duration": seconds}, f"duration: {seconds:g} s, {why}, the median of {len(lengths)} recordings or episodes"
