"""Memories from elsewhere: `python tests/faults/hostile.py --cases 100000 --json FILE`; goes on where FILE.part ends.

Each case mutates a memory, a row or a frame, and has it opened, merged, checked, repaired, copied, exported and shown
as whoever receives it would. It may only be refused with one of our errors, or be as it was, or be what anyone could
have made with this library. A failure is: a crash; another error; a hang of more than 10 s, twice (more: `--seconds`,
on a machine that has other things to do); more than 256 MB beyond the memory's own size; a change outside of its
folder, or of the folder where it is only read; a memory into which it was merged changed by a merge that failed, or no
longer what it was when that is taken back; and a memory that opens without a word and holds something else than before
its bytes were changed.

`--recordings` mutates recordings instead, see `recorded`.

`--case N` does case N of a seed once more, with the traceback; `--without gate` lets all that is read through, which
must not go unnoticed.
"""

from __future__ import annotations

import argparse
import faulthandler
import os
import shutil
import signal
import sys
import time
from collections import Counter
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, cast

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from faults import recorded
from faults.bench import Bench, prepared
from faults.cases import Finding, Told, limit_addresses
from faults.common import Part, folder, parser, progress, quiet_coroutines, run
from faults.learners import one_scale, warm
from faults.named import NAMED
from faults.recorded import RecordingBench
from faults.recording_attacks import ATTACKS
from faults.zygote import Child, Zygote
from scroll_tactile.memory.gate import MemoryStore

NAMES = 2**40  # the number of the first case that has a name
BATCH = 250  # cases a process
PATIENCE = 120  # seconds without a word from a child


def work(channel: Connection, home: Path, corpus: Any, options: argparse.Namespace, numbers: Any) -> None:
    """The child: cases one after another, each told of before and after."""
    quiet_coroutines()
    with (home / f"log-{os.getpid()}").open("w", encoding="utf-8") as log, Path(os.devnull).open("w") as nowhere:
        faulthandler.enable(log)
        if options.case < 0:
            os.dup2(nowhere.fileno(), 2)
        limit_addresses()
        make: Any = RecordingBench if options.recordings else Bench
        bench = make(home, *corpus, options, log)
        names = named(options)
        for number in numbers:
            channel.send(("begin", number, str(log.name)))
            told = bench.once(number) if number < NAMES else bench.named(names[number - NAMES], number)
            channel.send(("told", number, told))
        channel.send(("end", numbers[-1], bench.close()))


def named(options: argparse.Namespace) -> list[str]:
    """The attacks that have names; a third of them in a quick run where harm has to be noticed."""
    names = sorted(ATTACKS if options.recordings else NAMED)
    return names[::3] if options.quick and options.without else names


@dataclass
class Batch:
    """A child and its cases. begun: the case that it is at; log: where it says in what it died."""

    child: Child
    numbers: list[int]
    begun: int
    log: str = ""


