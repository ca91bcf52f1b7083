"""A robot's hour in a few seconds: touches are found in the stream, answered early, and learned from.

Simulated, so that it runs anywhere: python examples/live.py
"""

from scroll_tactile import Scene, TactileLearner, sensors
from scroll_tactile.simulation.shift import simulated_shift

scene = Scene(sensor=sensors.BIOTAC)
known, new = scene.materials[:4], scene.materials[4]
learner = TactileLearner(sensor=sensors.BIOTAC)
for repetition in range(6):
    for material in known:
        learner.observe(material, scene.touch(material, repetition))

robot = simulated_shift(scene, [*known, new], seconds=90)  # readings with their times, rests between, and the truth
truth = iter(robot.touches)
early, right, told = [], 0, 0
with learner.live(risk=0.05) as live:
    acted = False
    for reading, time in zip(robot.readings, robot.times, strict=True):
        now = live.push(reading, time)
        if now.decided and not acted:
            acted = True  # here an arm would act on now.prediction
            early.append(now.seconds)
        if now.ended:
            acted = False
            touch, real = now.touches[0], next(truth)
            right += touch.prediction.material == real.material and touch.decided
            if touch.prediction.known is False:
                told += 1
                learner.observe(real.material, touch.stream)  # told afterwards, as people do
    print(f"{live.report.touches} of {len(robot.touches)} touches found, {right} decided and right")
    print(f"decided after {sum(early) / len(early):.2f} s of touches of 4 s")
    print(f"never felt before, and told what it was: {told}")
    print(f"of {live.report.readings} readings, {live.report.lost} lost and {live.report.gaps} gaps in time")
