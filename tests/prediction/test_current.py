"""The current model: settled it is a function of the set of touches, between fits it has them all, no failure stays."""

import copy
import gc
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import weakref
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from touches import PAD, SMALL

from scroll_tactile import Scene, TactileLearner, sensors
from scroll_tactile.errors import CapacityError
from scroll_tactile.prediction.fitting import Draft
from scroll_tactile.prediction.model import Model
from scroll_tactile.readouts.readout import Readout
from scroll_tactile.readouts.task import Task

OBSERVED = tuple((name, seed) for seed in range(8) for name in "abc")
FEWER = OBSERVED[:15]
PROBES = (("a", 50, 60), ("b", 51, 25), ("c", 52, 6), ("b", 53, 120))
FIT = Draft.fit
SETTINGS = {"sensor": PAD, "embedding": SMALL, "kept_touches": 6}  # with few kept ones a fit takes a third of the time


def stream(material, seed, readings=60):
    """A noisy wave whose level and pace are the material's, such that some are taken for others."""
    rng, place = np.random.default_rng([ord(material), seed]), "abcdef".index(material)
    wave = np.sin(np.arange(readings)[:, None] * (0.2 + 0.1 * place) + rng.uniform(0, 6, 2))
    return 0.4 + 0.05 * place + 0.2 * wave + rng.normal(0, 0.15, (readings, 2))


def fed(observed, **settings):
    """A memory without a path that observed these touches."""
    learner = TactileLearner(**SETTINGS | settings)
    for material, seed in observed:
        learner.observe(material, stream(material, seed))
    return learner


def bits(learner, probes=PROBES):
    """Answers such that equal means equal to the bit."""
    said = [learner.predict(stream(*probe)) for probe in probes]
    return [([(name, share.hex()) for name, share in one.ranking], one.novelty.hex(), one.known) for one in said]


@cache
def expected(observed):
    """The answers of a fresh memory that observed these touches."""
    return bits(fed(observed))


def later(count):
    """All that was observed, and so many touches of a."""
    return *OBSERVED, *(("a", 90 + i) for i in range(count))


def asked_once():
    """A learner whose model was fitted to all that was observed."""
    learner = copy.deepcopy(_unasked())
    learner.predict(stream(*PROBES[0]))
    return learner


@cache
def _unasked():
    return fed(OBSERVED)


def require_followed(learner):
    """Its readouts have each touch that the memory has, once; another material is not answered."""
    assert {name for name, _ in learner.predict(stream(*PROBES[0])).ranking} == set(learner.materials)
    model, statistics = present(learner), learner.memory.statistics
    assert model.names == list(learner.materials)
    for scale, readout in model.readouts.items():
        names = [name for name, count in zip(model.names, statistics.counts(scale, model.names), strict=True) if count]
        assert sorted(readout.names) == names
        counts, (_, sums) = statistics.counts(scale, readout.names), statistics.totals(scale, readout.names)
        assert readout.counts.tolist() == counts.tolist()
        np.testing.assert_allclose(readout.means() + readout.origin, sums / counts[:, None], rtol=1e-12, atol=1e-6)
    kept = {(material, key) for material, key, _ in learner.memory.kept}
    assert set(model.matcher.kept.touches) == kept


def present(learner):
    return learner._predictor.present()


def beside():
    return threading.current_thread() is not threading.main_thread()


def slowly(monkeypatch, seconds):
    """Let every fit that a thread makes beside take longer."""

    def fit(draft, **how):
        if beside():
            time.sleep(seconds)
        return FIT(draft, **how)

    monkeypatch.setattr(Draft, "fit", fit)


# A touch that is observed, a row that is retracted, or None for a prediction.
CALLS = st.lists(st.none() | st.integers(1, 20) | st.tuples(st.sampled_from("abcd"), st.integers(100, 160)), max_size=9)


@settings(max_examples=6, deadline=None)
@given(CALLS, st.sampled_from(["lda", "ridge"]), st.permutations(FEWER), st.booleans())
def test_settled_answers_are_a_function_of_the_set_of_touches(tmp_path_factory, calls, readout, observed, reopened):
    """Whatever came in which order, batch or session, was asked between, or was retracted."""
    path, how = tmp_path_factory.mktemp("history"), SETTINGS | {"readout": readout}
    there = dict(enumerate(observed, start=1))
    with TactileLearner.open(path / "m", **how) as learner:
        with learner.batch():
            for touch in observed:
                learner.observe(touch[0], stream(*touch))
        bits(learner)
        for call in calls:
            if call is None:
                bits(learner)
            elif isinstance(call, int):
                if there.pop(call, None):
                    learner.retract(call)
            elif call not in there.values():
                there[learner.observe(call[0], stream(*call)).sequence] = call
        require_followed(learner)
        learner.settle()
        said = bits(learner)
    if reopened:
        with TactileLearner.open(path / "m", **how) as learner:
            assert bits(learner) == said
    fresh = fed(sorted(there.values()), readout=readout)
    assert said == bits(fresh)
    fresh.settle()
    assert said == bits(fresh)


