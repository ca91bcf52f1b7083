"""A touch taken out of a readout in one product, against one that never observed it, in fifty digits."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from readouts.dense import Dense, require_near

from scroll_tactile.readouts.leave_one_out import held_out_scores
from scroll_tactile.readouts.task import Task
from scroll_tactile.statistics.sample import SampledTouch, TouchSample
from scroll_tactile.statistics.statistics import Statistics

SCALE = 7
STAGES = [[SCALE]] * 3


def touches_of(kinds, seed, offset, width=4, alike=False):
    """Touches (material, key, rows, copies): `copies` times its rows are in the statistics.

    alike: the rows of a touch are equal.
    """
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(9, width)) * 40_000 + offset
    touches = []
    for number, (material, count, copies) in enumerate(kinds):
        rows = np.rint(means[material] + rng.normal(size=(count, width)) * 20_000).astype(np.int32)
        rows[1:] = rows[0] if alike else rows[1:]
        touches.append(("abcdefghi"[material], bytes([number]) * 32, rows, copies))
    return touches


def learned(touches, unsampled=()):
    """Of a touch's rows its own come first, then those of its copies."""
    statistics, sample = Statistics(touches[0][2].shape[1], [SCALE]), TouchSample()
    for material, key, rows, copies in touches:
        codes = {SCALE: np.concatenate([rows] * copies)}
        statistics.add(material, codes)
        if material not in unsampled:
            sample.add(material, key, SampledTouch.of([{SCALE: [[i]]} for i in range(len(rows))], codes))
    return statistics, sample


def groups_of(touches):
    groups = {}
    for material, _, rows, copies in touches:
        groups.setdefault(material, []).extend((row.tolist(), copies) for row in rows)
    return groups


KIND = st.sampled_from(["lda", "ridge"])
# Of a touch: material, rows, and how often they are there.
KINDS = st.lists(st.tuples(st.integers(0, 4), st.integers(1, 3), st.integers(1, 2)), min_size=2, max_size=9)


def require_left_out(found, place, row, own, without, every, material, weight, readout, kind):
    """A row is scored as by the readout that never had its touch, of so many rows, the last of them `own`.

    Of its own material it gains 1/n² of its distance, halved as scores are.
    """
    reference, share = found.names, float(Fraction(weight) / every.counts[material])
    scores = without.lda(row, reference, readout.origin)
    scores[reference.index(material)] += without.far(own, material) * share**2 / 2
    if kind == "ridge":  # but for the shares, which are those of all touches
        shares = [float(without.shares[name]) for name in reference]
        scores = np.array(without.ridge(row, reference)) - shares + readout.shares
    require_near(found.scores[place], scores)
    require_near(found.distances[place], without.distances(row, reference))
    if others := [name for name in reference if name != material]:
        new = Dense(without.groups, without.penalty, without.share, others, without.total, without.excess)
        require_near(found.distances_if_new[place], min(new.distances(row, others)))
    best = reference[int(found.scores[place].argmax())]
    away = [float(int(x) - m) for x, m in zip(row, without.means[best], strict=True)]
    total = float(readout.counts.sum())
    variances = [(float(every.scatter[j][j]) + readout.penalty) / total for j in range(len(row))]
    far = sum(a**2 / v for a, v in zip(away, variances, strict=True))
    require_near(found.diagonal_distances[place], far * (1 - share**2) if best == material else far)


WIDTHS, NOT = st.integers(1, 9), st.just(False)
ALIKE = [(material, 3, 1) for material in (0, 0, 0, 1, 1, 1)]


