"""What a fleet's workers do: a job is some sources, and what it leaves behind is a partial memory in a file."""

from __future__ import annotations

import faulthandler
import hashlib
import json
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from scroll_tactile.embeddings.protocol import Embedding, capabilities_of, window_plan
from scroll_tactile.errors import MismatchError, ScrollTactileError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.memory.identity import Identity
from scroll_tactile.memory.kept import Keeping
from scroll_tactile.memory.packing import reduce_partials
from scroll_tactile.memory.partial import Partial, write_partial
from scroll_tactile.memory.rows import OBSERVE, SOURCE, pack_codes, pack_readings
from scroll_tactile.memory.state import Memory
from scroll_tactile.pipelines.sources import Refused, SourceOptions, source_touches
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.recordings.locations import is_remote, local
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.copies import Augmented
from scroll_tactile.signals.ranges import all_clipped, range_problem
from scroll_tactile.signals.stream import Stream
from store import Head, StoreError, StoreFullError

__all__ = [
    "Again",
    "Contained",
    "LearnJob",
    "Made",
    "Making",
    "SumJob",
    "learn_partial",
    "packed_path",
    "sum_partials",
]


@dataclass(frozen=True)
class Making:
    """What all partials of a run are made with. patience: seconds that a job may take; None: any."""

    sensor: Sensor
    embedding: Embedding
    augmentation: Augmented | None
    exemplars: int | None
    recall: int | None
    options: SourceOptions
    patience: float | None = None

    @property
    def identity(self) -> Identity:
        """That of the memory that comes out."""
        return Identity.of(self.sensor, self.embedding, self.exemplars, self.augmentation, self.recall)

    def learner(self) -> TactileLearner:
        """A learner in memory only."""
        return TactileLearner(
            sensor=self.sensor,
            embedding=self.embedding,
            augmentation=self.augmentation,
            exemplars=self.exemplars,
            recall=self.recall,
        )

    def memory(self, exemplars: int = 0) -> Memory:
        """An empty memory of sums."""
        plan, extractor = window_plan(self.sensor, self.embedding), self.extractor()

        def encode(readings: Any) -> Any:
            touch = Stream(self.sensor, readings)
            return extractor.codes(extractor.image(touch), touch.key)

        exact = encode if capabilities_of(self.embedding).exact else None
        keeping = Keeping(self.sensor, self.identity.recall)
        return Memory(self.embedding.dimension, plan, exemplars, exact, keeping)

    def extractor(self) -> FeatureExtractor:
        """What makes codes of touches."""
        plan = window_plan(self.sensor, self.embedding)
        return FeatureExtractor(self.sensor, self.embedding, plan, self.augmentation)


@dataclass(frozen=True)
class LearnJob:
    """Sources whose touches become one partial, in the folder of the run; memory: it is one, and no recordings."""

    making: Making
    sources: tuple[str, ...]
    folder: str
    memory: bool = False

    @property
    def target(self) -> Path:
        """The partial's file: of these sources, and no others."""
        digest = hashlib.sha256(json.dumps(self.sources).encode()).hexdigest()
        return Path(self.folder) / f"learned-{digest[:24]}.part"

    def halves(self) -> list[LearnJob]:
        """Two jobs in place of this one; none of a single source."""
        middle = len(self.sources) // 2
        parts = (self.sources[:middle], self.sources[middle:])
        return [LearnJob(self.making, part, self.folder) for part in parts] if middle else []


@dataclass(frozen=True)
class SumJob:
    """Partials to be summed up, each with the numbers of its touches that came before; number: of the sum in a run."""

    making: Making
    parts: tuple[tuple[str, tuple[int, ...]], ...]
    target: str
    number: int = 0

    def halves(self) -> list[SumJob]:
        """Two jobs in place of this one; none of two partials."""
        middle = len(self.parts) // 2
        parts = (self.parts[:middle], self.parts[middle:])
        return (
            [SumJob(self.making, part, f"{self.target}-{i}.part", self.number) for i, part in enumerate(parts)]
            if middle > 1
            else []
        )


@dataclass
class Made:
    """What a job made: a partial, in a file, and what was not learned; path: "" where there is none.

    seconds, processor: what it took.
    """

    path: str
    refused: list[Refused] = field(default_factory=list)
    seconds: float = 0.0
    processor: float = 0.0


