"""Random histories of a store against a list that cannot go wrong."""

import shutil
import tempfile
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from scroll_tactile_store import CompactedError, RecordError, Store, check_store, repair_store
from store_builds import flip_row

labels = st.text("aé\U0001f9f6'\" ", max_size=4)
arrays = st.lists(st.integers(-(2**63), 2**63 - 1), max_size=5).map(lambda values: np.array(values, "<i8"))


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

    @property
    def compacted(self):
        return self.compaction[0] if self.compaction else 0

    def put(self, label, array):
        assert self.store.append("a", label, b"key", arrays={"x": array}).sequence == len(self.rows) + 1
        self.rows.append((label, array.tobytes()))

    @rule(label=labels, array=arrays)
    def append(self, label, array):
        self.put(label, array)

    @rule(several=st.lists(st.tuples(labels, arrays), max_size=5), undone=st.booleans())
    def batch(self, several, undone):
        before = list(self.rows)
        try:
            with self.store.batch():
                for label, array in several:
                    self.put(label, array)
                assert self.store.last == len(self.rows)
                if undone:
                    raise Undone
        except Undone:
            self.rows = before

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
        wrong = [lambda: self.store.append("a", "\ud800", b""), lambda: self.store.commit({}, last_sequence=10**6)]
        if self.compacted:
            wrong += [lambda: self.store.commit({}, last_sequence=self.compacted - 1)]
            wrong += [lambda: self.store.compact({}, last_sequence=self.compacted - 1)]
        for call in wrong:
            try:
                call()
            except RecordError:
                continue
            raise AssertionError("not refused")

    @rule()
    def reopen(self):
        self.store.close()
        self.store = Store.open(self.store.path)

    @rule(partial=st.booleans())
    def crash(self, partial):
        """Abandon the store as it lies on the disk, perhaps within a commit, and go on from a copy."""
        copy = self.copied()
        if partial:
            (copy / "checkpoints" / "00000099.partial" / "x").mkdir(parents=True)
        self.store = Store.open(copy)
        assert not (copy / "checkpoints" / "00000099.partial").exists()

    def copied(self):
        self.lives += 1
        copy = self.home / str(self.lives)
        shutil.copytree(self.store.path, copy, ignore=shutil.ignore_patterns("lock", "holder.json"))
        self.store.close()
        return copy

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
        self.rows = self.rows[: lost - 1]
        self.store = Store.open(copy)

    @rule()
    def check(self):
        for path in (self.store.path, self.copied()):
            assert {one.kind for one in check_store(path)} <= {"leftover"}
        self.store = Store.open(self.home / str(self.lives))

    @invariant()
    @precondition(lambda self: hasattr(self, "store"))
    def agrees(self):
        with Store.open(self.store.path, mode="read") as reader:
            for opened in (self.store, reader):
                found = [(row.label, row.arrays["x"].tobytes()) for row in opened.records(self.compacted)]
                assert found == self.rows[self.compacted :]
                assert [head.label for head in opened.heads()] == [label for label, _ in self.rows]
                assert (opened.last, opened.identity) == (len(self.rows), {"lives": 9})
                assert opened.compacted == self.compacted
            latest, compaction, newest = reader.latest(), reader.compaction(), reader.newest
            if self.compacted:
                try:
                    reader.record(self.compacted)
                except CompactedError:
                    pass
                else:
                    raise AssertionError("not compacted")
        assert (latest and (latest.last_sequence, latest.number, latest.arrays["x"].tobytes())) == self.current
        assert (
            compaction and (compaction.last_sequence, compaction.number, compaction.arrays["x"].tobytes())
        ) == self.compaction
        assert newest == (self.current and self.current[1])

    def teardown(self):
        if hasattr(self, "store"):
            self.store.close()
        shutil.rmtree(self.home)


History.TestCase.settings = settings(
    max_examples=12, stateful_step_count=15, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
TestHistory = History.TestCase
