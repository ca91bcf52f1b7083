"""What a fleet's workers do: a job is some sources, and what it leaves behind is a partial memory in a file."""

from __future__ import annotations

import faulthandler
import hashlib
import json
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from queue import Empty, Queue
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
from scroll_tactile.pipelines.sources import Refused, SourceOptions, find_sources, source_touches
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.recordings.locations import file_system, is_remote, local
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.copies import Augmented
from scroll_tactile.signals.stream import Stream
from store import Head, StoreError, StoreFullError
from store.header import holds_store
from store.packed import BEGIN

__all__ = ["LearnJob", "Made", "Making", "SumJob", "expand", "is_memory", "learn_partial", "sum_partials"]

RECORDINGS = (".bag", ".db3", ".mcap", ".npy", ".csv", ".h5", ".hdf5", ".parquet")
PACKED = (".part", ".partial")  # what is looked for in a remote folder: usual names of packed memories
WHOLE = ("metadata.yaml", "meta/info.json", ".zgroup", "zarr.json")  # in a folder that is one recording
JOURNAL = "journal.sqlite"


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
        keeping = Keeping(self.sensor, self.identity.recall or 0)
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
    """Partials to be summed up, each with the numbers of its touches that came before."""

    making: Making
    parts: tuple[tuple[str, tuple[int, ...]], ...]
    target: str

    def halves(self) -> list[SumJob]:
        """Two jobs in place of this one; none of two partials."""
        middle = len(self.parts) // 2
        parts = (self.parts[:middle], self.parts[middle:])
        return (
            [SumJob(self.making, part, f"{self.target}-{i}.part") for i, part in enumerate(parts)] if middle > 1 else []
        )


@dataclass
class Made:
    """A partial that a job made.

    path: its file, sources: those in it, with rows or without. adds_up: whether it is of the run's making.
    refused: what was not learned. touches: a hash of each
    touch's name and content, in the order of the file. descriptions: by material. seconds, processor: what it took.
    """

    path: str
    sources: tuple[str, ...]
    has_rows: bool = True
    adds_up: bool = True
    refused: list[Refused] = field(default_factory=list)
    touches: list[bytes] = field(default_factory=list)
    descriptions: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    processor: float = 0.0

    @classmethod
    def of(cls, path: Path, sources: tuple[str, ...] | None = None) -> Made:
        """The partial in a file; sources: None for those of a run that was cut short, which left it behind.

        Raises StoreError, MismatchError.
        """
        with Partial(path) as packed:
            named = packed.note.get("sources") if sources is None else list(sources)
            if not isinstance(named, list) or not all(isinstance(source, str) for source in named):
                raise MismatchError(f"{path} is a partial, but none of a fleet's run")
            packed.verify()
            touches = [touch_hash(head.label, head.key) for head in packed.named]
            described = dict(packed.descriptions)
            return cls(str(path), tuple(named), packed.has_rows, touches=touches, descriptions=described)


def touch_hash(material: str, key: bytes) -> bytes:
    """What tells touches apart: their names and contents, in 16 bytes."""
    return hashlib.blake2b(key + material.encode(), digest_size=16).digest()


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
    reads = bool(identity.exemplars and identity.exemplars[0]) or bool(identity.recall) or identity.embedding.bare
    failed: set[str] = set()
    touches: list[bytes] = []
    seen: set[bytes] = set()
    with write_partial(job.target) as written:
        for address in job.sources:
            for touch in source_touches(learner, address, making.options):
                if isinstance(touch, Refused):
                    refused.append(touch)
                    failed.add(address)
                    continue
                material, key = str(touch.material), touch.stream.key
                name = touch_hash(material, key)
                if name in seen:
                    continue
                seen.add(name)
                image = extractor.image(touch.stream)
                codes, columns = extractor.codes(image, key), image.shape[1]
                memory.add(material, key, columns, codes, len(seen), None, touch.stream.readings)
                said = {"columns": columns, SOURCE: touch.source}
                said |= {"nbytes": touch.stream.readings.nbytes} if reads else {}
                arrays = pack_readings(touch.stream.readings) if reads else {}
                arrays |= {} if identity.embedding.bare else pack_codes(codes)
                written.touch(Head(len(seen), OBSERVE, material, key, time.time(), said, 0), arrays)
                touches.append(name)
        learned = tuple(source for source in job.sources if source not in failed)
        written.finish(identity.to_json(), memory, None, note={"sources": list(learned)})
    return Made(str(job.target), learned, refused=refused, touches=touches)