@dataclass(frozen=True)
class Again:
    """A touch that came before in the same job, under its name: the sum has it once. said: where it came from."""

    address: str
    said: str
    material: str
    key: bytes


@dataclass(frozen=True)
class Contained:
    """What a partial holds, by itself, and not by what a worker said of it.

    path: its file. learned: the sources that it has all touches of. read: all of its sources, in order, each with how
    many touches it has of it, which follow each other. touches: material and key of each. again: others that came.
    memory: whether its source is one. adds_up: whether it is of the run's making; has_rows: and has a row for each
    touch. described: whether it describes materials. clipped: the numbers of touches all of whose values lay outside
    the sensor's range. range_problem: of the first touch that does not fit it, as `ranges.range_problem` says it.
    """

    path: str
    learned: tuple[str, ...]
    read: tuple[tuple[str, int], ...]
    touches: tuple[tuple[str, bytes], ...]
    again: tuple[Again, ...] = ()
    memory: bool = False
    adds_up: bool = True
    has_rows: bool = True
    described: bool = False
    clipped: frozenset[int] = frozenset()
    range_problem: str | None = None

    @property
    def sources(self) -> tuple[str, ...]:
        """All that were read."""
        return tuple(address for address, _ in self.read)

    @cached_property
    def numbers(self) -> dict[tuple[str, bytes], int]:
        """The number of each touch, from 1."""
        return {touch: number for number, touch in enumerate(self.touches, start=1)}

    @classmethod
    def of(cls, path: Path, making: Making, address: str | None = None, *, thorough: bool = False) -> Contained:
        """The partial in a file. address: of a memory; None for one that a job made of recordings.

        thorough: verify all of it, also that it sums up the touches that it names. Raises StoreError, MismatchError.
        """
        if not path.is_file():
            raise MismatchError(f"expected a partial of a fleet's run in {path}; it is no file")
        with Partial(path) as packed:
            if thorough:
                packed.verify()
            if thorough and address is None:
                packed.read_with(window_plan(making.sensor, making.embedding))
                packed.sums()
            # Of other settings a memory is merged by itself, or refused there by what differs.
            adds_up = packed.identity == making.identity.to_json()
            touches = tuple((head.label, head.key) for head in packed.named)
            described = bool(packed.descriptions)
            if address is not None:
                rows, whole = packed.has_rows and adds_up, ((address, len(touches)),)
                return cls(str(path), (address,), whole, touches, (), True, adds_up, rows, described)
            try:
                learned, read, again = _noted(packed.note, touches)
                clipped, problem = _noted_of_range(packed.note)
            except (KeyError, TypeError, ValueError) as error:
                raise MismatchError(f"{path} is a partial, but none of a fleet's run: {error!r:.200}") from error
            if not adds_up or packed.has_rows != bool(touches):
                raise MismatchError(f"{path} is a partial of another run")
            ranged: dict[str, Any] = {"clipped": clipped, "range_problem": problem}
            return cls(str(path), learned, read, touches, again, described=described, **ranged)


def _noted(
    note: Mapping[str, Any], touches: Sequence[tuple[str, bytes]]
) -> tuple[tuple[str, ...], tuple[tuple[str, int], ...], tuple[Again, ...]]:
    """What a job of recordings noted, of these touches. Raises KeyError, TypeError or ValueError for another note."""
    read = tuple((address, int(count)) for address, count in note["read"])
    learned = tuple(note["sources"])
    again = tuple(Again(address, said, name, bytes.fromhex(key)) for address, said, name, key in note["again"])
    places = [address for address, _ in read]
    texts = [*places, *learned, *(text for each in again for text in (each.address, each.said, each.material))]
    if not all(isinstance(text, str) for text in texts):
        raise TypeError("a source's name that is no text")
    counts = [count for _, count in read]
    known = {*learned, *(each.address for each in again)} <= set(places) and len(set(places)) == len(places)
    if not known or min(counts, default=0) < 0 or sum(counts) != len(touches):
        raise ValueError("touches of other sources than it names")
    if not {(each.material, each.key) for each in again} <= set(touches):
        raise ValueError("a touch that came again, and not before")
    return learned, read, again


