"""The order of a pass, and the proof that the order in which touches are learned makes no difference, to the bit."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from scroll_tactile import Kernels
from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.pipelines.classification import Labelled
from scroll_tactile.results import Prediction
from scroll_tactile.sensors import Sensor

__all__ = ["SCHEDULES", "ScheduleName", "Trial", "arrange", "part_ends", "si_blurry", "try_schedules"]


ScheduleName = Literal["class-by-class", "reversed", "shuffled", "batches", "interleaved"]
SCHEDULES: tuple[ScheduleName, ...] = get_args(ScheduleName)

_BATCH = 4  # materials in a batch: five batches of twenty, the usual split of continual learning


def arrange(schedule: ScheduleName, materials: Sequence[str], seed: int) -> list[int]:
    """The order in which N touches are learned: a permutation of 0 … N − 1.

    materials: of each touch, N names. seed: 0 or more.
    "class-by-class": all touches of one material, then of the next, materials in a drawn order; "reversed": the
    same backwards; "shuffled": at random; "batches": four materials at a time, shuffled among themselves;
    "interleaved": one touch of every material, then the next of every one.

    Raises InputError for another schedule.
    """
    if schedule not in SCHEDULES:
        raise InputError(f"expected a schedule, one of {', '.join(SCHEDULES)}; came {schedule!r}")
    random = np.random.default_rng(seed)
    names = sorted(set(materials))
    turn = {names[place]: i for i, place in enumerate(random.permutation(len(names)))}
    draw = random.permutation(len(materials))
    seen: dict[str, int] = {}
    repetition = []
    for name in materials:
        repetition.append(seen.get(name, 0))
        seen[name] = repetition[-1] + 1
    places = range(len(materials))
    if schedule == "shuffled":
        return [int(i) for i in draw]
    if schedule == "batches":
        return sorted(places, key=lambda i: (turn[materials[i]] // _BATCH, draw[i]))
    if schedule == "interleaved":
        return sorted(places, key=lambda i: (repetition[i], turn[materials[i]]))
    order = sorted(places, key=lambda i: (turn[materials[i]], repetition[i]))
    return order[::-1] if schedule == "reversed" else order


def part_ends(schedule: ScheduleName, materials: Sequence[str]) -> list[int]:
    """After how many touches each part of a pass ends; a pass has as many parts as materials.

    materials: of each touch, in the order in which they are learned. Where they come one by one a part is a
    material; else the parts are equally long: of twenty materials, twentieths.
    """
    total, kinds = len(materials), len(set(materials))
    if schedule in ("class-by-class", "reversed"):
        return [i for i in range(1, total + 1) if i == total or materials[i] != materials[i - 1]]
    return [round(total * part / kinds) for part in range(1, kinds + 1)]


def si_blurry(
    materials: Sequence[str], seed: int, *, tasks: int = 5, disjoint: float = 0.5, moved: float = 0.1
) -> tuple[list[int], list[int]]:
    """A Si-Blurry stream (Moon et al. 2023, arXiv 2308.09303): the order of N touches, and after how many a task ends.

    A share of the materials, `disjoint`, belongs to one task each, and so at first do the others, the blurry ones; both
    are cut into tasks at drawn places, so that tasks differ in size. Of the blurry materials' touches a share, `moved`,
    is drawn, and dealt over the tasks in shares that are drawn too. Within a task the order is at random. Each touch
    comes once. A task that nothing falls into is left out.

    materials: of each touch, N names. Raises InputError for shares that are none, or fewer tasks than one.
    """
    if tasks < 1 or not 0 <= disjoint <= 1 or not 0 <= moved <= 1:
        raise InputError(f"expected tasks of 1 or more and shares from 0 to 1; came {tasks}, {disjoint} and {moved}")
    random = np.random.default_rng([seed, 6])
    names = random.permutation(sorted(set(materials))).tolist()
    first = round(disjoint * len(names))
    task_of: dict[str, int] = {}
    for group in (names[:first], names[first:]):
        cuts = np.sort(random.integers(0, len(group) + 1, tasks - 1))
        task_of |= {name: int(np.searchsorted(cuts, i, side="right")) for i, name in enumerate(group)}
    task = np.array([task_of[name] for name in materials], dtype=np.intp)
    blurry = np.flatnonzero([name in names[first:] for name in materials])
    travelling = random.permutation(blurry)[: round(moved * len(blurry))]
    task[travelling] = random.choice(tasks, size=len(travelling), p=random.dirichlet(np.ones(tasks)))
    order = sorted(random.permutation(len(materials)).tolist(), key=lambda i: task[i])  # stable: random within a task
    ends = np.cumsum(np.bincount(task, minlength=tasks)).tolist()
    return order, sorted({end for end in ends if end})


@dataclass(frozen=True)
class Trial:
    """One random schedule: what was done, what came of it, and whether the answers are those of the first.

    batches: stretches of touches, with a prediction after each. reopened: how often the memory was closed and opened
    again. split: touches that a second learner observed (0: there was none). digest: of the joined statistics.
    """

    batches: int
    reopened: int
    split: int
    digest: str
    same_predictions: bool


def try_schedules(
    sensor: Sensor,
    touches: Sequence[Labelled],
    probes: Sequence[Labelled],
    *,
    count: int = 20,
    seed: int = 0,
    features: int = 1008,
    report: Callable[[Trial], object] = lambda trial: None,
) -> list[Trial]:
    """Learn the same touches by `count` random schedules, on disk; the first is the plain one, in memory.

    Each draws an order, a batching, where the memory is closed and opened again, and, every other time, which
    touches a second learner feels, whose statistics are added in the end. All should have one digest, and give the
    probes' predictions of the first, to the bit. `report` gets each trial when it is done. features: of the
    embedding.

    Raises InputError for a count below 1 or no touches.
    """
    if count < 1 or not touches or not probes:
        raise InputError(
            f"expected at least one schedule, touch and probe; came {count}, {len(touches)} and {len(probes)}"
        )
    embedding = Kernels(dimension=features)
    plain = TactileLearner(sensor=sensor, embedding=embedding)
    for name, stream in touches:
        plain.observe(name, stream)
    expected = _predictions(plain, probes)
    trials = [Trial(1, 0, 0, plain.digest(), True)]
    report(trials[0])
    for number in range(1, count):
        random = np.random.default_rng([seed, number])
        with tempfile.TemporaryDirectory(prefix="scroll-tactile-") as folder:
            trials.append(
                _try(sensor, embedding, touches, probes, expected, random, Path(folder), split=number % 2 == 0)
            )
        report(trials[-1])
    return trials


def _try(
    sensor: Sensor,
    embedding: Kernels,
    touches: Sequence[Labelled],
    probes: Sequence[Labelled],
    expected: list[Prediction],
    random: np.random.Generator,
    folder: Path,
    *,
    split: bool,
) -> Trial:
    order = random.permutation(len(touches))
    cuts = np.flatnonzero(random.random(len(touches)) < 4 / len(touches))  # about five batches
    second = set(random.permutation(len(touches))[: random.integers(1, len(touches))].tolist()) if split else set()
    parts = [[i for i in order if i not in second]] + ([[i for i in order if i in second]] if split else [])
    reopened = 0
    with ExitStack() as opened:
        learners = []
        for i, part in enumerate(parts):
            path = folder / str(i)
            reopened += _learn(
                path, sensor, embedding, [touches[place] for place in part], set(cuts.tolist()), probes[0], random
            )
            learners.append(opened.enter_context(TactileLearner.open(path, embedding=embedding, mode="read")))
        joint = learners[0] if len(learners) == 1 else _joined(learners)
        same = _predictions(joint, probes) == expected
        return Trial(len(cuts) + 1, reopened, len(second), joint.digest(), same)


def _learn(
    path: Path,
    sensor: Sensor,
    embedding: Kernels,
    touches: list[Labelled],
    cuts: set[int],
    probe: Labelled,
    random: np.random.Generator,
) -> int:
    """Fill a memory on disk; after each batch it is opened anew, or asked; returns how often it was opened anew."""
    reopened = 0
    learner = TactileLearner.open(path, sensor=sensor, embedding=embedding)
    try:
        for i, (name, stream) in enumerate(touches):
            learner.observe(name, stream)
            if i in cuts and random.random() < 0.5:
                learner.close()
                learner = TactileLearner.open(path, embedding=embedding)
                reopened += 1
            elif i in cuts:
                learner.predict(probe[1])
    finally:
        learner.close()
    return reopened


def _joined(learners: Sequence[TactileLearner]) -> TactileLearner:
    """One learner, in memory, that has observed what all of these have."""
    joint = TactileLearner(sensor=learners[0].sensor, embedding=learners[0].embedding)
    memory = joint.memory
    for learner in learners:
        memory.statistics = memory.statistics + learner.memory.statistics
        memory.sample.update(learner.memory.sample)
        if memory.kept is not None:
            memory.kept.update(learner.memory.kept or ())
    return joint


def _predictions(learner: TactileLearner, probes: Sequence[Labelled]) -> list[Prediction]:
    learner.settle()  # a memory that was closed and opened has read its model, and followed since
    return [learner.predict(stream) for _, stream in probes]
