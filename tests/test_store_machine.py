"""Random histories of a store against a list that cannot go wrong."""

import shutil
import tempfile
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from store import RecordError, Store

labels = st.text("aé\U0001f9f6'\" ", max_size=4)


class History(RuleBasedStateMachine):
    """The model: every row that was acknowledged, and the generation that was committed last."""

    def __init__(self):
        super().__init__()
        self.home = Path(tempfile.mkdtemp())
        self.lives = 0
        self.rows: list[tuple[str, bytes]] = []
        self.current: tuple[int, int, bytes] | None = None

    @initialize()
    def create(self):
        self.store = Store.open(self.home / "0", identity={"lives": 9})

    @rule(label=labels, values=st.lists(st.integers(-(2**63), 2**63 - 1), max_size=5))
    def append(self, label, values):
        array = np.array(values, "<i8")
        assert self.store.append("a", label, b"key", arrays={"x": array}).sequence == len(self.rows) + 1
        self.rows.append((label, array.tobytes()))

    @rule(where=st.floats(0, 1), value=st.integers(0, 255), later=st.booleans())
    def commit(self, where, value, later):
        upto = int(where * len(self.rows))
        array = np.full((2, 3), value, "|u1")
        (self.store.commit_later if later else self.store.commit)({"x": array}, upto=upto)
        self.store.flush()
        number = 1 + (self.current[0] if self.current else 0)
        self.current = (number, upto, array.tobytes())

    @rule()
    def refuse(self):
        for wrong in (lambda: self.store.append("a", "\0", b""), lambda: self.store.commit({}, upto=10**6)):
            try:
                wrong()
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
        self.lives += 1
        copy = self.home / str(self.lives)
        shutil.copytree(self.store.path, copy, ignore=shutil.ignore_patterns("*-shm"))
        self.store.close()
        if partial:
            (copy / "generations" / "00000099.partial" / "x").mkdir(parents=True)
        self.store = Store.open(copy)
        assert not (copy / "generations" / "00000099.partial").exists()

    @invariant()
    @precondition(lambda self: hasattr(self, "store"))
    def agrees(self):
        with Store.open(self.store.path, mode="read") as reader:
            for opened in (self.store, reader):
                found = [(row.label, row.arrays["x"].tobytes()) for row in opened.records()]
                assert (opened.last, found, opened.identity) == (len(self.rows), self.rows, {"lives": 9})
            latest = reader.latest()
        now = latest and (latest.number, latest.upto, latest.arrays["x"].tobytes())
        assert now == self.current

    def teardown(self):
        if hasattr(self, "store"):
            self.store.close()
        shutil.rmtree(self.home)


History.TestCase.settings = settings(
    max_examples=20, stateful_step_count=15, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
TestHistory = History.TestCase
