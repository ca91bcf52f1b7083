"""`unlearning`: beside the nearest peer: additions and deletions, and how far each way strays from starting anew.

The peer is exact federated continual unlearning (Quan, Wu and Montana 2026, arXiv 2603.12977), ridge on frozen
features: "exact" there is exact arithmetic, followed in float64, 1e-9 relative by their measure. None of this is their
code. Ours are the bytes of `TactileLearner` after `observe` and `retract`.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import typer
from scipy.linalg import cho_factor, cho_solve

from examples.paper.readers.labelled import Recordings, hold_out
from examples.paper.runs.cached import Cached
from examples.paper.runs.cells import Cell, Figures, learn, require_folds, run_cells, silent
from examples.paper.runs.options import Data, Dataset, Folds, Json, Quick, Run, Seed, folds_of, read
from examples.paper.runs.results import show, write
from examples.paper.runs.study import OwnSystems, sensors_of
from examples.paper.studies.peers import touch_features
from examples.paper.studies.recursive_ridge import RecursiveRidge
from examples.paper.systems.coming import Coming, code_of, require_systems
from scroll_tactile import Embedding, Kernels
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.clients.learning.metrics import Labelled
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.learner import TactileLearner
from scroll_tactile.results import Receipt
from scroll_tactile.statistics.statistics import Statistics

__all__ = [
    "PENALTIES",
    "WAYS",
    "Request",
    "Unlearning",
    "head_from",
    "relative_error",
    "requests",
    "ridge_from_scratch",
    "summary",
    "unlearning",
]

FloatArray = npt.NDArray[np.float64]

PENALTIES = (1.0, 1e-2, 1e-3)
"""λ of the ridge heads: the smaller, the more of the rounding errors is seen. The peer's own is not known to us."""

WAYS = {
    "weights": "W followed",
    "inverse": "the inverse followed, times XᵀY",
    "sums": "XᵀX and XᵀY followed, solved anew",
    "anew": "float64, from scratch",
}
"""How a peer comes to its head: by Woodbury's identity in two ways, by sums in float64, and not by following."""

CHECKPOINTS = (1, 10, 100, 1000)
LARGEST = 4  # touches in a request
START = 0.5  # of the touches are there before the first request


@dataclass(frozen=True)
class Request:
    """Touches that come, or go again, by their places."""

    adds: bool
    touches: tuple[int, ...]


def requests(count: int, touches: int, seed: int) -> tuple[list[int], list[Request]]:
    """Which of so many touches are there at first, a drawn half, and requests that come and go with even chance.

    Each is of 1 to LARGEST drawn touches that are not there, or are. Raises InputError for fewer touches than twice
    the largest request.
    """
    if touches < 2 * LARGEST:
        raise InputError(f"expected {2 * LARGEST} touches or more; came {touches}")
    random = np.random.default_rng([seed, 8])
    order = random.permutation(touches).tolist()
    first = sorted(order[: round(START * touches)])
    there, away = set(first), set(order) - set(first)
    drawn = []
    for _ in range(count):
        size = int(random.integers(1, LARGEST + 1))
        adds = bool(random.random() < 0.5) if size < min(len(there), len(away) + 1) else len(there) <= size
        chosen = random.choice(sorted(away if adds else there), size, replace=False).tolist()
        (there.update if adds else there.difference_update)(chosen)
        (away.difference_update if adds else away.update)(chosen)
        drawn.append(Request(adds, tuple(chosen)))
    return first, drawn


def relative_error(weights: FloatArray, truth: FloatArray) -> float:
    """|W − W*| / |W*| by Frobenius norms."""
    return float(np.linalg.norm(weights - truth) / np.linalg.norm(truth))


def ridge_from_scratch(rows: FloatArray, targets: FloatArray, penalty: float) -> tuple[FloatArray, FloatArray]:
    """W of (XᵀX + λI) W = XᵀY as float64 solves it, and to more digits: refined by residuals in long double."""
    factor = cho_factor(_with_penalty(rows.T @ rows, penalty))
    wide, wanted = rows.astype(np.longdouble), targets.astype(np.longdouble)
    solved = cho_solve(factor, rows.T @ targets)
    refined = solved.astype(np.longdouble)
    for _ in range(6):
        residual = wide.T @ (wanted - wide @ refined) - np.longdouble(penalty) * refined
        refined += cho_solve(factor, residual.astype(np.float64))
    return solved, refined.astype(np.float64)


