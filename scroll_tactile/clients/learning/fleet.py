"""Many recordings and memories become one memory, to the same bytes, whoever learns them and in how many processes.

Sources are cut into steps, in their order: some recordings, or a memory (see `steps`). A worker learns the recordings
of a step by the same loop as one process does, into a packed memory of its own (see `jobs`); steps are merged one after
another, in order. With one process the loop writes into the memory itself. Sums of whole numbers are equal in any
order, so the digest is that of one process which observed each touch once, whatever the workers, their number and their
ends.

Who runs the jobs is chosen by what is passed: processes on this machine, or a client of a cluster.
"""

from __future__ import annotations

import logging
import math
import os
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from scroll_tactile_store import DamageError, NotAStoreError, StoreError, StoreFullError, VersionError

from scroll_tactile.clients.learning.addresses import expand, fetched
from scroll_tactile.clients.learning.runfile import alone_in
from scroll_tactile.clients.learning.sources import Refused, SourceOptions, stored_source
from scroll_tactile.clients.learning.workers.destination import Destination, FleetReport
from scroll_tactile.clients.learning.workers.engines import Engine, engine, require_workers
from scroll_tactile.clients.learning.workers.jobs import Made, learn_job
from scroll_tactile.clients.learning.workers.steps import NOTES, Step, Steps
from scroll_tactile.embeddings.protocol import Embedding
from scroll_tactile.errors import (
    CapacityError,
    InputError,
    MismatchError,
    RangeWarning,
    ScrollTactileError,
)
from scroll_tactile.memory.touch_rows import SOURCE
from scroll_tactile.persistence.merge import Choice
from scroll_tactile.recipe import RecipeRequest
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.copies import Augmented

__all__ = ["FleetReport", "learn"]

logger = logging.getLogger(__name__)

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
    sensor, embedding, augmentation, exemplars, kept_touches: of the memory, as of `TactileLearner`; an existing one
    knows.
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
    require_workers(workers)
    begun = time.perf_counter()
    place = Path(destination).absolute()
    found, missing = expand([os.fspath(source) for source in sources], patience)
    report = FleetReport(refused=missing)
    requested = RecipeRequest.of(
        sensor, embedding, augmentation, {"exemplars": exemplars, "kept_touches": kept_touches}
    )
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
        _work(_Run(steps, report, into, progress, found), workers, client, patience)
        into.close(progress)
        report.range_problem = steps.range_problem
        steps.end()
    report.seconds = time.perf_counter() - begun
    if report.range_problem is not None:
        warnings.warn(report.range_problem, RangeWarning, stacklevel=2)
    return report


def _work(run: _Run, workers: int | None, client: Any, patience: float | None) -> None:
    """Have a run's steps learned, by this process where it is the only one, and nobody has a patience."""
    if client is None and workers == 1 and patience is None:
        run.work_here()
        return
    with engine(client, workers) as chosen:
        run.work(chosen)


class _Run:
    """One run: who learns its steps, and what came of them."""

    def __init__(
        self,
        steps: Steps,
        report: FleetReport,
        into: Destination,
        progress: Progress,
        found: Sequence[str],
    ) -> None:
        self._steps, self._report, self._into, self._progress = steps, report, into, progress
        self._patience, self._total = into.making.patience, len(found)
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
                    running[engine.submit(learn_job, steps.job(step.sources))] = step, time.monotonic()
                if self._come_in(steps.steps[0]):
                    continue
                for future in wait(running, self._longest(running), FIRST_COMPLETED).done:
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
            made.require_packed()
            refused = self._into.merge(path, self._merging, {bytes.fromhex(content) for content in made.clipped})
        except (StoreError, MismatchError) as error:
            if not _is_of(error, path):
                raise
            logger.warning("%s; its sources are learned again", error)
            self._again(step, 1, error)
            return False
        refusals = [Refused(str(head.attributes[SOURCE]), why) for head, why in refused]
        self._report.refused += [*made.refused, *refusals]
        step.failed = {*made.failed, *(step.source_of(head.sequence) for head, _ in refused)}
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

    @property
    def _bound(self) -> float:
        """Seconds in which a job that was handed over is answered."""
        return math.inf if self._patience is None else QUEUED * self._patience + GRACE

    def _longest(self, running: Mapping[Future[Made], tuple[Step, float]]) -> float | None:
        """Seconds until the first of these jobs is given up; None where nobody has a patience."""
        if math.isinf(self._bound) or not running:
            return None
        return max(0.0, min(begun for _, begun in running.values()) + self._bound - time.monotonic())

    def _give_up(self, engine: Engine, running: dict[Future[Made], tuple[Step, float]]) -> None:
        """Hand jobs over again that nobody answers. Raises ScrollTactileError where nobody answers any."""
        before = time.monotonic() - self._bound
        late = [future for future, (_, begun) in running.items() if begun <= before and not future.done()]
        if late and not engine.own and len(late) == len(running) and self._answered <= before:
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
