"""Writers that race, and readers under a writer: `python tests/faults/processes.py --seconds 60`.

The lock: processes open one memory to write at the same instant, again and again: one gets it, the others are told by
whom it is held and since when. A holder that is killed loses it.

Readers: while one process observes, batches, retracts, forgets, fine-tunes and compacts, others open the memory to
read, refresh it and predict all the time. What a reader sees must be the memory as it was after one of the writer's
operations: one that had begun when the reader was done, not older than what was acknowledged when the reader
began to look, and never older than what it saw before. No reader may raise anything. At the end nothing is lost.
"""

from __future__ import annotations

import argparse
import math
import random
import re
import socket
import sys
import time
from collections import Counter
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from scroll_tactile_store import CompactedError, LockedError
from touches import stream

from faults.common import folder, parser, progress, run, warnings_told
from faults.learners import expected, opened, perform, seen, warm
from faults.model import Operation, State, after
from faults.plans import draw
from faults.trials import checkpoints_every
from faults.zygote import Zygote

KINDS = ("observe", "observe", "observe", "batch", "retract", "forget", "describe", "compact", "fine_tune")
CHECKPOINT_EVERY = 6
LOOKS = 16  # of a reader, while a writer compacts
PACE = 0.1  # seconds, at most, between two operations of the writer
HELD = re.compile(r"by process (\d+) on (\S+) since (\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\S*)")


def race(channel: Connection, path: Path) -> None:
    """Told to, open the memory to write, and tell what came of it; hold it until told to let go."""
    while channel.recv() == "go":
        try:
            learner = opened(path)
        except LockedError as error:
            channel.send(("locked", str(error)))
            continue
        except Exception as error:
            channel.send(("raised", repr(error)))
            continue
        channel.send(("won", learner.observe("a", stream((learner.memory.sequence, 25))).sequence))
        channel.recv()
        learner.close()
        channel.send("closed")


def locks(home: Path, zygote: Zygote, rounds: int, failures: list[str]) -> dict[str, Any]:
    """Races, and a holder that dies."""
    path, told, wins = home / "raced", Counter(), 0
    children = [zygote.spawn(race, path) for _ in range(4)]
    for number in range(rounds):
        for child in children:
            child.channel.send("go")
        answers = [child.channel.recv() for child in children]
        winners = [child for child, (what, _) in zip(children, answers, strict=True) if what == "won"]
        if len(winners) != 1:
            failures.append(f"race {number}: {len(winners)} got the lock: {answers}")
        for what, about in answers:
            if what == "won":
                wins += 1
                if about != wins:
                    failures.append(f"race {number}: the winner's observation is {about}, expected {wins}")
            elif what == "raised":
                failures.append(f"race {number}: {about}")
            else:
                told["named" if _names(about, winners, failures) else "no note yet"] += 1
        for child in winners:
            child.channel.send("let go")
            child.channel.recv()
    taken = _taken_over(path, children, told, failures)
    with opened(path) as learner:
        if sum(learner.materials.values()) != wins + taken:
            failures.append(f"of {wins + taken} observations of the winners {learner.materials} are left")
    return {"races": rounds, "writers in a race": len(children), "refusals": dict(told), "killed holders": taken}


def _names(message: str, winners: list[Any], failures: list[str]) -> bool:
    """Whether a refusal names the holder; it may not while the holder has just taken the lock."""
    found = HELD.search(message)
    if found is None:
        return False
    if int(found[1]) not in {child.pid for child in winners} or found[2] != socket.gethostname():
        # The note of the holder before is there until the new one has written its own.
        failures.append(f"a refusal names another holder: {message}")
    return True


def _taken_over(path: Path, children: list[Any], told: Counter[str], failures: list[str]) -> int:
    """Kill holder after holder; the next writer must get in at once."""
    for number, child in enumerate(children):
        child.channel.send("go")
        what, about = child.channel.recv()
        if what != "won":
            failures.append(f"after {number} killed holders: {about}")
            continue
        try:
            opened(path).close()
            failures.append("a second writer got in beside the first")
        except LockedError as error:
            told["named" if _names(str(error), [child], failures) else "no note"] += 1
        child.kill()
        child.wait()
    return len(children)


def write(channel: Connection, path: Path, seed: int, seconds: float) -> None:
    """The writer: random operations; tells each, the instants of its beginning and its end, and what it returned."""
    checkpoints_every(CHECKPOINT_EVERY)
    rng, state = random.Random(seed), State()
    with opened(path) as learner:
        channel.send("ready")
        channel.recv()
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            kind = rng.choice(KINDS)
            operation = draw(rng, state, {}, "forget" if len(state.loose) > 20 else kind)
            begun = time.monotonic()
            result = perform(learner, operation, path)
            channel.send((operation, begun, time.monotonic(), result))
            state, _ = after(state, operation, {})
            time.sleep(rng.uniform(0, PACE))
    channel.send(None)


def _seen_at_last(reader: Any) -> dict[str, Any]:
    """What a reader sees, who looks again where the readings of its state are gone: a writer may compact many times."""
    for _ in range(LOOKS):
        try:
            return seen(reader)
        except CompactedError:
            reader.refresh()
    return seen(reader)


