"""What a learner runs, measured on a memory: features to codes, exact sums, the readout solved from them and followed."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from examples.benchmarks.numerics.memories import Memory
from examples.benchmarks.numerics.truth import Answers, TrueReadout, true_share
from scroll_tactile.readouts.leave_one_out import left_out
from scroll_tactile.readouts.readout import Change, Readout, Task
from scroll_tactile.readouts.shrinkage import LARGEST, LEAST
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.sample import SampledTouch, TouchSample
from scroll_tactile.statistics.statistics import Statistics

__all__ = [
    "AGREED",
    "SCALE",
    "answers_error",
    "asked",
    "compared",
    "flips",
    "follow",
    "measure_learned",
    "name_of",
    "solved",
]

FloatArray = npt.NDArray[np.float64]
Scores = npt.NDArray[np.floating[Any]]
Record = dict[str, Any]

SCALE = Scale("window", 1)
AGREED = 1e-9  # the relative error that scores of a followed readout stay below
LEFT_OUT = 20  # touches that are really left out
MOST_DENSE = 64  # features: up to here touches are left out, and distances compared, in balls too


def answers_error(found: Scores, true: Scores) -> float:
    """The largest error of a row of scores, (m, C), about their mean over the materials, relative to its largest score."""
    difference = (found - found.mean(axis=1, keepdims=True)) - (true - true.mean(axis=1, keepdims=True))
    sizes = np.abs(true - true.mean(axis=1, keepdims=True)).max(axis=1)
    error = np.abs(difference).max(axis=1) / np.where(sizes > 0, sizes, sizes.max() or 1.0)
    return float(error.max()) if np.isfinite(error).all() else float("inf")


def flips(found: Scores, true: Scores) -> int:
    """How many rows of scores, (m, C), name another material."""
    return int(np.count_nonzero(found.argmax(axis=1) != true.argmax(axis=1)))


@dataclass
class Learned:
    """A memory that was learned: the statistics of all touches, and the readout solved from them."""

    memory: Memory
    statistics: Statistics
    task: Task
    readout: Readout
    seconds_per_row: float
    solve_seconds: float

    @classmethod
    def of(cls, memory: Memory) -> Learned:
        """Learn all touches, one by one."""
        statistics = Statistics(memory.features.shape[2], [SCALE])
        memory.codes  # noqa: B018  # rounding is the embedding's
        begun = time.process_time()
        for place, rows in zip(memory.places.tolist(), memory.codes, strict=True):
            statistics.add(name_of(place), {SCALE: rows}, 1)
        statistics.second(SCALE).packed()
        summed = time.process_time()
        task, readout = solved(statistics)
        rows_in_all = memory.codes.shape[0] * memory.codes.shape[1]
        return cls(
            memory, statistics, task, readout, (summed - begun) / rows_in_all, time.process_time() - summed
        )  # fmt: skip

    def truth(self, readout: Readout, rows: npt.NDArray[Any] | None = None) -> TrueReadout:
        """The true readout with the P and the γ of another, of the codes or of other rows (t, k, d)."""
        table = self.memory.codes if rows is None else rows
        return TrueReadout(table.reshape(-1, table.shape[2]), self.memory.row_places, readout.penalty, readout.gamma)


def name_of(place: int) -> str:
    """A material's name: alphabetical order is that of the places."""
    return f"{place:05d}"


def solved(statistics: Statistics) -> tuple[Task, Readout]:
    """The readout of statistics, all materials its reference, and what it was solved from."""
    task = Task.of(statistics, SCALE, statistics.names(SCALE))
    return task, Readout(task, statistics)


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
    """Records of a memory: solved from the integers, followed, and what the grid costs."""
    learned = Learned.of(memory)
    readout, evaluated = learned.readout, np.rint(memory.evaluated * 2**20).astype(np.int64)
    truth = learned.truth(readout)
    true = truth.answers(evaluated)
    base = {
        "case": memory.name,
        "family": memory.family,
        "rows": memory.row_places.size,
        "dimension": memory.features.shape[2],
        "penalty": readout.penalty,
    }
    weights = _centred(readout.gamma * readout.means_of(readout.held(readout.reference))[1].T)
    fresh = base | {
        "method": "learner",
        "weights_error": _norm_error(weights, truth.weights()),
        **compared(asked(readout, evaluated), true),
        "seconds_per_row": learned.seconds_per_row,
        "solve_seconds": learned.solve_seconds,
        "share_error": share_error(learned),
        "left_out_error": left_out_error(learned),
    }
    free = learned.truth(readout, memory.units)
    unrounded = free.answers(memory.evaluated * 2.0**20)
    grid = base | {
        "method": "grid",
        "weights_error": _norm_error(truth.weights(), free.weights()),
        **compared(true, unrounded),
    }
    return [fresh, base | followed_error(learned, evaluated), grid]


def _centred(weights: FloatArray) -> FloatArray:
    return np.asarray(weights - weights.mean(axis=1, keepdims=True))


def _norm_error(found: FloatArray, true: FloatArray) -> float:
    return float(np.linalg.norm(found - true) / (np.linalg.norm(true) or 1.0))


