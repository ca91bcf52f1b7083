"""Ten thousand steps of random histories against the model: `python tests/faults/history.py --steps 10000 --seed 0`."""

from __future__ import annotations

import argparse
import itertools
import shutil
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any
from unittest import mock

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from touches import SMALL, SmallSample, contents, stream

from faults.common import parser, progress, run
from faults.learners import KIT, expected, fed, opened, perform, seen, unsound_copies
from faults.model import Pairs, State, after
from faults.plans import KINDS, draw, prepare, touch
from scroll_tactile.clients.learning.fleet import learn
from scroll_tactile.clients.learning.sources import SourceOptions
from scroll_tactile.errors import StreamError
from scroll_tactile.statistics.statistics import Statistics

LENGTH = 50
readouts = st.sampled_from(["lda", "ridge"])
randoms = st.randoms(use_true_random=False)


class Here(Executor):
    """Runs each job at once, in this process."""

    def submit(self, what: Callable[..., Any], /, *words: Any, **named: Any) -> Future[Any]:
        """See `Executor.submit`."""
        future: Future[Any] = Future()
        future.set_result(what(*words, **named))
        return future


def learn_files(path: Path, state: State, touches: Pairs) -> int:
    """Have a fleet learn these touches into a memory, which nobody has open; how many came in."""
    with tempfile.TemporaryDirectory() as home:
        files = []
        for number, (material, touch) in enumerate(touches):
            files.append(Path(home, f"{number:03d}", material, "touch.npy"))
            files[-1].parent.mkdir(parents=True)
            np.save(files[-1], stream(touch).astype(np.float32))
        destination = Path(home, "m")
        path.rename(destination)  # with what the run keeps beside it
        made = {"embedding": KIT.embeddings[state.embedding], "executor": Here()}
        by = f"folder:{len(destination.parts)}"  # of files that are typed the whole path counts
        done = learn(files, destination, SourceOptions(by=by), **made)
        assert not done.refused, done.refused
        destination.rename(path)
        return done.observations