def head_from(statistics: Statistics, penalty: float = 1.0) -> FloatArray:
    """The ridge head of a memory's widest windows, solved in float64 from its integers, shape (d, C), in codes.

    penalty: λ, by the mean of the second moment's diagonal.
    """
    scale = [scale for scale in statistics.scales if scale.kind == "window"][-1]
    dimension = statistics.dimension
    moment = np.zeros((dimension, dimension))
    moment[np.tril_indices(dimension)] = statistics.second(scale).packed()
    moment += np.tril(moment, -1).T
    _, sums = statistics.totals(scale, statistics.names(scale))
    system = _with_penalty(moment, penalty * float(np.trace(moment)) / dimension)
    return np.asarray(cho_solve(cho_factor(system), sums.T.astype(np.float64)))


def _with_penalty(matrix: FloatArray, penalty: float) -> FloatArray:
    matrix[np.diag_indices_from(matrix)] += penalty
    return matrix


@dataclass(frozen=True)
class Unlearning:
    """A schedule of requests on each fold's training touches.

    checkpoints: after how many requests all is compared with starting anew; the last is the number of requests.
    seed: draws them. features: of the kernels. systems: of one's own, beside ours. folder: of the notes, so that a run
    that was killed resumes; or None.
    """

    recordings: Recordings
    checkpoints: tuple[int, ...] = CHECKPOINTS
    seed: int = 0
    features: int = 1008
    folder: Path | None = None
    systems: tuple[str, ...] = ()

    @property
    def plan(self) -> dict[str, Any]:
        """All that a figure depends on, in JSON's types."""
        options = {"checkpoints": list(self.checkpoints), "seed": self.seed, "features": self.features}
        return {"run": "unlearning", "dataset": self.recordings.name, "penalties": list(PENALTIES), **options}

    def run(self, folds: Sequence[int], progress: Progress = silent) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each fold as it is finished; those finished before are read back.

        Raises InputError for a fold that is not there or a folder of another run, and what learning raises.
        """
        require_folds(self.recordings.fold, folds)
        cells = [Cell(self.recordings.name, fold, who) for who in ("requests", *self.systems) for fold in folds]
        code = code_of(self.systems)
        yield from run_cells(self.folder, self.plan, [self.recordings], cells, self._measure, progress, code)

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        return self._own(cell, progress) if cell.system in self.systems else self._ours(cell, progress)

    def _own(self, cell: Cell, progress: Progress) -> Figures:
        """After so many requests, the share of answers that a system of one's own gives that starts anew."""
        train, test = hold_out(self.recordings, self.recordings.fold == cell.fold)
        streams = [stream for _, stream in test]
        first, drawn = requests(self.checkpoints[-1], len(train), self.seed)
        followed, there, found = Coming(cell.system, self.seed), set(first), {}
        for i in first:
            followed.observe(i, train[i])
        for done, request in enumerate(drawn, start=1):
            progress("requests", done, len(drawn))
            (there.update if request.adds else there.difference_update)(request.touches)
            for i in request.touches:
                followed.observe(i, train[i]) if request.adds else followed.retract(i)
            if done in self.checkpoints:
                anew = Coming(cell.system, self.seed)
                for i in sorted(there):
                    anew.observe(i, train[i])
                pairs = zip(followed.predict(streams), anew.predict(streams), strict=True)
                found[str(done)] = float(np.mean([one == other for one, other in pairs]))
        return {"learned": len(train), "at first": len(first), "same_answers_after": found}

    def _ours(self, cell: Cell, progress: Progress) -> Figures:
        train, test = hold_out(self.recordings, self.recordings.fold == cell.fold)
        first, drawn = requests(self.checkpoints[-1], len(train), self.seed)
        peer = _Peer(touch_features(self._kernels, [stream for _, stream in train]), [name for name, _ in train])
        sensor = self.recordings.sensor
        with (
            tempfile.TemporaryDirectory(prefix="scroll-tactile-") as name,
            TactileLearner.open(name, sensor=sensor, embedding=self._kernels, exemplars=0) as learner,
        ):
            ours = _Ours(learner, train, test)
            for side in (ours, peer):
                side.follow(Request(True, tuple(first)))
                side.seconds = 0.0
            found = []
            for done, request in enumerate(drawn, start=1):
                progress("requests", done, len(drawn))
                ours.follow(request)
                peer.follow(request)
                if done in self.checkpoints:
                    found.append({"requests": done, "ours": ours.compared(), "peer": peer.compared()})
            same_answers = ours.answers_as_anew()
        took = {"ours_ms": 1000 * ours.seconds / len(drawn), "peer_ms": 1000 * peer.seconds / len(drawn)}
        return {"learned": len(train), "at first": len(first), "same_answers": same_answers, **took, "after": found}

    @cached_property
    def _kernels(self) -> Embedding:
        return Cached(Kernels(dimension=self.features))


