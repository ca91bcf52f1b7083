"""A first session: observe six materials, recognise one, and report "never felt this" of a seventh.

Simulated, so that it runs anywhere: python examples/quickstart.py
"""

from scroll_tactile import Scene, TactileLearner, sensors

scene = Scene(sensor=sensors.BIOTAC, seed=0)
*observed, never_observed = scene.materials[:7]

learner = TactileLearner(sensor=sensors.BIOTAC)
for material in observed:  # one material after the other; nothing is shown twice
    for repetition in range(6):
        learner.observe(material, scene.touch(material, repetition))

touch = scene.touch(observed[0], 40)
answer = learner.predict(touch)
print(f"{observed[0]}: {answer.material}, probability {answer.probability:.2f}, known {answer.known}")

early = learner.predict(touch.first(0.3))
print(f"after {early.seconds} s: {early.material}, probability {early.probability:.2f}")

here = learner.predict(touch, scene=observed[:2])  # only what can be here
print(f"of two: {[(name, round(chance, 2)) for name, chance in here.ranking]}")

stranger = learner.predict(scene.touch(never_observed, 40))
print(f"{never_observed}: known {stranger.known}, novelty {stranger.novelty:.1f} standard deviations")