def test_between_fits_answers_rest_on_all_touches_and_no_call_fits(monkeypatch, tmp_path):
    fitted = []
    with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
        for touch in OBSERVED:
            learner.observe(touch[0], stream(*touch))
        learner.settle()
        monkeypatch.setattr(Draft, "fit", lambda draft, **how: fitted.append(beside()) or FIT(draft, **how))
        for i in range(12):
            name = "abcdx"[i % 5]
            receipt = learner.observe(name, stream("abcdf"[i % 5], 100 + i))
            require_followed(learner)
            if name == "x":
                assert learner.predict(stream("f", 100 + i)).material == "x"  # a new one answers at once
                learner.retract(receipt)
                require_followed(learner)
        learner.forget("a")
        require_followed(learner)
        assert fitted and all(fitted)
        learner.settle()
        assert bits(learner) == bits(copy.deepcopy(learner))
        before = present(learner)
        learner.settle()
        assert present(learner) is before  # settled already


def test_no_call_waits_for_a_fit_that_never_ends_until_the_memory_has_doubled(monkeypatch):
    go, learner = threading.Event(), asked_once()
    monkeypatch.setattr(Draft, "fit", lambda draft, **how: (beside() and go.wait(60), FIT(draft, **how))[1])
    observed = [("abc"[i % 3], stream("abc"[i % 3], 100 + i, 60 + i)) for i in range(24)]
    for material, touch in observed:
        learner.observe(material, touch)
        require_followed(learner)
    assert not go.is_set()
    go.set()
    learner.settle()
    fresh = fed(OBSERVED)
    for material, touch in observed:
        fresh.observe(material, touch)
    assert bits(learner) == bits(fresh)


def test_a_fit_that_ends_answers_and_has_followed_what_came_since(monkeypatch):
    slowly(monkeypatch, 0.1)
    learner = asked_once()
    for i in range(3):
        learner.observe("a", stream("a", 90 + i))
    job = learner._predictor._job
    learner.observe("d", stream("d", 93))
    job[0].result()
    require_followed(learner)
    assert present(learner).fitted.touches == len(OBSERVED) + 3
    learner.settle()
    assert bits(learner) == expected((*OBSERVED, *(("a", 90 + i) for i in range(3)), ("d", 93)))


# What goes wrong


def failing(monkeypatch, what, name, error):
    monkeypatch.setattr(what, name, lambda *_, **__: (_ for _ in ()).throw(error))


STEPS = [(Draft, "of"), (Draft, "fit"), (Task, "solve"), (Model, "followed"), (Readout, "followed"), (Model, "judge")]


@pytest.mark.parametrize("error", [MemoryError("no room"), KeyboardInterrupt()])
@pytest.mark.parametrize(("what", "name"), STEPS)
def test_a_call_that_fails_or_is_interrupted_leaves_no_trace(tmp_path, monkeypatch, what, name, error):
    with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
        for touch in FEWER:
            learner.observe(touch[0], stream(*touch))
        if name in ("followed", "judge"):
            learner.predict(stream(*PROBES[0]))
        learner.observe("a", stream("a", 90))
        with monkeypatch.context() as broken:
            failing(broken, what, name, error)
            with pytest.raises(CapacityError if isinstance(error, MemoryError) else KeyboardInterrupt) as raised:
                learner.predict(stream(*PROBES[0]))
            if isinstance(error, MemoryError):
                raised.match(r"no memory left.*no room.*what was observed is kept")
            learner.observe("b", stream("b", 91))  # it is kept all the same
        require_followed(learner)
        learner.settle()
        settled = bits(learner)
    with TactileLearner.open(tmp_path / "m", **SETTINGS) as again:
        assert bits(again) == settled == expected((*FEWER, ("a", 90), ("b", 91)))


@pytest.mark.parametrize("error", [MemoryError("no room"), RuntimeError("no new thread")])
@pytest.mark.parametrize(("what", "name"), [(Draft, "of"), (Draft, "fit")])
def test_an_observation_is_acknowledged_though_nothing_can_be_fitted_beside(monkeypatch, what, name, error):
    learner = asked_once()
    with monkeypatch.context() as broken:
        failing(broken, what, name, error)
        for i in range(5):
            assert learner.observe("a", stream("a", 90 + i)).sequence == len(OBSERVED) + 1 + i
            require_followed(learner)
        if (job := learner._predictor._job) is not None:
            assert job[0].exception() is error  # it has ended
    learner.observe("a", stream("a", 95))
    require_followed(learner)
    job = learner._predictor._job
    job[0].result()  # a fit that failed beside is made again
    assert bits(learner) == expected(later(6))


