"""How far a model and kept touches are believed beside each other, against models that know all and nothing."""

import numpy as np
import pytest
from test_recall import MATERIALS, kept, noisy, touch

from scroll_tactile.readouts.calibration import FEWEST
from scroll_tactile.readouts.deviation import recall_of
from scroll_tactile.readouts.likelihood import CLEAN
from scroll_tactile.readouts.pooled import Apart, pool, recalled_of
from scroll_tactile.readouts.recollection import Kept

NAMES = [f"m{material}" for material in range(MATERIALS)]


def says(touches, height, confused=0):
    """What a model says of touches left out: their own material, by so much; another, in the first so many."""

    def logits(i, material):
        named = NAMES[(NAMES.index(material) + (i < confused)) % MATERIALS]
        return {name: height * (name == named) for name in NAMES}

    return {kept.key: Apart(kept.material, logits(i, kept.material), 1.0) for i, kept in enumerate(touches)}


def loss(pooled, recall, asked, logits):
    """The mean of −log p of the materials of some touches, of which a model says `logits`."""
    total = 0.0
    for (material, levels), own in zip(asked, logits, strict=True):
        found = recall.recollect(levels)
        steep = 1 / (1 + (1 / pooled.recalled - 1) * found.certainty)
        both = pooled.trusted * np.array([own[name] for name in NAMES]) + steep * found.scores
        total += np.log(np.exp(both - both.max()).sum()) - (both - both.max())[NAMES.index(material)]
    return total / len(asked)


def test_a_model_that_knows_nothing_leaves_it_to_the_kept_touches():
    touches = kept()
    recall = recall_of(touches)
    ignorant, wrong = (pool(recall, says(touches, height, confused=len(touches))) for height in (0.0, 8.0))
    asked = [(name, touch(i, 100 + seed)) for i, name in enumerate(NAMES) for seed in range(3)]
    assert loss(ignorant, recall, asked, [dict.fromkeys(NAMES, 0.0)] * len(asked)) < 0.1
    assert wrong.trusted < ignorant.trusted
    assert ignorant.recalled > 0
    misled = [{name: 8.0 * (name != material) for name in NAMES} for material, _ in asked]
    assert loss(wrong, recall, asked, misled) < np.log(MATERIALS)


def test_kept_touches_that_know_nothing_leave_it_to_the_model():
    rng = np.random.default_rng(0)
    blank = [Kept(k.material, k.key, rng.integers(0, 255, k.levels.shape).astype(np.uint8)) for k in kept()]
    recall = recall_of(blank)
    lost = pool(recall, says(blank, 8.0))
    asked = [(name, touch(i, 100)) for i, name in enumerate(NAMES)]
    right = [{name: 8.0 * (name == material) for name in NAMES} for material, _ in asked]
    assert loss(lost, recall, asked, right) < 0.1


@pytest.mark.parametrize("confused", [0, 10, 40])
def test_together_they_are_no_worse_than_either_on_touches_left_out(confused):
    touches = kept()
    recall, apart = recall_of(touches), says(touches, 4.0, confused)
    pooled = pool(recall, apart)
    rows = recall.rows()

    def total(trusted, recalled):
        summed = 0.0
        for left_out in touches:
            found = recall.recollect(left_out.levels, left_out=rows[left_out.key])
            steep = recalled and 1 / (1 + (1 / recalled - 1) * found.certainty)
            both = trusted * np.array([apart[left_out.key].logits[name] for name in NAMES]) + steep * found.scores
            summed += np.log(np.exp(both - both.max()).sum()) - (both - both.max())[NAMES.index(left_out.material)]
        return summed / len(touches)

    # The prior counts as five touches of forty.
    assert total(pooled.trusted, pooled.recalled) <= min(total(1.0, 0.0), total(0.0, pooled.recalled)) + 0.15


def test_it_is_a_function_of_the_set():
    touches = kept()
    first = pool(recall_of(touches), says(touches, 3.0))
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(len(touches))
        again = pool(recall_of([touches[i] for i in order]), dict(sorted(says(touches, 3.0).items(), reverse=seed > 0)))
        assert [
            getattr(again, name) == getattr(first, name) for name in ("trusted", "recalled", "familiar", "usual")
        ] == [True] * 4
        assert again.spread == first.spread


