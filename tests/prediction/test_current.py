"""The current model: the same calls give the same answers, whatever a thread's speed, and no failure leaves a trace."""

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
from scroll_tactile.readouts.system import System
from touches import PAD, SMALL

from scroll_tactile import TactileLearner
from scroll_tactile.errors import CapacityError
from scroll_tactile.prediction import current
from scroll_tactile.prediction.fitting import Draft
from scroll_tactile.prediction.model import Model
from scroll_tactile.readouts.readout import Readout

OBSERVED = tuple((name, seed) for seed in range(8) for name in "abc")
FEWER = OBSERVED[:15]
PROBES = (("a", 50, 60), ("b", 51, 25), ("c", 52, 6))
FIT = Draft.fit
SETTINGS = {"sensor": PAD, "embedding": SMALL, "kept_touches": 6}  # with few kept ones a fit takes a third of the time


@pytest.fixture(autouse=True, scope="module")
def often():
    """A model is fitted again after an eighth, so that a few touches show how."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(current, "BEGIN", 1)
        monkeypatch.setattr(current, "ADOPT", 2)
        yield


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
    """Its readouts count each touch that the memory has, once."""
    learner.predict(stream(*PROBES[0]))
    statistics = learner.memory.statistics
    for scale, readout in learner._predictor.current.present(learner._ledger).readouts.items():
        names = statistics.names(scale)
        counts = [readout.counts[readout.places[name]] for name in names]
        assert counts == statistics.counts(scale, names).tolist()
        assert readout.counts.sum() == sum(counts)


def slowly(monkeypatch, seconds):
    """Let every fit that a thread makes beside take longer."""

    def fit(draft, extractor):
        if threading.current_thread() is not threading.main_thread():
            time.sleep(seconds)
        return FIT(draft, extractor)

    monkeypatch.setattr(Draft, "fit", fit)


# A touch that is observed, or None for a prediction; of so small a memory each counts, and no thread is waited for.
CALLS = st.lists(st.none() | st.tuples(st.sampled_from("abcdef"), st.integers(100, 160)), max_size=7)


@settings(max_examples=3, deadline=None)
@given(CALLS, st.sampled_from(["lda", "ridge"]), st.sampled_from([0.01, 0.03]))
def test_the_same_calls_give_the_same_answers_whatever_the_threads_speed(calls, readout, seconds):
    said = []
    for wait in (0.0, seconds):
        with pytest.MonkeyPatch.context() as monkeypatch:
            slowly(monkeypatch, wait)
            learner = fed(OBSERVED[:6], readout=readout)
            answers = bits(learner)
            for call in calls:
                if call is None:
                    answers += bits(learner, PROBES[:1])
                else:
                    learner.observe(call[0], stream(*call))
            said.append(answers + bits(learner))
            learner.close()
    assert said[0] == said[1]


def test_what_was_just_observed_counts_and_a_fit_that_is_there_answers():
    learner = fed([(name, seed) for seed in range(9) for name in "ab"])  # more than FEW
    for i in range(6):
        learner.observe("abc"[i % 3], stream("abc"[i % 3], 200 + i))
        learner.predict(stream(*PROBES[0]))
        if (fit := learner._predictor.current._fit) is not None:
            fit.future.result()
        model = learner._predictor.current.present(learner._ledger)
        touches = learner.memory.statistics.touches
        assert 0 <= touches - model.fitted_to < max(2, model.fitted_to // 8)
        assert model.names == list(learner.materials)
        require_followed(learner)


def test_no_prediction_fits_in_the_foreground_while_touches_come(monkeypatch):
    learner, fitted = asked_once(), []
    monkeypatch.setattr(Draft, "fit", lambda *own: fitted.append(threading.current_thread()) or FIT(*own))
    for i in range(12):
        learner.observe("abcd"[i % 4], stream("abcd"[i % 4], 100 + i))
        if i % 5 == 0:
            learner.predict(stream(*PROBES[0]))
    assert fitted
    assert threading.main_thread() not in fitted


def test_no_prediction_waits_for_a_fit_that_never_ends(monkeypatch):
    """More touches come than readouts can follow, and of lengths that no kept touch has."""
    go = threading.Event()

    def fit(draft, extractor):
        go.wait(60)
        return FIT(draft, extractor)

    learner = asked_once()
    monkeypatch.setattr(Draft, "fit", fit)
    monkeypatch.setattr(current, "MOST_BEHIND", 8)
    observed = [("abc"[i % 3], stream("abc"[i % 3], 100 + i, 60 + i)) for i in range(24)]
    for i, (material, touch) in enumerate(observed):
        learner.observe(material, touch)
        if i % 9 == 0 or i == 23:
            learner.predict(stream(*PROBES[0]))
    assert not go.is_set()
    require_followed(learner)
    go.set()
    learner.settle()
    fresh = fed(OBSERVED)
    for material, touch in observed:
        fresh.observe(material, touch)
    assert bits(learner) == bits(fresh)


def test_many_touches_without_a_question_are_not_kept(monkeypatch):
    monkeypatch.setattr(current, "MOST_BEHIND", 8)
    learner = fed(FEWER)
    learner.predict(stream(*PROBES[0]))
    for i in range(current.MOST_BEHIND + 20):
        learner.observe("abc"[i % 3], stream("abc"[i % 3], 100 + i))
    held = learner._predictor.current
    jobs = [job for job in (held._fit, held._renewal) if job is not None]
    assert sum(len(kept or []) for kept in (held._behind, *(job.since for job in jobs))) <= 3 * current.MOST_BEHIND
    require_followed(learner)
    learner.settle()
    assert bits(learner) == bits(copy.deepcopy(learner))
    before = held._model
    learner.settle()
    assert held._model is before  # settled already


# What goes wrong


def failing(monkeypatch, what, name, error):
    monkeypatch.setattr(what, name, lambda *_, **__: (_ for _ in ()).throw(error))


@pytest.mark.parametrize(
    ("what", "name"), [(Draft, "of"), (Draft, "fit"), (Model, "follow"), (Model, "judge"), (System, "solve")]
)
def test_without_memory_the_answer_is_an_error_and_the_next_is_right(tmp_path, monkeypatch, what, name):
    with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
        for touch in FEWER:
            learner.observe(touch[0], stream(*touch))
        if name in ("follow", "judge"):
            learner.predict(stream(*PROBES[0]))
        learner.observe("a", stream("a", 90))
        with monkeypatch.context() as broken:
            failing(broken, what, name, MemoryError("no room"))
            with pytest.raises(CapacityError, match=r"no memory left.*no room.*what was observed is kept"):
                learner.predict(stream(*PROBES[0]))
            learner.observe("b", stream("b", 91))  # it is kept all the same
        require_followed(learner)
        learner.settle()
        settled = bits(learner)
    with TactileLearner.open(tmp_path / "m", **SETTINGS) as again:
        assert bits(again) == settled == expected((*FEWER, ("a", 90), ("b", 91)))


@pytest.mark.parametrize("error", [MemoryError("no room"), RuntimeError("no new thread")])
def test_an_observation_is_acknowledged_though_nothing_can_be_fitted_beside(monkeypatch, error):
    learner = fed(FEWER)
    learner.predict(stream(*PROBES[0]))
    with monkeypatch.context() as broken:
        failing(broken, Draft, "of", error)
        for i in range(5):
            assert learner.observe("a", stream("a", 90 + i)).sequence == len(FEWER) + 1 + i
    learner.settle()
    assert bits(learner) == expected((*FEWER, *(("a", 90 + i) for i in range(5))))


def test_a_small_memory_is_opened_as_it_is_fitted(tmp_path):
    with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
        for touch in OBSERVED[:9]:
            learner.observe(touch[0], stream(*touch))
        learner.predict(stream(*PROBES[0]))
        learner.observe("a", stream("a", 90))  # one more: the model that answers is the one before
    with TactileLearner.open(tmp_path / "m", **SETTINGS) as again:
        assert bits(again) == expected((*OBSERVED[:9], ("a", 90)))


def test_a_fit_that_failed_beside_is_made_again(monkeypatch):
    learner = asked_once()
    with monkeypatch.context() as broken:
        failing(broken, Draft, "fit", MemoryError("no room"))
        for i in range(3):
            learner.observe("a", stream("a", 90 + i))
        failed = learner._predictor.current._fit
        failed.future.exception()
    learner.predict(stream(*PROBES[0]))
    again = learner._predictor.current._fit
    assert again is not failed
    again.future.result()
    assert bits(learner) == expected(later(3))


@pytest.mark.parametrize("touches", [1, 3])
def test_following_that_is_cut_short_counts_no_touch_twice(monkeypatch, touches):
    learner = asked_once()
    for i in range(touches):
        learner.observe("a", stream("a", 90 + i))
    own, calls = Readout.follow, []

    def follow(readout, changes):
        calls.append(changes)
        done = own(readout, changes)
        if len(calls) == 1:
            raise KeyboardInterrupt
        return done

    monkeypatch.setattr(Readout, "follow", follow)
    with pytest.raises(KeyboardInterrupt):
        learner.predict(stream(*PROBES[0]))
    require_followed(learner)
    learner.settle()
    assert bits(learner) == expected(later(touches))


# With a fit running


@pytest.fixture
def fitting(monkeypatch):
    """A learner of which a thread is fitting the next model for a while."""
    slowly(monkeypatch, 0.3)
    learner = asked_once()
    for i in range(3):
        learner.observe("a", stream("a", 90 + i))
    assert not learner._predictor.current._fit.future.done()
    return learner


def test_closed_pickled_copied_and_dropped_while_a_fit_runs(fitting):
    for snapshot in (pickle.loads(pickle.dumps(fitting)), copy.deepcopy(fitting)):
        assert bits(snapshot) == expected(later(3))
    job = fitting._predictor.current._fit
    fitting.close()
    assert job.future.done()
    for _ in range(3):
        assert dict(fitting.predict(stream(*PROBES[0])).ranking).keys() == {"a", "b", "c"}
    fitting.close()


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
from scroll_tactile.prediction.fitting import Draft, Renewal

fit, begun = Draft.fit, threading.Event()
def slow(draft, extractor):
    if threading.current_thread() is not threading.main_thread():
        begun.set()
        time.sleep(1.0)
    return fit(draft, extractor)
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
