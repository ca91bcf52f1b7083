"""The steps of a fleet's run, in order, and the jobs that its workers do: some sources, which become a packed memory.

Here is how sources are cut into steps, what a worker makes of one, what is noted of it, and what a run before left.
"""

from __future__ import annotations

import faulthandler
import hashlib
import json
import logging
import os
import re
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from itertools import accumulate
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from scroll_tactile_store.archive import Files, files_of, write_archive
from scroll_tactile_store.exceptions import reported
from scroll_tactile_store.files import remove_tree

from scroll_tactile.clients.learning.learning import learn_sources
from scroll_tactile.clients.learning.runfile import RunFile
from scroll_tactile.clients.learning.sources import Refused, SourceOptions, is_memory
from scroll_tactile.errors import InputError, MismatchError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.memory.identity import Identity
from scroll_tactile.quantities import Quantity
from scroll_tactile.recipe import Recipe

__all__ = ["NOTES", "LearnJob", "Made", "Making", "Step", "Steps", "hush", "learn_job"]

logger = logging.getLogger(__name__)

JOBS_A_WORKER = 4  # at least, so that all have something to do to the end; a merge costs what 50 touches do
MOST_SOURCES = 1024  # of a step: what is lost with a worker
MOST_STEP_BYTES = 2**28  # of their files, where these are here
NOTES = "run.json"
MOST_TRIES = 20  # of a job of one source whose worker died: where one dies each second, nearly all end sooner
NOTING = 20  # times as long as noting took, nothing is noted again: of a million sources it takes seconds
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


@dataclass
class Made:
    """What a job made: a packed memory; path: "" where no touch was learned.

    identity: of its log, by which it is known again. rows: of each source of the job how many touches it has, which
    follow each other in it. repeated: how many others came twice under one name. refused: what was not learned, and
    why; failed: the sources of that. clipped: in hexadecimal the contents of touches all of whose values lay outside
    the sensor's range. range_problem: of the first touch that does not fit it. processor: seconds that it took.
    """

    path: str
    identity: str = ""
    rows: list[int] = field(default_factory=list)
    repeated: int = 0
    refused: list[Refused] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    clipped: list[str] = field(default_factory=list)
    range_problem: str | None = None
    processor: float = 0.0

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
        repeated = type(self.repeated) is int and self.repeated >= 0
        texts = isinstance(self.identity, str) and isinstance(self.range_problem, str | None)
        if not (refused and failed and rows and repeated and clipped and texts and isinstance(self.processor, float)):
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

    It has a row for each touch, also for those that come under two names: only the memory that it is merged into tells
    which come first. Raises CapacityError; StoreFullError, StoreError where it cannot be written.
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
        done.skipped,
        done.refused,
        sorted(done.failed),
        sorted(content.hex() for content in done.clipped),
        done.range_problem,
        time.process_time() - begun,
    )


def hush(learner: TactileLearner) -> None:
    """Have a learner write no checkpoints, and say nothing of its sensor's range: a run does both, at its end."""
    learner._ledger.saves, learner._range_warned = False, True


@dataclass(eq=False)
class Step:
    """Sources that come in together, in the order of the run: recordings, or one memory.

    made: what a worker made of recordings; None before. failed: sources of which something was not learned. tries: how
    often a worker ended with it.
    """

    sources: tuple[str, ...]
    memory: bool = False
    made: Made | None = None
    failed: set[str] = field(default_factory=set)
    tries: int = 0

    def source_of(self, row: int) -> str:
        """The source of a row of what was made."""
        assert self.made is not None
        return self.sources[min(bisect_right([*accumulate(self.made.rows)], row - 1), len(self.sources) - 1)]


