"""Continual learning as the paper measures it: `f` and `f*` after every material, for every size of the buffer.

Beside them, under the same folds and the same order, the ridge floor and the peers on the same features.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np

from examples.paper.readers.labelled import Recordings, hold_out
from examples.paper.runs.cached import Cached
from examples.paper.runs.cells import require_folds
from examples.paper.studies.continual import Points, accuracy_of, curve, forgetting_of, tally
from examples.paper.studies.peers import ContinualPeer, NearestMean, RanPAC, StreamingLDA, touch_features
from examples.paper.studies.peers_replay import GDumb, Replaying
from examples.paper.studies.replay import Progress
from examples.paper.studies.schedules import ScheduleName, arrange, part_ends
from scroll_tactile import Embedding
from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.pipelines.classification import Labelled
from scroll_tactile.pipelines.runfile import RunFile
from scroll_tactile.readouts.readout import ReadoutName

__all__ = ["SIZES", "Continual", "Size"]

Size = int | Literal["all"]
"""Of the buffer: exemplars in all, or every touch learned."""

SIZES: tuple[Size, ...] = (0, 20, 50, 100, 200, 400, "all")

_REPORTED = ("kept", "reason", "mode", "exemplars", "epochs", "held_out", "seconds")


@dataclass(frozen=True)
class Continual:
    """What to learn, and what to measure.

    recordings: the streams. embedding: frozen, of `f`, `f*` and the peers; each touch is embedded once.
    schedule, seed: see `arrange`; the seed draws the order, and what fine-tuning and the peers draw.
    sizes: of the buffer. epochs: of a fine-tune; the learner's own choice where it is None. device: of fine-tunes.
    curve: measure after every so many parts of the pass, as many as materials (see `part_ends`); 0: at its end only,
    and no forgetting. tuned_curve: measure `f*` there too, each time from a fine-tune of its own.
    peers: whether to run them. folder: where finished parts are noted, so that an interrupted run resumes; or None.

    Raises InputError for sizes that cannot be, such as fewer exemplars than materials, or a negative curve.
    """

    recordings: Recordings
    embedding: Embedding
    schedule: ScheduleName = "class-by-class"
    seed: int = 0
    sizes: tuple[Size, ...] = SIZES
    curve: int = 1
    tuned_curve: bool = False
    epochs: int | None = None
    peers: bool = True
    device: str = "cpu"
    folder: Path | None = None

    def __post_init__(self) -> None:
        kinds = len(set(self.recordings.materials))
        if self.curve < 0:
            raise InputError(
                f"expected a curve measured after every 1 or more parts of the pass, or 0; came {self.curve}"
            )
        if not self.sizes:
            raise InputError("expected at least one size of the buffer; came none")
        for size in self.sizes:
            if size != "all" and (size < 0 or 0 < size < kinds):
                raise InputError(
                    f"expected a buffer of 0, or of an exemplar of each of the {kinds} materials at least; came {size}"
                )

    @property
    def plan(self) -> dict[str, Any]:
        """All that each figure depends on, in JSON's types; sizes, folds and peers can be added to a run later."""
        options = ("schedule", "seed", "curve", "tuned_curve", "epochs", "device")
        made = {name: getattr(self.embedding, name) for name in ("name", "dimension", "fingerprint")}
        size = {"streams": len(self.recordings), "materials": len(set(self.recordings.materials))}
        return {"run": "continual", "dataset": self.recordings.name, **size, "embedding": made} | {
            name: getattr(self, name) for name in options
        }

    def run(self, folds: Sequence[int], progress: Progress = lambda what, done, of: None) -> Iterator[dict[str, Any]]:
        """The figures of each fold in turn, as they are finished; those finished before are read back.

        Raises InputError for a fold that is not there or a folder of another run, and what learning raises.
        """
        require_folds(self.recordings.fold, folds)
        notes = RunFile(None if self.folder is None else self.folder / "continual.json", self.plan)
        embedding = Cached(self.embedding)
        for fold in folds:
            yield _ContinualFold(self, embedding, fold, notes, progress).run()