def share_error(learned: Learned) -> float:
    """The relative error of ρ, of the scatter's fractions; 0 where there is no scatter and the readout has none."""
    rows, places = (
        learned.memory.codes.reshape(-1, learned.memory.codes.shape[2]).astype(object),
        learned.memory.row_places,
    )
    scatter = rows.T @ rows
    counts = np.bincount(places).tolist()
    common = int(np.lcm.reduce(np.array(counts, dtype=object)))
    scatter = scatter * common  # ρ does not depend on the unit
    for place, count in enumerate(counts):
        total = rows[places == place].sum(axis=0)
        scatter = scatter - np.outer(total, total) * (common // count)
    if not np.trace(scatter):
        return abs(learned.readout.share)
    true = true_share(scatter, len(learned.memory.places), LEAST, LARGEST)
    return float(abs(learned.readout.share - true) / true)


def followed_error(learned: Learned, evaluated: npt.NDArray[np.int64]) -> Record:
    """The readout of the first touches, followed to all of them: its worst errors then, when one more has come, was
    answered for and is retracted, and when the first touch is retracted.
    """
    memory = learned.memory
    touches = [(name_of(place), rows, 1) for place, rows in zip(memory.places.tolist(), memory.codes, strict=True)]
    rows, dimension = memory.codes.shape[1:]
    # As many touches as a readout follows, less three changes behind them.
    later = min(len(touches) // 2, max(32, dimension // 4) // rows - 3)
    statistics = Statistics(dimension, [SCALE])
    for name, codes, _ in touches[: len(touches) - later]:
        statistics.add(name, {SCALE: codes}, 1)
    _, readout = solved(statistics)
    worst: Record = {"solved_again": 0}
    spent = changed = 0.0

    def change(touch: Change) -> None:
        nonlocal readout, spent, changed
        begun = time.process_time()
        followed = follow(statistics, readout, touch)
        followed.scores(touch[1][0].astype(np.float64), range(len(followed.names)), "lda")
        spent += time.process_time() - begun
        worst["solved_again"] += followed is not readout
        readout, changed = followed, changed + 1

    def compare(kept: slice) -> None:
        true = TrueReadout(
            memory.codes[kept].reshape(-1, dimension), np.repeat(memory.places[kept], rows), readout.penalty, readout.gamma
        )  # fmt: skip
        for name, error in compared(asked(readout, evaluated), true.answers(evaluated)).items():
            worst[name] = max(error, worst.get(name, 0))

    for touch in touches[len(touches) - later :]:
        change(touch)
    compare(slice(None))
    extra = np.repeat(evaluated[:1], rows, axis=0).astype(np.int32)
    for sign in (1, -1):
        change((name_of(0), extra, sign))
    compare(slice(None))
    name, codes, _ = touches[0]
    if statistics.counts(SCALE, [name])[0] > rows:
        change((name, codes, -1))
        compare(slice(1, None))
    return {"method": "learner, followed", **worst, "seconds_per_row": spent / changed, "solve_seconds": 0.0}


def follow(statistics: Statistics, readout: Readout, change: Change) -> Readout:
    """Bring a change into the statistics and the readout; one solved again where it cannot follow."""
    name, rows, sign = change
    (statistics.add if sign > 0 else statistics.remove)(name, {SCALE: rows}, 1)
    return readout if readout.follow([change]) else solved(statistics)[1]


def left_out_error(learned: Learned) -> float | None:
    """The largest error of scores and distances of touches left out, against readouts of all others; None if too large."""
    memory, readout = learned.memory, learned.readout
    rows, dimension = memory.codes.shape[1:]
    if dimension > MOST_DENSE or len(memory.places) > 1000:
        return None
    sample, stages = TouchSample(), [[SCALE]] * rows
    pairs = np.array([(stage, 0, rows) for stage in range(rows)])
    for i, (place, codes) in enumerate(zip(memory.places.tolist(), memory.codes, strict=True)):
        sample.add(name_of(place), i.to_bytes(4, "big"), SampledTouch(codes, pairs))
    apart = {kind: left_out(readout, learned.task, sample, stages, kind) for kind in ("lda", "ridge")}
    worst = 0.0
    for number, (_, key, _) in list(enumerate(sample))[:LEFT_OUT]:
        if (number, 0) not in apart["lda"].rows:
            continue
        i = int.from_bytes(key, "big")
        others = np.arange(len(memory.places)) != i
        true = TrueReadout(
            memory.codes[others].reshape(-1, dimension), np.repeat(memory.places[others], rows), readout.penalty, readout.gamma
        ).answers(memory.codes[i])  # fmt: skip
        at = [apart["lda"].rows[number, stage] for stage in range(rows)]
        distances = np.abs(apart["lda"].distances[at] - true.distances).max() / (np.abs(true.distances).max() or 1.0)
        worst = max(worst, float(distances))
        if true.lda.shape[1] > 1:
            worst = max(worst, *(answers_error(apart[kind].scores[at], getattr(true, kind)) for kind in apart))
    return worst