class Steps:
    """The steps of a run that are still to come in, in order, and the notes beside their packed memories.

    folder: of the run. afresh: whether nothing of what was learned is there any more. learned: sources of which all has
    come in. waiting: steps that a worker is to learn. range_problem: of the first touch that has one.

    Raises InputError for notes of another run, or damaged ones, and for what is in the way.
    """

    def __init__(self, folder: Path, making: Making, *, afresh: bool) -> None:
        self.folder, self._making = folder, making
        plan = {"run": "fleet", "identity": Identity.of(making.recipe).to_json(), "options": repr(making.options)}
        self._notes = RunFile(folder / NOTES, plan)
        self._made: dict[tuple[str, ...], Made] = {}
        self._noted_at, self._noting, self._unnoted = 0.0, 0.0, False
        self._read()
        if afresh:
            self.learned.clear()
        self.left: list[tuple[str, bool]] = []
        self.steps: deque[Step] = deque()
        self.waiting: deque[Step] = deque()
        for path in folder.iterdir():
            if path.suffix == ".part" and (path.is_symlink() or not path.is_file()):
                raise InputError(f"{path} is no file, and in the way of one that this run writes: move it away")
            if path.name.startswith("learned-") and path.suffix == ".partial":  # of a worker that died
                remove_tree(path)

    def _read(self) -> None:
        notes = self._notes.notes
        learned, problem = notes.get("learned", []), notes.get("range_problem")
        try:
            if not isinstance(learned, list) or not all(isinstance(source, str) for source in learned):
                raise TypeError(f"learned: {learned!r:.80}")
            if not isinstance(problem, str | None):
                raise TypeError(f"range_problem: {problem!r:.80}")
            for noted in notes.get("made", []):
                sources, made = tuple(noted["sources"]), Made.from_json(noted["made"])
                made.require(self.job(sources))
                self._made[sources] = made
        except (MismatchError, AttributeError, KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"expected what a run learned in {self._notes.path}; it cannot be read: {error!r:.200}. Move "
                f"{self.folder} away, and begin with add=True (--add): what the memory has it does not learn twice"
            ) from error
        self.learned: set[str] = set(learned)
        self.range_problem: str | None = problem

    def job(self, sources: tuple[str, ...]) -> LearnJob:
        """What a worker is handed over."""
        return LearnJob(self._making, sources, str(self.folder))

    def begin(self, found: Sequence[str]) -> list[Refused]:
        """Look at the sources that an earlier run did not learn; those that give no answer."""
        refused = []
        for source in found:
            if source in self.learned:
                continue
            try:
                self.left.append((source, is_memory(source, self._making.patience)))
            except TimeoutError as error:
                refused.append(Refused(source, f"it cannot be looked at: {error!s:.300}"))
        return refused

    def cut(self, workers: int) -> None:
        """Cut what is left into steps for so many workers; what an earlier run made of one stays one."""
        recordings = sum(not memory for _, memory in self.left)
        most = max(1, min(MOST_SOURCES, -(-recordings // (JOBS_A_WORKER * workers))))
        made = {sources[0]: sources for sources in self._made}
        names = [source for source, _ in self.left]
        group: list[str] = []
        place = size = 0
        while place < len(names):
            source, memory = self.left[place]
            whole = made.get(source, ())
            if whole != tuple(names[place : place + len(whole)]):
                whole = ()
            own = 0 if memory else _bytes_of(source)
            if group and (memory or whole or len(group) >= most or size + own > MOST_STEP_BYTES):
                self.steps.append(Step(tuple(group)))
                group, size = [], 0
            if whole:
                self.steps.append(Step(whole, made=self._made[whole]))
            elif memory:
                self.steps.append(Step((source,), memory=True))
            else:
                group.append(source)
                size += own
            place += max(1, len(whole))
        if group:
            self.steps.append(Step(tuple(group)))
        self.waiting = deque(step for step in self.steps if not step.memory and step.made is None)

    def learned_by(self, step: Step, made: Made) -> None:
        """Take note of what a worker made. Raises MismatchError for what it cannot have made."""
        if not isinstance(made, Made):
            raise MismatchError(f"expected what a job made; who runs the jobs gave {type(made).__name__}")
        made.require(self.job(step.sources))
        step.made = made
        self._made[step.sources] = made
        self._note()

    def came_in(self, step: Step) -> set[str]:
        """The first step is in the memory, durably; the sources of which all is."""
        assert self.steps.popleft() is step
        learned = set(step.sources) - step.failed
        self.learned |= learned
        made = self._made.pop(step.sources, None)
        if step.made is not None:
            self.range_problem = self.range_problem or step.made.range_problem
        self._note()
        if made is not None and made.path:
            Path(made.path).unlink(missing_ok=True)
        return learned

    def again(self, step: Step, tries: int) -> bool:
        """Have a step learned again, by halves where it has several sources; False where it was tried too often."""
        self._made.pop(step.sources, None)
        step.made = None
        if middle := len(step.sources) // 2:
            place, halves = self.steps.index(step), (Step(step.sources[:middle]), Step(step.sources[middle:]))
            del self.steps[place]
            for half in reversed(halves):
                self.steps.insert(place, half)
            self.waiting.extendleft(reversed(halves))
            return True
        step.tries += tries
        if step.tries < MOST_TRIES:
            self.waiting.appendleft(step)
        return step.tries < MOST_TRIES

    def _note(self, *, now: bool = False) -> None:
        """Note what was learned, unless that was just now: what a kill leaves unnoted is learned again, and once."""
        begun = time.monotonic()
        self._unnoted = True
        if not now and begun < self._noted_at + NOTING * self._noting:
            return
        self._notes.notes |= {
            "learned": sorted(self.learned),
            "made": [{"sources": sources, "made": asdict(made)} for sources, made in self._made.items()],
        }
        self._notes.note("range_problem", self.range_problem)
        self._noted_at = time.monotonic()
        self._noting, self._unnoted = self._noted_at - begun, False

    def leave(self) -> None:
        """Note what is not noted yet, however the run ends."""
        if self._unnoted:
            try:
                self._note(now=True)
            except InputError as error:
                logger.warning("%s", error)

    def end(self) -> None:
        """Note that all is learned, and remove what packed memories are left."""
        self._made, self.range_problem = {}, None
        self._note(now=True)
        for path in self.folder.iterdir():
            if path.name.startswith("learned-") and path.suffix in (".part", ".partial"):
                remove_tree(path)


def _bytes_of(source: str) -> int:
    path = Path(source)
    return path.stat().st_size if path.is_file() else 0
