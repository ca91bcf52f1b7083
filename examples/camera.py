"""A camera behind a gel: frames in contact are learned, the gel at rest is not.

Simulated, so that it runs anywhere: python examples/camera.py
"""

import numpy as np

from scroll_tactile import TactileLearner
from scroll_tactile.errors import NoContactError
from scroll_tactile.simulation.gel import SMALL, Gel

gel = Gel(SMALL)  # presses reliefs into a gel before a small camera
learner = TactileLearner(sensor=SMALL)  # a camera's usual embedding: Frames(), the first frame is the gel at rest

for repetition in range(4):
    for relief in gel.materials[:4]:
        receipt = learner.observe(relief, gel.touch(relief, repetition))
print(f"{receipt.seconds:g} s of the last touch were in contact")

right = sum(learner.predict(gel.touch(relief, 40)).material == relief for relief in gel.materials[:4])
print(f"right: {right} of 4")

pressed = gel.touch(gel.materials[0], 41).readings
try:
    learner.predict(np.repeat(pressed[:1], 5, axis=0))  # nothing but the gel at rest
except NoContactError as error:
    print(f"refused: {str(error).split('.')[0]}")
