"""A sensor of your own, whose channels have ranges and units of their own: a gripper with pads and a motor current.

Simulated, so that it runs anywhere: python examples/own_sensor.py
"""

import numpy as np

from scroll_tactile import Sensor, TactileLearner, check_learner

GRIPPER = Sensor(
    name="gripper",
    channels=5,
    rate=200.0,
    duration=1.0,
    low=(0, 0, 0, 0, -4),  # four pads, and the current of the motor
    high=(12, 12, 12, 12, 4),
    unit=("N", "N", "N", "N", "A"),
)


def squeeze(stiffness: float, grip: int) -> np.ndarray:
    """One second of closing on something: pads press as far as it is stiff, the motor works as hard. Shape (200, 5)."""
    rng = np.random.default_rng([round(1000 * stiffness), grip])
    closing = np.linspace(0, 1, 200)[:, None] ** 2
    pads = 10 * stiffness * closing * rng.uniform(0.8, 1.2, 4) + rng.normal(0, 0.05, (200, 4))
    current = 3 * closing * stiffness * np.sin(40 * closing) + rng.normal(0, 0.05, (200, 1))
    return np.hstack([pads, current])


learner = TactileLearner(sensor=GRIPPER)
things = {"sponge": 0.1, "rubber": 0.4, "wood": 0.9}
for grip in range(6):
    for thing, stiffness in things.items():
        learner.observe(thing, squeeze(stiffness, grip))

right = sum(learner.predict(squeeze(stiffness, 90)).material == thing for thing, stiffness in things.items())
print(f"right: {right} of {len(things)}")

promises = check_learner(lambda path: TactileLearner.open(path, sensor=GRIPPER))
print(f"it keeps {len(promises)} promises; the first: {promises[0]}")
