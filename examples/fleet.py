"""A fleet's day becomes one memory: robots' recordings are learned by several processes, to the bytes of one.

Two robots touched the same materials; one robot's day proves wrong and is taken back.
Simulated, so that it runs anywhere: python examples/fleet.py
"""

import tempfile
from pathlib import Path

import numpy as np

from scroll_tactile import Scene, SourceOptions, TactileLearner, learn, sensors

SCENE = Scene(sensor=sensors.BIOTAC, seed=2)
ROBOTS = {"robot-1": range(4), "robot-2": range(3, 7)}  # the fourth touch of each material was copied to both


def record(folder: Path) -> None:
    """Write a recording of each touch, in the folder of its robot and its material."""
    for robot, repetitions in ROBOTS.items():
        for material in SCENE.materials[:6]:
            for repetition in repetitions:
                file = folder / robot / material / f"{repetition}.npy"
                file.parent.mkdir(parents=True, exist_ok=True)
                np.save(file, SCENE.touch(material, repetition).readings)


def of_one(robots: list[str]) -> str:
    """The digest of one process that observed each touch of these robots once."""
    repetitions = sorted({repetition for robot in robots for repetition in ROBOTS[robot]})
    learner = TactileLearner(sensor=sensors.BIOTAC)
    for material in SCENE.materials[:6]:
        for repetition in repetitions:
            learner.observe(material, SCENE.touch(material, repetition))
    return learner.digest()


def main() -> None:
    """Learn, compare, take a day back, pack."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record(folder)
        days = [folder / robot for robot in ROBOTS]
        done = learn(days, folder / "memory", SourceOptions(by="folder"), sensor=sensors.BIOTAC, workers=2)
        print(f"{done.observations} touches from {done.sources} recordings, {done.repeated} came twice")
        print(f"the bytes of one process: {done.digest == of_one(list(ROBOTS))}")
        with TactileLearner.open(folder / "memory") as learner:
            print(f"taken back: {learner.forget(source=str(folder / 'robot-2'))} touches of robot-2")
            print(f"as if they had never been: {learner.digest() == of_one(['robot-1'])}")
            learner.pack(folder / "memory.part")
        print(f"packed: {(folder / 'memory.part').stat().st_size / 1e6:.0f} MB, for another fleet to learn from")


if __name__ == "__main__":
    main()