class _Ours:
    """A memory that follows the requests, to be compared with one that never had what was deleted."""

    def __init__(self, learner: TactileLearner, train: Sequence[Labelled], test: Sequence[Labelled]) -> None:
        self._learner, self._train, self._test = learner, train, test
        self._receipts: dict[int, Receipt] = {}
        self.seconds = 0.0

    def follow(self, request: Request) -> None:
        """Observe what comes, retract what goes."""
        begun = time.process_time()
        for i in request.touches:
            if request.adds:
                self._receipts[i] = self._learner.observe(*self._train[i])
            else:
                self._learner.retract(self._receipts.pop(i))
        self.seconds += time.process_time() - begun

    def compared(self) -> dict[str, Any]:
        """Whether the bytes are those of starting anew, in another order; and the heads' relative error."""
        anew = self._anew()
        heads = head_from(self._learner.memory.statistics), head_from(anew.memory.statistics)
        same_bytes = self._learner.digest() == anew.digest()
        return {"touches": len(self._receipts), "same_bytes": same_bytes, "error": relative_error(*heads)}

    def answers_as_anew(self) -> bool:
        """Whether every answer to the test is the one of a memory that starts anew, in every bit."""
        learners = self._learner, self._anew()
        for learner in learners:
            learner.settle()
        followed, anew = ([learner.predict(stream) for _, stream in self._test] for learner in learners)
        return followed == anew

    def _anew(self) -> TactileLearner:
        anew = TactileLearner(sensor=self._learner.sensor, embedding=self._learner.embedding, exemplars=0)
        return learn(anew, [self._train[i] for i in sorted(self._receipts)])


class _Peer:
    """Ridge heads in float64 that follow the requests, one for each penalty, in each of WAYS."""

    def __init__(self, rows: FloatArray, names: Sequence[str]) -> None:
        self._rows = np.pad(rows, ((0, 0), (0, 1)), constant_values=1.0)
        places = {name: i for i, name in enumerate(sorted(set(names)))}
        self._targets = np.eye(len(places))[[places[name] for name in names]]
        width = self._rows.shape[1]
        self._followed = {penalty: RecursiveRidge(width, len(places), penalty) for penalty in PENALTIES}
        self._gram = np.zeros((width, width))
        self._there: set[int] = set()
        self.seconds = 0.0

    def follow(self, request: Request) -> None:
        """Woodbury's identity for all touches of a request; the time is of one penalty."""
        chosen = list(request.touches)
        rows, targets = self._rows[chosen], self._targets[chosen]
        self._gram += (1 if request.adds else -1) * (rows.T @ rows)
        (self._there.update if request.adds else self._there.difference_update)(chosen)
        begun = time.process_time()
        with np.errstate(over="ignore", invalid="ignore"):  # what diverges shows in its error
            for ridge in self._followed.values():
                (ridge.add if request.adds else ridge.remove)(rows, targets)
        self.seconds += (time.process_time() - begun) / len(PENALTIES)

    def compared(self) -> dict[str, dict[str, float | None]]:
        """Penalty → relative errors of the three ways, and of float64 starting anew, against more digits.

        None: it diverged, the error is 1 or more.
        """
        own = sorted(self._there)
        found = {}
        for penalty, ridge in self._followed.items():
            scratch, truth = ridge_from_scratch(self._rows[own], self._targets[own], penalty)
            solved = cho_solve(cho_factor(_with_penalty(self._gram.copy(), penalty)), ridge.sums)
            heads = {"weights": ridge.weights, "inverse": ridge.inverse @ ridge.sums, "sums": solved, "anew": scratch}
            with np.errstate(over="ignore", invalid="ignore"):
                errors = {way: relative_error(head, truth) for way, head in heads.items()}
            # A head that is further from the truth than 0 is has none of it left.
            found[f"{penalty:g}"] = {way: error if error < 1 else None for way, error in errors.items()}
        return found