def test_known_touches_are_not_novel_and_noise_alone_is():
    touches = kept()
    pooled = pool(recall_of(touches), says(touches, 3.0))
    known = [pooled.novelty(pooled.recall.recollect(touch(i, 100 + seed))) for i in range(MATERIALS) for seed in (0, 1)]
    through = [pooled.novelty(pooled.recall.recollect(noisy(touch(i, 100), 0.3, i))) for i in range(MATERIALS)]
    rng = np.random.default_rng(1)
    alone = [pooled.novelty(pooled.recall.recollect(rng.integers(0, 255, (8, 120)).astype(np.uint8))) for _ in range(5)]
    assert np.median(known) < 3
    assert max(through) < min(alone)


@pytest.mark.parametrize("count", [0, 1, FEWEST - 1])
def test_where_too_little_was_left_out_the_kept_touches_are_hardly_believed(count):
    touches = kept()
    pooled = pool(recall_of(touches), says(touches[:count], 3.0))
    measured = pool(recall_of(touches), says(touches, 3.0))
    assert (pooled.trusted, pooled.familiar) == (1.0, np.inf)
    assert 0 < pooled.recalled < measured.recalled
    alone = pool(recall_of(touches[:FEWEST]), says(touches[:FEWEST], 3.0))  # of one material
    assert alone.recalled == pytest.approx(pooled.recalled, rel=0.05)  # but for how certain their readings are


def test_what_the_model_does_not_know_is_not_weighed():
    """A material that came since, or that had no touch at some scale."""
    touches = kept()
    apart = {
        key: Apart(said.material, {name: value for name, value in said.logits.items() if name != "m4"}, 1.0)
        for key, said in says(touches, 3.0).items()
        if said.material != "m4"
    }
    pooled = pool(recall_of(touches), apart)
    assert np.isfinite([pooled.trusted, pooled.recalled, pooled.usual, pooled.spread]).all()


@pytest.mark.parametrize("certainty", [1.0, 0.8, 0.044])
@pytest.mark.parametrize("steepness", [1e-7, 1e-4, 0.3])
def test_kept_touches_are_believed_as_was_fitted_where_touches_are_as_certain_as_those(steepness, certainty):
    recalled = recalled_of(steepness, certainty)
    assert 1 / (1 + (1 / recalled - 1) * certainty) == pytest.approx(steepness)


def test_kept_touches_that_mislead_are_hardly_believed_however_uncertain_their_readings():
    """Of binary readings the certainty is a twentieth of what it is of others."""
    rng = np.random.default_rng(0)
    touches = [
        Kept(k.material, k.key, (254 * (rng.random(k.levels.shape) < 0.1)).astype(np.uint8)) for k in kept(each=10)
    ]
    recall = recall_of(touches)
    pooled = pool(recall, says(touches, 8.0))
    asked = [(name, (254 * (rng.random((8, 120)) < 0.1)).astype(np.uint8)) for name in NAMES for _ in range(4)]
    right = [{name: 8.0 * (name == material) for name in NAMES} for material, _ in asked]
    assert loss(pooled, recall, asked, right) < 0.05


def test_noise_leaves_the_word_to_kept_touches_by_themselves():
    """Beside a model that knows everything they are of no use, and yet they answer where it has nothing to say."""
    touches = kept()
    recall = recall_of(touches)
    pooled = pool(recall, says(touches, 8.0))
    assert pooled.alone > pooled.recalled
    through = recall.recollect(noisy(touch(0, 100), 0.3, 0))
    assert through.trust > 0.9
    clean = recall.recollect(touch(0, 100), noise=CLEAN)
    beside = 1 / (1 + (1 / pooled.recalled - 1) * clean.certainty)
    assert pooled.steepness(clean, 1.0) == pytest.approx(beside, rel=1e-2)
    assert pooled.steepness(through, 1.0) > 0.9 / (1 + (1 / pooled.alone - 1) * through.certainty)
    assert pooled.steepness(clean, 0.5) > pooled.steepness(clean, 1.0)


def test_where_nothing_was_left_out_both_are_believed_as_little():
    touches = kept()
    steep = [1 / pool(recall_of(touches), {}, power).recalled for power in (1.0, 0.01)]
    assert steep[1] == pytest.approx(100 * steep[0], rel=1e-2)
