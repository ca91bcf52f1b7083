"""What a learner runs, measured on a memory: codes, exact sums, the readout that is solved from them."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import numpy.typing as npt

from examples.benchmarks.numerics.memories import Memory
from examples.benchmarks.numerics.truth import Answers, TrueReadout
from scroll_tactile.readouts.leave_one_out import held_out_scores
from scroll_tactile.readouts.readout import Readout
from scroll_tactile.readouts.task import LARGEST, LEAST, Task
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.sample import SampledTouch, TouchSample
from scroll_tactile.statistics.statistics import Statistics

__all__ = [
    "AGREED",
    "SCALE",
    "answers_error",
    "asked",
    "compared",
    "flips",
    "measure_learned",
    "name_of",
    "solved",
]

FloatArray = npt.NDArray[np.float64]
Scores = npt.NDArray[np.floating[Any]]
Record = dict[str, Any]

SCALE = Scale("window", 1)
AGREED = 1e-9  # the relative error that scores stay below
LEFT_OUT = 20  # touches that are really left out
EDGE = 2.0**BITS
MOST_DENSE = 64  # features: up to here touches are really left out


def answers_error(found: Scores, true: Scores) -> float:
    """The largest error of a row of scores, (m, C), about their mean over the materials, relative to its largest."""
    difference = (found - found.mean(axis=1, keepdims=True)) - (true - true.mean(axis=1, keepdims=True))
    sizes = np.abs(true - true.mean(axis=1, keepdims=True)).max(axis=1)
    error = np.abs(difference).max(axis=1) / np.where(sizes > 0, sizes, sizes.max() or 1.0)
    return float(error.max()) if np.isfinite(error).all() else float("inf")


def flips(found: Scores, true: Scores) -> int:
    """How many rows of scores, (m, C), name another material."""
    return int(np.count_nonzero(found.argmax(axis=1) != true.argmax(axis=1)))


def name_of(place: int) -> str:
    """A material's name: alphabetical order is that of the places."""
    return f"{place:05d}"


def solved(statistics: Statistics) -> Readout:
    """The readout of statistics, all materials its reference."""
    return Task.of(statistics, SCALE, statistics.names(SCALE)).solve()


def asked(readout: Readout, codes: npt.NDArray[np.integer]) -> Answers:
    """What a readout answers for rows of codes, (m, d); its materials by name."""
    places = [readout.places[name] for name in sorted(readout.names)]
    rows = codes.astype(np.float64)
    lda, ridge = (np.stack([readout.scores(row, places, kind) for row in rows]) for kind in ("lda", "ridge"))
    novelty = np.array([readout.novelty(row, places) for row in rows])
    return Answers(lda, ridge, np.zeros((0, 0)), novelty)


def compared(found: Answers, true: Answers) -> Record:
    """Errors of answers: of the scores of both readouts, and of novelty, relative to its largest."""
    novelty = np.abs(found.novelty - true.novelty).max() / (np.abs(true.novelty).max() or 1.0)
    single = true.lda.shape[1] == 1
    return {
        "answers_error": 0.0 if single else answers_error(found.lda, true.lda),
        "ridge_error": 0.0 if single else answers_error(found.ridge, true.ridge),
        "novelty_error": float(novelty),
        "flipped": flips(found.lda, true.lda),
    }


