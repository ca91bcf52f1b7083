"""Random histories of a store, with kills, power cuts and a reader that stays, against a list that cannot go wrong."""

import random
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from forging import log_of
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from scroll_tactile_store import CompactedError, RecordError, Store, check_store, repair_store
from store_builds import as_after_a_crash, flip_row

labels = st.text("aé\U0001f9f6'\" ", max_size=4)
arrays = st.builds(
    lambda seed, size: np.random.default_rng(seed).integers(-(2**63), 2**63 - 1, size),
    st.integers(0, 2**32),
    st.integers(0, 5) | st.integers(0, 250),
)
several = st.lists(st.tuples(labels, arrays), max_size=5)
SECTOR = 512


class Undone(Exception):
    """Ends a batch."""


class History(RuleBasedStateMachine):
    """The model: every row that was acknowledged, the checkpoint that is current, and the compaction checkpoint."""

    def __init__(self):
        super().__init__()
        self.home = Path(tempfile.mkdtemp())
        self.lives = 0
        self.rows: list[tuple[str, bytes]] = []
        self.current: tuple[int, int, bytes] | None = None  # last_sequence, number, content
        self.compaction: tuple[int, int, bytes] | None = None

    @initialize()
    def create(self):
        self.store = Store.open(self.home / "0", identity={"lives": 9})
        self.reader = None

    @property
    def compacted(self):
        return self.compaction[0] if self.compaction else 0

    def put(self, label, array):
        assert self.store.append("a", label, b"key", arrays={"x": array}).sequence == len(self.rows) + 1
        self.rows.append((label, array.tobytes()))

    @rule(label=labels, array=arrays)
    def append(self, label, array):
        self.put(label, array)

    @rule(several=several, undone=st.booleans())
    def batch(self, several, undone):
        before = list(self.rows)
        with suppress(Undone), self.store.batch():
            for label, array in several:
                self.put(label, array)
            assert self.store.last == len(self.rows)
            if undone:
                self.rows = before
                raise Undone

    def numbered(self, last_sequence, array):
        """A checkpoint has the number behind those that are kept."""
        kept = [made[1] for made in (self.current, self.compaction) if made]
        return last_sequence, 1 + max(kept, default=0), array.tobytes()

    @rule(where=st.floats(0, 1), value=st.integers(0, 255), later=st.booleans())
    def commit(self, where, value, later):
        last_sequence = self.compacted + int(where * (len(self.rows) - self.compacted))
        array = np.full((2, 3), value, "|u1")
        (self.store.commit_later if later else self.store.commit)({"x": array}, last_sequence=last_sequence)
        self.store.flush()
        made = self.numbered(last_sequence, array)
        self.current = made if self.current is None or last_sequence >= self.current[0] else self.current

    @rule(where=st.floats(0, 1), value=st.integers(0, 255), with_newest=st.booleans())
    def compact(self, where, value, with_newest):
        last_sequence = self.compacted + int(where * (len(self.rows) - self.compacted))
        array = np.full((3, 2), value, "|u1")
        self.store.compact(
            {"x": array}, last_sequence=last_sequence, newest=({"x": array}, {}) if with_newest else None
        )
        self.current = self.compaction = self.numbered(last_sequence, array)
        if with_newest:
            self.current = self.numbered(len(self.rows), array)

    @rule()
    def refuse(self):
        with pytest.raises(RecordError):
            self.store.append(5, "", b"")
        for last_sequence in (10**6, self.compacted - 1):
            for call in (self.store.commit, self.store.compact):
                with pytest.raises(RecordError):
                    call({}, last_sequence=last_sequence)

    @rule()
    def reopen(self):
        self.store.close()
        self.store = Store.open(self.store.path)

    @rule()
    def look(self):
        """A reader that stays open sees no more until it looks, and then all."""
        if self.reader is None:
            self.reader = Store.open(self.store.path, mode="read")
        self.reader.state()
        self.require(self.reader)

    @rule(partial=st.booleans())
    def kill(self, partial):
        """Abandon the store as it lies on the disk, perhaps within a commit, and go on from a copy."""
        copy = self.copied()
        if partial:
            (copy / "checkpoints" / "00000099.partial" / "x").mkdir(parents=True)
        self.go_on(copy)
        assert not (copy / "checkpoints" / "00000099.partial").exists()

    @rule(several=several.filter(bool), seed=st.integers(0, 2**32), all_came=st.booleans())
    def power_cut(self, several, seed, all_came):
        """While a batch was being made durable: each sector of its write came, or did not, by itself; or the length."""
        rng, copy, before = random.Random(seed), self.copied(close=False), list(self.rows)
        safe = bytearray(log_of(copy).read_bytes())
        with self.store.batch():
            for label, array in several:
                self.put(label, array)
        written = log_of(self.store.path).read_bytes()
        self.store.close()
        safe.extend(bytes(len(written) - len(safe)))
        came = [at for at in range(0, len(written), SECTOR) if safe[at : at + SECTOR] != written[at : at + SECTOR]]
        for at in came:
            if all_came or rng.random() < 0.7:
                safe[at : at + SECTOR] = written[at : at + SECTOR]
        if not all_came and rng.random() < 0.3:
            del safe[came[-1] + rng.randrange(SECTOR) :]
        log_of(copy).write_bytes(safe)
        self.go_on(copy)
        if self.store.last == len(before) and not all_came:
            self.rows = before

    def copied(self, *, close=True):
        """A copy of the store as it lies on the disk; closed where it is not used any more."""
        self.lives += 1
        copy = as_after_a_crash(self.store, self.home / str(self.lives))
        if close:
            self.store.close()
        return copy

    def go_on(self, copy):
        if self.reader is not None:
            self.reader.close()
        self.store, self.reader = Store.open(copy), None

    @precondition(lambda self: len(self.rows) > max(self.compacted, self.current[0] if self.current else 0))
    @rule(where=st.floats(0, 0.99), arrays=st.booleans())
    def lose_a_row(self, where, arrays):
        """Behind the current checkpoint, and before another batch: then a repair keeps those before it."""
        first = (self.current[0] if self.current else 0) + 1
        lost = first + int(where * (len(self.rows) - first + 1))
        self.put("after", np.arange(3, dtype="<i8"))
        copy = self.copied()
        flip_row(copy, lost, arrays=arrays)
        assert repair_store(copy).kept == lost - 1
        if not self.compacted:
            self.compaction = None  # one that stands for no rows
        elif self.current[0] == self.compacted:
            self.compaction = self.current  # of two that stand for the same rows a repair names the newer
        self.rows = self.rows[: lost - 1]
        self.go_on(copy)

    @rule()
    def check(self):
        for path in (self.store.path, self.copied(close=False)):
            assert {one.kind for one in check_store(path)} <= {"leftover"}

    def require(self, opened):
        """It holds what the model does."""
        assert (opened.last, opened.compacted, opened.identity) == (len(self.rows), self.compacted, {"lives": 9})
        found = [(row.label, row.arrays["x"].tobytes()) for row in opened.records(self.compacted)]
        assert found == self.rows[self.compacted :]
        assert [head.label for head in opened.heads()] == [label for label, _ in self.rows]
        if self.compacted:
            with pytest.raises(CompactedError):
                opened.record(self.compacted)
        for made, expected in ((opened.latest(), self.current), (opened.compaction(), self.compaction)):
            assert (made and (made.last_sequence, made.number, made.arrays["x"].tobytes())) == expected
        assert opened.state(look=False).newest == (self.current and self.current[1])

    @invariant()
    @precondition(lambda self: hasattr(self, "store"))
    def agrees(self):
        self.require(self.store)
        with Store.open(self.store.path, mode="read") as reader:
            self.require(reader)

    def teardown(self):
        if hasattr(self, "store"):
            for opened in filter(None, (self.reader, self.store)):
                opened.close()
        shutil.rmtree(self.home)


History.TestCase.settings = settings(
    max_examples=12, stateful_step_count=15, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
TestHistory = History.TestCase
