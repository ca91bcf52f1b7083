"""Several touches of one thing: how far they say the same, on touches whose dependence is known."""

import itertools

import numpy as np
import pytest

from scroll_tactile.readouts.calibration import CORRELATION, Dependence, dependence_of

NAMES = [f"m{i}" for i in range(12)]


def apart(shared, of_each=12, seed=0):
    """Touches whose logits are off by an error of each material, a part `shared` of it, and one of their own."""
    rng = np.random.default_rng(seed)
    rows = []
    for i in range(len(NAMES)):
        common, odd = rng.normal(size=len(NAMES)), rng.normal()
        for _ in range(of_each):
            error = np.sqrt(shared) * common + np.sqrt(1 - shared) * rng.normal(size=len(NAMES))
            logits = 1.5 * (1.5 * np.eye(len(NAMES))[i] + error)
            novelty = np.sqrt(shared) * odd + np.sqrt(1 - shared) * rng.normal()
            key = int(rng.integers(2**62)).to_bytes(8, "big")
            rows.append((key, i, logits, float(novelty)))
    return held(rows)


def held(rows):
    """What is said of touches (key, material's number, logits, novelty)."""
    logits = np.array([row[2] for row in rows]).reshape(len(rows), len(NAMES))
    logs = logits - np.log(np.exp(logits).sum(axis=1, keepdims=True))
    targets, novelty = np.array([row[1] for row in rows], dtype=np.intp), np.array([row[3] for row in rows])
    return [row[0] for row in rows], targets, logs, novelty


def picked(found, places):
    """Some of them, in this order."""
    keys, *rest = found
    return [keys[place] for place in places], *(values[list(places)] for values in rest)


def test_touches_that_say_the_same_count_less():
    loose, tight = dependence_of(*apart(0.0)), dependence_of(*apart(0.9))
    assert loose.log_probability < tight.log_probability <= 1
    assert loose.log_probability < 0.25
    assert loose.novelty == pytest.approx(0.0, abs=0.1)
    assert tight.novelty == pytest.approx(0.9, abs=0.15)


def test_it_is_of_the_set():
    found = apart(0.5)
    assert dependence_of(*picked(found, range(len(found[0]))[::-1])) == dependence_of(*found)


@pytest.mark.parametrize("touches", [held([]), picked(apart(0.5), range(5))], ids=["none", "five"])
def test_few_touches_have_the_usual(touches):
    assert dependence_of(*touches) == Dependence(CORRELATION, CORRELATION)


def test_one_touch_is_what_it_is_and_any_order_gives_the_same_bits():
    dependence = Dependence(0.4, 0.2)
    chances = np.random.default_rng(0).dirichlet(np.ones(7), size=4)
    assert dependence.probability([chances[0]]) == pytest.approx(chances[0], rel=1e-12)
    assert dependence.standard([1.7]) == 1.7
    first = dependence.probability(list(chances))
    for order in itertools.permutations(range(4)):
        assert dependence.probability(list(chances[list(order)])).tobytes() == first.tobytes()
    assert dependence.standard([1e16, 1.0, -1e16]) == dependence.standard([1.0, -1e16, 1e16])


def test_touches_that_are_one_and_the_same_change_nothing_and_independent_ones_add_up():
    chances = np.array([0.6, 0.3, 0.1])
    assert Dependence(1.0, 1.0).probability([chances] * 3) == pytest.approx(chances)
    assert Dependence(1.0, 1.0).standard([2.0] * 3) == pytest.approx(2.0)
    product = chances**3 / (chances**3).sum()
    assert Dependence(0.0, 0.0).probability([chances] * 3) == pytest.approx(product)
    assert Dependence(0.0, 0.0).standard([2.0] * 4) == pytest.approx(4.0)
    assert np.isfinite(Dependence().probability([np.array([1.0, 0.0]), np.array([0.0, 1.0])])).all()
