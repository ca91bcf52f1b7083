"""Many recordings and memories become one memory, to the same bytes, whoever learns them and in how many processes.

Sources are cut into steps, in their order: some recordings, or a memory. A worker learns the recordings of a step by
the same loop as one process does, into a packed memory of its own; steps are merged one after another, as they come
up. With one process the loop writes into the memory itself. Sums of whole numbers are equal in any order, so the digest
is that of one process which observed each touch once, whatever the workers, their number and their ends.

Who runs the jobs is chosen by what is passed: processes on this machine, or a client of a cluster.
"""

from __future__ import annotations

import logging
import math
import os
import time
import warnings
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scroll_tactile.embeddings.protocol import Embedding
from scroll_tactile.errors import (
    CapacityError,
    InputError,
    MismatchError,
    ObservationError,
    RangeWarning,
    ScrollTactileError,
)
from scroll_tactile.learner import TactileLearner
from scroll_tactile.memory.identity import usual_embedding
from scroll_tactile.memory.merge import Choice, is_from
from scroll_tactile.pipelines.addresses import expand, is_memory
from scroll_tactile.pipelines.engines import Engine, engine
from scroll_tactile.pipelines.jobs import LearnJob, Made, Making, learn_job
from scroll_tactile.pipelines.learning import learn_sources
from scroll_tactile.pipelines.runfile import RunFile, alone_in
from scroll_tactile.pipelines.sources import Refused, SourceOptions, has_touches
from scroll_tactile.recordings.locations import local
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.copies import Augmented
from store import StoreError, StoreFullError

__all__ = ["FleetReport", "learn"]

logger = logging.getLogger(__name__)

JOBS_A_WORKER = 4  # at least, so that all have something to do to the end; a merge costs what 50 touches do
MOST_SOURCES = 1024  # of a job: what is lost with a worker
MOST_BYTES = 2**28  # of their files, where these are here
NOTES = "run.json"
TRIES = 20  # of a job of one source whose worker died: on a machine that kills a worker a second, nearly all end sooner
SLOW = 5  # tries that one counts for which took all the patience that there is
QUEUED = 2  # times its patience, and GRACE seconds: so long may a job be under way, for it may wait behind another, and
GRACE = 10.0  # a worker takes a moment to begin

Progress = Callable[[str, int, int], object]


@dataclass
class FleetReport:
    """What a run did.

    sources: how many were read, now or before the run was cut short. observations: touches that came in. repeated:
    those that had come before, by their names and contents. refused: what was not learned, and why; of touches that
    came under two names the first counts, of the destination and then of the sources in their order. deaths: jobs whose
    worker ended before them, or did not answer. seconds: of all, and of merging. processor: seconds of the workers,
    and of this process. held, digest: of the memory that came out. range_problem: where touches do not fit the
    sensor's range, what is wrong with the first, and what to do.
    """

    sources: int = 0
    observations: int = 0
    repeated: int = 0
    refused: list[Refused] = field(default_factory=list)
    deaths: int = 0
    seconds: float = 0.0
    merging: float = 0.0
    held: int = 0
    digest: str = ""
    range_problem: str | None = None
    processor: dict[str, float] = field(default_factory=lambda: {"learning": 0.0, "merging": 0.0})