def summary(cells: Sequence[tuple[Cell, Figures]]) -> dict[str, Any]:
    """Over folds: whether the bytes were the same, after so many requests, and the largest errors (None: diverged)."""
    folds = [figures for _, figures in cells]
    counts = [str(after["requests"]) for after in folds[0]["after"]]
    afters = {count: [fold["after"][i] for fold in folds] for i, count in enumerate(counts)}

    def largest(values: Sequence[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return max(known) if len(known) == len(values) else None

    peer = {
        f"{penalty:g}": {
            way: {
                count: largest([after["peer"][f"{penalty:g}"][way] for after in found])
                for count, found in afters.items()
            }
            for way in WAYS
        }
        for penalty in PENALTIES
    }
    return {
        "folds": len(folds),
        "same_bytes": {count: all(after["ours"]["same_bytes"] for after in found) for count, found in afters.items()},
        "ours": {count: max(after["ours"]["error"] for after in found) for count, found in afters.items()},
        "same_answers": all(fold["same_answers"] for fold in folds),
        "peer": peer,
        **{name: float(np.mean([fold[name] for fold in folds])) for name in ("ours_ms", "peer_ms")},
    }


def unlearning(
    context: typer.Context,
    dataset: Dataset,
    data: Data,
    folds: Folds = "all",
    seed: Seed = 0,
    own_systems: OwnSystems = None,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
) -> None:
    """Let touches come and go, a thousand requests, and compare what is left with starting anew.

    Ours must have the bytes of a memory that never had what went. Beside it: ridge heads that Woodbury's identity
    follows in float64, as exact federated continual unlearning and ACIL do, and their relative error.
    """
    own = require_systems(own_systems)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        (recordings,) = read("DATASET", dataset, data, seed, quick=quick).values()
        task = Unlearning(recordings, CHECKPOINTS[: 2 if quick else None], seed, folder=run, systems=own)
        results = list(task.run(folds_of(folds, recordings, quick=quick), progress))
    means = summary([(cell, figures) for cell, figures in results if cell.system not in own])
    means |= {"own": {key: _same_answers(results, key) for key in own}} if own else {}
    rows: list[dict[str, Any]] = [{"way": "ours: the same bytes", "after": means["same_bytes"]}]
    rows.append({"way": "ours", "after": means["ours"]})
    for penalty, ways in means["peer"].items():
        rows += [{"way": f"λ = {penalty}: {WAYS[way]}", "after": after} for way, after in ways.items()]
    columns = {"relative error of the head, the largest over folds": "{./way}"}
    columns |= {f"{count} requests": f"{{./after/{count}}}" for count in means["same_bytes"]}
    show("unlearning", columns, [row | {"after": {n: _shown(x) for n, x in row["after"].items()}} for row in rows])
    columns = {"the same answers": "{./same_answers}", "ours, ms a request": "{./ours_ms|.0f}"}
    show("the processor's time", columns | {"the peer's": "{./peer_ms|.0f}"}, [means])
    if own:
        columns = {"the same answers as from starting anew, %": "{./system}"}
        columns |= {f"{count} requests": f"{{./after/{count}|%}}" for count in means["same_bytes"]}
        show("one's own", columns, [{"system": key, "after": after} for key, after in means["own"].items()])
    sensor = sensors_of([recordings])[recordings.name]
    cells = {cell.key: figures for cell, figures in results}
    write(context, task.plan | {"sensor": sensor, "means": means, "cells": cells})


def _same_answers(results: Sequence[tuple[Cell, Figures]], key: str) -> dict[str, float]:
    """After so many requests, the mean over folds of a system's share of answers that starting anew gives."""
    folds = [figures["same_answers_after"] for cell, figures in results if cell.system == key]
    return {count: float(np.mean([fold[count] for fold in folds])) for count in folds[0]}


def _shown(figure: float | None) -> str:
    if isinstance(figure, bool):
        return "yes" if figure else "no"
    return "diverged" if figure is None else f"{figure:.0e}"