def _pack(job: LearnJob, address: str) -> Made:
    """The partial of a source that is a memory: a packed file is one, of a folder one is made."""
    try:
        with local(address) as place:
            path = job.target.with_name(job.target.name.replace("learned", "packed"))
            if place.is_dir():
                with TactileLearner.open(place, embedding=job.making.embedding, mode="read") as learner:
                    learner.pack(path, source=address)
            elif is_remote(address):
                shutil.copyfile(place, path)
            else:
                path = place
        made = Made.of(path, (address,))
        with Partial(path) as packed:
            # Of other settings it is merged by itself, or refused there by what differs.
            made.adds_up = packed.identity == job.making.identity.to_json()
            made.has_rows = made.has_rows and made.adds_up
        return made
    except StoreFullError:
        raise
    except (ScrollTactileError, StoreError, OSError) as error:
        return Made("", (), refused=[Refused(address, str(error))])


def sum_partials(job: SumJob) -> Made:
    """Sum up partials of one making as one without rows. Raises StoreError, MismatchError."""
    begun = time.perf_counter(), time.process_time()
    identity = job.making.identity
    exemplars = (identity.exemplars or (0, None))[0] or 0
    with _within(job.making.patience):
        parts = [(Path(path), frozenset(left_out)) for path, left_out in job.parts]
        reduce_partials(parts, Path(job.target), job.making.memory(exemplars))
    return Made(job.target, (), False, seconds=time.perf_counter() - begun[0], processor=time.process_time() - begun[1])


def is_memory(address: str) -> bool:
    """Whether an address is that of a memory, in a folder or packed; what cannot be looked at is none."""
    try:
        return _is_remote_memory(address) if is_remote(address) else _is_local_memory(Path(address))
    except Exception:  # each file system has errors of its own; reading it tells what is wrong
        return False


def _is_local_memory(path: Path) -> bool:
    if path.is_dir():
        return holds_store(path)
    if not path.is_file():  # a pipe would be waited for
        return False
    with path.open("rb") as file:
        return file.read(len(BEGIN)) == BEGIN


def _is_remote_memory(address: str) -> bool:
    if address.lower().endswith(RECORDINGS):
        return False
    files, path = file_system(address)
    if files.isdir(path):
        return bool(files.exists(f"{path.rstrip('/')}/{JOURNAL}"))
    with files.open(path, "rb", cache_type="none") as file:
        return bool(file.read(len(BEGIN)) == BEGIN)


def expand(paths: Sequence[str], patience: float | None = None) -> tuple[list[str], list[Refused]]:
    """The recordings and memories at some paths and addresses, each once, in order; and where there is none.

    patience: seconds in which an address must answer.
    """
    found: dict[str, None] = {}
    refused: list[Refused] = []
    for path in paths:
        inside: Sequence[str]
        if is_remote(path):
            try:
                inside = _answered(partial(_listed, path), patience)
            except Exception as error:  # each file system has errors of its own
                refused.append(Refused(path, f"it cannot be listed: {type(error).__name__}: {error!s:.300}"))
                continue
            if not inside:
                refused.append(Refused(path, "expected recordings or memories; nothing is there"))
        elif is_memory(path):
            inside = [path]
        else:
            inside, missing = find_sources([path])
            refused += missing
        found |= dict.fromkeys(inside)
    return list(found), refused


def _answered(ask: Callable[[], list[str]], patience: float | None) -> list[str]:
    """The answer of a call. Raises what it raises, and TimeoutError where it takes longer; it is left alone then."""
    answers: Queue[list[str] | Exception] = Queue()

    def call() -> None:
        try:
            answers.put(ask())
        except Exception as error:  # raised below
            answers.put(error)

    threading.Thread(target=call, daemon=True).start()
    try:
        answer = answers.get(timeout=patience)
    except Empty:
        raise TimeoutError(f"no answer in {patience:g} s") from None
    if isinstance(answer, Exception):
        raise answer
    return answer


def _listed(address: str) -> list[str]:
    """What a remote folder holds; the address itself where it is a file, or a folder that is one recording."""
    files, path = file_system(address)
    files.invalidate_cache()
    if not files.isdir(path):
        return [address]
    scheme, place = address.partition("://")[0], path.rstrip("/")
    names = sorted(str(name) for name in files.find(place))
    inside = {name[len(place) + 1 :] for name in names}
    if inside & {*WHOLE, JOURNAL}:
        return [address]
    folders = {name.rpartition("/")[0] for name in names if name.endswith((f"/{JOURNAL}", "/metadata.yaml"))}
    alone = [
        name for name in names if name.lower().endswith(RECORDINGS + PACKED) and not name.startswith(tuple(folders))
    ]
    return [f"{scheme}://{name}" for name in sorted({*folders, *alone})]