def measure_learned(memory: Memory) -> list[Record]:
    """Records of a memory: solved from the integers, and what the grid costs."""
    evaluated = np.rint(memory.evaluated * EDGE).astype(np.int64)
    begun = time.process_time()
    statistics = taught(memory)
    statistics.second(SCALE).packed()
    summed = time.process_time()
    readout = solved(statistics)
    done = time.process_time()
    truth = truth_of(memory, memory.codes, readout)
    true = truth.answers(evaluated)
    free = truth_of(memory, memory.units, readout)
    solution = readout.gamma * readout.solved()[0].T
    weights = solution - solution.mean(axis=1, keepdims=True)
    share = truth.share(len(memory.places), LEAST, LARGEST)
    base = {"case": memory.name, "family": memory.family, "penalty": readout.penalty}
    base |= {"rows": memory.row_places.size, "dimension": memory.features.shape[2]}
    fresh = {
        "method": "learner",
        **compared(asked(readout, evaluated), true),
        "weights_error": _norm_error(weights, truth.weights()),
        "share_error": abs(readout.share - share) / (share or 1.0),
        "left_out_error": _left_out_error(memory, readout),
        "seconds_per_row": (summed - begun) / memory.row_places.size,
        "solve_seconds": done - summed,
    }
    grid = {
        "method": "grid",
        **compared(true, free.answers(memory.evaluated * EDGE)),
        "weights_error": _norm_error(truth.weights(), free.weights()),
    }
    return [base | found for found in (fresh, grid)]


def taught(memory: Memory) -> Statistics:
    """The statistics of a memory."""
    statistics = Statistics(memory.features.shape[2], [SCALE])
    for place, rows in zip(memory.places.tolist(), memory.codes, strict=True):
        statistics.add(name_of(place), {SCALE: rows}, 1)
    return statistics


def truth_of(memory: Memory, rows: npt.NDArray[Any], readout: Readout, kept: Any = slice(None)) -> TrueReadout:
    """The true readout of some touches' rows, (t, k, d), with the P and the γ of a readout."""
    places = np.repeat(memory.places[kept], rows.shape[1])
    return TrueReadout(rows[kept].reshape(-1, rows.shape[2]), places, readout.penalty, readout.gamma)


def _norm_error(found: FloatArray, true: FloatArray) -> float:
    return float(np.linalg.norm(found - true) / (np.linalg.norm(true) or 1.0))


def _shares(places: npt.NDArray[np.intp]) -> npt.NDArray[np.float64]:
    """The share of each material among touches of these places, shape (C,)."""
    counts = np.bincount(places)
    return np.asarray(counts / counts.sum())


def _left_out_error(memory: Memory, readout: Readout) -> float | None:
    """The largest error of scores and distances of touches left out, against readouts of the others; None if many."""
    rows, dimension = memory.codes.shape[1:]
    if dimension > MOST_DENSE or len(memory.places) > 1000:
        return None
    sample, stages = TouchSample(), [[SCALE]] * rows
    pairs = np.array([(stage, 0, rows) for stage in range(rows)])
    for i, (place, codes) in enumerate(zip(memory.places.tolist(), memory.codes, strict=True)):
        sample.add(name_of(place), i.to_bytes(4, "big"), SampledTouch(codes, pairs))
    apart = {kind: held_out_scores(readout, sample, stages, kind) for kind in ("lda", "ridge")}
    worst = 0.0
    for number, (_, key, _) in list(enumerate(sample))[:LEFT_OUT]:
        if (number, 0) not in apart["lda"].rows:
            continue
        i = int.from_bytes(key, "big")
        kept = np.arange(len(memory.places)) != i
        others, place = truth_of(memory, memory.codes, readout, kept), int(memory.places[i])
        true = others.answers(memory.codes[i])
        # Its own material is no further away than from a new touch; scores are about their mean over the materials.
        nearer = others.far(memory.codes[i], place) / np.count_nonzero(memory.places == place) ** 2 / 2
        true.lda[:, place] += nearer
        # The ridge of the others, with the shares of all.
        true.ridge[...] += _shares(memory.places) - _shares(memory.places[kept])
        at = [apart["lda"].rows[number, stage] for stage in range(rows)]
        distances = np.abs(apart["lda"].distances[at] - true.distances).max() / (np.abs(true.distances).max() or 1.0)
        worst = max(worst, float(distances))
        if true.lda.shape[1] > 1:
            worst = max(worst, *(answers_error(apart[kind].scores[at], getattr(true, kind)) for kind in apart))
    return worst
