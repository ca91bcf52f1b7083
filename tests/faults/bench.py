"""One hostile memory, row or frame after another, and what has to hold behind each."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

from forging import named_in
from scroll_tactile_store import Record, VersionError
from scroll_tactile_store.encoding import decode_payload, encode_payload
from scroll_tactile_store.records import from_json
from touches import stream

from faults.attacks import CLASSES, FORGED, Attack, Scene, made_row
from faults.cases import Cases, Finding, Told, Wrong, remove, size
from faults.common import fingerprint, warnings_told
from faults.learners import opened
from faults.mutants import mutated_payload
from faults.named import NAMED, REFUSED
from faults.received import OURS, READING, WRITING, Case, Memory, Reader, Target, check, corpus, merge, read
from scroll_tactile import TactileLearner
from scroll_tactile.memory.gate import MemoryStore
from scroll_tactile.memory.touch_rows import pack_codes
from scroll_tactile.persistence.replaying import replay

SPARE = 256 * 2**20  # bytes beyond the memory's own
KINDS = ("frames", "records", "rows", "bytes", "identities", "checkpoints", "currents", "files")
SHARES = (50, 31, 10, 4, 1, 2, 1, 1)
QUICK = (64, 24, 7, 2, 1, 0.5, 1, 0.5)
TAKEN_IN = ("merge: merged", "read: accepted", "read: as before", "check: sound")


class Bench(Cases):
    """Cases of memories, and a memory to merge into."""

    def __init__(self, home: Path, memories: list[Memory], codes: Any, options: Any, log: TextIO) -> None:
        super().__init__(home, options, log)
        self.memories, self.codes = memories, codes
        self.learner: TactileLearner | None = None
        self.target = Target(memories[2].path, self.own / "target")

    def _scene(self, memory: Memory | None = None) -> Scene:
        return Scene(self.watched, tuple(one.path for one in self.memories if one is not memory), self.codes)

    def named(self, name: str, number: int = -1) -> Told:
        """Do an attack that has a name, before every reader."""
        told = Told(number, name, name.partition(":")[0])
        memory = next(memory for memory in self.memories if memory.name == "snapshot")
        same = name not in REFUSED and not name.startswith("D12")
        few = (read, merge) if name.startswith("D4") else (read,)
        for reader in few if self.quick else (*READING, *WRITING):
            self._attacked(told, memory, NAMED[name], [reader], name, same=same)
            if name in REFUSED and told.outcomes[-1] in TAKEN_IN:
                told.findings.append((f"{told.outcomes[-1]}, of what nobody may take in", ""))
        return told

    def once(self, number: int) -> Told:
        """Do a case."""
        rng = random.Random(f"{self.seed}:{number}")
        kind = rng.choices(KINDS, QUICK if self.quick else SHARES)[0]
        if kind == "frames":
            return self._frame(number, rng)
        if kind == "records":
            return self._record(number, rng)
        fitting = [m for m in self.memories if kind != "checkpoints" or named_in(m.path)]
        first = [memory for memory in fitting if memory.name in ("rows", "crashed")] if kind == "rows" else []
        memory = rng.choice(first if first and rng.random() < 0.8 else fitting)
        attack = rng.choice(CLASSES[kind])
        readers: list[Reader] = [rng.choice((read, read, merge, merge) if kind in FORGED else (read, check, merge))]
        if rng.random() < (0.15 if kind in ("rows", "bytes") else 0.6):
            readers.append(rng.choice((*READING, *WRITING)))
        told = Told(number, f"{memory.name}, {attack.__name__}", kind)
        self._attacked(told, memory, attack, readers, f"{rng.getrandbits(64)}", same=kind not in FORGED)
        return told

    def _attacked(
        self, told: Told, memory: Memory, attack: Attack, readers: list[Reader], seed: str, *, same: bool
    ) -> None:
        """Attack a copy of a memory, and have readers at it; same: it may hold nothing else without a word."""
        scene = self._scene(memory)
        attacked: Callable[[Path], Any] = lambda path: attack(random.Random(seed), path, scene)  # noqa: E731
        for name in ("memory", "out"):
            remove(self.own / name)
        (self.own / "out").mkdir()
        shutil.copytree(memory.path, self.own / "memory")
        try:
            told.about = f"{told.about}: {attacked(self.own / 'memory')}"[:300]
        except Exception as error:  # the attack itself cannot be: no row can be packed so, say
            told.outcomes.append(f"no attack: {type(error).__name__}")
            return
        rng = random.Random(f"{seed}, read")
        for reader in readers:
            case = Case(self.own / "memory", self.own / "out", rng, memory, same, attacked, self.target)
            self._read(reader, case, told)

    def _read(self, reader: Reader, case: Case, told: Told) -> None:
        """Have one reader at it, and look at what it left."""
        reads, name = reader in READING, reader.__name__
        before = fingerprint(case.path) if reads else {}
        names = {path.name for path in self.own.iterdir()} | {"target"}
        self.bounded(told, name, SPARE + size(case.path), lambda: reader(case), OURS)
        if reads and (now := fingerprint(case.path)) != before:
            changed = sorted(name for name in {*now, *before} if now.get(name) != before.get(name))
            told.findings.append((f"{name} left another {changed[:4]}", ""))
        self.require_untouched(told, name)
        if more := {path.name for path in self.own.iterdir()} - names:
            told.findings += [(f"{name} left {sorted(more)} beside the folder", "")] if reads else []
            for left in more:
                remove(self.own / left)
        remove(case.home)
        case.home.mkdir()

    def _frame(self, number: int, rng: random.Random) -> Told:
        """A payload decoded as it is: no row, no checksum."""
        name, payload = rng.choice(sorted(self.codes["payloads"].items()))
        what, payload = mutated_payload(rng, payload)
        told, refused = Told(number, f"payload of {name}: {what}", "frames"), (ValueError, VersionError)
        decoded = lambda: "decoded" if decode_payload(payload) else "nothing"  # noqa: E731
        self.bounded(told, "frame", SPARE + len(payload), decoded, refused)
        return told

    def _record(self, number: int, rng: random.Random) -> Told:
        """A row at the gate and, where that lets it in, in the memory: no file, no checksum."""
        if self.learner is None:
            self.learner = TactileLearner.open(self.memories[0].path, mode="read")
        learner = self.learner
        what, row = made_row(rng, self.memories[0].path, self._scene())
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
            with warnings_told(lambda text: None):
                replay(learner.memory, record, store)
                learner.digest()
            learner.close()
            return "let in"

        self.bounded(told, "record", SPARE + len(payload), come, OURS)
        return told

    def close(self) -> list[Finding]:
        """What the merges that failed left of the memory that they were made into."""
        if self.learner is not None:
            self.learner.close()
        try:
            self.target.close()
        except Wrong as error:
            return [(str(error), "merge")]
        finally:
            super().close()
        return []


def prepared(home: Path) -> tuple[list[Memory], dict[str, Any]]:
    """The memories, what a touch's rows of codes are, payloads to mutate, and a folder that is watched."""
    memories = corpus(home / "corpus")
    with opened(memories[0].path, "read") as learner:
        store = learner._ledger.store
        touch = learner._predictor.extractor.learned(learner.stream(stream((5, 30))))[1]
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
