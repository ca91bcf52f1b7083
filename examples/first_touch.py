"""A first session: learn three materials by touch, recognise one, and hear "never felt this" for a fourth.

Simulated, so that it runs anywhere: python examples/first_touch.py
"""

from scroll_tactile import TactileLearner, sensors
from scroll_tactile.datasets.simulator import Scene

scene = Scene(sensor=sensors.BIOTAC, seed=0)
*felt, never_felt = scene.materials[:7]

learner = TactileLearner(sensor=sensors.BIOTAC)
for material in felt:  # one material after the other; nothing is shown twice
    for repetition in range(6):
        learner.observe(material, scene.touch(material, repetition))

touch = scene.touch(felt[0], 40)
answer = learner.predict(touch)
print(f"{felt[0]}: {answer.material}, probability {answer.probability:.2f}, known {answer.known}")

early = learner.predict(touch.first(0.3))
print(f"after {early.seconds} s: {early.material}, probability {early.probability:.2f}")

here = learner.predict(touch, scene=felt[:2])  # only what can be here
print(f"of two: {[(name, round(chance, 2)) for name, chance in here.ranking]}")

stranger = learner.predict(scene.touch(never_felt, 40))
print(f"{never_felt}: known {stranger.known}, novelty {stranger.novelty:.1f} standard deviations")