def learn(
    destination: str | os.PathLike[str],
    sources: Sequence[str | os.PathLike[str]],
    options: SourceOptions | None = None,
    *,
    sensor: Sensor | None = None,
    embedding: Embedding | None = None,
    augmentation: Augmented | None = None,
    exemplars: int | None = None,
    recall: int | None = None,
    workers: int | None = None,
    client: Any = None,
    add: bool = False,
    descriptions: Choice = "same",
    patience: float | None = None,
    progress: Progress = lambda what, done, of: None,
) -> FleetReport:
    """Learn recordings and memories into the memory in folder `destination`, each touch once.

    sources: files, folders and addresses that fsspec knows, of recordings (as `recordings.read` takes them) and of
    memories, in folders or packed. options: how recordings are cut into touches and named.
    sensor, embedding, augmentation, exemplars, recall: of the memory, as of `TactileLearner`; an existing one knows.
    workers: processes on this machine; as many as it has cores unless given. With one, and no patience, this one
    learns. client: of a `dask.distributed` cluster,
    or anything whose `get_executor` gives an Executor, or an Executor; its workers must reach the folder beside
    the destination, where packed memories lie until they are merged.
    add: whether a destination that has touches of other sources is added to. descriptions: as of `merge`; the
    destination comes first, then the sources in their order. patience: seconds that a job, or a look at an address,
    may take before it is given up; an answer is waited for little more than twice as long, and from whoever gives none
    to any job the run ends. progress: called with (what is being done, sources done, sources in all).

    What is merged is durable, and a run that was cut short goes on where it was when it is called again. Sources that
    cannot be read are listed in the report, and so are those whose workers die again and again; all others are learned.
    Warns at the end, by a RangeWarning, where touches do not fit the sensor's range; they are learned all the same.

    Raises InputError where there is nothing to learn, or the destination was made from other sources; MismatchError
    for a destination of another sensor; CapacityError beyond what exact sums hold; LockedError while another fleet is
    at work for this destination; ScrollTactileError where nobody runs the jobs; StoreFullError and other StoreErrors:
    call again to go on.
    """
    begun = time.perf_counter()
    place = Path(destination).absolute()
    found, missing = expand([os.fspath(source) for source in sources], patience)
    report = FleetReport(refused=missing)
    settings: dict[str, Any] = {"augmentation": augmentation, "exemplars": exemplars, "recall": recall}
    folder = place.with_name(place.name + ".fleet")
    with ExitStack() as stack:
        stack.enter_context(alone_in(folder, place))
        held = None
        if place.exists():
            held = stack.enter_context(TactileLearner.open(place, sensor=sensor, embedding=embedding, **settings))
        making = _making(held, sensor, embedding, settings, options or SourceOptions(), patience)
        if held is not None and held.observations() and not (folder / NOTES).exists() and not add:
            raise InputError(
                f"{place} is there already, and not by a run of this kind: take another folder, or add=True to "
                "add to it"
            )
        into = _Destination(place, making, held, stack, report, descriptions)
        run = _Run(folder, making, report, into, progress)
        run.begin(found)
        if client is None and workers == 1 and patience is None:
            run.work_here()
        else:
            with engine(client, workers) as chosen:
                run.work(chosen)
        if into.learner is None:
            raise InputError(_nothing(report))
        report.held, report.digest = sum(into.learner.materials.values()), into.learner.digest()
        into.close()
        run.end()
    report.seconds = time.perf_counter() - begun
    if report.range_problem is not None:
        warnings.warn(report.range_problem, RangeWarning, stacklevel=2)
    return report


def _nothing(report: FleetReport) -> str:
    first = f", such as {report.refused[0].source}: {report.refused[0].why}" if report.refused else ""
    return f"nothing was learned, and no memory made: {len(report.refused)} sources were refused{first}"


def _making(
    held: TactileLearner | None,
    sensor: Sensor | None,
    embedding: Embedding | None,
    settings: Mapping[str, Any],
    options: SourceOptions,
    patience: float | None,
) -> Making:
    if held is not None:
        kept = held.settings
        return Making(held.sensor, held.embedding, held.augmentation, kept.exemplars, kept.recall, options, patience)
    if sensor is None:
        raise InputError("a new memory takes a sensor, sensor=: whose readings the sources are")
    chosen = usual_embedding(sensor) if embedding is None else embedding
    return Making(sensor, chosen, **settings, options=options, patience=patience)


class _Destination:
    """The memory that comes out: made when the first touches come in."""

    def __init__(
        self,
        place: Path,
        making: Making,
        learner: TactileLearner | None,
        stack: ExitStack,
        report: FleetReport,
        descriptions: Choice,
    ) -> None:
        self.learner, self._place, self._making, self._stack = learner, place, making, stack
        self._report, self._descriptions = report, descriptions
        if learner is not None:
            learner._ledger.saves = False

    def opened(self) -> TactileLearner:
        """The memory, made where there is none."""
        if self.learner is None:
            self.learner = self._stack.enter_context(self._making.open(self._place))
            self.learner._ledger.saves = False  # once, at the end: a checkpoint costs what 100 touches do
        return self.learner

    def merge(self, path: Path, source: str, progress: Progress) -> list[tuple[str, str]]:
        """Merge a memory, each touch once; what is refused, and why. Raises StoreError, MismatchError."""
        begun, processor = time.perf_counter(), time.process_time()
        try:
            merged, refused = self.opened()._ledger.merge_sources(path, self._descriptions, progress)
        finally:
            self._report.merging += time.perf_counter() - begun
            self._report.processor["merging"] += time.process_time() - processor
        self._report.observations += merged.observations
        self._report.repeated += merged.shared
        self._report.refused += [Refused(said, why) for said, why in refused]
        return refused

    def close(self) -> None:
        """Write a checkpoint, and close it."""
        if self.learner is not None:
            self.learner._ledger.saves = True
            self.learner.close()


