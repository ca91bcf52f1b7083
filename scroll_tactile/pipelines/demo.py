"""The demonstration: twenty simulated materials learned one by one. Nothing in it is a result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scroll_tactile import Kernels
from scroll_tactile.datasets.simulator import Scene
from scroll_tactile.learner import TactileLearner
from scroll_tactile.pipelines.classification import Answers, Labelled, evaluate, observe_all
from scroll_tactile.pipelines.runfile import RunFile
from scroll_tactile.results import Prediction
from scroll_tactile.sensors import Sensor

__all__ = ["Demo", "Outcome", "Step"]


@dataclass(frozen=True)
class Step:
    """After one more material: its name; accuracy over its own held-out touches, and over those of all met so far."""

    material: str
    own: float
    all: float


@dataclass(frozen=True)
class Outcome:
    """How a demonstration ended.

    answers: to the held-out touches of all materials. steps: accuracy after each material.
    novel: material of another scene → the answer to a touch of it. short: the same for 0.3 s of known ones.
    observed: how many touches this run observed; a resumed one fewer. digest: of the memory.
    """

    answers: Answers
    steps: list[Step]
    novel: dict[str, Prediction]
    short: Answers
    observed: int
    digest: str

    def forgotten(self) -> list[tuple[str, float, float]]:
        """(material, accuracy right after it was learned, accuracy at the end) of those that lost any."""
        pairs = [(step.material, step.own, self.answers.of(step.material).accuracy) for step in self.steps]
        return [pair for pair in pairs if pair[2] < pair[1]]


@dataclass(frozen=True)
class Demo:
    """A demonstration: a sensor, a seed, and how many materials and touches.

    sensor: any but a camera. seed: of the scene. materials: how many, at most twenty. touches: learned of each.
    held_out: touches of each that are only tested. features: of the embedding; the usual 1008 take three times
    as long to fit a readout to, and here twenty are fitted. folder: where the memory is kept, None for nowhere.
    """

    sensor: Sensor
    seed: int = 0
    materials: int = 20
    touches: int = 6
    held_out: int = 4
    features: int = 504
    folder: Path | None = None
    scene: Scene = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "scene", Scene(self.sensor, self.seed))

    def run(self, report: Callable[[Step], object] = lambda step: None) -> Outcome:
        """Learn and test; `report` receives every material when it is learned, those of an interrupted run first.

        A run with a folder that was interrupted, in whatever way, resumes where it was.

        Raises InputError for a folder of something else, and what the learner and the store raise.
        """
        plan: dict[str, Any] = {"run": "demo", "sensor": self.sensor.model_dump(mode="json"), "seed": self.seed}
        plan |= {
            "materials": self.materials,
            "touches": self.touches,
            "held_out": self.held_out,
            "features": self.features,
        }
        notes = RunFile(None if self.folder is None else self.folder / "demo.json", plan)
        with self._open() as learner:
            return self._learn(learner, notes, report)

    def _open(self) -> TactileLearner:
        embedding = Kernels(dimension=self.features)
        if self.folder is None:
            return TactileLearner(sensor=self.sensor, embedding=embedding)
        return TactileLearner.open(self.folder / "memory", sensor=self.sensor, embedding=embedding)

    def _learn(self, learner: TactileLearner, notes: RunFile, report: Callable[[Step], object]) -> Outcome:
        steps: list[Step] = []
        train: list[Labelled] = []
        test: list[Labelled] = []
        observed = 0
        answers = Answers([], [])
        for name in self.scene.materials[: self.materials]:
            train += self._touches(name, 0, self.touches)
            test += self._touches(name, self.touches, self.held_out)
            kept = notes.notes.get(name)
            if kept is None:
                observed += observe_all(learner, train)
                answers = evaluate(learner, test)
                kept = {"own": answers.of(name).accuracy, "all": answers.accuracy}
                notes.note(name, kept)
            steps.append(Step(name, kept["own"], kept["all"]))
            report(steps[-1])
        if len(answers.truth) < len(test):  # a finished run was started again
            observed += observe_all(learner, train)
            answers = evaluate(learner, test)
        return Outcome(answers, steps, self._novel(learner), self._short(learner), observed, learner.digest())

    def _touches(self, name: str, first: int, count: int) -> list[Labelled]:
        return [(name, self.scene.touch(name, i)) for i in range(first, first + count)]

    def _novel(self, learner: TactileLearner) -> dict[str, Prediction]:
        other = Scene(self.sensor, self.seed + 1)
        return {name: learner.predict(other.touch(name, 0)) for name in other.materials}

    def _short(self, learner: TactileLearner) -> Answers:
        repetition = self.touches + self.held_out
        touches = [(name, self.scene.touch(name, repetition)) for name in self.scene.materials[: self.materials]]
        return evaluate(learner, touches, seconds=0.3)
