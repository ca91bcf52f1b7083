"""`python -m examples.benchmarks buffers`: ways of choosing exemplars, by how well they stand for their classes.

`full` herds from all touches (what a memory of everything could do), `pooled` from candidates chosen by their hash
(ours), `live` again at every observation (SCROLL's own, Wang et al.), `random` picks by chance.

Beside the gap to the class means and the overlap of two schedules stands the accuracy of an f* fine-tuned on the
buffer, by itself: also where the learner would not let it answer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import typer

from examples.paper.readers.labelled import Recordings, hold_out
from examples.paper.runs.options import Data, Dataset, Json, Seed, read
from examples.paper.runs.results import show, write
from scroll_tactile import Embedding, Kernels
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.finetune.fine_tune import fine_tune
from scroll_tactile.finetune.network import TunedReader
from scroll_tactile.learner import TactileLearner
from scroll_tactile.memory.exemplars import Exemplar, herd, quotas, rank
from scroll_tactile.persistence.replaying import exemplar_candidates
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import mean_code
from scroll_tactile.statistics.sample import Sample

__all__ = ["Choice", "Chooser", "LiveHerding", "UniformRandom", "buffers", "compare", "mean_gap", "run_buffers"]

IntArray = npt.NDArray[np.int64]
Codes = npt.NDArray[np.int32]
Buffer = dict[str, list[bytes]]
Note = Callable[[str], None]


class Chooser(Protocol):
    """A buffer that is chosen while touches come in."""

    def add(self, material: str, key: bytes, code: Codes, mean: IntArray) -> None:
        """Feel a touch; mean: of the material's codes so far, this one's among them, rounded."""

    def buffer(self) -> Buffer:
        """Material → keys of its exemplars."""


class LiveHerding:
    """SCROLL's buffer: a material's exemplars and its new touch are herded against the mean so far, at every touch."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._kept: dict[str, list[tuple[bytes, Codes]]] = {}

    def add(self, material: str, key: bytes, code: Codes, mean: IntArray) -> None:
        """Feel a touch: herd its material again, and cut the others to their quotas."""
        candidates = [*self._kept.get(material, []), (key, code)]
        order = herd(np.stack([code for _, code in candidates]), [key for key, _ in candidates], mean, len(candidates))
        self._kept[material] = [candidates[i] for i in order]
        places = quotas({name: len(chosen) for name, chosen in self._kept.items()}, self.capacity)
        self._kept = {name: chosen[: places[name]] for name, chosen in self._kept.items()}

    def buffer(self) -> Buffer:
        """Material → keys of its exemplars, in herding order."""
        return {name: [key for key, _ in chosen] for name, chosen in sorted(self._kept.items())}


class UniformRandom:
    """A uniformly random choice of each material's touches: those with the smallest numbers drawn from `seed`."""

    def __init__(self, capacity: int, seed: int) -> None:
        self.capacity = capacity
        self._rng = np.random.default_rng(seed)
        self._kept: dict[str, list[tuple[float, bytes]]] = {}

    def add(self, material: str, key: bytes, code: Codes, mean: IntArray) -> None:
        """Feel a touch: draw its number, and cut all materials to their quotas."""
        self._kept[material] = sorted([*self._kept.get(material, []), (self._rng.random(), key)])
        places = quotas({name: len(chosen) for name, chosen in self._kept.items()}, self.capacity)
        self._kept = {name: chosen[: places[name]] for name, chosen in self._kept.items()}

    def buffer(self) -> Buffer:
        """Material → keys of its exemplars."""
        return {name: [key for _, key in chosen] for name, chosen in sorted(self._kept.items())}


class _Pooled:
    def __init__(self, capacity: int, ratio: int, means: Mapping[str, IntArray]) -> None:
        self._pool, self._capacity, self._means = Sample[int](ratio * capacity), capacity, means
        self._felt: list[Exemplar] = []

    def add(self, material: str, key: bytes, code: Codes, mean: IntArray) -> None:
        self._pool.add(material, key, len(self._felt))
        self._felt.append(Exemplar(material, key, np.zeros((1, 1), np.float32), code, Scale("window", 1)))

    def buffer(self) -> Buffer:
        ranked = rank(map(self._felt.__getitem__, self._pool.touches()), self._capacity, lambda m, _: self._means[m])
        return {name: [exemplar.key for exemplar in chosen] for name, chosen in ranked.items()}


def _pooled(capacity: int, ratio: int, means: Mapping[str, IntArray], _: int) -> Chooser:
    return _Pooled(capacity, ratio, means)


@dataclass(frozen=True)
class Choice:
    """What one way of choosing gave.

    gap: ‖mean of the exemplars − class mean‖, averaged over the materials and two schedules, in units of the grid.
    to_full: the gap divided by that of `full`. shared: part of the exemplars that two schedules have in common.
    buffer: material → keys of its exemplars, under the first order.
    """

    gap: float
    to_full: float
    shared: float
    buffer: Buffer


def mean_gap(buffer: Mapping[str, npt.NDArray[np.integer]], means: Mapping[str, IntArray]) -> float:
    """‖mean of the exemplars − class mean‖, averaged over the materials that have any.

    buffer: material → codes of its exemplars, shape (m, d). means: material → mean code, shape (d,).
    """
    gaps = [np.linalg.norm(codes.mean(axis=0) - means[name]) for name, codes in buffer.items() if len(codes)]
    return float(np.mean(gaps))


