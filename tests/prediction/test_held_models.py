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
from scroll_tactile.matching.likelihood import Likelihood, Noise
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.fitting import Draft
from scroll_tactile.statistics.sample import TouchSample

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
        ruled.append((model.fusion, own(model, risk)))
        return ruled[-1][1]

    monkeypatch.setattr(session, "decision_rule", decision_rule)
    other.live(contact="manual").close()
    learner.live(contact="manual").close()
    assert "n" in learner.materials
    (undisturbed, rule), (found, again) = ruled
    assert again == rule
    assert found.trajectories.chances.tobytes() == undisturbed.trajectories.chances.tobytes()
    assert found.trajectories.novelty.tobytes() == undisturbed.trajectories.novelty.tobytes()


def test_a_model_is_followed_while_a_session_asks_the_one_that_it_holds(monkeypatch):
    learner, count = learned(), []
    with learner.live(contact="manual") as live:
        live.begin()
        live.push(touch("a", 9, 30))
        model = live._under_way.frozen.model
        likelihood = model.matcher.deviation.likelihood

        def copied(noise, memo):
            if not count:
                count.append(True)
                beside(lambda: likelihood.table(Noise(777)))
            return noise

        monkeypatch.setattr(Noise, "__deepcopy__", copied, raising=False)
        changing(learner)()
        assert live.end().prediction.material == "a"


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


class SampleOfTwo(TouchSample):
    def __init__(self, capacity=2):
        super().__init__(capacity)


MANY = "pqrstu"


def of_many(name, seed):
    return 0.15 * MANY.index(name) + 0.1 * touch("n", seed)


@pytest.fixture
def many(monkeypatch, tmp_path):
    """Beyond a thousand, materials are read from the memory when they are asked for; here beyond two."""
    for module in ("prediction.model", "readouts.readout"):
        monkeypatch.setattr(f"scroll_tactile.{module}.EAGER", 2)
    monkeypatch.setattr("scroll_tactile.memory.state.TouchSample", SampleOfTwo)
    with TactileLearner.open(tmp_path / "many", **SETTINGS) as learner:
        for seed in range(3):
            for name in MANY:
                learner.observe(name, of_many(name, seed), source=f"{name}.csv")
        learner.settle()
        yield learner


def read_later(model):
    """The materials that a model has yet to read."""
    readout = min(model.readouts.items())[1]
    return [name for place, name in enumerate(readout.names) if place not in readout.held_means.rows]


def require_alike(prediction, expected):
    assert dict(prediction.ranking) == pytest.approx(dict(expected.ranking), rel=1e-9)  # solved for in another order
    assert prediction.novelty == pytest.approx(expected.novelty, rel=1e-9)
    assert prediction.typicality == expected.typicality


def observing(learner, names, tmp_path):
    for name in names:
        for seed in range(4):
            learner.observe(name, touch("n", 10 + seed))
    learner.predict(of_many("p", 90))
    learner.observe(names[0], of_many("p", 91))


def merging(learner, names, tmp_path, compacted=False):
    with TactileLearner.open(tmp_path / "other", **SETTINGS) as other:
        for name in names:
            for seed in range(4):
                other.observe(name, touch("n", 10 + seed))
        if compacted:
            other.compact(keep=0)
    learner.merge(tmp_path / "other")


def forgetting(learner, names, tmp_path):
    for name in names:
        learner.forget(name)


def retracting(learner, names, tmp_path):
    for one in learner.observations():
        if one.material in names and one.sequence > len(MANY):
            learner.retract(one.sequence)


def relabelling(learner, names, tmp_path):
    for one in learner.observations():
        if one.material in names and one.sequence > len(MANY):
            learner.relabel(one.sequence, "p")


@pytest.mark.parametrize(
    ("change", "most_added"),
    [(observing, 1024), (merging, 1024), (forgetting, 2), (retracting, 2), (relabelling, 2)],
)
def test_of_many_materials_too_a_live_touch_is_answered_as_it_was_when_it_began(
    many, monkeypatch, tmp_path, change, most_added
):
    monkeypatch.setattr("scroll_tactile.persistence.open_memory.MOST_ADDED", most_added)
    before = copy.deepcopy(many)
    with many.live(contact="manual", risk=1e-12) as live:
        live.begin()
        changed = read_later(live._under_way.frozen.model)
        assert len(changed) > 1
        change(many, changed, tmp_path)
        live.push(of_many(changed[0], 9)[:30])
        prediction = live.end().prediction
    require_alike(prediction, before.predict(live.touch))


