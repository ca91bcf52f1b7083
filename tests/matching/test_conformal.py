"""Class-conditional conformal sets against a plain model, their coverage, and crepes on the same scores."""

from collections import namedtuple

import numpy as np
import pytest

from scroll_tactile.matching.conformal import OTHER_WEIGHT, Conformal
from scroll_tactile.matching.kept_arrays import KeptArrays, KeptTouch, log_steps
from scroll_tactile.signals.levels import MISSING

CHANNELS, COLUMNS = 3, 40
Typicality = namedtuple("Typicality", "share least of_all least_of_all")


def touch(material, seed, columns=COLUMNS):
    rng = np.random.default_rng([material, seed])
    base = np.random.default_rng(material).uniform(40, 60, (CHANNELS, 4)).repeat(COLUMNS // 4, axis=1)
    return (
        (base + rng.normal(0, 12, (CHANNELS, 1)) + rng.normal(0, 4, base.shape))
        .clip(0, 254)
        .astype(np.uint8)[:, :columns]
    )


def kept(materials=4, of_each=25, first=0):
    return [KeptTouch(f"m{m}", bytes([m, i]), touch(m, first + i)) for m in range(materials) for i in range(of_each)]


def conformal_of(touches, before=None):
    return Conformal(KeptArrays(touches, before and before._kept), before)


def p_values(conformal, asked):
    names = conformal._kept.materials
    return {name: Typicality(*row) for name, row in zip(names, conformal.p_rows(asked, names), strict=True)}


def plain(touches, edges, asked, reach):
    """p-values by the definition: each material in turn, each kept touch beside all others and the one asked about."""
    levels = [*(kept.levels for kept in touches), asked]
    *steps, new = (log_steps(each[None], edges)[0][0, :reach].astype(float) for each in levels)
    labels = [kept.material for kept in touches]

    def nonconformity(i, bag, own):
        far = [(np.square(bag[i][0] - other).sum(), label) for j, (other, label) in enumerate(bag) if j != i]
        near = min((d for d, label in far if label == own), default=np.inf)
        other = min((d for d, label in far if label != own), default=0.0)
        return (1 + OTHER_WEIGHT) * np.log1p(near) - OTHER_WEIGHT * np.log1p(other)

    found = {}
    for own in sorted(set(labels)):
        bag = [*zip(steps, labels, strict=True), (new, own)]
        scores = np.array([nonconformity(i, bag, own if own == bag[i][1] else bag[i][1]) for i in range(len(bag))])
        same = np.array([label == own for _, label in bag])
        found[own] = (
            np.mean(scores[same] >= scores[-1]),
            1 / same.sum(),
            np.mean(scores >= scores[-1]),
            1 / len(bag),
        )
    return found


@pytest.mark.parametrize("columns", [COLUMNS, 13])
def test_p_values_are_those_of_the_definition(columns):
    touches = kept(materials=3, of_each=6)
    conformal, edges = conformal_of(touches), KeptArrays(touches).early
    reach = int(np.searchsorted(edges[1:], columns, side="right"))
    for seed in range(50, 54):
        asked = touch(seed % 3, seed, columns)
        found, expected = p_values(conformal, asked), plain(touches, edges, asked, reach)
        assert found.keys() == expected.keys()
        assert all(found[name] == pytest.approx(expected[name]) for name in found)


@pytest.mark.parametrize("columns", [COLUMNS, 10])
def test_each_material_is_covered(columns):
    """Over the choice of what is kept, too: of any one choice coverage is off by that of 25 touches."""
    values = np.zeros((4, 30, 10, 2))  # of each material, draw and touch: among its own, and among all
    for draw in range(30):
        conformal = conformal_of(kept(first=1000 * draw))
        for m, i in np.ndindex(4, 10):
            value = p_values(conformal, touch(m, 1000 * draw + 500 + i, columns))[f"m{m}"]
            values[m, draw, i] = value.share, value.of_all
    for error in (0.05, 0.2):
        covered = values > error
        spread = covered[..., 0].mean(axis=2).std(axis=1) / np.sqrt(30)
        assert (covered[..., 0].mean(axis=(1, 2)) >= 1 - error - 3 * spread).all()
        assert (covered.mean(axis=(0, 1, 2)) >= 1 - error - 0.01).all()


def test_any_order_and_any_way_to_it_gives_the_same_bytes():
    touches = kept(of_each=8)
    asked = touch(1, 200, 25)
    first = p_values(conformal_of(touches), asked)
    assert p_values(conformal_of(touches[::-1]), asked) == first
    before = conformal_of([*touches[:20], touches[-1]])
    start = p_values(before, asked)  # so that it has distances to follow
    followed = conformal_of(touches, before)
    assert p_values(followed, asked) == first
    assert p_values(before, asked) == start
    left, swapped = touches[:3] + touches[6:], touches[2:]
    fewer = conformal_of(left, followed)
    assert p_values(fewer, asked) == p_values(conformal_of(left), asked)
    assert p_values(conformal_of(touches, fewer), asked) == first
    assert p_values(conformal_of(swapped, fewer), asked) == p_values(conformal_of(swapped), asked)


def test_few_touches_exclude_nothing_and_one_material_is_always_typical():
    strange = np.full((CHANNELS, COLUMNS), 250, np.uint8)
    few, enough = (p_values(conformal_of(kept(of_each=count)), strange).values() for count in (18, 19))
    assert min(few).share > 0.05 >= min(enough).share
    assert {value.least for value in few} == {1 / 19}
    assert max(value.of_all for value in few) <= 0.05  # of all materials together there are enough
    alone = conformal_of(kept(materials=1, of_each=5))
    assert 0 < p_values(alone, touch(0, 99))["m0"].share <= 1
    assert min(p_values(conformal_of(kept(materials=2, of_each=1)), touch(0, 99)).values()).share >= 0.5


def test_touches_too_short_or_with_gaps_are_compared_by_what_they_have():
    touches = kept(of_each=20)
    long = conformal_of([KeptTouch("m", b"0", np.zeros((1, 10_000), np.uint8))])
    assert long.p_rows(np.zeros((1, 2), np.uint8), ["m"]).tolist() == [[1.0] * 4]
    conformal = conformal_of(touches)
    gap = touch(2, 300).copy()
    gap[0, 5:30] = MISSING
    assert p_values(conformal, gap)["m2"].share > 0.05
    gap[:] = MISSING
    assert np.isfinite([*p_values(conformal, gap).values()]).all()
    ragged = conformal_of([*touches[:-1], KeptTouch("m3", b"s", touch(3, 400, 15))])
    assert p_values(ragged, touch(3, 401))["m3"].share > 0.05


def test_rows_are_of_the_materials_that_are_asked_for():
    conformal = conformal_of(kept(of_each=4))
    every, asked = p_values(conformal, touch(1, 200)), conformal.p_rows(touch(1, 200), ["a", "m3", "m1"]).tolist()
    assert asked == [[1.0] * 4, [*every["m3"]], [*every["m1"]]]
