"""Many recordings and memories become one memory, to the same bytes, whoever learns them and in how many processes.

Sources are cut into steps, in their order: some recordings, or a memory (see `steps`). A worker learns the recordings
of a step by the same loop as one process does, into a packed memory of its own; steps are merged one after
another, in order. With one process the loop writes into the memory itself. Sums of whole numbers are equal in any
order, so the digest is that of one process which observed each touch once, whatever the workers, their number and their
ends.

Who runs the jobs is chosen by what is passed: processes on this machine, or a client of a cluster.
"""

from __future__ import annotations

import logging
import math
import os
import threading
import time
import warnings
from bisect import bisect_left
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from itertools import accumulate
from multiprocessing import get_all_start_methods, get_context, parent_process
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from typing import Any

from scroll_tactile_store import DamageError, Head, NotAStoreError, StoreError, StoreFullError, VersionError
from scroll_tactile_store.files import remove_tree

from scroll_tactile.clients.learning.learning import learn_sources
from scroll_tactile.clients.learning.runfile import alone_in
from scroll_tactile.clients.learning.sources import (
    Refused,
    SourceOptions,
    fetched,
    find_sources,
    stored_source,
)
from scroll_tactile.clients.learning.steps import NOTES, LearnJob, Made, Making, Step, Steps, hush, learn_job
from scroll_tactile.embeddings.protocol import Embedding
from scroll_tactile.errors import CapacityError, InputError, MismatchError, RangeWarning, ScrollTactileError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.memory.touch_rows import SOURCE
from scroll_tactile.persistence.merge import Choice, MergeRules
from scroll_tactile.quantities import require_declarable
from scroll_tactile.recipe import RecipeRequest
from scroll_tactile.sensors import Sensor

__all__ = ["FleetReport", "learn"]

logger = logging.getLogger(__name__)