def test_of_many_materials_a_reader_answers_a_live_touch_as_it_was_when_it_began(many, tmp_path):
    with TactileLearner.open(many.path, mode="read") as reader:
        before = copy.deepcopy(reader)
        with reader.live(contact="manual", risk=1e-12) as live:
            live.begin()
            changed = read_later(live._under_way.frozen.model)
            observing(many, changed, tmp_path)
            merging(many, changed, tmp_path, compacted=True)  # one row, in which a whole memory came
            assert reader.refresh()
            live.push(of_many(changed[0], 9)[:30])
            prediction = live.end().prediction
        require_alike(prediction, before.predict(live.touch))


def test_a_model_of_many_materials_has_no_later_touches(many, tmp_path):
    model = many.model()
    expected, changed = many.model(), read_later(model)
    asked = {
        scale: expected.readouts[scale].linear([*changed], "lda")[0].tobytes() for scale in sorted(expected.readouts)
    }
    observing(many, changed, tmp_path)
    forgetting(many, changed[:1], tmp_path)
    assert asked == {
        scale: model.readouts[scale].linear([*changed], "lda")[0].tobytes() for scale in sorted(model.readouts)
    }


@pytest.mark.parametrize("readings", [50, 12])
def test_a_prediction_is_of_one_state_that_there_was(monkeypatch, readings):
    learner = learned()
    before = copy.deepcopy(learner)
    done = once(monkeypatch, FeatureExtractor, "encode", lambda: beside(changing(learner)))
    prediction = learner.predict(touch("b", 9, readings))
    assert done
    monkeypatch.undo()
    assert prediction == before.predict(touch("b", 9, readings))


def test_a_held_model_stays_as_it_is_and_what_nobody_holds_is_followed_in_place():
    learner = learned()
    held = learner._predictor.current.frozen(learner._ledger)
    arrays = {name: value.copy() for name, value in _arrays(held.model).items()}
    changing(learner)()
    now = _arrays(held.model)
    assert held.model.names == ["a", "b", "c"]
    assert all(np.array_equal(now[name], arrays[name]) for name in arrays)
    current = learner._predictor.current.frozen(learner._ledger).model
    assert current is not held.model
    learner.observe("c", touch("c", 70))
    assert learner._predictor.current.present(learner._ledger) is current  # not fitted anew: what follows shows that
    assert current.readouts[min(current.readouts)].counts.sum() > 0


def _arrays(model):
    found = {}
    for scale, readout in model.readouts.items():
        found |= {f"{scale} {name}": getattr(readout.held_means, name) for name in ("means", "solved", "sizes")}
        found[f"{scale} counts"] = readout.counts
        rank = readout.system.rank
        found |= {f"{scale} e": readout.system._e[:rank, :rank], f"{scale} white": readout.system._white[:rank]}
    matcher, conformal = model.matcher, model.conformal
    found |= {f"kept {name}": getattr(matcher.kept, name) for name in ("blocks", "wide_blocks", "labels")}
    found |= {"steps": conformal._steps, "places": conformal._places, "held": np.array(len(conformal._touches))}
    return found


def test_a_model_is_fitted_to_the_memory_as_it_was_when_that_began():
    learner, other = learned(), learned()
    draft = Draft.of(learner.memory, "lda")
    for seed in range(12):
        learner.observe("a", touch("a", 60 + seed, 20))
    assert learner.memory.statistics.fifth_percentile_length == 20
    assert draft.fit(learner._predictor.extractor).least == other.model().least == 50


def test_tables_are_there_for_any_number_of_threads():
    likelihood, raised = Likelihood(np.full(255, 3.0), np.ones(255)), []
    expected = {step: likelihood._made(Noise(step)).logs.tobytes() for step in range(0, 420, 42)}

    def ask(seed):
        try:
            for step in np.random.default_rng(seed).permutation(sorted(expected)).tolist():
                assert likelihood.table(Noise(step)).logs.tobytes() == expected[step]
        except BaseException as error:
            raised.append(error)

    threads = [threading.Thread(target=ask, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not raised


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
