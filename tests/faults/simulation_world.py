"""The whole system, simulated: robots and a central memory, their disks, and a bucket that carries packed memories.

Each event has a seed of its own and is played on what there is: one that has nothing to do does nothing. `Wrong` is what
must not happen.
"""

from __future__ import annotations

import errno
import functools
import random
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from touches import SmallSample

import scroll_tactile.memory.ledger
import scroll_tactile.memory.state
import store.backup
from faults import simulation_model as model
from faults.shim import Shim
from faults.simulation_disk import Disks, Held, abandon, flip
from faults.simulation_model import Expected, Rows
from scroll_tactile import Sensor, TactileLearner
from scroll_tactile.embeddings.protocol import Capabilities
from scroll_tactile.errors import EmbeddingMismatchError, InputError, MismatchError
from scroll_tactile.prediction.features import FeatureExtractor
from store import StoreError, check_store, repair_store

MACHINES = ("robot-1", "robot-2", "central")
MATERIALS = ("a", "b", "ü")
TOUCHES = 9
SAID = (None, (("silk", 1.0),), (("silk", 0.25), ("wool", 0.75)), (("soft", True),))
SNAPSHOT_EVERY = 7
PAD = Sensor(name="tiny", channels=1, rate=50.0, low=0.0, high=1.0, unit="N", duration=0.16)
KEPT = ("kept", "pool", "exemplars")
MOST = 24  # touches of a memory that is merged
ERRORS = (errno.ENOSPC, errno.ENOSPC, errno.EIO)


class Tiny:
    """An embedding that costs nothing."""

    capabilities = Capabilities(partial_windows=False)
    name, dimension, bound = "tiny", 3, 1.0

    def __init__(self, fingerprint: str) -> None:
        self.fingerprint = fingerprint

    def embed(self, image: Any) -> Any:
        """Three numbers."""
        turned = -1.0 if self.fingerprint == "other" else 1.0
        return turned * np.array([image.mean(), image[:, -1].mean(), image.max()], np.float32)


EMBEDDINGS = {name: Tiny(name) for name in ("own", "other")}
SETTINGS: dict[str, Any] = {"sensor": PAD, "exemplars": 1, "recall": 3}


@functools.cache
def stream(touch: int) -> Any:
    """The readings of a touch."""
    return np.random.default_rng(touch).integers(0, 64, size=(8 + touch % 3, 1)) / 64


def fed(pairs: tuple[model.Pair, ...], embedding: str) -> TactileLearner:
    """A memory without a path of these touches."""
    learner = TactileLearner(embedding=EMBEDDINGS[embedding], **SETTINGS)
    for material, touch in pairs:
        learner.observe(material, stream(touch), again=True)
    return learner


def prepare() -> None:
    """Have what a touch comes to be worked out once."""
    scroll_tactile.memory.state.TouchSample = SmallSample  # type: ignore[misc]
    scroll_tactile.memory.ledger.SNAPSHOT_EVERY = SNAPSHOT_EVERY
    worked, known = FeatureExtractor.codes, dict[Any, Any]()

    def codes(self: FeatureExtractor, image: Any, key: bytes) -> Any:
        about = getattr(self._embedding, "fingerprint", ""), key
        if about not in known:
            known[about] = worked(self, image, key)
        return known[about]

    FeatureExtractor.codes = codes  # type: ignore[method-assign]


@functools.cache
def key_of(touch: int) -> bytes:
    """The content hash of a touch."""
    return TactileLearner(embedding=EMBEDDINGS["own"], **SETTINGS).stream(stream(touch)).key


EXPECTED = Expected(fed, key_of)


@contextmanager
def interleaved(place: int, between: Callable[[], None]) -> Iterator[None]:
    """While it lasts, do something just before the so many-th file is copied; 0: before the log is read."""
    copy, reader = store.backup.copy_regular, store.backup.LogReader
    left = [place] if place >= 0 else []

    def due(now: bool) -> None:
        if left and now:
            left.clear()
            between()

    def copied(*given: Any) -> None:
        due(left == [1])
        left[:] = [count - 1 for count in left]
        copy(*given)

    def read(*given: Any, **named: Any) -> Any:
        due(True)
        return reader(*given, **named)

    store.backup.copy_regular, store.backup.LogReader = copied, read  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        store.backup.copy_regular, store.backup.LogReader = copy, reader  # type: ignore[misc]


