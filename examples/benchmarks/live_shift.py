"""Shifts of an hour through a live session: what a reading takes, and how well touches are found."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from examples.paper.readers.biotac_slide import load
from examples.paper.readers.labelled import Recordings
from examples.paper.runs.options import Json, Seed
from examples.paper.runs.results import show, write
from scroll_tactile import Sensor, TactileLearner, sensors
from scroll_tactile.blas import one_thread
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.live.answers import LiveTouch
from scroll_tactile.simulation.scene import Scene
from scroll_tactile.simulation.shift import Shift, quiet_noise, resting_level, shift_of, simulated_shift

__all__ = ["live", "run_shifts"]

Record = dict[str, Any]

LONGEST = 15.0  # ms that a reading may take
LEARNED = 6  # simulated touches of each of ten materials
DEVIATIONS = 3.0  # of its noise, that a sensor's rest is set above the least it was pressed


def run_shifts(data: Path | None, *, seconds: float, seed: int, note: Callable[[str], None]) -> Record:
    """A record for each shift: simulated ones, and with `data` those of real touches of a fold that was left out."""
    records = []
    for sensor in (sensors.BIOTAC, sensors.ROBOSKIN):
        note(f"simulated {sensor.name}")
        records.append(_simulated(sensor, seconds, seed))
    if data is not None:
        for name in ("biotac", "roboskin"):
            note(f"recorded {name}")
            recordings = load(data, "biotac" if name == "biotac" else "roboskin", seed, unmixed=name == "roboskin")
            records.append(_recorded(recordings, seconds, seed))
    return {"bench": "live", "shifts": records}


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
    with one_thread(), learner.live() as session:
        for i, (reading, stamp) in enumerate(zip(shift.readings, shift.times.tolist(), strict=True)):
            begin, busy = time.perf_counter(), time.thread_time()
            now = session.push(reading, stamp)
            processor[i] = time.thread_time() - busy
            took[i] = time.perf_counter() - begin
            found += now.touches
        report = vars(session.report)
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
    over = np.count_nonzero(took > LONGEST / 1e3)
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


def live(
    context: typer.Context,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder of biotac_slide_20_50, or the one it lies in: also shifts of its touches."),
    ] = None,
    hours: Annotated[float, typer.Option(min=0.01, help="How long each shift is.")] = 1.0,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Send shifts of simulated and of recorded touches through a live session, reading by reading."""
    with progress_bar() as progress:
        result = run_shifts(data, seconds=3600 * hours, seed=seed, note=lambda what: progress(what, 0, 1))
    columns = {"shift": "{./shift}", "channels": "{./channels}"}
    for clock in ("milliseconds", "processor_milliseconds"):
        columns |= {f"{clock}, {name}".replace("_", " "): f"{{./{clock}/{name}|.3f}}" for name in ("p50", "p99", "max")}
    columns |= {"readings a second": "{./readings_per_second|.0f}", "touches": "{./touches}", "found": "{./found}"}
    columns |= {"in parts": "{./in_parts}", "false": "{./false}", "onset, ms": "{./onset_ms/median|.1f}"}
    show("shifts", columns | {"named right": "{./named_right}"}, result["shifts"])
    write(context, result)
