"""A fleet's memory: many recordings and memories, learned by many workers, become one, to the same bytes.

Each worker learns some sources into a partial memory, a file; partials are summed up at the workers, as a tree; their
touches and the sum of all become one memory in a folder. Sums of whole numbers are equal in any order, so the digest
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
from pathlib import Path
from typing import Any

from scroll_tactile.embeddings.protocol import Embedding
from scroll_tactile.errors import CapacityError, InputError, MismatchError, RangeWarning, ScrollTactileError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.memory.identity import usual_embedding
from scroll_tactile.memory.merge import Choice
from scroll_tactile.pipelines.addresses import expand, is_memory
from scroll_tactile.pipelines.choosing import Part
from scroll_tactile.pipelines.engines import Engine, engine
from scroll_tactile.pipelines.gathering import FleetReport, Gathering
from scroll_tactile.pipelines.partials import (
    Contained,
    LearnJob,
    Made,
    Making,
    SumJob,
    learn_partial,
    packed_path,
    sum_partials,
)
from scroll_tactile.pipelines.runfile import RunFile, alone_in
from scroll_tactile.pipelines.sources import Refused, SourceOptions
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.copies import Augmented
from store import StoreError, StoreFullError

__all__ = ["FleetReport", "learn"]

logger = logging.getLogger(__name__)

FAN = 16  # partials that are summed up by one job
MOST_SOURCES = 1024  # of a job: of touches of 6 ms so many cost thirty times what writing and adding their sums does
MOST_BYTES = 2**26  # of their files, where these are here
JOBS_A_WORKER = 4  # at least, so that all have something to do to the end
NOTES = "run.json"
PARTS = (".part", ".partial")
TRIES = 20  # of a job of one source whose worker died: on a machine that kills a worker a second, nearly all end sooner
SLOW = 5  # tries that one counts for which took all the patience that there is
QUEUED = 2  # times its patience, and GRACE seconds: so long may a job be under way, for it may wait behind another, and
GRACE = 10.0  # a worker takes a moment to begin

Progress = Callable[[str, int, int], object]


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
    fan: int = FAN,
    progress: Progress = lambda what, done, of: None,
) -> FleetReport:
    """Learn recordings and memories into the memory in folder `destination`, each touch once; durable at the end.

    sources: files, folders and addresses that fsspec knows, of recordings (as `recordings.read` takes them) and of
    memories, in folders or packed. options: how recordings are cut into touches and named.
    sensor, embedding, augmentation, exemplars, recall: of the memory, as of `TactileLearner`; an existing one knows.
    workers: processes on this machine; as many as it has cores unless given. client: of a `dask.distributed` cluster,
    or anything whose `get_executor` gives an Executor, or an Executor; its workers must reach the folder beside
    the destination, where partials lie meanwhile.
    add: whether a destination that has touches of other sources is added to. descriptions: as of `merge`; the
    destination comes first, then the sources in their order. patience: seconds that a job, or a look at an address,
    may take before it is given up; an answer is waited for little more than twice as long, and from whoever gives none
    to any job the run ends. fan: how many partials are summed up at once. progress: called with (what is being done,
    sources done, sources in all).

    A run that was cut short goes on where it was when it is called again. Sources that cannot be read are listed in
    the report, and so are those whose workers die again and again; all others are learned. Warns at the end, by a
    RangeWarning, where touches do not fit the sensor's range; they are learned all the same.

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
    with ExitStack() as stack:
        stack.enter_context(alone_in(_folder_of(place), place))
        held = None
        if place.exists():
            held = stack.enter_context(TactileLearner.open(place, sensor=sensor, embedding=embedding, **settings))
        making = _making(held, sensor, embedding, settings, options or SourceOptions(), patience)
        folder = _folder_of(place)
        if held is not None and held.observations() and not (folder / NOTES).exists() and not add:
            raise InputError(
                f"{place} is there already, and not by a run of this kind: take another folder, or add=True to "
                "add to it"
            )
        run = _Run(folder, making, report, fan, progress)
        run.begin(found)
        with engine(client, workers) as chosen:
            sums = run.work(chosen)
        if held is None:
            if sums is None and not run.whole:
                raise InputError(_nothing(report))
            held = TactileLearner.open(place, sensor=making.sensor, embedding=making.embedding, **settings)
            stack.enter_context(held)
        run.merge(held, sums, descriptions)
        report.held, report.digest = sum(held.materials.values()), held.digest()
        held.close()
        run.end()
    report.seconds = time.perf_counter() - begun
    if report.range_problem is not None:
        warnings.warn(report.range_problem, RangeWarning, stacklevel=2)
    return report


