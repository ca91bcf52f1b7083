"""The log as a state machine against lists: batches, crashes that tear what was not synced, readers that stay open."""

import random
import shutil
import tempfile
from pathlib import Path

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from logs import KIND, names, rest, to_write
from scroll_tactile_store.log import Log, create_log

SECTOR = 512
payloads = st.integers(0, 2000).flatmap(lambda size: st.integers(0, 255).map(lambda byte: bytes([byte]) * size))


class Recorded:
    """What a writer does to its file since the last sync; a sync empties it. A truncation is of the metadata."""

    def __init__(self, log):
        self.log, self.writes = log, []
        write = log._put

        def noted(offset, data):
            self.writes.append((offset, bytes(data)))
            write(offset, data)

        log._put = noted


class LogMachine(RuleBasedStateMachine):
    """The model: `durable` are the batches acknowledged, `staged` those of the open batch."""

    @initialize()
    def begin(self):
        self.home = Path(tempfile.mkdtemp())
        self.path = self.home / "log"
        create_log(self.path, b"about")
        self.durable, self.staged, self.readers = [], [], []
        self.open()

    def open(self):
        self.writer = to_write(self.path)
        self.recorded = Recorded(self.writer)

    @rule(payload=payloads)
    def stage(self, payload):
        self.writer.stage(KIND, payload)
        self.staged.append(payload)

    @precondition(lambda self: self.staged)
    @rule()
    def commit(self):
        self.safe = self.path.read_bytes()
        self.recorded.writes.clear()
        self.writer.commit()
        self.durable.append(self.staged)
        self.staged = []

    @rule()
    def rollback(self):
        self.writer.rollback()
        self.staged = []

    @rule()
    def reopen(self):
        self.writer.close(trim=True)
        self.staged = []
        self.open()

    @precondition(lambda self: self.staged)
    @rule(seed=st.integers(0, 2**32), all_came=st.booleans())
    def crash(self, seed, all_came):
        """While the open batch was being made durable: each sector of its write came, or did not, by itself."""
        rng, safe = random.Random(seed), bytearray(self.path.read_bytes())
        self.recorded.writes.clear()
        self.writer.commit()
        for offset, data in self.recorded.writes:
            safe.extend(bytes(max(0, offset + len(data) - len(safe))))
            begin = offset
            while begin < offset + len(data):
                end = min(offset + len(data), (begin // SECTOR + 1) * SECTOR)
                if all_came or rng.random() < 0.7:
                    safe[begin:end] = data[begin - offset : end - offset]
                begin = end
        if not all_came and rng.random() < 0.3:  # the length did not come
            del safe[self.recorded.writes[-1][0] + rng.randrange(2000) :]
        for log in self.readers:
            log[0].close()
        self.readers = []
        self.writer.close()
        self.path.write_bytes(safe)
        with Log(self.path) as log:
            found = rest(log)
        assert found in (self.durable, [*self.durable, self.staged])
        assert not all_came or found != self.durable
        self.durable, self.staged = found, []
        self.open()

    @precondition(lambda self: len(self.readers) < 4)
    @rule()
    def read(self):
        self.readers.append((Log(self.path), []))

    @rule(which=st.integers(0, 3))
    def refresh(self, which):
        if which < len(self.readers):
            log, found = self.readers[which]
            found += rest(log)
            assert found == self.durable
            with Log(self.path) as again:
                assert again.has_place(log.place)
                again.place = log.place
                assert rest(again) == []

    @rule(keep=st.integers(0, 3))
    def compact(self, keep):
        """Readers stay with the log that was."""
        self.writer.close()
        for log, found in self.readers:
            assert found + rest(log) == self.durable
        self.durable = [[each for batch in self.durable[-keep:] for each in batch]] if keep and self.durable else []
        create_log(self.path, b"about", [(KIND, each) for batch in self.durable for each in batch])
        for log, _ in self.readers:
            assert rest(log) == []
            log.close()
        self.readers, self.staged = [], []
        self.open()

    @invariant()
    def holds(self):
        with Log(self.path) as log:
            assert rest(log) == self.durable
        assert names(self.home) == ["log"]

    def teardown(self):
        for log, _ in self.readers:
            log.close()
        self.writer.close()
        shutil.rmtree(self.home)


TestLogMachine = LogMachine.TestCase
TestLogMachine.settings = settings(max_examples=40, stateful_step_count=25, deadline=None)
