"""What a fleet's workers do: a job is some sources, and what it leaves behind is a packed memory."""

from __future__ import annotations

import faulthandler
import hashlib
import json
import os
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from scroll_tactile.embeddings.protocol import Embedding
from scroll_tactile.errors import RangeWarning
from scroll_tactile.learner import TactileLearner
from scroll_tactile.memory.identity import Identity
from scroll_tactile.pipelines.learning import learn_sources
from scroll_tactile.pipelines.sources import Refused, SourceOptions
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.copies import Augmented

__all__ = ["LearnJob", "Made", "Making", "learn_job"]


@dataclass(frozen=True)
class Making:
    """What all memories of a run are made with. patience: seconds that a job may take; None: any."""

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

    def open(self, path: Path) -> TactileLearner:
        """A learner of this making, in a folder."""
        return TactileLearner.open(
            path,
            sensor=self.sensor,
            embedding=self.embedding,
            augmentation=self.augmentation,
            exemplars=self.exemplars,
            recall=self.recall,
        )


@dataclass(frozen=True)
class LearnJob:
    """Sources, in order, whose touches become one packed memory in the folder of the run."""

    making: Making
    sources: tuple[str, ...]
    folder: str

    @property
    def target(self) -> Path:
        """The file: of these sources, and no others."""
        digest = hashlib.sha256(json.dumps(self.sources).encode()).hexdigest()
        return Path(self.folder) / f"learned-{digest[:24]}.part"

    def halves(self) -> list[LearnJob]:
        """Two jobs in place of this one; none of a single source."""
        middle = len(self.sources) // 2
        parts = (self.sources[:middle], self.sources[middle:])
        return [LearnJob(self.making, part, self.folder) for part in parts] if middle else []


@dataclass
class Made:
    """What a job made: a packed memory; path: "" where no touch was learned.

    refused: what was not, and why; failed: the sources of that. repeated: touches that came before in the same job,
    under their names. range_problem: of the first touch that does not fit the sensor's range. seconds, processor: what
    it took.
    """

    path: str
    refused: list[Refused] = field(default_factory=list)
    failed: set[str] = field(default_factory=set)
    repeated: int = 0
    range_problem: str | None = None
    seconds: float = 0.0
    processor: float = 0.0


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


def learn_job(job: LearnJob) -> Made:
    """Learn the sources of a job; what cannot be read is listed. The packed memory appears whole, or not at all.

    Raises CapacityError; StoreFullError, StoreError where it cannot be written.
    """
    begun = time.perf_counter(), time.process_time()
    with (
        _within(job.making.patience),
        TemporaryDirectory(dir=job.folder, prefix=f"{job.target.name}.", suffix=".partial") as place,
        warnings.catch_warnings(record=True) as warned,
    ):
        warnings.simplefilter("always", RangeWarning)
        learner = job.making.open(Path(place) / "memory")
        learner._ledger.saves = False  # the packed memory is what is kept
        with learner:
            done = learn_sources(learner, job.sources, job.making.options)
            if done.learned:
                learner.pack(job.target)
    problems = [str(each.message) for each in warned if issubclass(each.category, RangeWarning)]
    return Made(
        str(job.target) if done.learned else "",
        done.refused,
        done.failed,
        done.skipped,
        problems[0] if problems else None,
        time.perf_counter() - begun[0],
        time.process_time() - begun[1],
    )
