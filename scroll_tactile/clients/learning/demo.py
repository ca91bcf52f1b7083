"""The demonstration: simulated materials, unknown first and then learned. Nothing in it is a result.

At its end a process that learns is killed, and its memory opened again. That process is this module, as
`python -m scroll_tactile.clients.learning.demo MEMORY SENSOR SEED`:
it prints the number of each touch once durable, and never ends.
"""

from __future__ import annotations

import itertools
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scroll_tactile import Kernels
from scroll_tactile.clients.learning.metrics import Answers, Labelled, evaluate, observe_all
from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream
from scroll_tactile.simulation.scene import Scene

__all__ = ["Demo", "Half", "Outcome", "Unplugged", "pull_the_plug"]

FEATURES = 64
ACKNOWLEDGED = 5  # touches, before the process is killed


@dataclass(frozen=True)
class Half:
    """The answers when half of the materials were learned.

    right: share of right answers to touches of these, held out. unknown, tested: how many touches of the others were
    called unknown, of how many. material, nearest, novelty, known: the answer to the first of those.
    """

    right: float
    unknown: int
    tested: int
    material: str
    nearest: str
    novelty: float
    known: bool | None


@dataclass(frozen=True)
class Outcome:
    """How a demonstration ended.

    half: the answers half-way. answers: to the held-out touches of all materials. first: of which as many are of the
    first half. short: answers to 0.3 s of one touch of each. observed: how many touches this run observed; a resumed
    one fewer. digest: of the memory.
    """

    half: Half
    answers: Answers
    first: int
    short: Answers
    observed: int
    digest: str

    @property
    def still_right(self) -> float:
        """The share of right answers to the touches of the first half, now that all materials are learned."""
        return Answers(self.answers.truth[: self.first], self.answers.predictions[: self.first]).accuracy


@dataclass(frozen=True)
class Demo:
    """A demonstration: a sensor, a seed, and how many materials and touches.

    sensor: any but a camera. seed: of the scene. materials: how many, at most twenty. touches: learned of each.
    held_out: touches of each that are only tested. features: of the embedding. folder: where the memory is kept, None
    for nowhere.
    """

    sensor: Sensor
    seed: int = 0
    materials: int = 12
    touches: int = 6
    held_out: int = 4
    features: int = 504
    folder: Path | None = None
    scene: Scene = field(init=False, repr=False)

    def __post_init__(self) -> None:
        # Here, so that a camera or a seed is refused before anything is written.
        object.__setattr__(self, "scene", Scene(self.sensor, self.seed))

    def run(self, report: Callable[[str], object] = lambda name: None) -> Outcome:
        """Learn and test; `report` receives every material when it is learned, those of an interrupted run first.

        A run with a folder that was interrupted, in whatever way, resumes where it was.

        Raises InputError for a folder of something else, and what the learner and the store raise.
        """
        with self._learner(self.folder) as learner:
            return self._learn(learner, report)

    def _learner(self, folder: Path | None) -> TactileLearner:
        how: dict[str, Any] = {"sensor": self.sensor, "embedding": Kernels(dimension=self.features)}
        return TactileLearner(**how) if folder is None else TactileLearner.open(folder / "memory", **how)

    def _learn(self, learner: TactileLearner, report: Callable[[str], object]) -> Outcome:
        names = self.scene.materials[: self.materials]
        middle = max(1, len(names) // 2)
        train = {name: self._touches(name, 0, self.touches) for name in names}
        there = sum(name in learner.names_of(stream) for touches in train.values() for name, stream in touches)
        if self.folder is not None and there < sum(learner.materials.values()):
            raise InputError(f"{self.folder} has touches that are none of this demonstration: take another folder")
        for place, name in enumerate(names):
            if place == middle:
                half = self._half(learner, names[:middle], names[middle:], train)
            for _, stream in train[name]:
                if name not in learner.names_of(stream):
                    learner.observe(name, stream)
            report(name)
        answers = evaluate(learner, self._held_out(names))
        short = evaluate(
            learner, [(name, self.scene.touch(name, self.touches + self.held_out)) for name in names], seconds=0.3
        )
        first = middle * self.held_out
        return Outcome(
            half=half,
            answers=answers,
            first=first,
            short=short,
            observed=sum(learner.materials.values()) - there,
            digest=learner.digest(),
        )

    def _half(
        self,
        learner: TactileLearner,
        learned: Sequence[str],
        others: Sequence[str],
        train: Mapping[str, Sequence[Labelled]],
    ) -> Half:
        """The answers of a learner that has learned this half alone; it is made again where a resumed one has more."""
        if not learner.materials.keys().isdisjoint(others):
            learner = self._learner(None)
            observe_all(learner, [touch for name in learned for touch in train[name]])
        answers = evaluate(learner, self._held_out(others))
        unknown = sum(answer.known is False for answer in answers.predictions)
        first = answers.predictions[0]
        return Half(
            right=evaluate(learner, self._held_out(learned)).accuracy,
            unknown=unknown,
            tested=len(answers.truth),
            material=answers.truth[0],
            nearest=str(first.material),
            novelty=first.novelty,
            known=first.known,
        )

    def _held_out(self, names: Sequence[str]) -> list[Labelled]:
        return [touch for name in names for touch in self._touches(name, self.touches, self.held_out)]

    def _touches(self, name: str, first: int, count: int) -> list[Labelled]:
        return [(name, self.scene.touch(name, i)) for i in range(first, first + count)]


@dataclass(frozen=True)
class Unplugged:
    """What became of a memory whose process was killed.

    acknowledged: how many touches the process had reported as learned. found: how many the memory has. same: whether it
    is, to the bit, the memory of as many touches that nothing interrupted.
    """

    acknowledged: int
    found: int
    same: bool


def pull_the_plug(sensor: Sensor, seed: int) -> Unplugged:
    """Kill a process of its own while it learns, and open what it leaves behind."""
    with tempfile.TemporaryDirectory(prefix="scroll-tactile-") as folder:
        place = Path(folder) / "memory"
        words = [sys.executable, "-m", __name__, str(place), sensor.model_dump_json(), str(seed)]
        with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
            try:
                assert process.stdout is not None
                acknowledged = len(list(itertools.islice(process.stdout, ACKNOWLEDGED)))
            finally:
                process.kill()
        with TactileLearner.open(place, mode="read") as left:
            found, digest = sum(left.materials.values()), left.digest()
    with TactileLearner(sensor=sensor, embedding=Kernels(dimension=FEATURES)) as undisturbed:
        for name, stream in itertools.islice(_touches(sensor, seed), found):
            undisturbed.observe(name, stream)
        return Unplugged(acknowledged, found, undisturbed.digest() == digest)


def _touches(sensor: Sensor, seed: int) -> Iterator[tuple[str, Stream]]:
    """A touch of each simulated material, round after round."""
    scene = Scene(sensor, seed)
    return ((name, scene.touch(name, i)) for i in itertools.count() for name in scene.materials)


def _learn_until_killed(place: str, sensor: str, seed: str) -> None:
    whose = Sensor.model_validate_json(sensor)
    with TactileLearner.open(place, sensor=whose, embedding=Kernels(dimension=FEATURES)) as learner:
        for name, stream in _touches(whose, int(seed)):
            print(learner.observe(name, stream).sequence, flush=True)


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        _learn_until_killed(*sys.argv[1:])