@dataclass(eq=False)
class _Step:
    """Sources that come in together, in the order of the run: recordings, or one memory.

    path: the packed memory that a worker made of recordings, "" of no touch; None before. failed: sources of which
    something was not learned.
    """

    sources: tuple[str, ...]
    memory: bool = False
    path: str | None = None
    failed: set[str] = field(default_factory=set)
    tries: int = 0


class _Run:
    """One run: its steps in order, what was done, and the folder where packed memories lie until they are merged."""

    def __init__(
        self, folder: Path, making: Making, report: FleetReport, into: _Destination, progress: Progress
    ) -> None:
        self.folder, self.making, self.report, self.into, self._progress = folder, making, report, into, progress
        plan = {"run": "fleet", "identity": making.identity.to_json(), "options": repr(making.options)}
        self._notes = RunFile(folder / NOTES, plan)
        self._begun = time.perf_counter()
        self._answered = -math.inf
        self._learned, self._parts = self._noted()
        self._steps: deque[_Step] = deque()
        self._waiting: deque[_Step] = deque()

    def _noted(self) -> tuple[set[str], dict[str, Any]]:
        """The sources that were learned, and of each packed memory that lies in the folder its sources."""
        learned, parts = self._notes.notes.get("learned", []), self._notes.notes.get("parts", {})
        sound = isinstance(learned, list) and all(isinstance(source, str) for source in learned)
        if not sound or not isinstance(parts, dict) or not all(map(_is_noted, parts.values())):
            raise InputError(
                f"expected what a run learned in {self.folder / NOTES}; it is {learned!r:.80}, {parts!r:.80}"
            )
        return set(learned), parts

    def begin(self, found: Sequence[str]) -> None:
        """Cut what an earlier run did not learn into steps."""
        self.report.sources = len(self._learned & set(found))
        self._total, self._left = len(found), list[tuple[str, bool]]()
        for source in found:
            if source in self._learned:
                continue
            try:
                self._left.append((source, is_memory(source, self.making.patience)))
            except TimeoutError as error:
                self.report.refused.append(Refused(source, f"it cannot be looked at: {error!s:.300}"))

    def _cut(self, workers: int) -> None:
        recordings = sum(not memory for _, memory in self._left)
        most = max(1, min(MOST_SOURCES, -(-recordings // (JOBS_A_WORKER * workers))))
        there = {part["sources"][0]: self._step_of(name) for name, part in self._parts.items()}
        group: list[str] = []
        place = size = 0
        while place < len(self._left):
            source, memory = self._left[place]
            own = 0 if memory else _bytes_of(source)
            made = there.get(source)
            whole = made is not None and made.sources == tuple(
                each for each, _ in self._left[place:][: len(made.sources)]
            )
            if group and (memory or whole or len(group) >= most or size + own > MOST_BYTES):
                self._steps.append(_Step(tuple(group)))
                group, size = [], 0
            if made is not None and whole:
                self._steps.append(made)
                place += len(made.sources)
                continue
            if memory:
                self._steps.append(_Step((source,), memory=True))
            else:
                group.append(source)
                size += own
            place += 1
        if group:
            self._steps.append(_Step(tuple(group)))
        self._waiting = deque(step for step in self._steps if not step.memory and step.path is None)

    def _step_of(self, name: str) -> _Step:
        """The step whose packed memory an earlier run left; it is verified when it is merged."""
        path, part = self.folder / name, self._parts[name]
        made = str(path) if path.is_file() and path.name == name else None
        return _Step(tuple(part["sources"]), path=made, failed=set(part["failed"]))

    def work_here(self) -> None:
        """Have all steps learned by this process, into the memory itself."""
        self._cut(1)
        while self._steps:
            step = self._steps[0]
            if not step.memory and step.path is None:
                self._learn_here(step)
            self._come_in()

    def _learn_here(self, step: _Step) -> None:
        making = self.making
        if self.into.learner is None and not has_touches(making.sensor, step.sources, making.options):
            learner = TactileLearner(sensor=making.sensor, embedding=making.embedding)  # for what is refused
        else:
            learner = self.into.opened()
        done = learn_sources(learner, step.sources, making.options, self._telling)
        step.path, step.failed = "", done.failed
        self.report.observations += done.learned.total()
        self.report.repeated += done.skipped
        self.report.refused += done.refused

    def work(self, engine: Engine) -> None:
        """Have all steps learned, and merge them in their order."""
        self._cut(engine.workers)
        running: dict[Future[Made], tuple[_Step, float]] = {}
        try:
            while self._steps:
                while self._waiting and len(running) < engine.room:
                    step = self._waiting.popleft()
                    job = LearnJob(self.making, step.sources, str(self.folder))
                    running[engine.submit(learn_job, job)] = step, time.monotonic()
                if self._come_in():
                    continue
                for future in wait(running, self._longest(running), FIRST_COMPLETED).done:
                    self._answered = time.monotonic()
                    self._done(future, *running.pop(future))
                self._give_up(engine, running)
        except BaseException:
            for future in running:
                future.cancel()
            raise

    def _come_in(self) -> bool:
        """Merge the first step, where it is ready; whether it was."""
        step = self._steps[0]
        if not step.memory and step.path is None:
            return False
        if step.memory:
            self._merge_memory(step)
        elif step.path and not self._merge_learned(step, Path(step.path)):
            return True  # it is learned again
        self._steps.popleft()
        learned = set(step.sources) - step.failed
        self._learned |= learned
        self.report.sources += len(learned)
        self._notes.note("learned", sorted(self._learned))
        if step.path and not step.memory:
            self._parts.pop(Path(step.path).name, None)
            Path(step.path).unlink(missing_ok=True)
        self._tell()
        return True

    def _merge_learned(self, step: _Step, path: Path) -> bool:
        try:
            refused = self.into.merge(path, path.name, self._telling)
        except (StoreError, MismatchError) as error:
            if isinstance(error, StoreFullError) or not _is_about(error, path):
                raise
            logger.warning("%s; its sources are learned again", error)
            step.path = None
            self._parts.pop(path.name, None)
            self._lost(step, 1, error)
            return False
        step.failed |= {source for source in step.sources if any(is_from(said, source) for said, _ in refused)}
        return True

    def _merge_memory(self, step: _Step) -> None:
        (source,) = step.sources
        try:
            with local(source) as place:
                refused = self.into.merge(place, source, self._telling)
                step.failed |= {source} if refused else set()
        except StoreFullError:
            raise
        except (ScrollTactileError, StoreError, OSError) as error:
            if isinstance(error, MismatchError | ObservationError | OSError) or _is_about(error, Path(source)):
                self.report.refused.append(Refused(source, str(error)))
                step.failed.add(source)
                return
            raise

    def _telling(self, what: str, done: int, of: int) -> None:
        self._progress(f"{what} {done} of {of} touches", self.report.sources, self._total)

    def _tell(self) -> None:
        seconds = time.perf_counter() - self._begun
        count, done = self.report.observations, self.report.sources + len(self.report.refused)
        left = f", {seconds / done * (self._total - done):.0f} s left" if 0 < done <= self._total else ""
        failed = f", {len(self.report.refused)} refused" if self.report.refused else ""
        self._progress(f"{count} touches, {count / seconds:.0f} a second{left}{failed}", done, self._total)

    @property
    def _bound(self) -> float:
        """Seconds in which a job that was handed over is answered."""
        patience = self.making.patience
        return math.inf if patience is None else QUEUED * patience + GRACE

    def _longest(self, running: Mapping[Future[Made], tuple[_Step, float]]) -> float | None:
        """Seconds until the first of these jobs is given up; None where nobody has a patience."""
        if math.isinf(self._bound) or not running:
            return None
        return max(0.0, min(begun for _, begun in running.values()) + self._bound - time.monotonic())

    def _give_up(self, engine: Engine, running: dict[Future[Made], tuple[_Step, float]]) -> None:
        """Hand jobs over again that nobody answers. Raises ScrollTactileError where nobody answers any."""
        before = time.monotonic() - self._bound
        late = [future for future, (_, begun) in running.items() if begun <= before and not future.done()]
        if late and not engine.own and len(late) == len(running) and self._answered <= before:
            raise ScrollTactileError(
                f"{engine.name} has answered no job for {self._bound:.0f} s: look whether it has workers, and whether "
                f"they reach {self.folder}. What was learned is kept there: call again to go on"
            )
        for future in late:
            step, _ = running.pop(future)
            engine.abandon(future)
            self._lost(step, SLOW, TimeoutError(f"no answer in {self._bound:.0f} s"))

    def _done(self, future: Future[Made], step: _Step, begun: float) -> None:
        job = LearnJob(self.making, step.sources, str(self.folder))
        try:
            made = _sound(future.result(), job)
        except (CapacityError, StoreFullError, KeyboardInterrupt):
            raise
        except Exception as error:
            patience = self.making.patience
            slow = patience is not None and time.monotonic() - begun >= patience
            self._lost(step, SLOW if slow else 1, error)
            return
        step.path, step.failed = made.path, set(made.failed)
        self.report.processor["learning"] += made.processor
        self.report.refused += made.refused
        self.report.repeated += made.repeated
        self.report.range_problem = self.report.range_problem or made.range_problem
        if made.path:
            self._parts[Path(made.path).name] = {"sources": list(step.sources), "failed": sorted(step.failed)}
            self._notes.note("parts", self._parts)

    def _lost(self, step: _Step, tries: int, error: Exception) -> None:
        """A job ended without its memory: again, by halves, and in the end without the source that ends workers."""
        self.report.deaths += 1
        logger.info("a job of %s ended: %s: %s", self.making.sensor.name, type(error).__name__, error)
        job, place = LearnJob(self.making, step.sources, str(self.folder)), self._steps.index(step)
        if halves := job.halves():
            steps = [_Step(half.sources) for half in halves]
            del self._steps[place]
            for half in reversed(steps):
                self._steps.insert(place, half)
                self._waiting.appendleft(half)
        elif (tries := step.tries + tries) < TRIES:
            step.tries = tries
            self._waiting.appendleft(step)
        else:
            last = f"{type(error).__name__}: {error!s:.200}"
            why = f"workers ended while they learned it, again and again; the last: {last}"
            self.report.refused.append(Refused(step.sources[0], why))
            step.path, step.failed = "", set(step.sources)

    def end(self) -> None:
        """Remove what packed memories are left, and what is noted of them."""
        self._notes.note("parts", {})
        for path in self.folder.iterdir():
            if path.suffix == ".part" and path.is_file():
                path.unlink()


def _sound(made: object, job: LearnJob) -> Made:
    """What a job gave back, as far as nobody but its worker can know it. Raises MismatchError for anything else."""
    if not isinstance(made, Made):
        raise MismatchError(f"expected what a job made; who runs the jobs gave {type(made).__name__}")
    if made.path not in (str(job.target), "") or (made.path and not job.target.is_file()):
        raise MismatchError(f"expected the packed memory of a job in {job.target}; came {made.path!r:.200}")
    refused = isinstance(made.refused, list) and all(isinstance(each, Refused) for each in made.refused)
    failed = isinstance(made.failed, set) and made.failed <= set(job.sources)
    numbers = isinstance(made.processor, float) and isinstance(made.repeated, int)
    if not refused or not failed or not numbers or not isinstance(made.range_problem, str | None):
        raise MismatchError(f"expected what a job refused, and what it took; came {made!r:.200}")
    return made


def _is_noted(part: Any) -> bool:
    """Whether this is what a run notes of a packed memory."""
    lists = [part.get(name) for name in ("sources", "failed")] if isinstance(part, dict) else [None]
    texts = all(isinstance(found, list) and all(isinstance(each, str) for each in found) for found in lists)
    return texts and len(lists) == 2 and bool(lists[0])


def _is_about(error: Exception, path: Path) -> bool:
    """Whether an error is about what lies at a path, and not about the memory that it is merged into."""
    where = getattr(error, "path", None)
    return isinstance(where, Path) and (where == path or path in where.parents)


def _bytes_of(source: str) -> int:
    return Path(source).stat().st_size if Path(source).exists() else 0