SLOW = 5  # tries that one counts for which took all the patience that there is
QUEUED = 2  # times its patience, and GRACE seconds: so long may a job be under way, for it may wait behind another, and
GRACE = 10.0  # a worker takes a moment to begin
SAVED_EVERY = 4096  # touches: what opening replays where a run was cut short; a checkpoint costs what 100 do
STARTS = 5  # of a worker: what starts it may have been killed as well, and takes a moment to be noticed
PAUSE = 0.1

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
    exemplars: int | None = None,
    kept_touches: int | None = None,
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
    sensor, embedding, exemplars, kept_touches: of the memory, as of `TactileLearner`; an existing one knows.
    workers: processes on this machine; as many as it has cores unless given. With one, and no patience, this one
    learns. client: of a `dask.distributed` cluster, or anything whose `get_executor` gives an Executor, or an Executor;
    its workers must reach the folder beside the destination, where packed memories lie until they are merged.
    add: whether a destination that has touches of other sources is added to. descriptions: as of `merge`; the
    destination comes first, then the sources in their order. patience: seconds that a job, or a look at an address,
    may take before it is given up; an answer is waited for little more than twice as long, and from whoever gives none
    to any job the run ends. progress: called with (what is being done, sources done, sources in all).

    What is merged is durable, and a run that was cut short goes on where it was when it is called again. Sources that
    cannot be read are listed in the report, and so are those whose workers die again and again; all others are learned.
    Warns at the end, by a RangeWarning, where touches do not fit the sensor's range; they are learned all the same.

    Raises InputError where there is nothing to learn, or the destination was made from other sources; MismatchError
    for a destination of another sensor; AnnotationError where it has a quantity with another unit or range;
    CapacityError beyond what exact sums hold; LockedError while another fleet is at work for this destination;
    ScrollTactileError where nobody runs the jobs; StoreFullError and other StoreErrors: call again to go on.
    """
    if workers is not None and (isinstance(workers, bool) or not isinstance(workers, int) or workers < 1):
        raise InputError(f"expected workers as a whole number of 1 or more; came {workers!r}")
    begun = time.perf_counter()
    place = Path(destination).absolute()
    found, missing = find_sources([os.fspath(source) for source in sources], memories=True, patience=patience)
    report = FleetReport(refused=missing)
    requested = RecipeRequest.of(sensor, embedding, {"exemplars": exemplars, "kept_touches": kept_touches})
    folder = place.with_name(place.name + ".fleet")
    with ExitStack() as stack:
        stack.enter_context(alone_in(folder, place))
        into = Destination(place, requested, options or SourceOptions(), patience, stack, report, descriptions)
        if into.learned and not (folder / NOTES).exists() and not add:
            raise InputError(
                f"{place} is there already, and not by a run of this kind: take another folder, or add=True to "
                "add to it",
                argument="add",
            )
        steps = Steps(folder, into.making, afresh=not into.learned)
        stack.callback(steps.leave)
        report.refused += steps.begin(found)
        running = _Run(steps, report, into, progress, found)
        if client is None and workers == 1 and patience is None:
            running.work_here()
        else:
            with engine(client, workers) as chosen:
                running.work(chosen)
        into.close(progress)
        report.range_problem = steps.range_problem
        steps.end()
    report.seconds = time.perf_counter() - begun
    if report.range_problem is not None:
        warnings.warn(report.range_problem, RangeWarning, stacklevel=2)
    return report


class _Run:
    """One run: who learns its steps, and what came of them."""

    def __init__(
        self, steps: Steps, report: FleetReport, into: Destination, progress: Progress, found: Sequence[str]
    ) -> None:
        self._steps, self._report, self._into, self._progress = steps, report, into, progress
        self._patience, self._total = into.making.patience, len(found)
        # Seconds in which a job that was handed over is answered.
        self._bound = math.inf if self._patience is None else QUEUED * self._patience + GRACE
        self._begun = time.perf_counter()
        self._answered = -math.inf
        report.sources = len(steps.learned & set(found))

    def work_here(self) -> None:
        """Have all steps learned by this process, into the memory itself."""
        self._steps.cut(1)
        while self._steps.steps:
            step = self._steps.steps[0]
            if not step.memory and step.made is None:
                self._into.learn(step, lambda what, done, of: self._show_progress(done))
            self._come_in(step)

    def work(self, engine: Engine) -> None:
        """Have all steps learned, and merge them in their order."""
        steps = self._steps
        steps.cut(engine.workers)
        running: dict[Future[Made], tuple[Step, float]] = {}
        try:
            while steps.steps:
                while steps.waiting and len(running) < engine.room:
                    step = steps.waiting.popleft()
                    job = LearnJob(self._into.making, step.sources, str(steps.folder))
                    running[engine.submit(learn_job, job)] = step, time.monotonic()
                if self._come_in(steps.steps[0]):
                    continue
                late = min(begun for _, begun in running.values()) + self._bound - time.monotonic()
                for future in wait(running, min(max(0.0, late), threading.TIMEOUT_MAX), FIRST_COMPLETED).done:
                    self._answered = time.monotonic()
                    self._done(future, *running.pop(future))
                self._give_up(engine, running)
        except BaseException:
            for future in running:
                future.cancel()
            raise

    def _come_in(self, step: Step) -> bool:
        """Merge the first step, where it is ready; whether it was, or is learned again."""
        if not step.memory and step.made is None:
            return False
        if step.made is None:
            self._merge_memory(step)
        elif not step.made.path:
            self._report.refused += step.made.refused
            step.failed |= set(step.made.failed)
        elif not self._merge_made(step, step.made):
            return True
        self._report.sources += len(self._steps.came_in(step))
        self._show_progress()
        return True

    def _merge_made(self, step: Step, made: Made) -> bool:
        path = Path(made.path)
        try:
            refused = self._into.merge(path, self._merging, {bytes.fromhex(content) for content in made.clipped})
        except (StoreError, MismatchError) as error:
            if not _is_of(error, path):
                raise
            logger.warning("%s; its sources are learned again", error)
            self._again(step, 1, error)
            return False
        refusals = [Refused(str(head.attributes[SOURCE]), why) for head, why in refused]
        self._report.refused += [*made.refused, *refusals]
        self._report.repeated += made.repeated
        ends = [*accumulate(made.rows)]
        step.failed = {*made.failed, *(step.sources[bisect_left(ends, head.sequence)] for head, _ in refused)}
        return True

    def _merge_memory(self, step: Step) -> None:
        (source,) = step.sources
        place = Path(source)
        try:
            with fetched(source, self._patience) as place:
                refused = self._into.merge(place, self._merging, source=stored_source(source))
        except (InputError, MismatchError, StoreError, OSError) as error:
            if isinstance(error, StoreError) and not _is_of(error, place):
                raise
            self._report.refused.append(Refused.by(error, source))
            step.failed = {source}
            return
        self._report.refused += [Refused(str(head.attributes.get(SOURCE, source)), why) for head, why in refused]
        step.failed = {source} if refused else set()

    def _merging(self, what: str, done: int, of: int) -> None:
        self._progress(f"{what} {done} of {of} touches", self._report.sources, self._total)

    def _show_progress(self, more: int = 0) -> None:
        """Say how far the run is; more: sources of the step that is being learned."""
        seconds, refused = time.perf_counter() - self._begun, len(self._report.refused)
        count, done = self._report.observations, min(self._report.sources + refused + more, self._total)
        left = f", {seconds / done * (self._total - done):.0f} s left" if done else ""
        failed = f", {refused} refused" if refused else ""
        self._progress(f"{count} touches, {count / seconds:.0f} a second{left}{failed}", done, self._total)

    def _give_up(self, engine: Engine, running: dict[Future[Made], tuple[Step, float]]) -> None:
        """Hand jobs over again that nobody answers. Raises ScrollTactileError where nobody answers any."""
        before = time.monotonic() - self._bound
        late = [future for future, (_, begun) in running.items() if begun <= before and not future.done()]
        if late and not isinstance(engine, Processes) and len(late) == len(running) and self._answered <= before:
            raise ScrollTactileError(
                f"{engine.name} has answered no job for {self._bound:.0f} s: look whether it has workers, and whether "
                f"they reach {self._steps.folder}. What was learned is kept: call again to go on"
            )
        for future in late:
            step, _ = running.pop(future)
            engine.abandon(future)
            self._lost(step, SLOW, TimeoutError(f"no answer in {self._bound:.0f} s"))

    def _done(self, future: Future[Made], step: Step, begun: float) -> None:
        try:
            made = future.result()
            self._steps.learned_by(step, made)
        except (CapacityError, StoreFullError, KeyboardInterrupt):
            raise
        except Exception as error:
            slow = self._patience is not None and time.monotonic() - begun >= self._patience
            self._lost(step, SLOW if slow else 1, error)
            return
        self._report.processor["learning"] += made.processor

    def _lost(self, step: Step, tries: int, error: Exception) -> None:
        self._report.deaths += 1
        logger.info("a job of %d sources ended: %s: %s", len(step.sources), type(error).__name__, error)
        self._again(step, tries, error)

    def _again(self, step: Step, tries: int, error: Exception) -> None:
        """Have a step learned again; in the end go on without the source that ends workers."""
        if self._steps.again(step, tries):
            return
        last = f"{type(error).__name__}: {error!s:.200}"
        why = f"workers ended while they learned it, again and again; the last: {last}"
        step.made, step.failed = Made("", refused=[Refused(step.sources[0], why)]), set(step.sources)


def _is_of(error: Exception, path: Path) -> bool:
    """Whether an error is of the memory at a path, and not of the one that it is merged into, which is open."""
    if isinstance(error, DamageError):
        return error.path == path or path in error.path.parents
    return isinstance(error, MismatchError | NotAStoreError | VersionError)


class Destination:
    """The memory that comes out; it is removed again where nothing was learned into a new one.

    making: what it is made with. learned: whether it was there before the run, with touches.

    Raises AnnotationError where it has another quantity than is declared for it, under one name.
    """

    def __init__(
        self,
        place: Path,
        requested: RecipeRequest,
        options: SourceOptions,
        patience: float | None,
        stack: ExitStack,
        report: FleetReport,
        descriptions: Choice,
    ) -> None:
        self._report, self._descriptions, self._made = report, descriptions, not place.exists()
        asked = requested.recipe().arguments if self._made else requested.arguments
        self.learner = TactileLearner.open(place, **asked)
        stack.callback(lambda: remove_tree(place) if self.nothing_learned else None)
        stack.enter_context(self.learner)
        hush(self.learner)
        if adaptations := self.learner.memory.corrections:  # workers learn apart from it
            raise InputError(
                f"{place} was adapted to a changed skin by row {max(adaptations)}, of which the workers of a fleet "
                "know nothing: learn with scroll-tactile learn, or retract that row first"
            )
        for quantity in options.declared:
            require_declarable(self.learner.quantities, quantity)
        self.making = Making(self.learner._recipe, options, patience, tuple(self.learner.quantities.values()))
        self.learned = bool(self.learner.observations())

    @property
    def nothing_learned(self) -> bool:
        """Whether it is new and has no touch yet."""
        return self._made and not self.learner.materials

    def learn(self, step: Step, progress: Progress) -> None:
        """Learn the recordings of a step. Raises StoreError, CapacityError."""
        done = learn_sources(self.learner, step.sources, self.making.options, progress)
        step.made, step.failed = Made("", range_problem=done.range_problem), done.failed
        self._report.observations += done.learned.total()
        self._report.repeated += done.skipped
        self._report.refused += done.refused
        self.learner._ledger.checkpoint_in_background(SAVED_EVERY)

    def merge(
        self, path: Path, progress: Progress, clipped: Collection[bytes] = (), source: str | None = None
    ) -> list[tuple[Head, str]]:
        """Merge a memory, each touch once; its rows that are refused, and why. Raises as `Ledger.merge`."""
        begun, processor = time.perf_counter(), time.process_time()
        try:
            ledger = self.learner._ledger
            rules = MergeRules(
                one_name=True,
                descriptions=self._descriptions,
                clipped=clipped,
                default_source=source,
            )
            merged, refused = ledger.merge(path, rules, progress)
            ledger.checkpoint_in_background(SAVED_EVERY)
        finally:
            self._report.merging += time.perf_counter() - begun
            self._report.processor["merging"] += time.process_time() - processor
        self._report.observations += merged.observations
        self._report.repeated += merged.shared
        return refused

    def close(self, progress: Progress) -> None:
        """Write a checkpoint and a fitted model, and close it.

        Raises InputError where nothing was learned.
        """
        if self.nothing_learned:
            refused = self._report.refused
            first = f", such as {refused[0].source}: {refused[0].why}" if refused else ""
            raise InputError(f"nothing was learned, and no memory made: {len(refused)} sources were refused{first}")
        self._report.held, self._report.digest = sum(self.learner.materials.values()), self.learner.digest()
        self.learner._ledger.saves = True
        with suppress(ScrollTactileError):  # the touches are learned: who opens the memory is told
            self.learner.settle()
        self.learner.close()


class Engine:
    """Who runs the jobs: an Executor of the caller's.

    workers: how many jobs run at once, as far as is known. room: how many are handed over at once. name: of what runs
    them.
    """

    def __init__(self, executor: Executor, workers: int) -> None:
        self._executor, self.workers, self.room = executor, workers, 2 * workers
        self.name = type(executor).__name__

    def submit(self, what: Callable[[Any], Made], job: LearnJob) -> Future[Made]:
        """Have a job done; the future raises where it could not be."""
        return self._executor.submit(what, job)

    def abandon(self, future: Future[Made]) -> None:
        """Wait no longer for a job."""
        future.cancel()

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """The executor is the caller's."""


