"""The steps of a fleet's run, in order, and the jobs that its workers do: some sources, which become a packed memory.

Here is how sources are cut into steps, what a worker makes of one, what is noted of it, and what a run before left.
"""

from __future__ import annotations

import faulthandler
import hashlib
import json
import os
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from scroll_tactile_store.archive import write_archive
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

JOBS_A_WORKER = 4  # at least, so that all have something to do to the end; a merge costs what 50 touches do
MOST_SOURCES = 1024  # of a step: what is lost with a worker
MOST_STEP_BYTES = 2**28  # of their files, where these are here
NOTES = "run.json"
MOST_TRIES = 20  # of a job of one source whose worker died: where one dies each second, nearly all end sooner
NOTING = 20  # times as long as noting took, nothing is noted again: of a million sources it takes seconds


@dataclass(frozen=True)
class Making:
    """What all memories of a run are made with, and how sources are read.

    patience: seconds for a job; None: any. quantities: that the memory which comes out has.
    """

    recipe: Recipe
    options: SourceOptions
    patience: float | None = None
    quantities: tuple[Quantity, ...] = ()


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

    rows: of each source of the job how many touches it has, which
    follow each other in it. repeated: how many others came twice under one name. refused: what was not learned, and
    why; failed: the sources of that. clipped: in hexadecimal the contents of touches all of whose values lay outside
    the sensor's range. range_problem: of the first touch that does not fit it. processor: seconds that it took.
    """

    path: str
    rows: list[int] = field(default_factory=list)
    repeated: int = 0
    refused: list[Refused] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    clipped: list[str] = field(default_factory=list)
    range_problem: str | None = None
    processor: float = 0.0

    @classmethod
    def from_json(cls, noted: Any) -> Made:
        """What was noted; raises TypeError or KeyError for anything else."""
        refused = [Refused(each["source"], each["why"], each["argument"]) for each in noted["refused"]]
        return cls(**{**noted, "refused": refused})


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
        with TactileLearner.open(place, **job.making.recipe.arguments) as learner:
            hush(learner)
            for quantity in job.making.quantities:
                learner.declare(quantity)
            done = learn_sources(learner, job.sources, job.making.options, every=True)
            learner._ledger.saves = True  # it is merged by its checkpoint
        if done.learned:
            write_archive(place, job.target)
    return Made(
        path=str(job.target) if done.learned else "",
        rows=[done.rows[source] for source in job.sources],
        repeated=done.skipped,
        refused=done.refused,
        failed=sorted(done.failed),
        clipped=sorted(content.hex() for content in done.clipped),
        range_problem=done.range_problem,
        processor=time.process_time() - begun,
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


class Steps:
    """The steps of a run that are still to come in, in order, and the notes beside their packed memories.

    folder: of the run. afresh: whether nothing of what was learned is there any more. learned: sources of which all has
    come in. waiting: steps that a worker is to learn. range_problem: of the first touch that has one.

    Raises InputError for notes of another run, or damaged ones.
    """

    def __init__(self, folder: Path, making: Making, *, afresh: bool) -> None:
        self.folder, self._making = folder, making
        plan = {"run": "fleet", "identity": Identity.of(making.recipe).to_json(), "options": repr(making.options)}
        self._notes = RunFile(folder / NOTES, plan)
        self._noted_at, self._noting, self._unnoted = 0.0, 0.0, False
        notes = self._notes.notes
        self.range_problem: str | None = notes.get("range_problem")
        try:
            self.learned: set[str] = set() if afresh else set(notes.get("learned", []))
            made = notes.get("made", [])
            self._made = {tuple(noted["sources"]): Made.from_json(noted["made"]) for noted in made}
        except (KeyError, TypeError) as error:
            raise InputError(
                f"expected what a run learned in {self._notes.path}; it cannot be read: {error!r:.200}. Move "
                f"{self.folder} away, and begin with add=True (--add): what the memory has it does not learn twice"
            ) from error
        self.left: list[tuple[str, bool]] = []
        self.steps: list[Step] = []
        self.waiting: deque[Step] = deque()
        for path in folder.iterdir():
            if path.name.startswith("learned-") and path.suffix == ".partial":  # of a worker that died
                remove_tree(path)

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
            own = 0 if memory or not Path(source).is_file() else Path(source).stat().st_size
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
        """Take note of what a worker made. Raises MismatchError where that is no answer of a job."""
        if not isinstance(made, Made):
            raise MismatchError(f"expected what a job made; who runs the jobs gave {type(made).__name__}")
        step.made = made
        self._made[step.sources] = made
        self._note()

    def came_in(self, step: Step) -> set[str]:
        """The first step is in the memory, durably; the sources of which all is."""
        self.steps.remove(step)
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
            self.steps[place : place + 1] = halves
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
            with suppress(InputError):  # what is not noted is learned again, and once
                self._note(now=True)

    def end(self) -> None:
        """Note that all is learned, and remove what packed memories are left."""
        self._made, self.range_problem = {}, None
        self._note(now=True)
        for path in self.folder.iterdir():
            if path.name.startswith("learned-") and path.suffix in (".part", ".partial"):
                remove_tree(path)
