"""A memory carried over to another embedding is what that one would have made of the same touches, or as it was."""

import threading

import pytest
from scroll_tactile_store import LockedError, Store, StoreFullError
from touches import OBSERVED, SETTINGS, SMALL, contents, fed, filled, held, stream, without

from examples.paper.transfer.maps import Maps
from scroll_tactile import Kernels, TactileLearner
from scroll_tactile.errors import InputError, MismatchError
from scroll_tactile.persistence import reembed
from scroll_tactile.prediction.predictor import reembed_memory

OTHER = {
    "exact": lambda: Kernels(seed=3, dimension=128),
    "not exact": lambda: Maps(layout=(2,)),
    "its own": lambda: Kernels(seed=0, dimension=64),
}


@pytest.fixture(params=["exact", "not exact"])
def other(request):
    return OTHER[request.param]()


def eventful(path):
    """A memory with observations, a description and retractions, and its receipts; row 13 retracts row 5."""
    learner, receipts = filled(path)
    learner.retract(receipts[4])
    learner.describe("a", {"wool": 1.0})
    learner.observe("d", stream((9, 60)))
    learner.forget("d")
    return learner, receipts


WHOLE = {}


def require_carried(learner, embedding, *, answers=False):
    """It holds, or answers, too, what a memory of this embedding does that observed the same."""
    key, seen = (embedding.fingerprint, answers), contents if answers else held
    if key not in WHOLE:
        WHOLE[key] = seen(fed(without(4), {"a": {"wool": 1.0}}, embedding=embedding))
    assert seen(learner) == WHOLE[key]


def rows(path):
    with Store.open(path, mode="read") as store:
        return [(head.sequence, head.kind, head.label, head.key, head.time) for head in store.heads()]


def test_it_is_what_the_other_embedding_would_have_made(path, other):
    learner, receipts = eventful(path)
    before = rows(path)
    with learner:
        old = learner.reembed(other)
        require_carried(learner, other, answers=True)
        assert (learner.path, learner.embedding) == (path, other)
        assert rows(path) == rows(old) == before
    with TactileLearner.open(path, embedding=other) as again:
        require_carried(again, other)
        again.retract(receipts[11])
        assert again.digest() == fed(without(4, 11), embedding=other).digest()
    with TactileLearner.open(old, **SETTINGS) as learner:
        require_carried(learner, SMALL)


@pytest.mark.parametrize(("name", "stopped"), [("exact", 1), ("its own", 3)])
def test_a_run_that_was_cut_short_goes_on(path, name, stopped, monkeypatch):
    other = OTHER[name]()
    monkeypatch.setattr(reembed, "ROWS_TOGETHER", 4)
    monkeypatch.setattr("scroll_tactile.persistence.ledger.CHECKPOINT_EVERY", 5)
    learner, _ = eventful(path)
    steps = []

    def stop(what, done, of):
        steps.append((done, of))
        if len(steps) == stopped:
            raise KeyboardInterrupt

    with learner:
        with pytest.raises(KeyboardInterrupt):
            learner.reembed(Kernels(seed=5, dimension=64), progress=stop)  # a run for another begins anew
        steps.clear()
        with pytest.raises(KeyboardInterrupt):
            learner.reembed(other, progress=stop)
        require_carried(learner, SMALL)
        learner.observe("a", stream((10, 60)))
        learner.retract(17)
        learner.reembed(other, progress=lambda what, *step: steps.append(step))
        assert steps[stopped][0] == min(4 * (stopped + 1), 18)
        assert steps[-1] == (18, 18)
        require_carried(learner, other)


@pytest.mark.parametrize("call", range(3))
def test_killed_in_the_exchange_one_of_them_is_whole(path, call, monkeypatch):
    learner, _ = eventful(path)
    kind, rename, calls = type(path), type(path).rename, []

    def killed(self, target):
        if self.parent == path.parent:
            calls.append(target)
            if len(calls) == call + 1:
                raise KeyboardInterrupt
        return rename(self, target)

    with monkeypatch.context() as broken:
        broken.setattr(kind, "rename", killed)
        with pytest.raises(KeyboardInterrupt):
            learner.reembed(OTHER["exact"]())
    made = OTHER["exact"]() if call == 2 else SMALL
    with TactileLearner.open(path) as again:
        require_carried(again, made)
    reembed_memory(path, OTHER["exact"]())
    with TactileLearner.open(path) as again:
        require_carried(again, OTHER["exact"]())


def test_what_is_observed_meanwhile_is_in_it(path, monkeypatch):
    other = OTHER["exact"]()
    monkeypatch.setattr(reembed, "ROWS_TOGETHER", 4)
    learner, _ = filled(path, OBSERVED[:6])
    late = iter(OBSERVED[6:9])

    def progress(what, done, of):
        for name, touch in late:
            thread = threading.Thread(target=learner.observe, args=(name, stream(touch)))
            thread.start()
            thread.join()
            break

    with learner:
        learner.reembed(other, progress=progress)
        kept = len(learner.observations())
        assert 8 <= kept <= 9
        assert learner.digest() == fed(OBSERVED[:kept], embedding=other).digest()


class TestRefused:
    def test_where_readings_are_gone(self, path, tmp_path):
        ours, _ = filled(path, OBSERVED[:4])
        theirs, _ = filled(tmp_path / "other", OBSERVED[4:])
        bare, _ = filled(tmp_path / "bare", embedding=Maps(layout=(2,)), exemplars=0)
        with ours, theirs, bare:
            theirs.compact(keep=3)
            ours.merge(theirs)
            for learner, what in ((theirs, "rows 1 to 5 were compacted"), (ours, "row 5, have"), (bare, "row 1, have")):
                with pytest.raises(MismatchError, match=f"readings of every observation: .*{what}"):
                    learner.reembed(SMALL)
            assert ours.digest() == fed(OBSERVED).digest()

    def test_in_a_batch(self, path):
        learner, _ = filled(path)
        with learner, learner.batch(), pytest.raises(InputError, match="in a batch"):
            learner.reembed()

    def test_while_another_has_it(self, path):
        learner, _ = filled(path)
        with learner, pytest.raises(LockedError):
            reembed_memory(path)


def test_on_a_full_disk_the_memory_stays_as_it_was(path, monkeypatch):
    learner, _ = eventful(path)

    def full(*_, **__):
        raise StoreFullError("no space left")

    with learner:
        for call in ("append", "commit"):
            with monkeypatch.context() as broken:
                broken.setattr(Store, call, full)
                with pytest.raises(StoreFullError):
                    learner.reembed(OTHER["exact"]())
            require_carried(learner, SMALL)
        learner.reembed(OTHER["exact"]())  # there is space again
        require_carried(learner, OTHER["exact"]())
