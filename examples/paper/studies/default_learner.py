"""The default learner, told nothing but its sensor: in this process, or as a process of another checkout's.

`python -P default_learner.py FILE` prints a line of JSON for each test. This module imports `scroll_tactile` alone, so
PYTHONPATH says whose learner answers; touches are changed before they come here, so both sides get the same ones.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile import TactileLearner
from scroll_tactile.errors import InputError, StreamTooShortError
from scroll_tactile.sensors import Sensor

__all__ = ["Answering", "Answers", "Checkout", "Touch", "answers"]

Readings = npt.NDArray[np.float32]
Touch = tuple[str, Readings]
"""A material, and a touch's readings of shape (T, n)."""

Answers = dict[str, list[Any]]
"""Of N touches: material, probability, known and novelty, each a list of N."""

Progress = Callable[[str, int, int], object]
Answering = Callable[
    [Sensor, Sequence[Touch], Mapping[str, Sequence[Readings]], Progress], Iterator[tuple[str, Answers]]
]
"""Learns touches, and yields (name, answers) of each of some tests as it is finished."""

_EVERY = 20  # touches between two reports


def answers(
    sensor: Sensor, train: Sequence[Touch], tests: Mapping[str, Sequence[Readings]], progress: Progress
) -> Iterator[tuple[str, Answers]]:
    """What the default learner answers to each test after learning `train`.

    Touches that are too short for it are not learned, and have no material, probability 0 and infinite novelty.
    """
    learner = TactileLearner(sensor=sensor, exemplars=0)
    for i, (material, readings) in enumerate(train):
        if i % _EVERY == 0:
            progress("learning", i, len(train))
        try:
            learner.observe(material, readings)
        except StreamTooShortError:
            continue
    learner.settle()
    for name, touches in tests.items():
        found: Answers = {"material": [], "probability": [], "known": [], "novelty": []}
        for i, readings in enumerate(touches):
            if i % _EVERY == 0:
                progress(name, i, len(touches))
            for figure, value in zip(found.values(), _answer(learner, readings), strict=True):
                figure.append(value)
        yield name, found


def _answer(learner: TactileLearner, readings: Readings) -> tuple[str | None, float, bool, float]:
    try:
        answer = learner.predict(readings)
    except StreamTooShortError:
        return None, 0.0, False, math.inf
    return answer.material, float(answer.probability), answer.known is not False, float(answer.novelty)


class Checkout:
    """`answers` of another checkout of the project, each time in a process of its own.

    Raises InputError for a folder that is none, and where the process ends before it has answered.
    """

    def __init__(self, path: Path) -> None:
        if not (path / "scroll_tactile" / "__init__.py").is_file():
            raise InputError(f"expected a checkout of the project in {path}; it has no scroll_tactile/__init__.py")
        self.path = path.resolve()

    def __call__(
        self, sensor: Sensor, train: Sequence[Touch], tests: Mapping[str, Sequence[Readings]], progress: Progress
    ) -> Iterator[tuple[str, Answers]]:
        """As `answers`."""
        with TemporaryDirectory() as folder:
            file = Path(folder) / "touches.npz"
            _write(file, sensor, train, tests)
            # -P: beside the checkout's own paths nothing of this folder's is to be imported; its store is its own, too.
            command = [sys.executable, "-P", __file__, str(file)]
            paths = os.pathsep.join(map(str, [self.path, self.path / "store"]))
            environment = {**os.environ, "PYTHONPATH": paths}
            with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
                assert process.stdout is not None
                try:
                    for line in process.stdout:
                        said = json.loads(line)
                        if "progress" in said:
                            progress(*said["progress"])
                        else:
                            yield said["name"], said["answers"]
                finally:
                    process.stdout.close()
                    if process.poll() is None:
                        process.terminate()
                    ended = process.wait()
            if ended:
                raise InputError(f"expected answers of the learner in {self.path}; its process ended with {ended}")


def _write(file: Path, sensor: Sensor, train: Sequence[Touch], tests: Mapping[str, Sequence[Readings]]) -> None:
    touches = [readings for _, readings in train] + [readings for some in tests.values() for readings in some]
    described = {
        "sensor": sensor.model_dump(mode="json", exclude_defaults=True),
        "materials": [material for material, _ in train],
        "tests": {name: len(some) for name, some in tests.items()},
    }
    lengths = np.array([len(readings) for readings in touches])
    np.savez(file, described=json.dumps(described), lengths=lengths, readings=np.concatenate(touches))


def _read(file: Path) -> tuple[Sensor, list[Touch], dict[str, list[Readings]]]:
    with np.load(file) as kept:
        described = json.loads(str(kept["described"]))
        touches = iter(np.split(kept["readings"], np.cumsum(kept["lengths"])[:-1]))
    train = [(material, next(touches)) for material in described["materials"]]
    return (
        Sensor(**described["sensor"]),
        train,
        {name: [next(touches) for _ in range(count)] for name, count in described["tests"].items()},
    )


def main(file: Path) -> None:
    """Print, as lines of JSON, how far it is and the answers to each test in a file of touches."""

    def say(**what: Any) -> None:
        print(json.dumps(what), flush=True)

    for name, found in answers(*_read(file), lambda *progress: say(progress=progress)):
        say(name=name, answers=found)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
