"""Shifts of an hour through a live session: what a reading takes, and how well touches are found."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.table import Table

from examples.benchmarks.timing import circumstances
from examples.paper.readers.biotac_slide import load
from examples.paper.readers.labelled import Recordings
from scroll_tactile import Sensor, TactileLearner, sensors
from scroll_tactile.blas import one_thread
from scroll_tactile.cli.terminal import console
from scroll_tactile.live.answers import LiveTouch
from scroll_tactile.simulation.scene import Scene
from scroll_tactile.simulation.shift import Shift, quiet_noise, resting_level, shift_of, simulated_shift

__all__ = ["run_shifts", "show_shifts"]

Record = dict[str, Any]

TO_REACH = {"p50": 0.15, "p99": 2.0, "max": 15.0, "found": 0.99, "false": 1.0, "onset": 30.0, "rate": 1000.0}
LEARNED = 6  # simulated touches of each of ten materials
DEVIATIONS = 3.0  # of its noise, that a sensor's rest is set above the least it was pressed


def run_shifts(data: Path | None, *, seconds: float, seed: int, note: Callable[[str], None]) -> Record:
    """A record for each shift: simulated ones, and with `data` those of real touches of a fold that was left out."""
    result, records = {"bench": "live", **circumstances(seed)}, []
    for sensor in (sensors.BIOTAC, sensors.ROBOSKIN):
        note(f"simulated {sensor.name}")
        records.append(_simulated(sensor, seconds, seed))
    if data is not None:
        for name in ("biotac", "roboskin"):
            note(f"recorded {name}")
            recordings = load(data, "biotac" if name == "biotac" else "roboskin", seed, unmixed=name == "roboskin")
            records.append(_recorded(recordings, seconds, seed))
    return {**result, "shifts": records}


def _simulated(sensor: Sensor, seconds: float, seed: int) -> Record:
    scene, learner = Scene(sensor=sensor, seed=seed), TactileLearner(sensor=sensor)
    names = scene.materials[:10]
    for repetition in range(LEARNED):
        for name in names:
            learner.observe(name, scene.touch(name, repetition))
    return _measured(f"simulated {sensor.name}", learner, simulated_shift(scene, names, seconds=seconds, seed=seed))


def _recorded(recordings: Recordings, seconds: float, seed: int) -> Record:
    sensor, learner = recordings.sensor, TactileLearner(sensor=recordings.sensor)
    tested = []
    for material, stream, fold in zip(recordings.materials, recordings.streams, recordings.fold, strict=True):
        if fold:
            learner.observe(material, stream)
        else:
            tested.append((material, stream))
    streams = [stream for _, stream in tested]
    random = np.random.default_rng([6, seed])
    noise = quiet_noise(streams)
    level = resting_level(streams) + DEVIATIONS * noise(random, 2000).std(axis=0)
    order = [int(i) for _ in range(10) for i in random.permutation(len(tested))]
    touches = [(tested[i][0], tested[i][1].readings) for i in order]
    whole = bool(np.all([np.all(stream.readings == np.rint(stream.readings)) for stream in streams]))
    shift = shift_of(touches, sensor, level, noise, seconds=seconds, step=1.0 if whole else 0.0, seed=seed)
    return _measured(recordings.name, learner, shift)


def _measured(name: str, learner: TactileLearner, shift: Shift) -> Record:
    learner.settle()
    found: list[LiveTouch] = []
    took, processor = np.empty((2, len(shift.readings)))
    with one_thread(), learner.live() as live:
        for i, (reading, stamp) in enumerate(zip(shift.readings, shift.times.tolist(), strict=True)):
            begin, busy = time.perf_counter(), time.thread_time()
            now = live.push(reading, stamp)
            processor[i] = time.thread_time() - busy
            took[i] = time.perf_counter() - begin
            found += now.touches
        report = vars(live.report)
    scored = _scored(shift, found)
    return {
        "shift": name,
        "channels": shift.sensor.channels,
        "hours": len(took) / shift.sensor.rate / 3600,
        "milliseconds": _quantiles(took),
        "processor_milliseconds": _quantiles(processor),
        "readings_per_second": len(took) / float(took.sum()),
        **scored,
        "report": {key: value for key, value in report.items() if value},
    }


def _quantiles(took: npt.NDArray[np.float64]) -> dict[str, float]:
    p50, p99, most = np.quantile(took, [0.5, 0.99, 1.0]) * 1e3
    over = np.count_nonzero(took > TO_REACH["max"] / 1e3)
    return {"p50": float(p50), "p99": float(p99), "max": float(most), "longer_than_to_reach": int(over)}


def _scored(shift: Shift, found: list[LiveTouch]) -> Record:
    """Touches found, contacts that are none, touches found in parts, and how far off their beginnings are."""
    spans = [(touch.at, touch.at + touch.stream.seconds) for touch in found]
    off, hit, parts, right = [], set[int](), 0, 0
    for truth in shift.touches:
        own = [i for i, (begin, end) in enumerate(spans) if begin < truth.end and end > truth.begin]
        hit |= set(own)
        if own:
            off.append(1e3 * (spans[own[0]][0] - truth.begin))
            parts += len(own) > 1
            right += found[own[0]].prediction.material == truth.material
    return {
        "touches": len(shift.touches),
        "found": len(off),
        "false": len(found) - len(hit),
        "in_parts": parts,
        "named_right": right,
        "onset_ms": {"median": float(np.median(np.abs(off))), "p5_p95": np.quantile(off, [0.05, 0.95]).tolist()},
    }


def show_shifts(records: list[Record]) -> None:
    """Print the tables beside what is to be reached."""
    names = ("p50", "p99", "max")
    speed = Table("shift", "channels", "", *(f"{name} ms" for name in names), "longer", "readings/s", title="a reading")
    speed.add_row("to reach", "", "", *(f"≤ {TO_REACH[name]:g}" for name in names), "0", f"≥ {TO_REACH['rate']:g}")
    contact = Table("shift", "touches", "found", "in parts", "false/h", "onset ms", "5 to 95 %", "named right")
    contact.add_row(
        "to reach", "", f"≥ {TO_REACH['found']:.0%}", "", f"≤ {TO_REACH['false']:g}", f"≤ {TO_REACH['onset']:g}"
    )
    for record in records:
        for clock, took in (("wall", record["milliseconds"]), ("processor", record["processor_milliseconds"])):
            of = [f"{took[name]:.3f}" for name in names]
            rate = f"{record['readings_per_second']:.0f}" if clock == "wall" else ""
            speed.add_row(record["shift"], str(record["channels"]), clock, *of, str(took["longer_than_to_reach"]), rate)
        low, high = record["onset_ms"]["p5_p95"]
        contact.add_row(
            record["shift"],
            str(record["touches"]),
            f"{record['found'] / record['touches']:.1%}",
            str(record["in_parts"]),
            f"{record['false'] / record['hours']:.2f}",
            f"{record['onset_ms']['median']:.1f}",
            f"{low:.1f} to {high:.1f}",
            f"{record['named_right'] / max(1, record['found']):.1%}",
        )
    console().print(speed)
    console().print(contact)
