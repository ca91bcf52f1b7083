"""Small random touches, memories that observe them, and what such a memory must hold."""

import dataclasses

import numpy as np

import scroll_tactile.memory.state
from scroll_tactile import Capabilities, Kernels, Sensor, TactileLearner
from scroll_tactile.statistics.sample import TouchSample

SMALL = Kernels(seed=0, dimension=64)
PAD = Sensor(name="pad", channels=2, rate=50.0, low=0.0, high=1.0, unit="N", duration=1.0)
SETTINGS = {"sensor": PAD, "embedding": SMALL, "exemplars": 4}
OBSERVED = [(name, (seed, 60)) for seed in range(4) for name in "abc"]


class Windowed(Kernels):
    """Kernels that read windows alone, and no touch as a whole."""

    capabilities = dataclasses.replace(Kernels.capabilities, reads_whole_touches=False)


class OwnKernels(Kernels):
    """An embedding of a user's own, exact: a memory cannot make it, and keeps codes beside the readings."""

    name = "own kernels"
    capabilities = Capabilities(embeds_windows=True, exact=True)


class SmallSample(TouchSample):
    """A pool that is soon full, so that what was left out of it has to come back."""

    def __init__(self, capacity=5):
        super().__init__(capacity)


def stream(touch):
    """The readings of a touch (seed, readings), the same for the same numbers."""
    seed, readings = touch
    return np.random.default_rng([seed, readings]).uniform(-0.1, 1.1, size=(readings, 2))


def fed(observed, described=(), **settings):
    """A memory without a path that observed these touches."""
    learner = TactileLearner(**SETTINGS | settings)
    for material, constituents in dict(described).items():
        learner.describe(material, constituents)
    for material, touch in observed:
        learner.observe(material, stream(touch))
    return learner


def filled(path, observed=OBSERVED, **settings):
    """A memory in a folder that observed these touches, and its receipts."""
    learner = TactileLearner.open(path, **SETTINGS | settings)
    return learner, [learner.observe(name, stream(touch)) for name, touch in observed]


def without(*places):
    """What was observed but at these places."""
    return [pair for i, pair in enumerate(OBSERVED) if i not in places]


def kept_of(learner):
    """The kept touches, to the byte; None of a memory that keeps none."""
    kept = learner.memory.kept
    return None if kept is None else [(touch.material, touch.key, touch.levels.tobytes()) for touch in kept.touches()]


def held(learner, *, exemplars=True):
    """All that answers follow from, to the byte: digest, exemplars, pool, kept touches and descriptions."""
    pool = [(name, key, t.rows.tobytes(), t.pairs.tobytes()) for name, key, t in learner.memory.sample]
    chosen = learner.exemplars if exemplars else None
    return learner.digest(), chosen, pool, kept_of(learner), repr(learner.descriptions)


def contents(learner, *, exemplars=True):
    """What is held, and answers, to the byte; they take ten times as long, for the fits."""
    learner.settle()
    answers = [learner.predict(stream(touch)) for touch in ((7, 25), (8, 6), (9, 60), (9, 300))]
    composed = repr(learner.compose(stream((7, 25)))) if learner.descriptions else ""
    return held(learner, exemplars=exemplars), answers, composed


def require_same(learner, observed, described=(), *, exemplars=True, answers=False, **settings):
    """All that is held of what was observed is, to the byte, what a memory holds that observed it in another order.

    answers: also what it answers, which tests/faults/history.py compares after any history.
    """
    settings["readout"] = learner.settings.readout
    expected = _expected(sorted(observed), dict(described), exemplars, answers, settings)
    assert (contents if answers else held)(learner, exemplars=exemplars) == expected


_EXPECTED = {}


def _expected(observed, described, exemplars, answers, settings):
    """What a memory without a path holds that observed these; one of the same touches and settings is made once."""
    key = repr((observed, described, exemplars, answers, settings, scroll_tactile.memory.state.TouchSample))
    if "embedding" in settings or key not in _EXPECTED:
        whole = fed(observed, described, **settings)
        _EXPECTED[key] = (contents if answers else held)(whole, exemplars=exemplars)
    return _EXPECTED[key]


def spoil(path, number):
    """Damage a checkpoint's array on the disk."""
    array = path / "checkpoints" / f"{number:08d}" / "statistics-observations" / "c"
    next(file for file in array.rglob("*") if file.is_file()).unlink()
