"""A process that learns is killed, as by a plug that is pulled, and its memory is opened again.

Run as a module it is the process: `python -m scroll_tactile.pipelines.unplugged MEMORY SENSOR SEED` prints the number
of each touch when it is durable, and never ends.
"""

from __future__ import annotations

import itertools
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from scroll_tactile import Kernels
from scroll_tactile.learner import TactileLearner
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream
from scroll_tactile.simulation.scene import Scene

__all__ = ["Unplugged", "pull_the_plug"]

FEATURES = 64
ACKNOWLEDGED = 5  # touches, before it is killed


@dataclass(frozen=True)
class Unplugged:
    """What became of a memory whose process was killed.

    acknowledged: how many touches the process had said were learned. found: how many the memory has. same: whether it
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
        acknowledged = 0
        with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
            try:
                assert process.stdout is not None
                for _ in itertools.islice(process.stdout, ACKNOWLEDGED):
                    acknowledged += 1
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
