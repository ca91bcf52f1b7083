"""What a fleet's workers do: a job is some sources, and what it leaves behind is a packed memory."""

from __future__ import annotations

import faulthandler
import hashlib
import json
import os
import re
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from scroll_tactile_store.archive import Files, files_of, write_archive
from scroll_tactile_store.exceptions import reported

from scroll_tactile.clients.learning.learning import learn_sources
from scroll_tactile.clients.learning.sources import Refused, SourceOptions
from scroll_tactile.errors import MismatchError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.memory.identity import Identity
from scroll_tactile.quantities import Quantity
from scroll_tactile.recipe import Recipe

__all__ = ["LearnJob", "Made", "Making", "hush", "learn_job"]

CONTENT = re.compile("[0-9a-f]{64}")


@dataclass(frozen=True)
class Making:
    """What all memories of a run are made with, and how sources are read.

    patience: seconds for a job; None: any. quantities: that the memory which comes out has.
    """

    recipe: Recipe
    options: SourceOptions
    patience: float | None = None
    quantities: tuple[Quantity, ...] = ()

    @property
    def identity(self) -> Identity:
        """That of the memory that comes out."""
        return Identity.of(self.recipe)

    def open(self, path: Path) -> TactileLearner:
        """A learner of this recipe, in a folder."""
        return TactileLearner.open(path, **self.recipe.arguments)


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

    identity: of its log, by which it is known again. rows: of each source of the job how many touches it has, which
    follow each other in it. refused: what was not learned, and why; failed: the sources of that. clipped: in
    hexadecimal the contents of touches all of whose values lay outside the sensor's range. range_problem: of the first
    touch that does not fit it. processor: seconds that it took.
    """

    path: str
    identity: str = ""
    rows: list[int] = field(default_factory=list)
    refused: list[Refused] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    clipped: list[str] = field(default_factory=list)
    range_problem: str | None = None
    processor: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """As a run notes it."""
        return asdict(self)

    @classmethod
    def from_json(cls, noted: Any) -> Made:
        """What was noted; raises TypeError, KeyError or ValueError for anything else."""
        refused = [Refused(each["source"], each["why"], each["argument"]) for each in noted["refused"]]
        return cls(**{**noted, "refused": refused})

    def require(self, job: LearnJob) -> None:
        """Raise MismatchError where a job cannot have made this, as far as nobody but its worker can know it."""
        count = len(job.sources)
        refused = _is_list(self.refused, Refused) and all(
            _is_list([r.source, r.why, r.argument or ""], str) for r in self.refused
        )
        failed = _is_list(self.failed, str) and set(self.failed) <= set(job.sources)
        rows = _is_list(self.rows, int) and len(self.rows) == count and min(self.rows, default=0) >= 0
        clipped = _is_list(self.clipped, str) and all(map(CONTENT.fullmatch, self.clipped))
        texts = isinstance(self.identity, str) and isinstance(self.range_problem, str | None)
        if not (refused and failed and rows and clipped and texts and isinstance(self.processor, float)):
            raise MismatchError(f"expected what a job learned and refused; came {self!r:.200}")
        if self.path != (str(job.target) if any(self.rows) else ""):
            raise MismatchError(f"expected the packed memory of a job in {job.target}; came {self.path!r:.200}")

    def require_packed(self) -> None:
        """Raise StoreError or MismatchError where its packed memory is not there, or another."""
        files = files_of(Path(self.path))
        try:
            if not files.is_packed or files.current().log_identity.hex() != self.identity:
                raise MismatchError(f"{self.path} is not the packed memory that was made there")
        finally:
            files.close()


def _is_list(items: Any, kind: type) -> bool:
    return isinstance(items, list) and all(isinstance(each, kind) and not isinstance(each, bool) for each in items)


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

    It has a row for each touch, also for those that come twice, or under two names: only the memory that it is merged
    into tells which come first. Raises CapacityError; StoreFullError, StoreError where it cannot be written.
    """
    begun, folder = time.process_time(), Path(job.folder)
    with _within(job.making.patience), ExitStack() as stack:
        with reported(folder, "making a folder for a job"):
            made = TemporaryDirectory(dir=folder, prefix=f"{job.target.name}.", suffix=".partial")
        place = Path(stack.enter_context(made)) / "memory"
        with job.making.open(place) as learner:
            hush(learner)
            for quantity in job.making.quantities:
                learner.declare(quantity)
            done = learn_sources(learner, job.sources, job.making.options, every=True)
            learner._ledger.saves = True  # it is merged by its checkpoint
        identity = ""
        if done.learned:
            write_archive(place, job.target)
            identity = Files(place).current().log_identity.hex()
    return Made(
        str(job.target) if done.learned else "",
        identity,
        [done.rows[source] for source in job.sources],
        done.refused,
        sorted(done.failed),
        sorted(content.hex() for content in done.clipped),
        done.range_problem,
        time.process_time() - begun,
    )


def hush(learner: TactileLearner) -> None:
    """Have a learner write no checkpoints, and say nothing of its sensor's range: a run does both, at its end."""
    learner._ledger.saves, learner._range_warned = False, True