class History(RuleBasedStateMachine):
    """Random operations on a memory with a reader beside it; the model is a list of touches that cannot go wrong."""

    def __init__(self) -> None:
        super().__init__()
        self.pools = mock.patch("scroll_tactile.memory.state.TouchSample", SmallSample)
        self.pools.start()
        self.home = Path(tempfile.mkdtemp())
        self.others = prepare(self.home)
        self.names = itertools.count()
        self.state = State()

    @initialize()
    def create(self) -> None:
        self.path = self.home / f"memory-{next(self.names)}"
        self.learner, self.reader = self.open(), self.open("read")

    def open(self, mode: str = "write", **settings_: Any) -> Any:
        return opened(self.path, mode, embedding=KIT.embeddings[self.state.embedding], **settings_)

    def do(self, operation: Any) -> None:
        self.state, result = after(self.state, operation, self.others)
        assert perform(self.learner, operation, self.home) == result

    @rule(kind=st.sampled_from(KINDS), rng=randoms)
    def change(self, kind: str, rng: Any) -> None:
        if kind == "fine_tune" and self.learner.settings.readout != "lda":  # from which the model's f* starts
            self.reopen("lda")
        self.do(draw(rng, self.state, self.others, kind))
        assert unsound_copies(self.path, [self.state]) == []

    @rule(rng=randoms)
    def reembed(self, rng: Any) -> None:
        self.do(draw(rng, self.state, self.others, "reembed"))
        assert seen(self.learner) == expected(self.state)
        self.reader.close()  # it reads the memory that was replaced
        self.reader = self.open("read")

    @rule(rng=randoms)
    def learn_as_a_fleet(self, rng: Any) -> None:
        operation = draw(rng, self.state, self.others, "fleet")
        readout = self.learner.settings.readout
        self.learner.close()
        self.reader.close()
        came = learn_files(self.path, self.state, operation[1])
        self.state, result = after(self.state, operation, self.others)
        self.learner, self.reader = self.open(readout=readout), self.open("read")
        assert came == result
        assert seen(self.learner) == expected(self.state)

    @rule(rng=randoms)
    def fail_in_a_batch(self, rng: Any) -> None:
        """What came before the error is kept."""
        _, operations = draw(rng, self.state, self.others, "batch")
        with pytest.raises(StreamError), self.learner.batch():
            for operation in operations:
                self.do(operation)
            self.learner.observe("a", [])

    @rule()
    def refuse(self) -> None:
        for sequence, _ in self.state.listed:
            if sequence not in self.state.loose:
                self.do(("retract", sequence))
        for material, readings in (("a", np.full((50, 2), np.nan)), ("a", []), ("", np.zeros((50, 2)))):
            with pytest.raises(ValueError, match="expected"):
                self.learner.observe(material, readings)

    @rule(rng=randoms, scene=st.none() | st.lists(st.sampled_from(KIT.materials), min_size=1))
    def predict(self, rng: Any, scene: list[str] | None) -> None:
        observed = set(self.state.materials)
        chosen = observed.intersection(scene or ())
        prediction = self.learner.predict(stream(touch(rng)), scene=chosen or None)
        assert {name for name, _ in prediction.ranking} == (chosen or observed)
        shares = [share for _, share in prediction.ranking]
        assert np.isfinite(shares).all()
        assert not shares or abs(sum(shares) - 1) < 1e-9

    @rule(readout=readouts)
    def reopen(self, readout: str) -> None:
        self.learner.close()
        self.learner = self.open(readout=readout)
        self.agrees(self.learner)

    @rule(readout=readouts)
    def abandon(self, readout: str) -> None:
        """Leave the memory as it lies on the disk, as a kill would, and go on from there."""
        before, self.path = self.path, self.home / f"memory-{next(self.names)}"
        shutil.copytree(before, self.path, ignore=shutil.ignore_patterns("lock"))
        self.learner.close()
        self.reader.close()
        self.learner, self.reader = self.open(readout=readout), self.open("read")

    @rule()
    def refresh(self) -> None:
        self.reader.refresh()
        self.agrees(self.reader)
        assert not self.reader.refresh()

    @rule(rng=randoms)
    def split_and_add(self, rng: Any) -> None:
        """The statistics of two memories that share the touches are, together, those of the one that observed all."""
        sides: tuple[list[Any], list[Any]] = ([], [])
        for pair in self.state.pairs:
            sides[rng.randrange(2)].append(pair)
        memories = [fed(tuple(side), self.state.embedding).memory for side in sides]
        ours, theirs = (memory.statistics for memory in memories)
        whole = self.learner.memory.statistics
        assert ours + theirs == whole
        assert whole - ours == theirs
        of_ours, of_theirs = (memory.targets for memory in memories)
        assert of_ours + of_theirs == self.learner.memory.targets
        assert self.learner.memory.targets - of_ours == of_theirs
        assert whole - whole == Statistics(SMALL.dimension, whole.scales)

    @invariant()
    @precondition(lambda self: hasattr(self, "learner"))
    def is_counted(self) -> None:
        assert self.learner.materials == self.state.materials

    def agrees(self, learner: Any) -> None:
        """What a learner holds and answers is, to the byte, as if it had observed the list in another order."""
        assert seen(learner) == expected(self.state)
        whole = fed(self.state.pairs, self.state.embedding, readout=learner.settings.readout)
        for material, constituents in self.state.said.items():
            whole.describe(material, constituents)
        if self.state.tuned is None:
            assert contents(learner) == contents(whole)
        assert repr(learner.descriptions) == repr(dict(sorted(self.state.said.items())))
        if self.state.said:
            learner.settle()  # where an f* answers, `contents` did not
            assert repr(learner.compose(stream((7, 25)))) == repr(whole.compose(stream((7, 25))))

    def teardown(self) -> None:
        if hasattr(self, "learner"):
            self.agrees(self.learner)
            self.reopen(self.learner.settings.readout)
            self.learner.close()
            self.reader.close()
        self.pools.stop()
        shutil.rmtree(self.home)


def main(options: argparse.Namespace) -> dict[str, Any]:
    """Run the machine; what it finds is a failure, told with the shortest history that leads there."""
    steps, done, failures = 300 if options.quick else options.steps, {"steps": 0, "histories": 0}, []

    class Counted(History):
        @invariant()
        def counted(self) -> None:
            done["steps"] += 1
            if done["steps"] % 1000 == 0:
                progress(f"{done['steps']} steps, {done['histories']} histories")

        def teardown(self) -> None:
            done["histories"] += 1
            super().teardown()

    chosen = settings(
        max_examples=-(-steps // LENGTH) * 2,
        stateful_step_count=LENGTH,
        deadline=None,
        database=None,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )
    try:
        run_state_machine_as_test(seed(options.seed)(Counted), settings=chosen)
    except Exception as error:
        failures.append("\n".join([repr(error), *getattr(error, "__notes__", [])]))
    return {**done, "failures": failures}


if __name__ == "__main__":
    run("history", parser(__doc__, steps=10_000).parse_args(), main)