class Processes(Engine):
    """So many processes, each a pool of its own: one that dies takes nobody else's job with it."""

    def __init__(self, workers: int) -> None:
        self.workers = self.room = workers
        self._free: list[ProcessPoolExecutor] = []
        self._all: set[ProcessPoolExecutor] = set()
        self._busy: dict[Future[Made], ProcessPoolExecutor] = {}
        method = "forkserver" if "forkserver" in get_all_start_methods() else "spawn"
        self._context: Any = get_context(method)
        if method == "forkserver":  # whoever comes after a worker that died need not import all of it again
            self._context.set_forkserver_preload([__name__])

    def submit(self, what: Callable[[Any], Made], job: LearnJob) -> Future[Made]:
        """As `Engine.submit`, by a process that has nothing else to do."""
        for left in range(STARTS, 0, -1):
            pool = self._free.pop() if self._free else self._new()
            try:
                future = pool.submit(what, job)
            except (BrokenProcessPool, EOFError, OSError) as error:  # it died while it waited, or its fork server did
                self._drop(pool)
                if left == 1:
                    why = f"{type(error).__name__}: {error}"
                    raise ScrollTactileError(f"no worker can be started ({why}). Call again to go on") from error
                time.sleep(PAUSE)
            else:
                break
        self._busy[future] = pool
        future.add_done_callback(lambda done: self._back(pool, done))
        return future

    def abandon(self, future: Future[Made]) -> None:
        """End the process that does a job, however it is held."""
        pool = self._busy.pop(future, None)
        if pool is not None:
            processes = list((pool._processes or {}).values())  # none after its end
            self._drop(pool)
            for process in processes:
                process.kill()

    def _drop(self, pool: ProcessPoolExecutor) -> None:
        self._all.discard(pool)
        pool.shutdown(wait=False)

    def _new(self) -> ProcessPoolExecutor:
        pool = ProcessPoolExecutor(1, mp_context=self._context, initializer=_begin, initargs=(dict(os.environ),))
        self._all.add(pool)
        return pool

    def _back(self, pool: ProcessPoolExecutor, done: Future[Made]) -> None:
        broken = not done.cancelled() and isinstance(done.exception(), BrokenProcessPool)
        if self._busy.pop(done, None) is None or broken:  # it was abandoned, or died
            self._drop(pool)
        else:
            self._free.append(pool)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for pool in list(self._all):
            pool.shutdown(wait=kind is None, cancel_futures=True)


def _begin(environment: dict[str, str]) -> None:
    """Make a worker: of the environment that its parent has now, for a fork server keeps the one that it began with.

    One whose parent was killed ends, too, and it leaves arithmetic to one thread: there are others beside it.
    """
    os.environ.clear()
    os.environ.update(environment)
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=lambda: (wait_for([parent.sentinel]), os._exit(1)), daemon=True).start()


def engine(client: Any, workers: int | None) -> Engine:
    """Who runs the jobs: the caller's client or Executor, or so many processes. Raises InputError for what is none."""
    if client is None:
        return Processes(workers or os.cpu_count() or 1)
    executor = client.get_executor() if hasattr(client, "get_executor") else client
    if not isinstance(executor, Executor):
        raise InputError(f"expected a dask.distributed.Client or an Executor; came {type(client).__name__}")
    cores = getattr(client, "ncores", None)
    known = sum(cores().values()) if callable(cores) else getattr(executor, "_max_workers", 0)
    return Engine(executor, workers or known or os.cpu_count() or 1)