class Wrong(Exception):
    """What must not be."""


@dataclass
class Machine:
    """A machine. candidates: what its memory may hold, the first of them unless something went wrong.

    sure: how many rows no flip can take away unnoticed. copies: its backups, and whether each was acknowledged.
    """

    name: str
    path: Path
    candidates: list[Rows] = field(default_factory=lambda: [Rows()])
    learner: Any = None
    readers: list[Any] = field(default_factory=list)
    sure: int = 0
    copies: dict[Path, tuple[list[Rows], bool]] = field(default_factory=dict)
    made: bool = False

    @property
    def rows(self) -> Rows:
        """What it holds, where nothing is open."""
        return self.candidates[0]


Fate = tuple[str, Any]


class World:
    """All of it, in an empty folder; strict: what is not to be."""

    def __init__(self, home: Path, shim: Shim, log: Path, counts: Counter[str]) -> None:
        self.root, self.net = home / "disks", home / "net"
        for name in MACHINES:
            (self.root / name).mkdir(parents=True)
        self.net.mkdir()
        self.disks = Disks(self.root, shim, log)
        self.machines = [Machine(name, self.root / name / "memory") for name in MACHINES]
        self.bucket: dict[str, list[tuple[bytes, Rows]]] = {}
        self.flying: list[tuple[int, str, tuple[bytes, Rows]]] = []
        self.step = 0
        self.counts = counts
        self.warned: list[str] = []
        self.told: list[str] = []

    def say(self, text: str) -> None:
        """Note what happened."""
        self.told.append(text)

    def close(self) -> None:
        """Let go of everything."""
        for machine in self.machines:
            self.drop(machine)

    @staticmethod
    def _problems(path: Path) -> list[Any]:
        return [one for one in check_store(path) if one.kind != "leftover"]

    def drop(self, machine: Machine) -> None:
        """The processes of a machine are gone."""
        for learner in [machine.learner, *machine.readers]:
            if learner is not None:
                abandon(learner)
        machine.learner, machine.readers = None, []

    # What is done to a disk, and what may come between.

    def crash(self, machine: Machine, rng: random.Random, how: str) -> None:
        """Power cut, or the death of all of its processes in the midst of something."""
        self.drop(machine)
        if how == "cut":
            self.say(f"    power cut of {machine.name}: {self.disks.cut(machine.name, rng)}")
        else:
            self.disks.kill(machine.name)
            self.say(f"    {machine.name} killed")
        self.counts[f"crash: {how}"] += 1

    def fate(self, rng: random.Random) -> Fate:
        """What happens to an operation."""
        drawn, where = rng.random(), rng.random()
        if drawn < 0.09:
            return "cut", where
        if drawn < 0.12:
            return "kill", where
        if drawn < 0.19:
            return "full", (where, rng.choice((1, 1, 2, 10**6)), rng.choice(ERRORS))
        return "", None

    def operate(
        self,
        machine: Machine,
        rng: random.Random,
        what: str,
        do: Callable[[], Any],
        then: tuple[Rows, Any],
        either: tuple[Rows, Any] | None = None,
    ) -> Any:
        """Do something that writes, with its fate; what it returned, None where that is not known.

        either: what may come of it as well; then it has no fate.
        """
        kind, about = ("", None) if either else self.fate(rng)
        Held.at_once = rng.random() < 0.3
        before, (after, foretold) = machine.rows, then
        held = None if machine.learner is None else machine.learner._ledger.store
        late = held is not None and held._checkpoints._failure is not None  # closing tells of it
        fail = None
        if kind == "full":
            first = 1 + int(about[0] ** 3 * 400) if rng.random() < 0.5 else rng.randint(1, 12)
            fail = first, first + about[1] - 1, about[2]
        self.disks.begin(fail)
        try:
            try:
                result = do()
            except (InputError, MismatchError) as error:
                result = type(error).__name__
            except StoreError as error:
                result = error
        finally:
            done = self.disks.end()
        self.say(f"  {machine.name}: {what}" + (f" [{kind} {about}]" if kind else "") + f" -> {result!r:.110}")
        self.counts[f"fate: {kind or 'none'}"] += 1
        if kind in ("cut", "kill"):
            count = int(about * (len(done) + 1))
            self.disks.go(done[:count])
            machine.candidates = [before, *machine.candidates[1:]] + ([after] if after != before else [])
            self.crash(machine, rng, kind)
            return None
        self.disks.go(done)
        if isinstance(result, StoreError):
            self.counts["refused by a full disk"] += kind == "full"
            if kind != "full" and not (late and what.startswith(("close", "reembed"))):
                raise Wrong(f"{what} said {result!r}")
            if after != before:
                machine.candidates = [*machine.candidates, after]
            if machine.learner is not None and not machine.learner._ledger._closed:
                self.look(machine, machine.learner, f"after {what} failed")
                if machine.rows != before and not what.startswith(("compact", "backup")):
                    raise Wrong(f"{what} said {result!r}, and was done")
            return None
        if either is not None and result == either[1]:
            (after, foretold), self.counts["damaged on the way: the same"] = (
                either,
                1 + self.counts["damaged on the way: the same"],
            )
        if result != foretold:
            raise Wrong(f"{what} gave {result!r}, expected {foretold!r}")
        if after != before:
            machine.sure = min(len(before.rows), len(after.rows))
            machine.candidates = [after]
        return result

    def look(
        self, machine: Machine, learner: Any, where: str, *, settle: bool = False, but: Sequence[str] = ()
    ) -> None:
        """What is seen of a memory is one of its candidates; settle: no other any more; but: what may differ."""
        found = model.seen(learner)
        differ = []
        for rows in machine.candidates:
            wanted = EXPECTED(rows)
            differ.append([name for name, value in found.items() if value != wanted[name] and name not in but])
            if not differ[-1]:
                others = [] if settle else [other for other in machine.candidates if other is not rows]
                if learner is machine.learner:
                    machine.candidates = [rows, *others]
                return
        about = [(name, str(found[name])[:300], str(EXPECTED(machine.rows)[name])[:300]) for name in differ[0][:2]]
        raise Wrong(f"{where}: {machine.name} differs in {differ}: {about}")

    # Opening.

    def opened(self, machine: Machine, rng: random.Random) -> Any:
        """The memory of a machine, opened to write; None where its fate was not to be."""
        if machine.learner is not None:
            return machine.learner

        def do() -> None:
            machine.learner = self._open(machine, machine.path, machine.candidates)

        self.operate(machine, rng, "open", do, (machine.rows, None))
        if machine.learner is not None:
            machine.made = True
            self.look(machine, machine.learner, "opened", settle=True)
            # Opening replays what no checkpoint has, and counts as no row.
        return machine.learner

    @staticmethod
    def _open(machine: Machine, path: Path, candidates: list[Rows], mode: Any = "write") -> Any:
        for name in dict.fromkeys(rows.embedding for rows in candidates):
            try:
                return TactileLearner.open(path, embedding=EMBEDDINGS[name], mode=mode, **SETTINGS)
            except EmbeddingMismatchError as error:
                refused = error
        raise Wrong(f"{machine.name} has another embedding: {refused}")

    # Events.

    def play(self, kind: str, seed: int) -> None:
        """One event."""
        rng = random.Random(seed)
        self.step += 1
        self.say(f"{self.step} {kind} {seed}")
        for landed in [one for one in self.flying if one[0] <= self.step]:
            self.flying.remove(landed)
            self.bucket.setdefault(landed[1], []).append(landed[2])
        machine = rng.choice(self.machines)
        self.counts[kind] += 1
        getattr(self, f"_{kind}")(machine, rng)

    def _do(
        self, machine: Machine, rng: random.Random, what: str, call: Callable[[Any], Any], after: Callable[[Rows], Any]
    ) -> Any:
        learner = self.opened(machine, rng)
        if learner is None:
            return None
        return self.operate(machine, rng, what, lambda: call(learner), after(machine.rows))

    def _change(self, rng: random.Random, rows: Rows) -> tuple[str, Callable[[Any], Any], Callable[[Rows], Any]]:
        """A small change of a memory."""
        kind = rng.choice(("observe", "observe", "observe", "observe", "retract", "describe", "forget"))
        material, touch = rng.choice(MATERIALS), rng.randrange(TOUCHES)
        if kind == "observe":
            again = rng.random() < 0.4
            return (
                f"observe {material} {touch} {again}",
                lambda learner: learner.observe(material, stream(touch), again=again).sequence,
                lambda ours: model.observe(ours, material, touch, again),
            )
        if kind == "describe":
            said = rng.choice(SAID)
            return (
                f"describe {material} {said}",
                lambda learner: learner.describe(material, said and dict(said)),
                lambda ours: model.describe(ours, material, said),
            )
        if kind == "forget":
            return (
                f"forget {material}",
                lambda learner: learner.forget(material),
                lambda ours: model.forget(ours, material),
            )
        sequence = self._some(rng, rows)
        return (
            f"retract {sequence}",
            lambda learner: learner.retract(sequence),
            lambda ours: model.retract(ours, sequence),
        )

    @staticmethod
    def _some(rng: random.Random, rows: Rows) -> int:
        loose = rows.loose
        return rng.choice(loose) if loose and rng.random() < 0.95 else rng.randint(1, len(rows.rows) + 2)

    def _small(self, machine: Machine, rng: random.Random) -> None:
        if self.opened(machine, rng) is not None:
            self._do(machine, rng, *self._change(rng, machine.rows))

    def _batch(self, machine: Machine, rng: random.Random) -> None:
        if self.opened(machine, rng) is None:
            return
        rows, parts = machine.rows, []
        results = []
        for _ in range(rng.randint(2, 5)):
            what, call, after = self._change(rng, rows)
            rows, result = after(rows)
            parts.append((what, call))
            results.append(result)

        def do(learner: Any) -> list[Any]:
            found = []
            with learner.batch():
                for _, call in parts:
                    try:
                        found.append(call(learner))
                    except InputError as error:
                        found.append(type(error).__name__)
            return found

        self._do(machine, rng, f"batch of {[what for what, _ in parts]}", do, lambda _: (rows, results))

    def _relabel(self, machine: Machine, rng: random.Random) -> None:
        if self.opened(machine, rng) is not None:
            sequence, material = self._some(rng, machine.rows), rng.choice(MATERIALS)
            self._do(
                machine,
                rng,
                f"relabel {sequence} {material}",
                lambda learner: learner.relabel(sequence, material),
                lambda ours: model.relabel(ours, sequence, material),
            )

    def _compact(self, machine: Machine, rng: random.Random) -> None:
        keep = rng.choice((0, 1, 2, 3, 5))
        self._do(
            machine,
            rng,
            f"compact {keep}",
            lambda learner: learner.compact(keep=keep).upto,
            lambda ours: model.compact(ours, keep),
        )

    def _reembed(self, machine: Machine, rng: random.Random) -> None:
        if self.opened(machine, rng) is None:
            return
        to = "other" if machine.rows.embedding == "own" or rng.random() < 0.2 else "own"
        rows = machine.rows
        then = (replace(rows, embedding=to), None) if rows.whole else (rows, "MismatchError")
        self._shut(machine, readers_only=True)
        self._do(machine, rng, f"reembed {to}", lambda learner: self._reembedded(learner, to), lambda _: then)
        if machine.learner is not None and machine.learner._ledger._closed:
            abandon(machine.learner)
            machine.learner = None

    @staticmethod
    def _reembedded(learner: Any, to: str) -> None:
        shutil.rmtree(learner.reembed(EMBEDDINGS[to]), ignore_errors=True)

    def _tick(self, machine: Machine, rng: random.Random) -> None:
        """What was handed to the background is done now."""
        if machine.learner is not None and machine.learner._ledger.store._checkpoints._worker.jobs:
            worker = machine.learner._ledger.store._checkpoints._worker
            self.operate(machine, rng, "background commit", worker.run, (machine.rows, None))
            self.counts["background commits later"] += 1

    def _close(self, machine: Machine, rng: random.Random) -> None:
        learner = machine.learner
        if learner is not None:
            self.operate(machine, rng, "close", learner.close, (machine.rows, None))
            machine.learner = None

    def _shut(self, machine: Machine, *, readers_only: bool = False) -> None:
        """Close without any fate."""
        for reader in machine.readers:
            reader.close()
        machine.readers = []
        if not readers_only and machine.learner is not None:
            learner, machine.learner = machine.learner, None
            self.disks.begin()
            try:
                learner.close()
            except StoreError as error:  # of an earlier background commit
                self.say(f"    closing said {error!r:.100}")
            finally:
                self.disks.go(self.disks.end())

    def _cut(self, machine: Machine, rng: random.Random) -> None:
        self.crash(machine, rng, "cut")

    def _kill(self, machine: Machine, rng: random.Random) -> None:
        """The writer dies, and its readers go on."""
        if machine.learner is not None:
            abandon(machine.learner)
            machine.learner = None

    def _reader(self, machine: Machine, rng: random.Random) -> None:
        if machine.made and len(machine.candidates) == 1 and (machine.path / "CURRENT").exists():
            machine.readers.append(self._open(machine, machine.path, machine.candidates, "read"))
            self.look(machine, machine.readers[-1], "a reader opened")

    def _refresh(self, machine: Machine, rng: random.Random) -> None:
        for reader in machine.readers:
            reader.refresh()
            self.look(machine, reader, "a reader refreshed")

    def _leave(self, machine: Machine, rng: random.Random) -> None:
        if machine.readers:
            machine.readers.pop(rng.randrange(len(machine.readers))).close()

    def _backup(self, machine: Machine, rng: random.Random) -> None:
        if self.opened(machine, rng) is None:
            return
        rows, to = machine.rows, machine.path.with_name(f"copy-{self.step}")
        # While it copies, the memory goes on.
        then, place = rows, rng.choice((-1, 0, 1, 5, 20))
        if place >= 0:
            material, touch = rng.choice(MATERIALS), rng.randrange(TOUCHES)
            then, sequence = model.observe(rows, material, touch, True)

        def do(learner: Any) -> str:
            def between() -> None:
                learner.observe(material, stream(touch), again=True)
                learner._ledger._snapshot()

            with interleaved(place, between):
                learner.backup(to)
            return "done"

        done = self._do(machine, rng, f"backup {to.name}, going on at {place}", do, lambda _: (then, "done"))
        machine.copies[to] = [rows, then], done == "done"

    def _restore(self, machine: Machine, rng: random.Random) -> None:
        """A copy is whole; now and then it takes the memory's place."""
        if not machine.copies:
            return
        path = rng.choice(sorted(machine.copies))
        rows, acknowledged = machine.copies[path]
        if not path.exists():
            if acknowledged:
                raise Wrong(f"{path.name} of {machine.name} is gone")
            return
        if problems := self._problems(path):
            raise Wrong(f"{path.name} of {machine.name}: {problems}")
        if rng.random() < 0.5:
            self._shut(machine)
            self.disks.begin()
            shutil.rmtree(machine.path, ignore_errors=True)
            shutil.copytree(path, machine.path)
            self.disks.end()
            self.disks.settle(machine.name)
            machine.candidates, machine.sure = rows, 0
            machine.made = True
            self.say(f"  {machine.name}: restored {path.name}")
            self.counts["restored"] += 1
        else:
            learner = self._open(machine, path, rows, "read")
            self.look(Machine(path.name, path, rows), learner, "a backup")
            learner.close()

    # What goes from one memory to another.

    def _pack(self, machine: Machine, rng: random.Random) -> None:
        """Packed, and sent: it may be lost, come late, or twice."""
        if self.opened(machine, rng) is None or not machine.rows.pairs or machine.rows.unlisted:
            return
        rows, to = rng.random() < 0.7, machine.path.with_name("packed.zip")
        pack = lambda learner: learner.pack(to, rows=rows) or "done"  # noqa: E731
        if self._do(machine, rng, f"pack {rows}", pack, lambda ours: (ours, "done")) != "done":
            return
        sent = to.read_bytes(), model.packed(machine.rows, rows)
        name = f"{machine.name}-{rng.randrange(2)}"
        drawn = rng.random()
        for _ in range(0 if drawn < 0.1 else 2 if drawn < 0.25 else 1):
            self.flying.append((self.step + rng.choice((0, 0, 1, 5, 20)), name, sent))
        self.counts[
            "packed memories lost" if drawn < 0.1 else "packed memories doubled" if drawn < 0.25 else "sent"
        ] += 1

    def _listed(self, rng: random.Random) -> list[tuple[str, bytes, Rows]]:
        """The bucket as a listing says: some are missing, some old, some there twice."""
        found = []
        for name, versions in sorted(self.bucket.items()):
            drawn = rng.random()
            version = rng.choice(versions) if drawn < 0.3 else versions[-1]
            self.counts["listed: old"] += version is not versions[-1]
            self.counts["listed: missing"] += drawn > 0.85
            self.counts["listed: twice"] += 0.3 < drawn < 0.45
            found += [(name, *version)] * (0 if drawn > 0.85 else 2 if 0.3 < drawn < 0.45 else 1)
        return found

    def _collect(self, machine: Machine, rng: random.Random) -> None:
        """What lies in the bucket is merged; what came damaged is refused by name."""
        if rng.random() < 0.7:
            machine = self.machines[-1]
        listed = self._listed(rng)
        rng.shuffle(listed)
        for name, data, rows in listed[:3]:
            path, bad = self.net / f"{name}.zip", rng.random() < 0.12
            path.write_bytes(data)
            if bad and rng.random() < 0.5:
                flip(path, rng)
            elif bad:
                path.write_bytes(data[: rng.randrange(len(data))])
            self._merge_from(machine, rng, path, rows, bad=bad)

    def _merge_from(self, machine: Machine, rng: random.Random, path: Path, rows: Rows, *, bad: bool = False) -> None:
        if self.opened(machine, rng) is None:
            return
        once, choice = rng.random() < 0.8, rng.choice(("same", "ours", "theirs", "theirs"))
        of_sources = once and rng.random() < 0.4
        after = model.merge(machine.rows, rows, once, choice, of_sources)

        def do(learner: Any) -> Any:
            if of_sources:
                merged, refused = learner._ledger.merge_sources(path, choice, lambda *_: None)
                return [merged.observations, merged.shared, merged.described, len(refused)]
            merged = learner.merge(path, shared="once" if once else "twice", descriptions=choice)
            return [merged.observations, merged.shared, merged.described, 0]

        what = f"merge {path.name} {'once' if once else 'twice'} {choice}{' of sources' if of_sources else ''}"
        if not bad:
            self._do(machine, rng, what, do, lambda _: after)
            return

        def damaged(learner: Any) -> Any:
            try:
                return do(learner)
            except StoreError as error:
                self.say(f"    refused: {error!r:.200}")
                self.counts["damaged on the way: refused"] += 1
                return "refused"

        then = machine.rows, "refused"
        self.operate(machine, rng, f"damaged, {what}", lambda: damaged(machine.learner), then, either=after)

    def _merge(self, machine: Machine, rng: random.Random) -> None:
        """The folder of another machine is merged, in which somebody may be writing."""
        other = rng.choice([one for one in self.machines if one is not machine])
        usable = other.made and len(other.candidates) == 1 and (other.path / "CURRENT").exists()
        if not usable or other.rows.unlisted or len(other.rows.pairs) > MOST or (len(machine.rows.pairs) > MOST):
            return
        self._merge_from(machine, rng, other.path, other.rows)

    # Rot.

    def _rot(self, machine: Machine, rng: random.Random) -> None:
        """A bit of a file at rest is another: the memory is the same, or refused by name and repaired."""
        if not machine.made or len(machine.candidates) > 1 or not machine.path.exists():
            return
        if rng.random() < 0.5:
            self._shut(machine)
        self.drop(machine)
        files = [one for one in machine.path.rglob("*") if one.is_file() and one.stat().st_size]
        files = [one for one in files if one.name not in ("lock", "holder.json")]
        if not files:
            return
        first = [one for one in files if one.parent == machine.path]
        hurt = rng.choice(first if rng.random() < 0.6 else files)
        flip(hurt, rng)
        self.disks.settle(machine.name)
        self.say(f"  {machine.name}: a bit of {hurt.relative_to(machine.path)} is another")
        whole = machine.rows
        allowed = [whole]
        if hurt.name.startswith("log-") and machine.sure < len(whole.rows):
            allowed.append(whole.cut(max(machine.sure, whole.base)))
        machine.candidates = allowed
        self.warned.clear()

        def look(learner: Any, where: str, *, settle: bool = False) -> None:
            # Of a damaged base a warning tells that nothing can take the place of what is retracted.
            named = any("no other touch can take the place" in text for text in self.warned)
            self.look(machine, learner, f"{where} after a bit of {hurt.name} changed", settle=settle, but=KEPT * named)

        try:
            learner = self._open(machine, machine.path, allowed, "read")
            look(learner, "read")
            learner.close()
        except StoreError as error:
            self.counts["rot: refused to read"] += 1
            self.say(f"    reading: {error!r:.150}")
        try:
            self.disks.begin()
            machine.learner = self._open(machine, machine.path, allowed)
        except StoreError as error:
            self.counts["rot: refused"] += 1
            self.say(f"    writing: {error!r:.150}")
        finally:
            self.disks.go(self.disks.end())
        if machine.learner is not None:
            try:
                look(machine.learner, "opened", settle=True)
                self.counts["rot: the same" if machine.rows == whole else "rot: took the last batch"] += 1
                if not self._problems(machine.path):
                    return
                self.counts["rot: named by a check alone"] += 1
                self.drop(machine)
            except StoreError as error:
                self.counts["rot: refused when it was read"] += 1
                self.say(f"    reading what was opened: {error!r:.150}")
                self.drop(machine)
        self._repair(machine, whole, hurt)

    def _repair(self, machine: Machine, whole: Rows, hurt: Path) -> None:
        refused = None
        self.disks.begin()
        try:
            repair = repair_store(machine.path)
        except StoreError as error:
            refused = error
        finally:
            self.disks.go(self.disks.end())
        if refused is not None:
            self.say(f"    repairing: {refused!r:.200}")
            self.counts["rot: not repaired"] += 1
            self._replace(machine)
            return
        self.say(f"    repaired: {repair!r:.300}")
        self.counts["rot: repaired"] += 1
        rows = whole.cut(repair.kept)
        if not repair.lost and repair.kept < len(whole.rows):
            raise Wrong(f"a repair of {hurt.name} kept {repair.kept} of {len(whole.rows)} rows, and tells of no loss")
        if repair.kept < whole.base:  # the base is lost: with it all that it stood for
            self._replace(machine)
            return
        if hurt.name == "CURRENT" and repair.kept < len(whole.rows):
            raise Wrong(f"a repair of CURRENT kept {repair.kept} of {len(whole.rows)} rows")
        try:
            learner = self._open(machine, machine.path, [rows], "read")
        except StoreError as error:
            raise Wrong(f"repaired after {hurt.name}, and not opened: {error!r}") from error
        base = learner._ledger.store.compacted
        listed = {each.sequence for each in learner.observations()}
        learner.close()
        if base < rows.base:
            raise Wrong(f"a repair of {hurt.name} left the base at {base}, which was {rows.base}")
        if base > rows.base:
            rows = rows.based(base)
        unlisted = {sequence for sequence, _ in rows.listed if sequence <= base and sequence not in listed}
        if len(unlisted) > 1:
            raise Wrong(f"a repair after one bit of {hurt.name} left out rows {unlisted}")
        # A row of another kind may be left out, too, such as one that took another back.
        if unlisted or base > whole.base:
            self.counts["rot: repaired, with less"] += 1
            self._replace(machine)
            return
        machine.candidates, machine.sure = [rows], min(repair.kept, len(rows.rows))

    def _replace(self, machine: Machine) -> None:
        """A new disk, and nothing on it."""
        self.drop(machine)
        shutil.rmtree(self.root / machine.name)
        (self.root / machine.name).mkdir()
        self.disks.settle(machine.name)
        machine.candidates, machine.copies, machine.made, machine.sure = [Rows()], {}, False, 0
        self.counts["disks replaced"] += 1

    # The end.

    def quiet(self) -> None:
        """All that is open is as it must be."""
        for machine in self.machines:
            if machine.learner is not None:
                self.look(machine, machine.learner, "quiet")
        self.counts["quiet points"] += 1

    def _quiet(self, machine: Machine, rng: random.Random) -> None:
        self.quiet()

    def finish(self, rng: random.Random) -> None:
        """The power of all is cut once more; then all is sound, and in one of the ways it may be."""
        for machine in self.machines:
            if not machine.made:
                continue
            self.crash(machine, rng, "cut")
            self.disks.begin()
            try:
                machine.learner = self._open(machine, machine.path, machine.candidates)
            finally:
                self.disks.go(self.disks.end())
            self.look(machine, machine.learner, "at the end", settle=True)
            self._shut(machine)
            if problems := self._problems(machine.path):
                raise Wrong(f"at the end {machine.name} has {problems}")
            for path, (rows, acknowledged) in machine.copies.items():
                if acknowledged and not path.exists():
                    raise Wrong(f"{path.name} of {machine.name} is gone")