def read(channel: Connection, path: Path, seed: int) -> None:
    """A reader: opens, refreshes, predicts until told to stop; tells what it saw, and between which instants."""
    rng, reader, looks = random.Random(seed), None, []
    errors: list[str] = []
    with warnings_told(errors.append):
        while not channel.poll(0):
            begun = time.monotonic()
            try:
                how = rng.choice(("open", "refresh", "refresh", "refresh", "predict"))
                if reader is None or how == "open":
                    if reader is not None:
                        reader.close()
                    reader, how = opened(path, "read"), "open"
                elif how == "refresh":
                    reader.refresh()
                found = _seen_at_last(reader)
                ended = time.monotonic()
                answer = reader.predict(stream((rng.randrange(4), 60)))
                shares = [share for _, share in answer.ranking]
                if sorted(name for name, _ in answer.ranking) != list(found["materials"]):
                    errors.append(f"{how}: predicts {answer.ranking} of {found['materials']}")
                if shares and not abs(sum(shares) - 1) < 1e-9:
                    errors.append(f"{how}: shares {shares}")
                looks.append((how, begun if how != "predict" else -math.inf, ended, found))
            except Exception as error:
                errors.append(f"{how}: {error!r}")
                reader = None
    channel.send((looks, errors))


@dataclass
class Written:
    """What the writer did: state n + 1 was begun at begun[n] and acknowledged at ended[n]."""

    states: list[State]
    begun: list[float]
    ended: list[float]

    def place(self, found: dict[str, Any], since: float, until: float, earliest: int) -> int | None:
        """The number of a state that a reader saw between two instants, which is not before `earliest`."""
        acknowledged = sum(ended <= since for ended in self.ended)
        for number in range(max(acknowledged, earliest), len(self.states)):
            if number and self.begun[number - 1] > until:
                return None
            # What is compacted is asked of the store, and may be newer than what was read.
            if self.states[number].last == found["last"] and _alike(expected(self.states[number]), found):
                return number
        return None

    def told(self, found: dict[str, Any], since: float, until: float, earliest: int) -> str:
        """What a reader saw that was in no place."""
        acknowledged = sum(ended <= since for ended in self.ended)
        begun = sum(begun <= until for begun in self.begun)
        differ = {}
        for number, state in enumerate(self.states):
            if state.last == found["last"]:
                told = expected(state)
                differ[number] = [key for key in found if key != "compacted" and found[key] != told[key]]
        return (
            f"saw row {found['last']}, when {acknowledged} operations were acknowledged, {begun} begun, and {earliest} "
            f"seen; states with that row differ in {differ}"
        )


def _alike(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return all(one[key] == other[key] for key in one if key != "compacted")


def under_a_writer(home: Path, zygote: Zygote, count: int, seconds: float, seed: int, failures: list[str]) -> Any:
    """One writer, so many readers."""
    path = home / "read"
    writer = zygote.spawn(write, path, seed, seconds)
    writer.channel.recv()
    readers = [zygote.spawn(read, path, seed + 1 + number) for number in range(count)]
    writer.channel.send("go")
    written = Written([State()], [], [])
    operations: Counter[str] = Counter()
    while (told := writer.channel.recv()) is not None:
        operation: Operation = told[0]
        state, foretold = after(written.states[-1], operation, {})
        written.states.append(state)
        written.begun.append(told[1])
        written.ended.append(told[2])
        operations[operation[0]] += 1
        if told[3] != foretold:
            failures.append(f"the writer: {operation} gave {told[3]}, expected {foretold}")
    writer.wait()
    progress(f"{sum(operations.values())} operations written")
    looks: Counter[str] = Counter()
    distinct = set()
    for number, child in enumerate(readers):
        child.channel.send("stop")
        saw, errors = child.channel.recv()
        child.wait()
        failures += [f"reader {number}: {error}" for error in errors]
        earliest = 0
        for how, since, until, found in saw:
            looks[how] += 1
            place = written.place(found, since, until, earliest)
            if place is None:
                failures.append(f"reader {number}, {how}: {written.told(found, since, until, earliest)}")
                continue
            earliest = place
            distinct.add(place)
    with opened(path) as learner:
        if seen(learner) != expected(written.states[-1]):
            failures.append("at the end the memory is not what was written")
    return {
        "readers": count,
        "seconds": seconds,
        "written": dict(operations),
        "looks": dict(looks),
        "different states seen": len(distinct),
    }


def main(options: argparse.Namespace) -> dict[str, Any]:
    """The races, then the readers."""
    failures: list[str] = []
    warm()
    with Zygote() as zygote, folder(options) as home:
        raced = locks(home, zygote, 2 if options.quick else options.races, failures)
        progress(f"races: {len(failures)} failures")
        seconds, readers = (1.5, 2) if options.quick else (options.seconds, options.readers)
        seen_under = under_a_writer(home, zygote, readers, seconds, options.seed, failures)
    return {"locks": raced, "readers": seen_under, "failures": failures}


if __name__ == "__main__":
    run("processes", parser(__doc__, races=100, readers=8, seconds=45.0).parse_args(), main)