class Hostile:
    """All cases, some at a time in each process, and what came of them."""

    def __init__(self, home: Path, zygote: Zygote, options: argparse.Namespace) -> None:
        self.home, self.zygote, self.options = home, zygote, options
        self.corpus = (recorded.prepared(home),) if options.recordings else prepared(home)
        self.named = named(options)
        self.outcomes: dict[str, Counter[str]] = {}
        self.wrong: dict[str, dict[str, Any]] = {}
        self.again: set[int] = set()
        self.done, self.peak, self.seconds = 0, 0, 0.0
        self.part = Part(options.json, seed=options.seed, recordings=options.recordings)

    def all(self, cases: int) -> None:
        """Do as many as asked, from where an earlier run ended."""
        self._resume()
        begun = time.monotonic() - self.seconds
        if not self.done and not (self.options.quick and self.options.recordings):  # tests/recordings does these
            numbers = list(range(NAMES, NAMES + len(self.named)))
            self.run([numbers[i :: self.options.workers] for i in range(self.options.workers)])
        step = BATCH * self.options.workers
        while self.done < cases:
            numbers = list(range(self.done, min(self.done + step, cases)))
            self.run([numbers[i : i + BATCH] for i in range(0, len(numbers), BATCH)])
            self.done += len(numbers)
            self.seconds = time.monotonic() - begun
            if self.done % 1000 < step:
                progress(f"{self.done} cases in {self.seconds:.0f} s, {len(self.wrong)} failures")
            self._save()

    def run(self, waiting: list[list[int]]) -> None:
        """Do these cases, each list in a process of its own; where one ends it, another goes on behind that."""
        running: dict[Connection, Batch] = {}
        while waiting or running:
            for numbers in waiting:
                child = self.zygote.spawn(work, self.home, self.corpus, self.options, numbers)
                running[child.channel] = Batch(child, numbers, numbers[0])
            waiting = []
            ready = wait(list(running), PATIENCE)
            for channel in cast("list[Connection]", ready or list(running)):
                batch = running[channel]
                if not ready or not self._listen(batch):
                    del running[channel]
                    waiting += [left] if (left := self._ended(batch)) else []

    def _listen(self, batch: Batch) -> bool:
        """Take in what a child says next; False where it said its last."""
        try:
            what, number, about = batch.child.channel.recv()
        except (EOFError, ConnectionResetError):
            return False
        if what == "begin":
            batch.begun, batch.log = number, about
        elif what == "told":
            self._note(about)
        else:
            for finding in about:
                self._fail("merges", f"cases {batch.numbers[0]} to {number}", finding)
            batch.numbers = []
        return what != "end"

    def _ended(self, batch: Batch) -> list[int]:
        """Wait for a child; the cases behind the one in which it ended."""
        if not batch.numbers:
            batch.child.wait()
            return []
        batch.child.kill()
        status = batch.child.wait()
        shutil.rmtree(self.home / f"bench-{batch.child.pid}", ignore_errors=True)
        if status == -signal.SIGALRM and batch.begun not in self.again:  # the machine may have had other things to do
            self.again.add(batch.begun)
            return [number for number in batch.numbers if number >= batch.begun]
        names = {-signal.SIGALRM: "a hang", -signal.SIGKILL: "no word for two minutes, or killed"}
        text = Path(batch.log).read_text(encoding="utf-8") if batch.log else ""
        places = [line.strip() for line in text.splitlines() if "/store/" in line or "/scroll_tactile/" in line]
        place = places[0].rsplit("/", 1)[-1] if places else text[:100]
        name = f" ({self.named[batch.begun - NAMES]})" if batch.begun >= NAMES else ""
        self._fail("crash", f"case {batch.begun}{name}", (names.get(status, f"ended with {status}"), place))
        return [number for number in batch.numbers if number > batch.begun]

    def _note(self, told: Told) -> None:
        self.outcomes.setdefault(told.kind, Counter()).update(told.outcomes or ["nothing"])
        self.peak = max(self.peak, told.peak)
        for finding in told.findings:
            self._fail(told.kind, f"case {told.number} ({told.about})", finding)

    def _fail(self, kind: str, where: str, finding: Finding) -> None:
        text = "".join("#" if letter.isdigit() else letter for letter in finding[0])[:60]
        known = self.wrong.setdefault(
            f"{text} @ {finding[1]}", {"count": 0, "class": kind, "what": list(finding), "in": []}
        )
        known["count"] += 1
        known["in"] = [*known["in"], where][:5]
        if known["count"] == 1:
            progress(f"{where}: {finding[0]} at {finding[1]}")

    def _resume(self) -> None:
        for name in ("done", "peak", "seconds", "wrong"):
            setattr(self, name, self.part.known.get(name, getattr(self, name)))
        self.outcomes = {kind: Counter(counted) for kind, counted in self.part.known.get("outcomes", {}).items()}

    def _save(self) -> None:
        known = {name: getattr(self, name) for name in ("done", "peak", "seconds", "wrong", "outcomes")}
        self.part.save(**known)


def main(options: argparse.Namespace) -> dict[str, Any]:
    """As many cases as asked."""
    cases = min(100 if options.recordings else 200, options.cases) if options.quick else options.cases
    if options.quick and not options.without:
        options.seconds = max(options.seconds, 60)  # with the tests, which may run on any machine
    if options.without == "gate":
        for name in ("sound_head", "sound_record"):
            setattr(MemoryStore, name, lambda self, read: read)
    if options.recordings:
        recorded.warm()
    else:
        warm()
        one_scale()
    with Zygote() as zygote, folder(options, in_memory=True) as home:
        (home / "corpus").mkdir()
        hostile = Hostile(home, zygote, options)
        if options.case >= 0:
            hostile.run([[options.case]])
        else:
            hostile.all(cases)
    hostile.part.remove()
    by_class = {kind: dict(sorted(counted.items())) for kind, counted in sorted(hostile.outcomes.items())}
    return {
        "cases": hostile.done,
        "attacks by name": len(hostile.named),
        "most memory beyond the start, MB": hostile.peak >> 20,
        f"begun again after {options.seconds} s": len(hostile.again),
        "seconds in cases": round(hostile.seconds),
        "outcomes": by_class,
        "failures": [f"{known['count']} times {name}: {known['in'][0]}" for name, known in hostile.wrong.items()],
    }


if __name__ == "__main__":
    run(
        "hostile",
        parser(__doc__, cases=100_000, case=-1, seconds=10, workers=1, without="", recordings=False).parse_args(),
        main,
    )
