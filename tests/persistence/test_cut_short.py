"""Ctrl-C at the worst line: what was half done is read again, and never kept."""

import sys
import threading
from contextlib import contextmanager

import pytest
from touches import PAD, SMALL, stream

from scroll_tactile import TactileLearner
from scroll_tactile.errors import MismatchError
from scroll_tactile.persistence import ledger as ledgers
from scroll_tactile.persistence import reembed
from scroll_tactile.persistence.ram_store import RamStore

MADE = {"sensor": PAD, "embedding": SMALL}
NAMES = "abc"


def touch(i):
    return NAMES[i % 3], stream((i, 30))


def learned(count, **made):
    learner = TactileLearner(**MADE, **made)
    return learner, [learner.observe(*touch(i)) for i in range(count)]


@contextmanager
def interrupted(function, line):
    """In the block a KeyboardInterrupt comes before the line of the function, counted as they are run from 1."""
    count = 0

    def before(frame, event, _):
        nonlocal count
        if event == "line":
            count += 1
            if count == line:
                sys.settrace(None)
                raise KeyboardInterrupt
        return before

    sys.settrace(lambda frame, *_: before if frame.f_code is function.__code__ else None)
    try:
        yield
    except KeyboardInterrupt:
        pass
    finally:
        sys.settrace(None)


def at_call(monkeypatch, owner, name, call):
    whole, calls = getattr(owner, name), []

    def cut(*words, **named):
        calls.append(words)
        if len(calls) == call:
            raise KeyboardInterrupt
        return whole(*words, **named)

    monkeypatch.setattr(owner, name, cut)


def test_a_reembedding_cut_short_keeps_nothing_that_was_retracted(tmp_path, monkeypatch):
    monkeypatch.setattr(ledgers, "CHECKPOINT_EVERY", 8)
    with TactileLearner.open(tmp_path / "m", **MADE) as learner:
        receipts = [learner.observe(*touch(i)) for i in range(6)]
        learner.retract(receipts[4])
        learner.observe(*touch(7))
        with monkeypatch.context() as patched:
            at_call(patched, reembed, "refill", 1)
            with pytest.raises(KeyboardInterrupt):
                learner.reembed()
    with TactileLearner.open(tmp_path / "m") as again:
        again.reembed()
        assert receipts[4].key not in {key for _, key, _ in again.memory.sample}


@pytest.mark.parametrize("line", range(1, 8))
def test_compacting_in_ram_is_whole_or_not_there(line):
    learner, receipts = learned(9, exemplars=4)
    learner.retract(receipts[1])
    for i in (20, 21, 22):
        learner.observe(*touch(i))
    learner.retract(receipts[2])
    before = learner.digest(), learner.exemplars
    with interrupted(RamStore.compact, line):
        learner.compact(keep=2)
    assert (learner.digest(), learner.exemplars) == before
    learner.compact()
    assert learner.digest() == before[0]


def test_who_reads_beside_an_observation_waits_for_its_end(tmp_path, monkeypatch):
    with TactileLearner.open(tmp_path / "m", **MADE) as learner:
        learner.observe(*touch(0))
        seen, apply = [], ledgers.apply

        def beside(*words, **named):
            if len(seen) == 0:
                seen.append(threading.Thread(target=lambda: seen.append(learner._ledger.memory.sequence)))
                seen[0].start()
                seen[0].join(0.1)
            return apply(*words, **named)

        monkeypatch.setattr(ledgers, "apply", beside)
        version = learner._ledger.version
        learner.observe(*touch(1))
        seen[0].join()
        assert (seen[1], learner._ledger.version) == (2, version + 1)
        assert learner.digest() == learned(2)[0].digest()


def test_the_pack_of_an_empty_memory_comes_in(tmp_path):
    TactileLearner(**MADE).pack(tmp_path / "empty")
    learner, _ = learned(3)
    before = learner.digest()
    learner.merge(tmp_path / "empty")
    assert learner.digest() == before


def test_memories_with_more_axes_than_one_may_have_are_not_merged():
    one, other = TactileLearner(**MADE), TactileLearner(**MADE)
    for i, learner in enumerate((one, other)):
        learner.observe(*touch(i), labels={f"axis {10 * i + axis}": "x" for axis in range(10)})
    with pytest.raises(MismatchError, match="at most 16 axes in both memories together; came 20"):
        one.merge(other)
    one.observe(*touch(5), labels={"axis 0": "x"})


def test_what_is_read_of_a_description_is_a_copy():
    learner, _ = learned(3)
    learner.describe("a", {"hardness": (62, "Shore A")})
    before = repr(learner.descriptions)
    learner.descriptions["a"]["hardness"][0] = 5
    assert repr(learner.descriptions) == before
