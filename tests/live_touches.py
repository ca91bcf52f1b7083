"""Streams of a small pad with touches at known places, and learners that know what is touched."""

from functools import cache

import numpy as np
from touches import PAD, SMALL

from scroll_tactile import Joined, Kernels, TactileLearner
from scroll_tactile.simulation.gel import SMALL as SMALL_GEL
from scroll_tactile.simulation.gel import Gel

NOISE = 0.004
GEL = Gel()


class Means:
    """An embedding of somebody's own: the mean and the spread of each half of a window."""

    name, dimension, bound, fingerprint = "means", 8, 2.0, "means 1"

    def embed(self, image):
        halves = np.array_split(image.astype(np.float64), 2, axis=1)
        values = [f(half, axis=1) if half.size else np.zeros(len(image)) for half in halves for f in (np.mean, np.std)]
        return np.concatenate(values)


EMBEDDINGS = {"kernels": SMALL, "joined": Joined(SMALL, Kernels(seed=3, dimension=64)), "own": Means()}


def rest(count, random, level=0.1):
    return level + NOISE * random.standard_normal((count, PAD.channels))


def slide(material, count, random):
    """A touch: its material's level and rhythm."""
    place = "abc".index(material)
    times = np.arange(count)[:, None] / PAD.rate
    waves = 0.1 * np.sin(2 * np.pi * (3 + 4 * place) * times + random.uniform(0, 6, PAD.channels))
    return np.clip(0.35 + 0.15 * place + waves + 0.01 * random.standard_normal((count, PAD.channels)), 0, 1)


@cache
def learner(embedding="kernels", repetitions=6):
    made = TactileLearner(sensor=PAD, embedding=EMBEDDINGS[embedding])
    random = np.random.default_rng(1)
    for _ in range(repetitions):
        for material in "abc":
            made.observe(material, slide(material, 50, random))
    made.settle()
    return made


def shift(materials, seed=0, length=50, pause=120):
    """Readings (T, n) of touches between rests, and where each begins and ends."""
    random = np.random.default_rng([2, seed])
    parts, places = [rest(pause, random)], []
    for material in materials:
        begin = sum(map(len, parts))
        parts += [slide(material, length, random), rest(pause, random)]
        places.append((begin, begin + length))
    return np.concatenate(parts), places


@cache
def gel_learner():
    """A learner of what is pressed into a small camera's gel."""
    made = TactileLearner(sensor=SMALL_GEL)
    for repetition in range(3):
        for material in GEL.materials[:3]:
            made.observe(material, GEL.touch(material, repetition))
    return made


def frames(material, repetition, pressed):
    """Frames of the gel at rest, so many of it pressed, and at rest again."""
    touch = GEL.touch(material, repetition, frames=pressed + 1).readings
    still = touch[:1].repeat(4, axis=0)
    return np.concatenate([still, touch[1:], still])


def predictions(live, rows, sizes):
    """Push readings in blocks of these sizes, then the rest; every prediction that showed, and what ended."""
    shown, ended, first = [], [], 0
    for size in [*sizes, len(rows)]:
        now = live.push(rows[first : first + size])
        first += size
        ended += now.touches
        if now.contact and now.prediction is not None and now.prediction not in shown:
            shown.append(now.prediction)
    return shown, ended


def touched(live, rows, again=False):
    """A touch from begin to end of a manual session, `again` or not, as it ended."""
    if again:
        live.again()
    live.begin()
    live.push(rows)
    return live.end().touches[0]
