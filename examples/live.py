"""A robot's minutes in a few seconds: touches are found in the stream, answered early, and learned from.

Simulated, so that it runs anywhere: python examples/live.py
"""

import numpy as np

from scroll_tactile import Scene, TactileLearner, sensors

scene, random = Scene(sensor=sensors.BIOTAC), np.random.default_rng(0)
known, new = scene.materials[:4], scene.materials[4]
learner = TactileLearner(sensor=sensors.BIOTAC)
for repetition in range(6):
    for material in known:
        learner.observe(material, scene.touch(material, repetition))

touched = [*known, new, *known[:2], new, *known[2:]]  # ten touches of four seconds, with rests of four between them
robot = []
for number, material in enumerate(touched, start=100):
    robot += [*4095 * (scene.rest + scene.noise(random, 400)), *scene.touch(material, number).readings]
robot += [*4095 * (scene.rest + scene.noise(random, 200))]

truth = iter(touched)
early, right, told = [], 0, 0
with learner.live(risk=0.05) as live:
    acted = False
    for reading in robot:
        now = live.push(reading)
        if now.decided and not acted:
            acted = True  # here an arm would act on now.prediction
            early.append(now.seconds)
        if now.ended:
            acted = False
            touch, real = now.touches[0], next(truth)
            right += touch.prediction.material == real and touch.decided
            if touch.prediction.known is False:
                told += 1
                learner.observe(real, touch.stream)  # told afterwards, as people do
    print(f"{live.report.touches} of {len(touched)} touches found, {right} decided and right")
    print(f"decided after {sum(early) / len(early):.2f} s of touches of 4 s")
    print(f"never felt before, and told what it was: {told}")
