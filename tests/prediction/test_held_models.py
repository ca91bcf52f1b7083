"""A model that somebody holds stays as it is, whatever other threads do meanwhile; answers are of one state."""

import copy
import shutil
import threading
from functools import cache

import numpy as np
import pytest
from live_touches import slide
from scroll_tactile_store import StoreClosedError
from touches import PAD, SMALL

from scroll_tactile import Kernels, TactileLearner
from scroll_tactile.errors import InputError
from scroll_tactile.live import session
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.fitting import Draft

SETTINGS = {"sensor": PAD, "embedding": SMALL, "kept_touches": 8}  # with few kept ones a fit takes less
TOUCHES = 5  # of each material: a model is followed for some touches, and fitted anew after more


def touch(material, seed, readings=50):
    """A touch of material a, b or c; "n" is new, and like none of them."""
    random = np.random.default_rng([ord(material), seed])
    if material == "n":
        return random.uniform(0, 1, (readings, 2))
    return slide(material, readings, random)


def teach(learner):
    for seed in range(TOUCHES):
        for material in "abc":
            learner.observe(material, touch(material, seed))
    learner.settle()
    return learner


@cache
def taught():
    return teach(TactileLearner(**SETTINGS))


def learned():
    made = copy.deepcopy(taught())
    made.settle()
    return made


def beside(call):
    """Do something in another thread, and wait for it; what it raises is raised here."""
    raised = []

    def run():
        try:
            call()
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join(60)
    assert not thread.is_alive()
    if raised:
        raise raised[0]


def changing(learner, count=2):
    """What changes the memory and has its model follow: a new material, and touches that answers depend on."""

    def change():
        for seed in range(100, 100 + count):
            learner.observe("n", touch("n", seed))
            learner.predict(touch("n", seed + 50))
            learner.observe("a", touch("b", seed))
            learner.predict(touch("b", seed + 50))

    return change


def once(monkeypatch, what, name, call):
    """Have something done in the midst of the next call of a method, once."""
    own, done = getattr(what, name), []

    def method(*args, **kwargs):
        result = own(*args, **kwargs)
        if not done and threading.current_thread() is threading.main_thread():
            done.append(True)
            call()
        return result

    monkeypatch.setattr(what, name, method)
    return done


def test_a_session_begins_while_another_thread_observes_and_predicts(monkeypatch):
    other, learner, ruled = learned(), learned(), []
    own = session.decision_rule

    def decision_rule(model, risk):
        if len(ruled) == 1:  # in the midst of beginning
            beside(changing(learner))
        ruled.append(own(model, risk))
        return ruled[-1]

    monkeypatch.setattr(session, "decision_rule", decision_rule)
    other.live(contact="manual").close()
    learner.live(contact="manual").close()
    assert "n" in learner.materials
    assert ruled[0] == ruled[1]


def test_a_live_touch_is_answered_by_the_memory_as_it_was_when_it_began(monkeypatch):
    learner = learned()
    before = copy.deepcopy(learner)
    with learner.live(contact="manual", risk=1e-12) as live:
        live.begin()
        live.push(touch("b", 9, 30))
        done = once(monkeypatch, FeatureExtractor, "encode", lambda: beside(changing(learner)))
        prediction = live.end().prediction
    assert done
    monkeypatch.undo()
    assert "n" in learner.materials
    assert prediction == before.predict(live.touch)


@pytest.mark.parametrize("readings", [50, 12])
def test_a_prediction_is_of_one_state_that_there_was(monkeypatch, readings):
    learner = learned()
    before = copy.deepcopy(learner)
    done = once(monkeypatch, FeatureExtractor, "encode", lambda: beside(changing(learner)))
    prediction = learner.predict(touch("b", 9, readings))
    assert done
    monkeypatch.undo()
    assert prediction == before.predict(touch("b", 9, readings))


def test_a_held_model_stays_as_it_is_to_the_bit():
    learner = learned()
    model, extractor = learner._predictor.present(), learner._predictor.extractor
    encoded = extractor.encode(extractor.stream(touch("b", 9, 20)), model.longest, lambda at: model.scales_for("abc", at))
    before = learner._predictor.answer_of(model, list("abc"), [encoded])
    changing(learner)()
    learner.settle()
    assert learner._predictor.present() is not model
    assert learner._predictor.answer_of(model, list("abc"), [encoded]) == before


def test_a_model_is_fitted_to_the_memory_as_it_was_when_that_began():
    learner, other = learned(), learned()
    draft = Draft.of(learner.memory, "lda")
    for seed in range(12):
        learner.observe("a", touch("a", 60 + seed, 20))
    assert learner.memory.statistics.fifth_percentile_length == 20
    assert draft.fit().fitted.least == other.model().fitted.least == 50


# Embedded again


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("kept") / "m"
    with TactileLearner.open(path, **SETTINGS) as learner:
        teach(learner)
    return path


@pytest.fixture
def kept(folder, tmp_path):
    with TactileLearner.open(shutil.copytree(folder, tmp_path / "m"), **SETTINGS) as learner:
        yield learner


OTHER = Kernels(seed=0, dimension=128)


@pytest.mark.parametrize("contact", ["manual", "auto"])
def test_a_session_ends_with_a_sentence_where_the_memory_is_embedded_again(kept, contact):
    live = kept.live(contact=contact)
    if contact == "manual":
        live.begin()
    live.push(touch("a", 9, 30))
    before = copy.deepcopy(kept)
    kept.reembed(OTHER)
    for call in (lambda: live.push(touch("a", 9, 30)), lambda: live.push(np.zeros((0, 2)))):
        with pytest.raises(InputError, match=r"embedded again.*begin another with learner\.live\(\)"):
            call()
    assert live.report.readings == 30
    live.close()
    if contact == "manual":
        assert len(live.touch) == 30
        assert before.predict(live.touch).material == "a"
    with kept.live(contact="manual") as again:
        again.begin()
        again.push(touch("a", 9))
        assert again.end().prediction == kept.predict(touch("a", 9))


def test_a_touch_under_way_while_the_memory_is_embedded_again_is_answered_as_it_was_when_it_began(kept, monkeypatch):
    before = copy.deepcopy(kept)
    live = kept.live(contact="manual", risk=1e-12)
    live.begin()
    once(monkeypatch, FeatureExtractor, "encode", lambda: beside(lambda: kept.reembed(OTHER)))
    now = live.push(touch("a", 9))
    monkeypatch.undo()
    assert now.prediction == before.predict(touch("a", 9)[: round(now.prediction.seconds * PAD.rate)])


def test_an_observation_meets_a_memory_that_is_embedded_again(kept, monkeypatch):
    once(monkeypatch, FeatureExtractor, "codes", lambda: beside(lambda: kept.reembed(OTHER)))
    with pytest.raises(StoreClosedError):
        kept.observe("n", touch("n", 1))
    assert "n" not in kept.materials
    kept.observe("n", touch("n", 1))
    assert kept.predict(touch("n", 1)).material == "n"


def test_a_prediction_meets_a_memory_that_is_embedded_again(kept, monkeypatch):
    before = copy.deepcopy(kept)
    done = once(monkeypatch, FeatureExtractor, "encode", lambda: beside(lambda: kept.reembed(OTHER)))
    prediction = kept.predict(touch("b", 9))
    assert done
    monkeypatch.undo()
    assert prediction in (before.predict(touch("b", 9)), kept.predict(touch("b", 9)))