def compare(
    codes: Codes,
    keys: Sequence[bytes],
    materials: Sequence[str],
    capacity: int,
    seed: int,
    ratios: Sequence[int] = (2, 3, 4),
) -> dict[str, Choice]:
    """Choose a buffer of so many touches in every way, under two orders drawn from `seed`.

    codes: of the touches, shape (N, d). Returns `full`, `pooled-2` and so on, `live`, `random`.
    """
    names = np.array(materials)
    observed = {name: codes[names == name] for name in sorted(set(materials))}
    means = {name: mean_code(rows.sum(axis=0, dtype=np.int64), len(rows)) for name, rows in observed.items()}
    ways: dict[str, Callable[[int], Chooser]] = {"full": partial(_pooled, len(keys), 1, means)}
    for ratio in ratios:
        ways[f"pooled-{ratio}"] = partial(_pooled, capacity, ratio, means)
    ways |= {"live": lambda _: LiveHerding(capacity), "random": lambda number: UniformRandom(capacity, number)}
    orders = [np.random.default_rng([seed, number]).permutation(len(keys)) for number in range(2)]
    code_of = dict(zip(keys, codes, strict=True))
    places = quotas({name: len(rows) for name, rows in observed.items()}, capacity)
    choices: dict[str, Choice] = {}
    for way, make in ways.items():
        buffers = [
            _chosen(make(2 * seed + number), order, codes, keys, materials) for number, order in enumerate(orders)
        ]
        buffers = [{name: chosen[: places[name]] for name, chosen in buffer.items()} for buffer in buffers]
        gaps = [mean_gap({n: np.stack([code_of[k] for k in b[n]]) for n in b}, means) for b in buffers]
        kept = [{key for chosen in buffer.values() for key in chosen} for buffer in buffers]
        gap = float(np.mean(gaps))
        full = choices["full"].gap if choices else gap
        overlap = len(kept[0] & kept[1]) / max(len(kept[0]), 1)
        choices[way] = Choice(gap, gap / full if full else 1.0, overlap, buffers[0])
    return choices


def _chosen(
    chooser: Chooser, order: npt.NDArray[np.int64], codes: Codes, keys: Sequence[bytes], materials: Sequence[str]
) -> Buffer:
    sums: dict[str, IntArray] = {}
    counts: dict[str, int] = {}
    for i in order:
        name = materials[i]
        sums[name] = sums.get(name, np.zeros(codes.shape[1], np.int64)) + codes[i]
        counts[name] = counts.get(name, 0) + 1
        chooser.add(name, keys[i], codes[i], mean_code(sums[name], counts[name]))
    return chooser.buffer()


def run_buffers(
    recordings: Recordings,
    embedding: Embedding,
    capacities: Sequence[int] = (100, 200, 400),
    *,
    seed: int = 0,
    note: Note = lambda _: None,
) -> dict[str, Any]:
    """Learn all folds but the first, choose buffers of these capacities in every way, and fine-tune on each.

    Returns a list of records: capacity, way, gap, ratio to full herding's, overlap of two schedules,
    accuracy of f* by itself and of f, on the first fold.
    """
    train, test = hold_out(recordings, recordings.fold == 0)
    learner = TactileLearner(sensor=recordings.sensor, embedding=embedding, exemplars=len(recordings))
    note("learning")
    for touch in train:
        learner.observe(*touch)
    kept = learner._ledger.read(exemplar_candidates)
    codes, keys = np.stack([exemplar.code for exemplar in kept]), [exemplar.key for exemplar in kept]
    f = float(np.mean([learner.predict(stream).material == name for name, stream in test]))
    records = []
    for capacity in capacities:
        for way, choice in compare(codes, keys, [exemplar.material for exemplar in kept], capacity, seed).items():
            note(f"{capacity} exemplars, {way}: fine-tuning")
            records.append(
                {
                    "capacity": capacity,
                    "way": way,
                    "gap": choice.gap,
                    "ratio": choice.to_full,
                    "overlap": choice.shared,
                    "tuned": _tuned(learner, choice.buffer, kept, test, seed),
                    "f": f,
                }
            )
    return {"bench": "buffers", "dataset": recordings.name, "records": records}


def _tuned(
    learner: TactileLearner, buffer: Buffer, kept: Sequence[Exemplar], test: Sequence[tuple[str, Any]], seed: int
) -> float:
    """Accuracy of an f* fine-tuned on a buffer, whether it would be kept or not."""
    of = {exemplar.key: exemplar for exemplar in kept}
    exemplars = {name: [of[key] for key in chosen] for name, chosen in buffer.items()}
    extractor = FeatureExtractor(learner.sensor, learner.embedding, learner.plan)
    statistics = learner.memory.statistics
    tuned, _ = fine_tune(learner.embedding, learner.model(), statistics, exemplars, extractor, seed=seed)
    reader = TunedReader(learner.embedding, learner.plan, tuned)
    right = []
    for name, stream in test:
        logits = reader.logits(tactile_image(stream))
        right.append(max(logits, key=logits.__getitem__) == name)
    return float(np.mean(right))


def buffers(context: typer.Context, dataset: Dataset, data: Data, seed: Seed = 0, json: Json = None) -> None:
    """Compare ways of choosing exemplars: gap to the class means, overlap of two schedules, accuracy of f*."""
    with progress_bar() as progress:
        (recordings,) = read("DATASET", dataset, data, seed).values()
        result = run_buffers(recordings, Kernels(), seed=seed, note=lambda what: progress(what, 0, 1))
    columns = {"exemplars": "{./capacity}", "way": "{./way}", "gap to full herding's": "{./ratio|.3f}"}
    columns |= {name: f"{{./{name}|%}}" for name in ("overlap", "tuned", "f")}
    show(f"{recordings.name}, fold 0", columns, result["records"])
    write(context, result)