def _noted_of_range(note: Mapping[str, Any]) -> tuple[frozenset[int], str | None]:
    """The touches that were clipped throughout, and what does not fit the sensor's range; raises as `_noted` does."""
    problem = note["range_problem"]
    if not isinstance(problem, str | None):
        raise TypeError("a problem of the range that is no text")
    return frozenset(int(number) for number in note["clipped"]), problem


@contextmanager
def _within(patience: float | None) -> Iterator[None]:
    """End this process where the block takes longer; whoever runs the job then gives it to another."""
    if patience is None:
        yield
        return
    with Path(os.devnull).open("w") as nowhere:
        faulthandler.dump_traceback_later(patience, exit=True, file=nowhere)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()


def learn_partial(job: LearnJob) -> Made:
    """Learn the sources of a job; what cannot be read is listed. The partial appears whole, or not at all.

    Raises StoreFullError, StoreError where it cannot be written.
    """
    begun = time.perf_counter(), time.process_time()
    with _within(job.making.patience):
        made = _pack(job, job.sources[0]) if job.memory else _learn(job)
    made.seconds, made.processor = time.perf_counter() - begun[0], time.process_time() - begun[1]
    return made


def _learn(job: LearnJob) -> Made:
    making, refused = job.making, []
    learner, extractor, memory = making.learner(), making.extractor(), making.memory()
    identity = making.identity
    reads = bool(identity.exemplars or identity.recall) or identity.embedding.bare
    failed: set[str] = set()
    seen: set[tuple[str, bytes]] = set()
    read: list[tuple[str, int]] = []
    again: list[tuple[str, str, str, str]] = []
    clipped: list[int] = []
    problem: str | None = None
    with write_partial(job.target) as written:
        for address in job.sources:
            before = len(seen)
            for touch in source_touches(learner, address, making.options):
                if isinstance(touch, Refused):
                    refused.append(touch)
                    failed.add(address)
                    continue
                material, key = str(touch.material), touch.stream.key
                if (material, key) in seen:
                    again.append((address, touch.source, material, key.hex()))
                    continue
                seen.add((material, key))
                problem = problem or range_problem(touch.stream)
                clipped += [len(seen)] if all_clipped(touch.stream) else []
                image = extractor.image(touch.stream)
                codes, columns = extractor.codes(image, key), image.shape[1]
                memory.add(material, key, columns, codes, len(seen), None, touch.stream.readings)
                said = {"columns": columns, SOURCE: touch.source}
                said |= {"nbytes": touch.stream.readings.nbytes} if reads else {}
                arrays = pack_readings(touch.stream.readings) if reads else {}
                arrays |= {} if identity.embedding.bare else pack_codes(codes)
                written.touch(Head(len(seen), OBSERVE, material, key, time.time(), said, 0), arrays)
            read.append((address, len(seen) - before))
        learned = [source for source in job.sources if source not in failed]
        note = {"sources": learned, "read": read, "again": again, "clipped": clipped, "range_problem": problem}
        written.finish(identity.to_json(), memory, None, note=note)
    return Made(str(job.target), refused=refused)


def packed_path(job: LearnJob) -> Path:
    """The file of a memory that a job packs."""
    return job.target.with_name(job.target.name.replace("learned", "packed"))


def _pack(job: LearnJob, address: str) -> Made:
    """The partial of a source that is a memory: a packed file is one, of a folder one is made."""
    try:
        with local(address) as place:
            path = packed_path(job)
            if place.is_dir():
                with TactileLearner.open(place, embedding=job.making.embedding, mode="read") as learner:
                    learner.pack(path, source=address)
            elif is_remote(address):
                shutil.copyfile(place, path)
            else:
                path = place
        Contained.of(path, job.making, address, thorough=True)
        return Made(str(path))
    except StoreFullError:
        raise
    except (ScrollTactileError, StoreError, OSError) as error:
        return Made("", refused=[Refused(address, str(error))])


def sum_partials(job: SumJob) -> Made:
    """Sum up partials of one making as one without rows. Raises StoreError, MismatchError."""
    begun = time.perf_counter(), time.process_time()
    with _within(job.making.patience):
        parts = [(Path(path), frozenset(left_out)) for path, left_out in job.parts]
        reduce_partials(parts, Path(job.target), job.making.memory(job.making.identity.exemplars))
    return Made(job.target, seconds=time.perf_counter() - begun[0], processor=time.process_time() - begun[1])
