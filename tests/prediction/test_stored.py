"""The weighing that a writer keeps in the checkpoint: read by whoever opens the memory, and dropped by a retraction."""

import json
import logging
import shutil

import numpy as np
import pytest
from prediction.test_current import OBSERVED, SETTINGS, bits, fed, require_followed, stream

from scroll_tactile import TactileLearner
from scroll_tactile.prediction.fitting import Draft
from scroll_tactile.prediction.stored import read_weighing, weighing_text


def opened(path, mode="read", **settings):
    return TactileLearner.open(path, mode=mode, **SETTINGS, **settings)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A memory whose writer kept how it is weighed, also by labels, and what that answered."""
    path = tmp_path_factory.mktemp("kept") / "m"
    with opened(path, "write") as learner:
        for i, (material, seed) in enumerate(OBSERVED):
            learner.observe(material, stream(material, seed), labels={"slip": "ne"[i % 2]} if i % 5 else None)
        by_slip(learner)
        learner.settle()
        return path, bits(learner), by_slip(learner)


@pytest.fixture
def path(made, tmp_path):
    """A copy of it, somewhere else."""
    return shutil.copytree(made[0], tmp_path / "m")


@pytest.fixture
def fits(monkeypatch):
    """How many models were fitted."""
    found, fit = [], Draft.fit
    monkeypatch.setattr(Draft, "fit", lambda draft, **how: found.append(1) or fit(draft, **how))
    return found


def by_slip(learner):
    return [learner.predict(stream("a", seed), of="slip") for seed in range(50, 53)]


def stored(path):
    """The weighings of the newest checkpoint, by axis."""
    with opened(path) as learner:
        return dict(learner.memory.weighings)


@pytest.mark.parametrize("mode", ["read", "write"])
def test_who_opens_the_memory_answers_as_when_it_was_settled_and_fits_nothing(made, path, fits, mode, caplog):
    before = stored(path)
    with opened(path, mode) as learner:
        assert (bits(learner), by_slip(learner)) == made[1:]
    learner.close()  # it is closed already
    assert (fits, caplog.records) == ([], [])
    assert stored(path).keys() == before.keys() == {"", "slip"}
    with opened(path) as learner:  # and again, after what was kept anew
        assert (bits(learner), by_slip(learner)) == made[1:]
        learner.settle()
        assert (bits(learner), by_slip(learner)) == made[1:]


def test_what_is_read_is_written_as_it_was(path):
    """To the bit, however often a memory is opened."""
    with opened(path) as learner:
        text, memory = learner.memory.weighings[""], learner.memory
        assert weighing_text(read_weighing(text, Draft.of(memory, "lda").solved())) == text


def test_what_was_asked_for_nothing_keeps_nothing_and_loses_nothing(path, tmp_path):
    with opened(tmp_path / "other", "write") as learner:
        learner.observe("a", stream("a", 1))
    assert stored(tmp_path / "other") == {}
    before = stored(path)
    with opened(path, "write") as learner:
        learner.observe("a", stream("a", 60))
    assert stored(path) == before


def test_it_is_kept_again_though_a_checkpoint_was_written_meanwhile(path, monkeypatch):
    before = stored(path)
    with opened(path, "write") as learner:
        learner.predict(stream("a", 50))
        learner.observe("a", stream("a", 60))
        monkeypatch.setattr("scroll_tactile.persistence.ledger.CHECKPOINT_EVERY", 1)
        learner._ledger.checkpoint_if_due()
    assert stored(path).keys() == before.keys()


@pytest.mark.parametrize("change", ["observed", "new", "retracted"])
def test_rows_behind_the_checkpoint_are_taken_in(path, fits, change):
    with opened(path, "write") as learner:
        if change == "retracted":
            learner.retract(2)
        else:
            learner.observe("a" if change == "observed" else "d", stream("a", 40))
        wanted = learner.digest()
        learner._ledger.saves = False  # as if its process had died
    with opened(path) as reader:
        assert reader.digest() == wanted
        require_followed(reader)
        assert len(fits) == (change == "retracted")
        reader.settle()
        observed = [one for i, one in enumerate(OBSERVED) if (change, i) != ("retracted", 1)]
        whole = fed(observed)
        if change != "retracted":
            whole.observe("a" if change == "observed" else "d", stream("a", 40))
        assert bits(reader) == bits(whole)


@pytest.mark.parametrize("asked", [False, True])
@pytest.mark.parametrize("how", ["retract", "forget", "relabel"])
def test_nothing_of_it_is_left_after_a_retraction(path, how, asked):
    with opened(path, "write") as learner:
        if asked:
            bits(learner)
            by_slip(learner)
        {"retract": lambda: learner.retract(2), "forget": lambda: learner.forget("b"),
         "relabel": lambda: learner.relabel(2, "d")}[how]()  # fmt: skip
        if asked:
            bits(learner)
            by_slip(learner)  # the models follow, and what they were fitted to has the touch
    assert stored(path) == {}
    with opened(path, "write") as learner:
        learner.settle()
        by_slip(learner)
        said = bits(learner), by_slip(learner)
        learner.compact()
    assert stored(path).keys() == {"", "slip"}
    with opened(path) as learner:
        assert (bits(learner), by_slip(learner)) == said


def test_settling_drops_those_of_axes_that_nobody_asked_yet(path):
    with opened(path, "write") as learner:
        learner.observe("b", stream("b", 70), labels={"slip": "n"})
        learner.settle()
        whole = fed(())
        for i, (material, seed) in enumerate(OBSERVED):
            whole.observe(material, stream(material, seed), labels={"slip": "ne"[i % 2]} if i % 5 else None)
        whole.observe("b", stream("b", 70), labels={"slip": "n"})
        assert by_slip(learner) == by_slip(whole)


def test_another_readout_or_release_fits_its_own_and_says_so(made, path, fits, monkeypatch, caplog):
    with opened(path, readout="ridge") as learner:
        assert bits(learner) == bits(fed(OBSERVED, readout="ridge"))
    monkeypatch.setattr("scroll_tactile.prediction.stored.MADE_BY", "another")
    with opened(path) as learner:
        assert bits(learner) == made[1]
    assert len(fits) == 3
    assert caplog.text.count("the weighing in the memory's checkpoint is not used, and fitted anew") == 2
    assert "another" in caplog.text


def changed(text, **how):
    return json.dumps(json.loads(text) | how)


OTHERS = [
    *({"made_by": value} for value in (1, None, "another")),
    {"kind": "ridge"},
    *({"weighing": value} for value in (None, [], {}, 3, "x")),
    *({"deviation": value} for value in (None, [], {}, 1)),
]


def test_what_is_no_weighing_of_this_release_readout_and_plan_is_refused(made):
    with opened(made[0]) as learner:
        text, memory = learner.memory.weighings[""], learner.memory
    solved = Draft.of(memory, "lda").solved()
    assert read_weighing(text, solved).weighing is not None
    other = [changed(text, **how) for how in OTHERS] + [text.replace('"scales": [', '"scales": [1, ')]
    for said in (*other, "", "null", "[]", "{", text[:-1], text[: len(text) // 2], "[" * 100_000, "\ud800"):
        with pytest.raises(ValueError, match=r".+"):
            read_weighing(said, solved)


def test_one_that_is_refused_is_fitted_anew_with_a_warning_and_kept(made, path, fits, caplog):
    with opened(path, "write") as learner:
        learner.memory.weighings[""] = changed(learner.memory.weighings[""], made_by="another")
        with caplog.at_level(logging.WARNING):
            assert bits(learner) == made[1]
    assert "the weighing in the memory's checkpoint is not used, and fitted anew: expected" in caplog.text
    assert len(fits) == 1
    with opened(path) as learner:
        assert bits(learner) == made[1]
    assert len(fits) == 1


def test_composition_rests_on_touches_held_out_and_answers_after_opening(path):
    with opened(path, "write") as learner:
        for name, share in (("a", 1.0), ("b", 0.0), ("c", 0.5)):
            learner.describe(name, {"wool": share, "silk": 1 - share})
        said = repr(learner.compose(stream("a", 50)))
        learner.settle()
        assert repr(learner.compose(stream("a", 50))) == said
        learner.forget("c")
        assert np.isfinite(learner.compose(stream("a", 50)).prediction.novelty)
