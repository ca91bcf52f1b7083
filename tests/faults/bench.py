"""One hostile case after another in a process that may die of it, and what has to hold behind each."""

from __future__ import annotations

import faulthandler
import os
import random
import resource
import shutil
import signal
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

from forging import named_in
from touches import stream

from faults.attacks import CLASSES, FORGED, made_row
from faults.model import opened
from faults.mutants import mutated_payload
from faults.named import NAMED, REFUSED
from faults.places import Scene
from faults.received import (
    OURS,
    READING,
    WRITING,
    Case,
    Memory,
    Reader,
    Target,
    Wrong,
    check,
    corpus,
    fingerprint,
    heard,
    merge,
    read,
)
from scroll_tactile import TactileLearner
from scroll_tactile.memory.touch_rows import pack_codes
from scroll_tactile.persistence.replaying import replay
from scroll_tactile.validation.gate import MemoryStore
from store import Record, VersionError
from store.encoding import decode_payload, encode_payload
from store.records import from_json

SECONDS = 10  # of work in one case
SPARE = 256 * 2**20  # bytes beyond the memory's own
ADDRESSES = 3 * 2**30  # of which no case can take more, so that the machine lives
KINDS = ("frames", "records", "rows", "bytes", "identities", "checkpoints", "currents", "files")
SHARES = (50, 31, 10, 4, 1, 2, 1, 1)
QUICK = (64, 24, 7, 2, 1, 0.5, 1, 0.5)

Finding = tuple[str, str]  # what it is, and where


@dataclass
class Told:
    """What came of a case: outcomes by reader, and what was wrong."""

    number: int
    about: str
    kind: str
    outcomes: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    peak: int = 0


def limit_addresses() -> None:
    """From here on, this process can take ADDRESSES bytes of addresses more than it has now."""
    now = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    most = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (now + ADDRESSES, most))