class _ContinualFold:
    """One fold: what is learned, what is tested, and the parts whose figures are noted one by one."""

    def __init__(self, task: Continual, embedding: Embedding, number: int, notes: RunFile, progress: Progress) -> None:
        self.task = task
        self.embedding = embedding
        self.number = number
        self.notes = notes
        self.progress = progress
        recordings = task.recordings
        trained, self.test = hold_out(recordings, recordings.fold == number)
        self.train = [trained[i] for i in arrange(task.schedule, [name for name, _ in trained], task.seed)]
        self.total = len(self.train)
        self.ends = part_ends(task.schedule, [name for name, _ in self.train])
        every = task.curve
        self.stops = sorted({self.total, *(self.ends[every - 1 :: every] if every else ())})

    def run(self) -> dict[str, Any]:
        f = self._part("f", self._closed_form)
        offline = self._part("offline", self._offline)
        tuned = {str(size): self._part(f"f* {size}", partial(self._tuned, size, f)) for size in self.task.sizes}
        peers = [
            self._part(f"{name} {size or ''}".strip(), partial(self._peer, name, size, make))
            for name, size, make in (self._peers() if self.task.peers else ())
        ]
        return {
            "fold": self.number,
            "learned": self.total,
            "tested": len(self.test),
            "digest": f["digest"],
            "equals_offline": all(part["digest"] == f["digest"] for part in (offline, *tuned.values())),
            "f": f,
            "ridge": offline["ridge"],
            "tuned": tuned,
            "peers": peers,
        }

    def _part(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The figures of a part: read back where it was finished, else made and noted."""
        key = f"fold {self.number}, {name}"
        if key not in self.notes.notes:
            begun = time.perf_counter()
            figures = make()
            self.notes.notes.pop(f"{key}, so far", None)
            self.notes.note(key, figures | {"part_seconds": time.perf_counter() - begun})
        figures = self.notes.notes[key]
        assert isinstance(figures, dict)
        return figures

    def _learner(self, exemplars: int, readout: ReadoutName = "lda") -> TactileLearner:
        sensor = self.task.recordings.sensor
        return TactileLearner(sensor=sensor, embedding=self.embedding, readout=readout, exemplars=exemplars)

    def _closed_form(self) -> dict[str, Any]:
        learner = self._learner(0)
        points = self._learn(learner, "f", self.stops, lambda test: _predict(learner, test))
        return {"digest": learner.digest(), **_figures(points)}

    def _offline(self) -> dict[str, Any]:
        """The same touches in another order, all at random, as offline training has them; and the ridge floor."""
        learner = self._learner(0, "ridge")
        self._train_offline(learner, "offline")
        point = tally([name for name, _ in self.test], _predict(learner, self.test))
        return {"digest": learner.digest(), "ridge": accuracy_of(point)}

    def _tuned(self, size: Size, f: dict[str, Any]) -> dict[str, Any]:
        if size == 0:
            same = {name: f[name] for name in ("digest", "accuracy", "forgetting", "curve")}
            return {"exemplars": 0, "kept": False, "reason": "no exemplars: f answers", **same}
        name, capacity = f"f* {size}", self._capacity(size)
        learner = self._learner(capacity)

        def tune() -> Any:
            what = f"{name}: fine-tuning"
            return learner.fine_tune(
                epochs=self.task.epochs,
                seed=self.task.seed,
                device=self.task.device,
                progress=lambda step, done, of: self.progress(f"{what} ({step})", done, of),
            )

        def answer(test: Sequence[Labelled]) -> list[str | None]:
            if len(learner.materials) > 1:  # with one there is nothing to classify
                tune()
            return _predict(learner, test, tuned=True)

        points = self._learn(learner, name, self.stops[:-1] if self.task.tuned_curve else [], answer)
        report = tune()
        test = tally([material for material, _ in self.test], _predict(learner, self.test, tuned=True))
        other = self._learner(capacity)
        self._train_offline(other, f"{name}: another order")
        return {
            "digest": learner.digest(),
            "tuned_digest": learner.tuned_digest(),
            "buffer_digest": _buffer_digest(learner),
            "buffer_of_another_order": _buffer_digest(other) == _buffer_digest(learner),
            "bytes_per_exemplar": self._bytes(learner),
            **{name: getattr(report, name) for name in _REPORTED},
            **_figures(points | {str(self.total): test}),
        }

    def _bytes(self, learner: TactileLearner) -> float:
        """Bytes of an exemplar's readings, as they are recorded: float32 of shape (T, n)."""
        sizes = {stream.key: stream.readings.nbytes for _, stream in self.train}
        kept = [sizes[key] for keys in learner.exemplars.values() for key in keys]
        return sum(kept) / max(1, len(kept))

    def _learn(
        self,
        learner: TactileLearner,
        name: str,
        stops: Sequence[int],
        answer: Callable[[Sequence[Labelled]], list[str | None]],
    ) -> Points:
        """Learn all training touches, and measure after so many of them; what an interrupted run measured is read
        back."""
        key = f"fold {self.number}, {name}, so far"
        points: Points = dict(self.notes.notes.get(key, {}))
        for done, (material, stream) in enumerate(self.train, start=1):
            learner.observe(material, stream)
            self.progress(f"{name}: learning", done, self.total)
            if done in stops and str(done) not in points:
                asked = [touch for touch in self.test if touch[0] in learner.materials]
                points[str(done)] = tally([truth for truth, _ in asked], answer(asked))
                self.notes.note(key, points)
        return points

    def _train_offline(self, learner: TactileLearner, name: str) -> None:
        order = np.random.default_rng([self.task.seed, 1]).permutation(self.total)
        for done, i in enumerate(order, start=1):
            learner.observe(*self.train[i])
            self.progress(f"{name}: learning", done, self.total)

    @cached_property
    def _vectors(self) -> tuple[np.ndarray, np.ndarray]:
        """Features of the training and of the test touches."""
        self.progress("peers: embedding", 0, 1)
        trained = touch_features(self.embedding, [stream for _, stream in self.train])
        return trained, touch_features(self.embedding, [stream for _, stream in self.test])

    def _peers(self) -> Iterator[tuple[str, Size | None, Callable[[], ContinualPeer]]]:
        seed = self.task.seed
        yield "nearest mean", None, NearestMean
        yield "streaming LDA", None, StreamingLDA
        yield "RanPAC", None, partial(RanPAC, seed)
        yield "naive fine-tuning", None, partial(Replaying, 0, seed)
        for size in self.task.sizes:
            if size:
                yield "GDumb", size, partial(GDumb, self._capacity(size), seed)
                yield "experience replay", size, partial(Replaying, self._capacity(size), seed)

    def _capacity(self, size: Size) -> int:
        return self.total if size == "all" else size

    def _peer(self, name: str, size: Size | None, make: Callable[[], ContinualPeer]) -> dict[str, Any]:
        peer = make()
        trained, tested = self._vectors
        truth = [material for material, _ in self.test]
        points: Points = {}
        for done, ((material, _), features) in enumerate(zip(self.train, trained, strict=True), start=1):
            peer.observe(features, material)
            if done in self.ends:
                peer.boundary()
                self.progress(name, done, self.total)
            if done in self.stops:
                met = [i for i, material in enumerate(truth) if material in peer.materials]
                points[str(done)] = tally([truth[i] for i in met], peer.predict(tested[met]))
        return {"peer": name, "size": None if size is None else str(size), **_figures(points)}


def _predict(learner: TactileLearner, touches: Sequence[Labelled], *, tuned: bool = False) -> list[str | None]:
    return [learner.predict(stream, tuned=tuned).material for _, stream in touches]


def _figures(points: Points) -> dict[str, Any]:
    last = max(points, key=int)
    return {"accuracy": accuracy_of(points[last]), "forgetting": forgetting_of(points), "curve": curve(points)}


def _buffer_digest(learner: TactileLearner) -> str:
    """Hex, equal for two buffers if and only if they hold the same exemplars in the same ranks."""
    digest = sha256()
    for material, keys in sorted(learner.exemplars.items()):
        digest.update(f"{material}\0{len(keys)}\0".encode())
        digest.update(b"".join(keys))
    return digest.hexdigest()
