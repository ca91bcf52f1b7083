"""`python -m examples.benchmarks frontier`: error against milliseconds, on recorded touches.

Width of the embedding × readout × length of the touch, learned from one pass over the other folds into a
memory on disk; and beside it other libraries' learners on the same feature vectors, one for each touch. Times are of
the processor, on one thread, the median and the 99th percentile over the touches of one fold. Errors are of all folds
given.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from examples.benchmarks.timing import Timing, circumstances, timed
from examples.benchmarks.vector_peers import (
    GradientSteps,
    OneVsRest,
    Ours,
    PseudoInverse,
    RecursiveFilters,
    Refitted,
    VectorPeer,
    lacking,
)
from examples.paper.drawing import picture
from examples.paper.studies.peers import touch_features
from scroll_tactile import Kernels
from scroll_tactile.datasets import Recordings
from scroll_tactile.learner import TactileLearner
from scroll_tactile.pipelines.classification import Labelled, hold_out
from scroll_tactile.readouts.readout import ReadoutName

__all__ = ["WIDTHS", "draw_frontier", "knee", "measure_frontier", "run_frontier", "run_peers"]

Record = dict[str, Any]
Note = Callable[[str], object]
FloatArray = npt.NDArray[np.float64]

WIDTHS = (126, 252, 504, 1008, 2016)
LENGTHS = (0.3, 1.0, None)  # seconds; None: all of a touch
PEERS_WIDTH = 252  # features: padasip's filters carry a P each, and at 1008 a touch takes them a second
STYLES = {"lda": "-", "ridge": "--"}
SLOW = 20  # predictions that are timed where each follows an observation


def measure_frontier(
    sets: Sequence[Recordings], *, seed: int = 0, quick: bool = False, note: Note = lambda what: None
) -> Record:
    """The records of `run_frontier` and `run_peers` on some sets, and the `knee`; quick: one fold, two widths."""
    result = {"bench": "frontier", **circumstances(seed), "clock": "processor", "quick": quick}
    widths = WIDTHS[:2] if quick else WIDTHS
    frontier, peers = [], []
    for recordings in sets:
        folds = [0] if quick else sorted(set(recordings.fold.tolist()))
        frontier += run_frontier(recordings, folds, widths, note=note)
        peers += run_peers(recordings, 0, seed, note=note)
    return result | {"frontier": frontier, "peers": peers, "knee": knee(frontier)}


def run_frontier(
    recordings: Recordings, folds: Sequence[int], widths: Sequence[int] = WIDTHS, *, note: Note = lambda what: None
) -> list[Record]:
    """Records of every width × readout × length: wrong share over the folds, milliseconds of the first of them."""
    records = []
    for width in widths:
        tried: dict[tuple[str, str], list[float]] = {}
        times: dict[tuple[str, str], Record] = {}
        for fold in folds:
            note(f"{recordings.name}: {width} features, fold {fold}")
            for key, share, taken in _one_fold(recordings, fold, width):
                tried.setdefault(key, []).append(share)
                times.setdefault(key, taken)
        for (readout, length), wrong in tried.items():
            common = {"dataset": recordings.name, "width": width, "readout": readout, "length": length}
            touches = int(np.isin(recordings.fold, folds).sum())
            records.append(common | {"wrong": float(np.mean(wrong)), "touches": touches} | times[readout, length])
    return records


def _one_fold(recordings: Recordings, fold: int, width: int) -> list[tuple[tuple[str, str], float, Record]]:
    train, test = hold_out(recordings, recordings.fold == fold)
    found = []
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        path, embedding = Path(folder, "memory"), Kernels(dimension=width)
        with TactileLearner.open(path, sensor=recordings.sensor, embedding=embedding, exemplars=0) as learner:
            observing = [timed(partial(learner.observe, *touch), "processor") for touch in train]
        for readout in get_args(ReadoutName):
            with TactileLearner.open(path, embedding=embedding, readout=readout, mode="read") as learner:
                first = timed(partial(learner.predict, test[0][1]), "processor")
                for seconds in LENGTHS:
                    wrong, predicting = _answered(learner, test, seconds)
                    times = {**_times("observe", observing), **_times("predict", predicting)}
                    times |= {"first_predict_ms": 1e3 * first}
                    found.append(((readout, "all" if seconds is None else f"{seconds:g} s"), wrong, times))
    return found


def _answered(learner: TactileLearner, test: Sequence[Labelled], seconds: float | None) -> tuple[float, list[float]]:
    """The share of touches that were taken for something else, and the seconds that each answer took."""
    wrong, taken = 0, []
    for name, stream in test:
        cut = stream if seconds is None else stream.first(seconds)
        begun = time.process_time()
        said = learner.predict(cut).material
        taken.append(time.process_time() - begun)
        wrong += said != name
    return wrong / len(test), taken


def _times(verb: str, seconds: Sequence[float]) -> Record:
    timing = Timing.of(seconds, "processor")
    return {f"{verb}_ms": timing.median, f"{verb}_p99_ms": timing.p99}


def run_peers(recordings: Recordings, fold: int, seed: int, *, note: Note = lambda what: None) -> list[Record]:
    """Ours and others on the same vectors, the mean of a touch's windows: wrong share of a fold, and milliseconds.

    In a random order, which gradient steps need. `predict_ms` is of a prediction that follows others, `fresh_ms` of
    one that follows an observation.
    """
    train, test = hold_out(recordings, recordings.fold == fold)
    embedding = Kernels(dimension=PEERS_WIDTH)
    note(f"{recordings.name}: {PEERS_WIDTH} features of {len(train) + len(test)} touches")
    names = sorted(set(recordings.materials))
    rows = touch_features(embedding, [stream for _, stream in train])
    questions = touch_features(embedding, [stream for _, stream in test])
    places = [names.index(name) for name, _ in train]
    truth = [names.index(name) for name, _ in test]
    order = np.random.default_rng(seed).permutation(len(rows)).tolist()
    records = []
    for name, package, make in _peers(len(names), seed):
        common = {"dataset": recordings.name, "learner": name, "features": PEERS_WIDTH}
        if why := lacking(package):
            records.append(common | {"measured": False, "why": why})
            continue
        note(f"{recordings.name}: {name}")
        with threadpool_limits(1):
            records.append(common | {"measured": True} | _measured(make(), rows, places, order, questions, truth))
    return records


def _peers(classes: int, seed: int) -> list[tuple[str, str, Callable[[], VectorPeer]]]:
    """Name, the package that it needs, how it is made."""
    return [
        ("ours, refit=0: λ at every change", "torch", lambda: Ours(PEERS_WIDTH, 0.0)),
        ("ours, refit=0.1: λ where it has grown by a tenth", "torch", lambda: Ours(PEERS_WIDTH, 0.1)),
        ("streaming LDA, pseudo-inverse on predict", "torch", lambda: PseudoInverse(classes, PEERS_WIDTH)),
        ("scikit-learn RidgeClassifier, fitted again", "sklearn", Refitted),
        ("scikit-learn SGDClassifier.partial_fit", "sklearn", lambda: GradientSteps(classes, seed)),
        ("river one-vs-rest LogisticRegression", "river", OneVsRest),
        ("padasip FilterRLS, one a class", "padasip", lambda: RecursiveFilters(classes, PEERS_WIDTH)),
    ]


def _measured(
    peer: VectorPeer,
    rows: FloatArray,
    places: Sequence[int],
    order: Sequence[int],
    questions: FloatArray,
    truth: Sequence[int],
) -> Record:
    observing, fresh = [], []
    for step, i in enumerate(order):
        observing.append(timed(partial(peer.observe, places[i], rows[i]), "processor"))
        if step >= len(order) - SLOW:
            fresh.append(timed(partial(peer.predict, questions[0]), "processor"))
    taken, wrong = [], 0
    for row, place in zip(questions, truth, strict=True):
        begun = time.process_time()
        said = peer.predict(row)
        taken.append(time.process_time() - begun)
        wrong += said != place
    return {
        "wrong": wrong / len(truth),
        **_times("observe", observing),
        **_times("predict", taken),
        **_times("fresh", fresh),
    }


def knee(records: Sequence[Record], readout: ReadoutName = "lda") -> Record:
    """Where along the widths more time stops paying: the default's reason, of whole touches.

    The mean over the data sets of wrong shares and of milliseconds, by width; for each width the points of error that
    the next wider takes away, and how much longer it predicts. The knee is the first width from which no wider takes
    away more than a standard error, √(e (1 − e) / n) with n touches a data set.
    """
    mine = [record for record in records if record["readout"] == readout and record["length"] == "all"]
    widths = sorted({record["width"] for record in mine})
    steps = []
    for width in widths:
        of_width = [record for record in mine if record["width"] == width]
        steps.append(
            {
                "width": width,
                "wrong": float(np.mean([record["wrong"] for record in of_width])),
                "predict_ms": float(np.mean([record["predict_ms"] for record in of_width])),
                "observe_ms": float(np.mean([record["observe_ms"] for record in of_width])),
                "touches": sum(record["touches"] for record in of_width),
            }
        )
    for i, step in enumerate(steps):
        spread = float(np.sqrt(max(step["wrong"] * (1 - step["wrong"]), 1e-6) / step["touches"]))
        gained = max((step["wrong"] - wider["wrong"] for wider in steps[i + 1 :]), default=0.0)
        step |= {"standard_error": spread, "gained_by_wider": gained}
    chosen = next(step["width"] for step in steps if step["gained_by_wider"] <= step["standard_error"])
    return {"readout": readout, "width": chosen, "default": Kernels().dimension, "steps": steps}


def draw_frontier(path: Path, records: Sequence[Record], peers: Sequence[Record], *, default: int) -> None:
    """Draw the records of `run_frontier` and `run_peers` into a picture; `default` is the width to be marked.

    Raises InputError where matplotlib is missing or the file cannot be written.
    """
    with picture(path, 13, 6) as figure:
        ours, others = figure.subplots(1, 2)
        _draw_widths(ours, records, default)
        _draw_peers(others, [record for record in peers if record["measured"]])
        for panel in (ours, others):
            panel.set(xscale="log", yscale="log", ylabel="touches taken for something else, %")
            panel.grid(alpha=0.25, which="both")
            if panel.get_legend_handles_labels()[0]:
                panel.legend(fontsize=8)


def _draw_widths(panel: Any, records: Sequence[Record], default: int) -> None:
    lines = dict.fromkeys((record["dataset"], record["length"], record["readout"]) for record in records)
    colours = {key: f"C{i}" for i, key in enumerate(dict.fromkeys((dataset, length) for dataset, length, _ in lines))}
    for dataset, length, readout in lines:
        mine = [
            record
            for record in records
            if (record["dataset"], record["length"], record["readout"]) == (dataset, length, readout)
        ]
        mine.sort(key=lambda record: record["width"])
        times, errors = [record["predict_ms"] for record in mine], [_percent(record) for record in mine]
        colour = colours[dataset, length]
        label = f"{dataset}, {'whole touches' if length == 'all' else length}, {readout}"
        panel.plot(times, errors, STYLES[readout], color=colour, marker=".", label=label)
        marked = [place for place, record in enumerate(mine) if record["width"] == default]
        panel.scatter([times[place] for place in marked], [errors[place] for place in marked], s=90, color=colour)
    panel.set(xlabel="ms a prediction, embedding included", title=f"widths of the embedding; large: {default}, default")


def _draw_peers(panel: Any, peers: Sequence[Record]) -> None:
    names = list(dict.fromkeys(record["learner"] for record in peers))
    markers = dict(zip(dict.fromkeys(record["dataset"] for record in peers), "os^D", strict=False))
    for i, name in enumerate(names):
        for record in (record for record in peers if record["learner"] == name):
            label = f"{name}, {record['dataset']}"
            pair = record["observe_ms"] + record["fresh_ms"]
            panel.scatter(
                pair, _percent(record), s=70, color=f"C{i % 10}", marker=markers[record["dataset"]], label=label
            )
    features = peers[0]["features"] if peers else ""
    panel.set(xlabel="ms an observation and the prediction that follows", title=f"the same {features} features for all")


def _percent(record: Record) -> float:
    # None wrong has no place on a logarithmic axis: it stands where a tenth of a percent is.
    return max(100.0 * float(record["wrong"]), 0.1)