class Bench:
    """What a process needs for cases: folders of its own, and a memory to merge into."""

    def __init__(self, home: Path, memories: list[Memory], codes: Any, options: Any, log: TextIO) -> None:
        self.home, self.memories, self.codes, self.log = home, memories, codes, log
        self.seed, self.verbose, self.quick = options.seed, options.case >= 0, options.quick
        self.seconds = options.seconds
        self.own = home / f"bench-{os.getpid()}"
        self.watched = self.own / "watched"
        shutil.copytree(home / "watched", self.watched)
        self.watching = fingerprint(self.watched)
        self.learner: TactileLearner | None = None
        self.target = Target(memories[2].path, self.own / "target")

    def named(self, name: str, number: int = -1) -> Told:
        """Do an attack that has a name, before every reader."""
        told = Told(number, name, name.partition(":")[0])
        scene = Scene(self.watched, tuple(memory.path for memory in self.memories), self.codes)
        memory = next(memory for memory in self.memories if memory.name == "snapshot")
        for reader in (read, merge) if self.quick else (*READING, *WRITING):
            about = Told(number, name, "")
            self._begin(memory, about, lambda path: NAMED[name](path, scene))
            case = Case(
                self.own / "memory",
                self.own / "out",
                random.Random(name),
                memory,
                name not in REFUSED and not name.startswith("D12"),
                lambda path: NAMED[name](path, scene),
                self.target,
            )
            self._read(reader, case, about)
            told.outcomes += about.outcomes
            told.findings += about.findings
            told.peak = max(told.peak, about.peak)
            if name in REFUSED and about.outcomes[0] in (
                "merge: merged",
                "read: accepted",
                "read: as before",
                "check: sound",
            ):
                told.findings.append((f"{about.outcomes[0]}, of what nobody may take in", ""))
        return told

    def once(self, number: int) -> Told:
        """Do a case."""
        rng = random.Random(f"{self.seed}:{number}")
        shares = QUICK if self.quick else SHARES
        kind = rng.choices(KINDS, shares)[0]
        if kind == "frames":
            return self._frame(number, rng)
        if kind == "records":
            return self._record(number, rng)
        fitting = [m for m in self.memories if kind != "checkpoints" or named_in(m.path)]
        first = [memory for memory in fitting if memory.name in ("rows", "crashed")] if kind == "rows" else []
        memory = rng.choice(first if first and rng.random() < 0.8 else fitting)
        attack, state = rng.choice(CLASSES[kind]), rng.getrandbits(64)
        others = tuple(other.path for other in self.memories if other is not memory)
        scene = Scene(self.watched, others, self.codes)
        told = Told(number, f"{memory.name}, {attack.__name__}", kind)
        readers: list[Reader] = [rng.choice((read, read, merge, merge) if kind in FORGED else (read, check, merge))]
        if rng.random() < (0.15 if kind in ("rows", "bytes") else 0.6):
            readers.append(rng.choice((*READING, *WRITING)))
        try:
            self._begin(memory, told, lambda path: attack(random.Random(state), path, scene))
        except Exception as error:  # the attack itself cannot be: no row can be packed so, say
            told.outcomes.append(f"no attack: {type(error).__name__}")
            return told
        for reader in readers:
            case = Case(
                self.own / "memory",
                self.own / "out",
                rng,
                memory,
                kind not in FORGED,
                lambda path: attack(random.Random(state), path, scene),
                self.target,
            )
            self._read(reader, case, told)
        return told

    def _begin(self, memory: Memory, told: Told, attack: Any) -> None:
        for name in ("memory", "out"):
            remove(self.own / name)
        (self.own / "out").mkdir()
        shutil.copytree(memory.path, self.own / "memory")
        told.about += f": {attack(self.own / 'memory')}"[:300]

    def _read(self, reader: Reader, case: Case, told: Told) -> None:
        """Have one reader at it, and look at what it left."""
        reads = reader in READING
        before = fingerprint(case.path) if reads else {}
        names = {path.name for path in self.own.iterdir()} | {"target"}
        held, start, worked = size(case.path), begin_peak(), time.process_time()
        came = self._came(reader, case, told)
        told.outcomes.append(f"{reader.__name__}: {came}")
        if (worked := time.process_time() - worked) > SECONDS:
            told.findings.append((f"worked for {worked:.0f} s", reader.__name__))
        grown = peak() - start
        told.peak = max(told.peak, grown)
        if grown > SPARE + held:
            told.findings.append((f"took {grown >> 20} MB for {held >> 10} KB", reader.__name__))
        if reads and (now := fingerprint(case.path)) != before:
            changed = sorted(name for name in {*now, *before} if now.get(name) != before.get(name))
            told.findings.append((f"{reader.__name__} left another {changed[:4]}", ""))
        if fingerprint(self.watched) != self.watching:
            told.findings.append((f"{reader.__name__} changed something outside of the folder", ""))
            shutil.rmtree(self.watched)
            shutil.copytree(self.home / "watched", self.watched)
        if more := {path.name for path in self.own.iterdir()} - names:
            told.findings += [(f"{reader.__name__} left {sorted(more)} beside the folder", "")] if reads else []
            for name in more:
                remove(self.own / name)
        remove(case.home)
        case.home.mkdir()

    def _came(self, reader: Reader, case: Case, told: Told) -> str:
        """What came of a reader; where it is none of our errors, or it takes too long, that is found."""
        signal.setitimer(signal.ITIMER_REAL, self.seconds)
        faulthandler.dump_traceback_later(self.seconds - 1, file=self.log)
        try:
            return reader(case)
        except OURS as error:
            if is_memory(error):
                told.findings.append(("memory ran out", place(error)))
            return type(error).__name__
        except Wrong as error:
            told.findings.append((f"{reader.__name__}: {error}"[:300], ""))
            return "WRONG"
        except Exception as error:
            told.findings.append((f"{type(error).__name__}: {error}"[:160], f"{reader.__name__}: {place(error)}"))
            if self.verbose:
                traceback.print_exc()
            return "UNTYPED"
        finally:
            faulthandler.cancel_dump_traceback_later()
            signal.setitimer(signal.ITIMER_REAL, 0)

    def _frame(self, number: int, rng: random.Random) -> Told:
        """A payload decoded as it is: no row, no checksum."""
        name, payload = rng.choice(sorted(self.codes["payloads"].items()))
        what, payload = mutated_payload(rng, payload)
        told = Told(number, f"payload of {name}: {what}", "frames")
        self._bounded(told, len(payload), lambda: decode_payload(payload) and "decoded", (ValueError, VersionError))
        return told

    def _record(self, number: int, rng: random.Random) -> Told:
        """A row at the gate and, where that lets it in, in the memory: no file, no checksum."""
        if self.learner is None:
            self.learner = TactileLearner.open(self.memories[0].path, mode="read")
        learner, scene = self.learner, Scene(self.watched, tuple(m.path for m in self.memories), self.codes)
        what, row = made_row(rng, self.memories[0].path, scene)
        told = Told(number, f"record: {what}", "records")

        made: dict[str, Any] = {"sequence": learner.memory.sequence + 1, "attributes": {}, "time": 0.0, **row}
        text, payload = made["attributes"], made.pop("payload", b"")
        made.pop("kept", None)
        made["size"] = len(payload)
        try:
            made["attributes"] = from_json(text) if isinstance(text, str) else text
            made["arrays"] = decode_payload(payload) if payload else {}
        except (ValueError, VersionError) as error:  # what reads it makes damage of it
            told.outcomes.append(f"no record: {type(error).__name__}")
            return told

        def come() -> str:
            store = learner._ledger.store
            assert isinstance(store, MemoryStore)
            record = store.gate.record(Record(**made))
            self.learner = None
            with heard():
                replay(learner.memory, record, store)
                learner.digest()
            learner.close()
            return "let in"

        self._bounded(told, len(payload), come, OURS)
        return told

    def _bounded(self, told: Told, size: int, do: Callable[[], Any], typed: tuple[type[Exception], ...]) -> None:
        """Do what may only end in a value or in a typed error, soon, and in a bounded room."""
        start = begin_peak()
        signal.setitimer(signal.ITIMER_REAL, self.seconds)
        try:
            told.outcomes.append(do() or "nothing")
        except typed as error:
            told.outcomes.append(type(error).__name__)
        except Exception as error:
            told.findings.append((f"{type(error).__name__}: {error}"[:160], place(error)))
            if self.verbose:
                traceback.print_exc()
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        told.peak = peak() - start
        if told.peak > SPARE + size:
            told.findings.append((f"took {told.peak >> 20} MB for {size} bytes", told.kind))

    def close(self) -> list[Finding]:
        """What the merges that failed left of the memory that they were made into."""
        if self.learner is not None:
            self.learner.close()
        try:
            self.target.close()
        except Wrong as error:
            return [(str(error), "merge")]
        finally:
            remove(self.own)
        return []


def remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def size(path: Path) -> int:
    """The bytes that a folder takes on the disk."""
    return sum(file.lstat().st_blocks * 512 for file in path.rglob("*"))


def begin_peak() -> int:
    """Forget the most memory that this process had, and return what it has."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    return peak()


def peak() -> int:
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    return int(status.split("VmHWM:")[1].split()[0]) * 1024


def is_memory(error: BaseException | None) -> bool:
    seen = 0
    while error is not None and seen < 10:
        if isinstance(error, MemoryError):
            return True
        error, seen = error.__cause__ or error.__context__, seen + 1
    return False


def place(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "/store/" in frame.filename or "/scroll_tactile/" in frame.filename]
    last = (own or frames)[-1]
    return f"{last.filename.rsplit('/', 1)[-1]}:{last.lineno} {last.name}"


def prepared(home: Path) -> tuple[list[Memory], dict[str, Any]]:
    """The memories, what a touch's rows of codes are, payloads to mutate, and a folder that is watched."""
    memories = corpus(home / "corpus")
    with opened(memories[0].path, "read") as learner:
        store = learner._ledger.store
        touch = learner._codes_of(stream((5, 30)).astype("float32"))
        payloads = {"readings": encode_payload(dict(store.record(1).arrays))}
    with opened(home / "corpus" / "compacted", "read") as learner:
        compaction = learner._ledger.store.compaction()
        payloads["compaction"] = encode_payload(dict(compaction.arrays))
    payloads["codes"] = encode_payload(pack_codes(touch))
    watched = home / "watched"
    (watched / "12345").mkdir(parents=True)
    (watched / "12345" / "data").write_text("precious")
    (watched / "file").write_text("precious")
    shutil.copytree(memories[2].path, watched / "memory")
    return memories, {"touch": touch, "merge": payloads["compaction"], "payloads": payloads}
