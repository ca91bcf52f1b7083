"""kill -9 at random instants: `python tests/faults/kill.py --kills 1000`.

A child works on a memory and tells of each operation before it begins and after it returned; it is killed at a random
instant of a random one. The memory is then opened again: it must hold what a replay of the acknowledged operations
holds, or that and the one that had begun. The next child goes on with the same memory, until it has grown.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
import time
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from faults.common import folder, parser, progress, run, warnings_told
from faults.learners import opened, perform, seen, warm
from faults.model import Operation, State, after
from faults.plans import KINDS, history, prepare
from faults.trials import Trials, checkpoints_every
from faults.zygote import Child, Zygote

CHECKPOINT_EVERY = 6  # rows between checkpoints: some are written behind the back of most children
GROWN = 40  # touches at which a new memory is begun
TARGETS = (*KINDS, "open", "close", "idle")
TOLD = ("done", "begin", "warned", "seen")
PATIENCE = 120  # seconds without a word from a child


def work(channel: Connection, path: Path, home: Path, operations: list[Operation]) -> None:
    """The child: open the memory, do the operations; "close": close it; "idle": wait to be killed."""
    checkpoints_every(CHECKPOINT_EVERY)
    with warnings_told(lambda text: channel.send(("warned", text))):
        channel.send(("begin", "open"))
        learner = opened(path)
        channel.send(("done", None))
        channel.send(("seen", seen(learner)))
        for operation in operations:
            channel.send(("begin", operation[0]))
            channel.send(("done", None if operation == ("idle",) else perform(learner, operation, home)))
        time.sleep(PATIENCE)


class Durations:
    """How long each kind of operation takes, so that a kill at a random share of it lands inside."""

    def __init__(self) -> None:
        self._told: dict[str, float] = {}

    def note(self, kind: str, seconds: float) -> None:
        self._told[kind] = 0.8 * self._told.get(kind, seconds) + 0.2 * seconds

    def instant(self, rng: random.Random, kind: str) -> float:
        return rng.uniform(0, 0.95) * self._told.get(kind, 0.02 if kind != "idle" else 0.05)


class Killing(Trials):
    """One memory after another, killed again and again."""

    def __init__(self, home: Path, seed: int, zygote: Zygote) -> None:
        super().__init__(home, prepare(home))
        self.zygote, self.rng, self.durations = zygote, random.Random(seed), Durations()
        self.landed: Counter[str] = Counter()
        self.memories = self.kills = 0
        self.begin_anew()

    def begin_anew(self) -> None:
        """Go on with a memory that is not there yet."""
        self.memories += 1
        self.path, self.state = self.home / f"memory-{self.memories}", State()

    def once(self) -> None:
        """One child, one kill, one look at what is left."""
        target = self.rng.choice(TARGETS)
        kinds = self.rng.choices(KINDS[:6], k=self.rng.randrange(4))
        operations = history(self.rng, self.state, self.others, [*kinds, *([target] if target in KINDS else [])])
        if target in ("close", "idle"):
            operations.append((target,))
        child = self.zygote.spawn(work, self.path, self.home, operations)
        told = self._listen(child, 0 if target == "open" else len(operations))
        self.kills += 1
        before = len(self.failures)
        self._judge(operations, told)
        if len(self.failures) > before:
            self.tell()
            progress(f"  {operations}\n  {told}\n  kept in {self.path}")
            self.begin_anew()

    def _listen(self, child: Child, target: int) -> list[tuple[str, Any]]:
        """What the child says until it is killed, at a random instant of its operation number `target`."""
        told: list[tuple[str, Any]] = []
        begun, seconds = 0.0, PATIENCE
        while child.channel.poll(seconds):
            try:
                told.append(child.channel.recv())
            except EOFError:
                break
            what, about = told[-1]
            if what == "begin":
                begun = time.monotonic()
                if sum(kind == "begin" for kind, _ in told) == target + 1:
                    time.sleep(self.durations.instant(self.rng, about))
                    break
            elif what == "done":
                self.durations.note(told[-2][1], time.monotonic() - begun)
        child.kill()
        if (status := child.wait(told.append)) != -signal.SIGKILL:
            self.failures.append(f"kill {self.kills}: the child ended by itself, with {status}, after {told[-1:]}")
        return told

    def _judge(self, operations: list[Operation], told: list[tuple[str, Any]]) -> None:
        where = f"kill {self.kills} (memory {self.memories})"
        done, begun, warned, saw = ([about for kind, about in told if kind == one] for one in TOLD)
        self.failures += [f"{where}: the child warned: {text}" for text in warned]
        self.landed[begun[-1] if len(begun) > len(done) else "between two"] += 1
        if saw:
            self.settled(f"{where}, as the child opened it", saw[0], [self.state])
        for operation, result in zip(operations, done[1:], strict=False):
            self.counts[f"acknowledged: {operation[0]}"] += 1
            if operation != ("idle",):
                self.state, foretold = after(self.state, operation, self.others)
                if result != foretold:
                    self.failures.append(f"{where}: {operation} gave {result}, expected {foretold}")
        candidates = [self.state]
        if len(begun) > len(done) > 0 and (operation := operations[len(done) - 1]) != ("idle",):
            candidates.append(after(self.state, operation, self.others)[0])
        self._look(where, candidates)
        if len(self.state.listed) > GROWN or self.rng.random() < 0.03:
            self.begin_anew()

    def _look(self, where: str, candidates: list[State]) -> None:
        """Find which of the candidates it is; that one holds from now on."""
        if not (self.path / "CURRENT").exists() and set(candidates) == {State()}:
            self.counts["no memory made yet"] += 1
            return
        # Half the time only as a reader, so that the next child finds what the kill left.
        mode = self.rng.choice(("read", "write"))
        self.counts[f"opened afterwards to {mode}"] += 1
        with self.examined(f"{where}, opened to {mode}"), warnings_told(self.failures.append):
            with opened(self.path, mode) as learner:
                self.state = self.require(f"{where}, opened to {mode}", learner, candidates)
            # It was the last that the child did, if at all.
            self.require_copies(where, self.path, [self.state])


def main(options: argparse.Namespace) -> dict[str, Any]:
    """Kill as often as asked."""
    warm()
    with Zygote() as zygote, folder(options) as home:
        killing = Killing(home, options.seed, zygote)
        for number in range(3 if options.quick else options.kills):
            killing.once()
            if number % 100 == 99:
                killing.tell(f"{number + 1} kills")
    return {
        "kills": killing.kills,
        "memories": killing.memories,
        "landed in": dict(sorted(killing.landed.items())),
        **killing.figures(),
    }


if __name__ == "__main__":
    run("kill", parser(__doc__, kills=1000).parse_args(), main)