# With a fit running


@pytest.fixture
def fitting(monkeypatch, tmp_path):
    """A learner of which a thread is fitting the next model for a while."""
    slowly(monkeypatch, 0.3)
    with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
        for touch in OBSERVED:
            learner.observe(touch[0], stream(*touch))
        learner.predict(stream(*PROBES[0]))
        for i in range(3):
            learner.observe("a", stream("a", 90 + i))
        assert not learner._predictor._job[0].done()
        yield learner


def test_closed_pickled_and_copied_while_a_fit_runs(fitting):
    for snapshot in (pickle.loads(pickle.dumps(fitting)), copy.deepcopy(fitting)):
        assert bits(snapshot) == expected(later(3))
    job = fitting._predictor._job
    fitting.close()
    assert job[0].done()
    for _ in range(3):
        require_followed(fitting)
    fitting.close()


def test_a_material_that_is_forgotten_while_a_fit_runs_is_gone(fitting):
    job = fitting._predictor._job
    fitting.forget("b")
    require_followed(fitting)
    job[0].result()
    require_followed(fitting)
    with fitting.live(contact="manual") as live:
        live.begin()
        live.push(stream(*PROBES[0]))
        assert {name for name, _ in live.end().prediction.ranking} == {"a", "c"}
    fitting.settle()
    assert bits(fitting) == expected(tuple(touch for touch in later(3) if touch[0] != "b"))


def test_a_learner_that_nobody_holds_is_gone_and_its_thread_ends(monkeypatch):
    slowly(monkeypatch, 0.1)
    threads = set(threading.enumerate())
    learner = asked_once()
    learner.observe("a", stream("a", 90))
    learner.observe("a", stream("a", 91))
    gone = weakref.ref(learner)
    del learner
    gc.collect()
    assert gone() is None
    for thread in set(threading.enumerate()) - threads:
        thread.join(30)
        assert not thread.is_alive()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a process cannot be forked here")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_process_waits_for_no_thread_of_its_parent(fitting):
    child = os.fork()
    if not child:
        signal.alarm(20)
        fitting.predict(stream(*PROBES[0]))
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


ENDS = """
import os, signal, sys, threading, time
sys.path[:0] = sys.argv[3:]
from prediction.test_current import SETTINGS, stream
from scroll_tactile import TactileLearner
from scroll_tactile.prediction.fitting import Draft

fit, begun = Draft.fit, threading.Event()
def slow(draft, **how):
    if threading.current_thread() is not threading.main_thread():
        begun.set()
        time.sleep(1.0)
    return fit(draft, **how)
Draft.fit = slow
learner = TactileLearner.open(sys.argv[1], **SETTINGS)
for i in range(8):
    for name in "ab":
        learner.observe(name, stream(name, i))
learner.predict(stream("a", 50))
for i in range(3):
    learner.observe("a", stream("a", 90 + i))
assert begun.wait(30)
print("fitting", flush=True)
how = sys.argv[2]
if how == "interrupted":
    signal.raise_signal(signal.SIGINT)
"""


@pytest.mark.parametrize(("how", "code"), [("ended", (0,)), ("interrupted", (1, -2, 130))])
def test_a_process_may_end_in_any_way_while_a_fit_runs(tmp_path, how, code):
    done = subprocess.run(
        [sys.executable, "-c", ENDS, tmp_path / "m", how, *sys.path],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.stdout == "fitting\n", done.stderr
    assert done.returncode in code, done.stderr
    with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
        observed = *((name, i) for i in range(8) for name in "ab"), *(("a", 90 + i) for i in range(3))
        assert bits(learner) == expected(observed)


def test_a_material_that_was_just_told_is_not_called_new(monkeypatch):
    """Its touches are among those that novelty looks around at, before any fit has them."""
    scene, learner = Scene(sensor=sensors.BIOTAC), TactileLearner(sensor=sensors.BIOTAC, exemplars=0)
    for name in ("cork", "denim", "felt", "oak", "silk"):
        for repetition in range(6):
            learner.observe(name, scene.touch(name, repetition))
    assert learner.predict(scene.touch("bark", 50)).known is False
    monkeypatch.setattr("scroll_tactile.prediction.predictor.GROWTH", 1)  # no fit begins
    for repetition in range(6):
        learner.observe("bark", scene.touch("bark", repetition))
    answers = [learner.predict(scene.touch("bark", 50 + repetition)) for repetition in range(6)]
    assert [answer.material for answer in answers] == ["bark"] * 6 and sum(
        answer.known is True for answer in answers
    ) >= 5