@settings(max_examples=40, deadline=None)
@given(
    KINDS,
    st.integers(0, 999),
    st.sampled_from([0, 900_000]),
    WIDTHS,
    KIND,
    st.booleans(),
    st.booleans(),
    st.just(False),
)
@example(ALIKE, 0, 0, 9, "ridge", False, False, True)
@example(ALIKE, 1, 900_000, 9, "lda", False, True, True)
def test_it_is_as_if_the_touch_had_never_been_observed(kinds, seed, offset, width, kind, others, elsewhere, alike):
    """With the same P and γ, of fewer features than materials and of more than they and the touch's rows span.

    others: some materials are of no sampled touch, as where there are very many. elsewhere: other rows are asked in
    place of its own, as of its beginnings, or of the touch at another pace; its own are among them.
    """
    touches = touches_of(kinds, seed, offset, width, alike)
    unsampled = {"d", "e"} if others and kind == "lda" else set()
    if not {material for material, *_ in touches} - unsampled:
        return
    statistics, sample = learned(touches, unsampled)
    reference = [name for name in statistics.names(SCALE) if name not in unsampled]
    readout = Task.of(statistics, SCALE, reference).solve()
    places, asked = {(material, key): at for at, (material, key, _) in enumerate(sample)}, None
    if elsewhere:
        rng = np.random.default_rng(seed + 1)
        asked = {
            place: {2 * at: np.rint(rng.normal(size=width) * 60_000 + offset) for at in range(int(rng.integers(0, 4)))}
            for place in places.values()
        }
        for material, key, rows, _ in touches:
            if material not in unsampled and asked[places[material, key]]:
                asked[places[material, key]][1] = rows[0].astype(float)
    found = held_out_scores(readout, sample, STAGES, kind, asked)
    assert found.names == reference
    total = Fraction(int(statistics.second(SCALE).rows))
    excess = total / sum(int(count) for count in statistics.counts(SCALE, reference))
    every = Dense(groups_of(touches), readout.penalty, readout.share)
    judged = set()
    for i, (material, key, rows, copies) in enumerate(touches):
        rest = [other for j, other in enumerate(touches) if i != j]
        if material in unsampled or material not in {other for other, *_ in rest}:
            continue
        dense = Dense(groups_of(rest), readout.penalty, readout.share, reference, total, excess)
        for number, codes in (asked[places[material, key]] if elsewhere else dict(enumerate(rows))).items():
            judged.add((places[material, key], number))
            place, row = found.rows[places[material, key], number], codes.astype(np.int64)
            own = rows[-1] if elsewhere else row
            require_left_out(found, place, row, own, dense, every, material, len(rows) * copies, readout, kind)
    assert found.rows.keys() == judged
    assert sorted(found.rows.values()) == list(range(len(found.scores)))


@pytest.mark.parametrize("kind", ["lda", "ridge"])
def test_of_few_touches_the_left_out_scores_find_the_materials(kind):
    """The shares of what is left would tell against the material of the touch that is judged, and outdo the rest."""
    statistics, sample = learned(touches_of([(i % 4, 1, 1) for i in range(20)], 3, 0))
    found = held_out_scores(heavily_shrunk(statistics), sample, STAGES, kind)
    owners = ["abcd".index(material) for material, *_ in sample]
    best = found.scores.argmax(axis=1)
    assert np.mean([best[found.rows[i, 0]] == owner for i, owner in enumerate(owners)]) > 0.7


def heavily_shrunk(statistics):
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("scroll_tactile.readouts.task.shrinkage", lambda *_: 0.999)
        return Task.of(statistics, SCALE, [*"abcd"]).solve()


@pytest.mark.parametrize("kind", ["lda", "ridge"])
def test_materials_of_one_touch_and_stages_that_were_not_reached_are_not_there(kind):
    touches = touches_of([(0, 3, 1), (0, 1, 1), (1, 2, 1)], 0, 0)
    statistics, sample = learned(touches)
    task = Task.of(statistics, SCALE, ["a", "b"])
    found = held_out_scores(task.solve(), sample, STAGES, kind)
    assert sorted(found.rows) == [(0, 0), (0, 1), (0, 2), (1, 0)]
    assert (
        found.scores.shape == found.z.shape == found.distances.shape == (*found.diagonal_distances.shape, 2) == (4, 2)
    )
    alone, none = learned(touches[2:])
    task = Task.of(alone, SCALE, ["b"])
    empty = held_out_scores(task.solve(), none, STAGES, kind)
    assert (empty.rows, empty.scores.shape) == ({}, (0, 1))