def _folder_of(place: Path) -> Path:
    return place.with_name(place.name + ".fleet")


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


class _Run:
    """One run: what is to be done, what was done, and the folder where partials lie until they are merged."""

    def __init__(self, folder: Path, making: Making, report: FleetReport, fan: int, progress: Progress) -> None:
        self.folder, self.making, self.report = folder, making, report
        self._fan, self._progress = fan, progress
        plan = {"run": "fleet", "identity": making.identity.to_json(), "options": repr(making.options)}
        self._notes = RunFile(folder / NOTES, plan)
        self._waiting: deque[tuple[LearnJob | SumJob, int]] = deque()
        self._order: dict[str, int] = {}
        self._seen: set[tuple[str, bytes]] = set()
        self._parts: list[Part] = []
        self._ready: list[tuple[str, tuple[int, ...]]] = []
        self._sums = 0
        self._outdated = 0  # sums up to this one are of partials that were not what they seemed
        self._begun = time.perf_counter()
        self._answered = -math.inf
        noted = self._notes.notes.get("learned", [])
        if not isinstance(noted, list) or not all(isinstance(source, str) for source in noted):
            raise InputError(f"expected the sources that a run learned in {folder / NOTES}; they are {noted!r:.80}")
        self._learned: set[str] = set(noted)
        self.whole: list[Contained] = []

    def begin(self, found: Sequence[str]) -> None:
        """Take what an earlier run left behind, and cut the rest into jobs."""
        self._order = {source: place for place, source in enumerate(found)}
        learned = self._learned
        for path in sorted(self.folder.iterdir()):
            if path.suffix not in PARTS:
                continue
            if not path.is_file():
                raise InputError(f"{path} is no file, and in the way of one that this run writes: move it away")
            if not path.name.startswith("learned-"):
                continue
            try:
                held = Contained.of(path, self.making, thorough=True)
            except (StoreError, ScrollTactileError) as error:
                logger.warning("%s; its sources are learned again", error)
                continue
            if learned.isdisjoint(held.learned) and set(held.sources) <= set(found):
                self._take(held)
        self.report.sources = len(learned & set(found))
        self._total = len(found)
        left = [source for source in found if source not in learned]
        self._left = []
        for source in left:
            try:
                if is_memory(source, self.making.patience):
                    self._waiting.append((self._job((source,), memory=True), 0))
                else:
                    self._left.append(source)
            except TimeoutError as error:
                self.report.refused.append(Refused(source, f"it cannot be looked at: {error!s:.300}"))

    def _job(self, sources: Sequence[str], *, memory: bool = False) -> LearnJob:
        return LearnJob(self.making, tuple(sources), str(self.folder), memory)

    def _cut(self, workers: int) -> None:
        """Cut the recordings that are left into jobs."""
        most = max(1, min(MOST_SOURCES, -(-len(self._left) // (JOBS_A_WORKER * workers))))
        group: list[str] = []
        size = 0
        for source in self._left:
            own = _bytes_of(source)
            if group and (len(group) >= most or size + own > MOST_BYTES):
                self._waiting.append((self._job(group), 0))
                group, size = [], 0
            group.append(source)
            size += own
        if group:
            self._waiting.append((self._job(group), 0))

    def work(self, engine: Engine) -> str | None:
        """Have all jobs done; returns the sum of all partials with rows."""
        self._cut(engine.workers)
        running: dict[Future[Made], tuple[LearnJob | SumJob, int, float]] = {}
        try:
            while self._waiting or running or len(self._ready) > 1 or self._alone():
                self._sum_up(idle=not self._waiting and not running)
                while self._waiting and len(running) < engine.room:
                    job, tries = self._waiting.popleft()
                    what = learn_partial if isinstance(job, LearnJob) else sum_partials
                    running[engine.submit(what, job)] = job, tries, time.monotonic()
                for future in wait(running, self._longest(running), FIRST_COMPLETED).done:
                    self._answered = time.monotonic()
                    self._done(future, *running.pop(future))
                self._give_up(engine, running)
        except BaseException:
            for future in running:
                future.cancel()
            raise
        return self._ready[0][0] if self._ready else None

    @property
    def _bound(self) -> float:
        """Seconds in which a job that was handed over is answered."""
        patience = self.making.patience
        return math.inf if patience is None else QUEUED * patience + GRACE

    def _longest(self, running: Mapping[Future[Made], tuple[LearnJob | SumJob, int, float]]) -> float | None:
        """Seconds until the first of these jobs is given up; None where nobody has a patience."""
        if math.isinf(self._bound) or not running:
            return None
        return max(0.0, min(begun for *_, begun in running.values()) + self._bound - time.monotonic())

    def _give_up(self, engine: Engine, running: dict[Future[Made], tuple[LearnJob | SumJob, int, float]]) -> None:
        """Hand jobs over again that nobody answers. Raises ScrollTactileError where nobody answers any."""
        before = time.monotonic() - self._bound
        late = [future for future, (*_, begun) in running.items() if begun <= before and not future.done()]
        if late and not engine.own and len(late) == len(running) and self._answered <= before:
            raise ScrollTactileError(
                f"{engine.name} has answered no job for {self._bound:.0f} s: look whether it has workers, and whether "
                f"they reach {self.folder}. What was learned is kept there: call again to go on"
            )
        for future in late:
            job, tries, _ = running.pop(future)
            engine.abandon(future)
            self._lost(job, tries + SLOW, TimeoutError(f"no answer in {self._bound:.0f} s"))

    def _alone(self) -> bool:
        """Whether the one partial that is left has touches to be left out, and is no sum yet."""
        return len(self._ready) == 1 and bool(self._ready[0][1])

    def _sum_up(self, idle: bool) -> None:
        """Have partials summed up where there are enough of them, or nothing else is to be done."""
        while len(self._ready) >= self._fan or (idle and (len(self._ready) > 1 or self._alone())):
            parts, self._ready = self._ready[: self._fan], self._ready[self._fan :]
            self._sums += 1
            target = self.folder / f"sum-{os.getpid()}-{self._sums}.part"
            self._waiting.appendleft((SumJob(self.making, tuple(parts), str(target), self._sums), 0))

    def _done(self, future: Future[Made], job: LearnJob | SumJob, tries: int, begun: float) -> None:
        try:
            made = _sound(future.result(), job)
            held = self._held_by(job, made) if isinstance(job, LearnJob) and made.path else None
        except (CapacityError, StoreFullError, KeyboardInterrupt):
            raise
        except Exception as error:
            patience = self.making.patience
            slow = patience is not None and time.monotonic() - begun >= patience
            self._lost(job, tries + (SLOW if slow else 1), error)
            return
        if isinstance(job, SumJob):
            self._summed(job, made)
            return
        self.report.processor["learning"] += made.processor
        self.report.refused += made.refused
        if held is not None:
            self.report.sources += len(held.learned)
            self._take(held)
        seconds = time.perf_counter() - self._begun
        count, done = len(self._seen), self.report.sources + len(self.report.refused)
        left = f", {seconds / done * (self._total - done):.0f} s left" if 0 < done <= self._total else ""
        failed = f", {len(self.report.refused)} refused" if self.report.refused else ""
        self._progress(f"{count} touches, {count / seconds:.0f} a second{left}{failed}", done, self._total)

    def _held_by(self, job: LearnJob, made: Made) -> Contained:
        """What is in the partial that a job made. Raises StoreError, MismatchError where it is not that of the job."""
        held = Contained.of(Path(made.path), self.making, job.sources[0] if job.memory else None)
        if held.sources != job.sources:
            raise MismatchError(f"{made.path} is of other sources than those of its job")
        return held

    def _take(self, held: Contained) -> None:
        """Take a partial in: of touches that came before, under their names, the sums have the first."""
        self._learned.update(held.learned)
        if not held.has_rows:
            self.whole.append(held)
            return
        out = set()
        for number, touch in enumerate(held.touches, start=1):
            if touch in self._seen:
                out.add(number)
            self._seen.add(touch)
        part = Part(held, frozenset(out))
        self._parts.append(part)
        if held.touches:
            self._ready.append(part.summed)

    def _lost(self, job: LearnJob | SumJob, tries: int, error: Exception) -> None:
        """A job ended without its partial: again, by halves, and in the end without the source that ends workers."""
        self.report.deaths += 1
        logger.info("a job of %s ended: %s: %s", job.making.sensor.name, type(error).__name__, error)
        if isinstance(job, SumJob) and (
            job.number <= self._outdated or (isinstance(error, StoreError | MismatchError) and self._learn_again())
        ):
            return
        if halves := job.halves():
            self._waiting.extendleft((half, 0) for half in halves)
        elif tries < TRIES:
            self._waiting.appendleft((job, tries))
        elif isinstance(job, LearnJob):
            last = f"{type(error).__name__}: {error!s:.200}"
            why = f"workers ended while they learned it, again and again; the last: {last}"
            self.report.refused.append(Refused(job.sources[0], why))
        else:  # nobody's data but ours: what is wrong with it is raised here
            self._summed(job, sum_partials(job))

    def _learn_again(self) -> bool:
        """Have the sources of partials learned again that are not what they seemed; whether there are any."""
        sound, spoilt = [], []
        for part in self._parts:
            address = part.held.sources[0] if part.held.memory else None
            try:
                sound.append(Contained.of(Path(part.held.path), self.making, address, thorough=True))
            except (StoreError, MismatchError) as error:
                logger.warning("%s; its sources are learned again", error)
                spoilt.append(part.held)
        if not spoilt:
            return False
        # All sums are begun anew: a touch that is left out of one partial may have been in another.
        self._outdated = self._sums
        self._waiting = deque((job, tries) for job, tries in self._waiting if isinstance(job, LearnJob))
        self._seen, self._parts, self._ready = set(), [], []
        for held in sound:
            self._take(held)
        for held in spoilt:
            self._learned.difference_update(held.learned)
            self.report.sources -= len(held.learned)
            self._waiting.append((self._job(held.sources, memory=held.memory), 0))
        return True

    def _summed(self, job: SumJob, made: Made) -> None:
        self.report.processor["sums"] += made.processor
        if job.number > self._outdated:
            self._ready.append((made.path, ()))
        for path, _ in job.parts:
            if Path(path).name.startswith("sum-"):
                Path(path).unlink(missing_ok=True)

    def merge(self, held: TactileLearner, sums: str | None, descriptions: Choice) -> None:
        """Put everything into the memory; what is there already is left out."""

        def progress(what: str, done: int, of: int) -> None:
            self._progress(f"{what} {done} of {of} touches", self._total, self._total)

        gathering = Gathering(self.folder, self.making, self.report, self._order, progress)
        gathering.merge(held, [part.held for part in self._parts], sums, self.whole, descriptions)
        self._learned -= gathering.refused

    def end(self) -> None:
        """Note what was learned, and remove the partials."""
        self._notes.note("learned", sorted(self._learned))
        for path in self.folder.iterdir():
            if path.suffix in PARTS and path.is_file():
                path.unlink()


def _sound(made: object, job: LearnJob | SumJob) -> Made:
    """What a job gave back, as far as nobody but its worker can know it. Raises MismatchError for anything else."""
    if not isinstance(made, Made):
        raise MismatchError(f"expected what a job made; who runs the jobs gave {type(made).__name__}")
    own = {str(job.target)}
    if isinstance(job, LearnJob) and job.memory:
        own = {str(packed_path(job)), str(Path(job.sources[0])), ""}
    if made.path not in own:
        raise MismatchError(f"expected the partial of a job in one of {sorted(own)}; came {made.path!r:.200}")
    refused = isinstance(made.refused, list) and all(isinstance(each, Refused) for each in made.refused)
    if not refused or not isinstance(made.processor, float) or (not made.path and not made.refused):
        raise MismatchError(f"expected what a job refused, and what it took; came {made!r:.200}")
    return made


def _bytes_of(source: str) -> int:
    return Path(source).stat().st_size if Path(source).exists() else 0
