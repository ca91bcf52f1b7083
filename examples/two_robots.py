"""The memory is exact: order, batching, restarts and a cut of the power leave the same bytes.

One robot feels everything in one go; another feels it in another order and is switched off halfway, without a
chance to close anything; two more feel half each and put it together. Simulated, so that it runs anywhere:
python examples/two_robots.py
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from scroll_tactile import Scene, TactileLearner, sensors

scene = Scene(sensor=sensors.ROBOSKIN, seed=1)
touches = [(material, repetition) for material in scene.materials[:5] for repetition in range(4)]

CUT = """
import os, signal, sys
from scroll_tactile import Scene, TactileLearner, sensors
scene = Scene(sensor=sensors.ROBOSKIN, seed=1)
learner = TactileLearner.open(sys.argv[1], sensor=sensors.ROBOSKIN)
for entry in sys.argv[2:]:
    material, repetition = entry.rsplit(":", 1)
    learner.observe(material, scene.touch(material, int(repetition)))
os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))
"""

with tempfile.TemporaryDirectory() as folder:
    calm, cut = Path(folder) / "calm", Path(folder) / "cut"
    with TactileLearner.open(calm, sensor=sensors.ROBOSKIN) as learner:
        for material, repetition in touches:
            learner.observe(material, scene.touch(material, repetition))
        expected = learner.digest()

    backwards = touches[::-1]
    first_half = [f"{material}:{repetition}" for material, repetition in backwards[:10]]
    subprocess.run([sys.executable, "-c", CUT, str(cut), *first_half], check=False)
    with TactileLearner.open(cut) as learner:
        print(f"after the cut: {sum(learner.materials.values())} of 10 touches are there")
        for material, repetition in backwards[10:]:
            learner.observe(material, scene.touch(material, repetition))
        print(f"the same bytes: {learner.digest() == expected}")

    left, right = Path(folder) / "left", Path(folder) / "right"
    for path, half in ((left, touches[::2]), (right, touches[1::2])):
        with TactileLearner.open(path, sensor=sensors.ROBOSKIN) as learner, learner.batch():
            for material, repetition in half:
                learner.observe(material, scene.touch(material, repetition))
    with TactileLearner.open(left) as learner:
        learner.merge(right)
        print(f"put together, the same bytes: {learner.digest() == expected}")
        slip = learner.observe(scene.materials[0], scene.touch(scene.materials[9], 0))
        learner.retract(slip)
        print(f"a slip retracted, the same bytes: {learner.digest() == expected}")
