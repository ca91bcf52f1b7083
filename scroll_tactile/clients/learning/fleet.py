"""Many recordings and memories become one memory, to the same bytes, whoever learns them and in how many processes.

A fleet is a map, then a merge. The sources are cut into shares, in their order: some recordings, or one memory. A
worker learns the recordings of a share by the same loop as one process does, into a memory in a folder of its own,
which gets its name when it is complete. The parent merges shares one after another, in their order. Sums of whole
numbers are equal in any order, so the digest is that of one process which observed each touch once.

A call that was cut short is made again: folders that are complete are merged and not learned again, and a touch that
the memory has counts once.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from scroll_tactile_store import DamageError, NotAStoreError, StoreError, StoreFullError, VersionError
from scroll_tactile_store.exceptions import reported
from scroll_tactile_store.files import new_file, remove_tree

from scroll_tactile.clients.learning.learning import Learned, Progress, learn_sources
from scroll_tactile.clients.learning.sources import Refused, SourceOptions, find_sources, is_memory, stored_source
from scroll_tactile.embeddings.protocol import Embedding
from scroll_tactile.errors import CapacityError, FactWarning, InputError, MismatchError, ScrollTactileError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.memory.identity import Identity
from scroll_tactile.persistence.merge import Choice
from scroll_tactile.quantities import Quantity, require_declarable
from scroll_tactile.recipe import Recipe, RecipeRequest
from scroll_tactile.recordings.locations import local
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.facts import Fact, merged, name_fact, warn_of

__all__ = ["FleetReport", "Processes", "learn"]

SHARES_A_WORKER = 2  # at least, so that one is merged while another is learned; each costs what some 60 touches do
MOST_SOURCES = 256  # of a share: what is lost with a worker


@dataclass
class FleetReport:
    """What a call of `learn` did.

    sources: how many recordings and memories were looked at. learned: material → touches that came in. observations:
    their sum. repeated: touches that had come before, by their names and contents. refused: what was not learned, and
    why; of touches that came under two names the first counts, of the memory and then of the sources in their order.
    deaths: shares whose worker ended before them. seconds: by the clock. held, digest: of the memory that came out;
    0 and "" where nothing was learned, and no memory was made. facts: what is odd about what was learned, each kind
    once, with its first source and how many have it.
    """

    sources: int = 0
    learned: Counter[str] = field(default_factory=Counter)
    repeated: int = 0
    refused: list[Refused] = field(default_factory=list)
    deaths: int = 0
    seconds: float = 0.0
    held: int = 0
    digest: str = ""
    facts: list[Fact] = field(default_factory=list)

    @property
    def observations(self) -> int:
        """Touches that came in."""
        return self.learned.total()


def learn(
    sources: Sequence[str | os.PathLike[str]],
    memory: str | os.PathLike[str],
    options: SourceOptions | None = None,
    *,
    sensor: Sensor | None = None,
    embedding: Embedding | None = None,
    exemplars: int | None = None,
    kept_touches: int | None = None,
    descriptions: Choice = "same",
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress = lambda what, done, of: None,
) -> FleetReport:
    """Learn recordings and memories into the memory in a folder, each touch once.

    sources: files, folders and addresses that fsspec knows, of recordings (as `recordings.read` takes them) and of
    memories, in folders or packed. memory: its folder; there is none yet, or it is added to. options: how recordings
    are cut into touches and named.
    sensor, embedding, exemplars, kept_touches: of the memory, as of `TactileLearner`; an existing one knows.
    descriptions: as of `merge`; the memory comes first, then the sources in their order.
    workers: how many learn at once; as many as this machine has cores unless given. One is this process itself.
    executor: whoever runs the workers, such as `dask.distributed.Client.get_executor()` or an `MPIPoolExecutor`;
    processes on this machine unless given. Its workers must reach the folder beside the memory that is named after it
    with ".fleet", where what they learn lies until all is merged.
    progress: called with (what is being done, sources done, sources in all).

    What is merged is durable. Call again after an interruption, and it goes on: what a worker had completed is not
    learned again. A worker that dies is tried once more, source by source. Sources that cannot be read, and those whose
    worker died twice, are listed in the report; all others are learned.
    Warns at the end by a FactWarning of each kind of fact, see `FleetReport`; the touches are learned all the same.
    Tables go by the names of their columns, the sensor's or the first source's; a new memory's sensor keeps them.

    Raises InputError without a sensor for a new memory, and for several workers where the memory was adapted to a
    changed skin; MismatchError for a memory of another sensor; AnnotationError where it has a quantity with another
    unit or range; CapacityError beyond what exact sums hold; LockedError while it is being written; ScrollTactileError
    where nobody runs the workers; StoreFullError and other StoreErrors: call again to go on.
    """
    if isinstance(sources, str | os.PathLike):
        raise InputError(f"expected a list of sources, then the folder of the memory; came {os.fspath(sources)!r:.100}")
    if workers is not None and (isinstance(workers, bool) or not isinstance(workers, int) or workers < 1):
        raise InputError(f"expected workers as a whole number of 1 or more; came {workers!r}")
    if executor is not None and not isinstance(executor, Executor):
        raise InputError(f"expected an Executor, such as client.get_executor() of Dask; came {type(executor).__name__}")
    begun, place = time.perf_counter(), Path(memory).expanduser().absolute()
    paths = [os.fspath(source) for source in sources]
    found, missing = find_sources(paths)
    options = (options or SourceOptions()).among(found, paths)
    report = FleetReport(sources=len(found), refused=missing)
    if sensor is not None and not place.exists():
        options = options.by_names(found, sensor)
        sensor = sensor.model_copy(update={"columns": tuple(options.names) or None})
    asked = RecipeRequest.of(sensor, embedding, {"exemplars": exemplars, "kept_touches": kept_touches})
    with _opened(place, asked) as learner:
        run = _Run(learner, options.by_names(found, learner.sensor), descriptions, report, progress)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FactWarning)  # they are said at the end
            if executor is None and workers == 1:
                run.learn_here(found)
            else:
                run.learn_apart(found, workers or os.cpu_count() or 1, executor)
        new = sorted(report.learned.keys() - run.before.keys())  # each stands beside those before, and those behind it
        near = [fact for i, name in enumerate(new) for fact in name_fact(name, [*run.before, *new[i + 1 :]])]
        report.facts = merged([*report.facts, *near])
        if report.held:
            report.digest = learner.digest()
            with suppress(ScrollTactileError):  # the touches are learned: who opens the memory is told
                learner.settle()
    report.seconds = time.perf_counter() - begun
    for fact in report.facts:
        warn_of(fact)
    return report


@contextmanager
def _opened(place: Path, asked: RecipeRequest) -> Iterator[TactileLearner]:
    """The memory, open; a new one is removed again where nothing was learned."""
    new = not place.exists()
    learner = TactileLearner.open(place, **(asked.recipe() if new else asked).arguments)
    try:
        with learner:
            yield learner
    finally:
        if new and not learner.materials:
            remove_tree(place)


@dataclass(frozen=True)
class Share:
    """Sources, in order, that come in together: one memory, or recordings that a worker learns.

    folder: where the worker puts them, complete or not at all. recipe, quantities: of the memory that they are merged
    into. known: a file of the touches that this has, content → names.
    """

    sources: tuple[str, ...]
    folder: Path
    recipe: Recipe
    options: SourceOptions
    quantities: tuple[Quantity, ...]
    known: Path

    @property
    def memory(self) -> Path:
        """The memory in its folder."""
        return self.folder / "memory"

    def of(self, sources: Sequence[str]) -> Share:
        """A share of other sources, in a folder that is named after them and all that they are learned with."""
        what = [Identity.of(self.recipe).to_json(), repr(self.options), *sources]
        name = hashlib.sha256(json.dumps(what).encode()).hexdigest()[:24]
        return replace(self, sources=tuple(sources), folder=self.folder.parent / f"share-{name}")

    def learned(self) -> Learned | None:
        """What a worker learned of it; None where its folder is not complete."""
        try:
            return Learned.from_json(json.loads((self.folder / "learned.json").read_text(encoding="utf-8")))
        except (OSError, ValueError, LookupError, TypeError):
            return None


def learn_share(share: Share) -> None:
    """Learn the recordings of a share into its folder, which appears whole or not at all; a worker's job.

    Its memory has a row for each touch, also for those that come under two names: only the memory that it is merged
    into tells which came first. Raises CapacityError; StoreFullError, StoreError where it cannot be written.
    """
    with reported(share.folder, "making the folder of a share"):
        made = TemporaryDirectory(dir=share.folder.parent, prefix=f"{share.folder.name}.", suffix=".partial")
    with made as draft, warnings.catch_warnings():
        warnings.simplefilter("ignore", FactWarning)
        whole = Path(draft) / "whole"
        known = {bytes.fromhex(key): names for key, names in json.loads(share.known.read_text("utf-8")).items()}
        with TactileLearner.open(whole / share.memory.name, **share.recipe.arguments) as learner, learner.batch():
            for quantity in share.quantities:
                learner.declare(quantity)
            done = learn_sources(learner, share.sources, share.options, known=known)
        with reported(share.folder, "completing the folder of a share"):
            (whole / "learned.json").write_text(json.dumps(done.to_json()), encoding="utf-8")
            if share.learned() is None:  # a worker of a call before may have completed it meanwhile
                remove_tree(share.folder)
                whole.rename(share.folder)


class _LostError(Exception):
    """What a worker was to learn is not there, or cannot be merged."""


class _Run:
    """One call: whoever learns the sources, and what came of them. folder: where shares lie until all is merged."""

    def __init__(
        self,
        learner: TactileLearner,
        options: SourceOptions,
        descriptions: Choice,
        report: FleetReport,
        progress: Progress,
    ) -> None:
        for quantity in options.declared:
            require_declarable(learner.quantities, quantity)
        self._learner, self._options, self._descriptions = learner, options, descriptions
        self._report, self._progress, self._begun = report, progress, time.perf_counter()
        self.before, self._done = Counter(learner.materials), 0

    def learn_here(self, found: Sequence[str]) -> None:
        """Have this process learn all sources, into the memory itself."""
        for sources, memory in _cut(found, len(found)):
            if memory:
                self._merge_memory(*sources)
            else:
                self._note(learn_sources(self._learner, sources, self._options, self._show))
            self._came_in(len(sources))

    def learn_apart(self, found: Sequence[str], workers: int, executor: Executor | None) -> None:
        """Have workers learn the recordings, and merge what they made, in order."""
        learner = self._learner
        assert learner.path is not None
        if adaptations := learner.memory.corrections:  # workers learn apart from it
            raise InputError(
                f"{learner.path} was adapted to a changed skin by row {max(adaptations)}, of which the workers of a "
                "fleet know nothing: learn with workers=1, or retract that row first"
            )
        folder = learner.path.with_name(learner.path.name + ".fleet")
        with reported(folder, "making the folder of a fleet"):
            folder.mkdir(exist_ok=True)
        for left in folder.glob("share-*.partial"):  # of a worker that died
            remove_tree(left)
        known: dict[str, list[str]] = {}
        for row in learner.observations():
            if row.state != "retracted":
                known.setdefault(row.key.hex(), []).append(row.material)
        self._known = {bytes.fromhex(key) for key in known}
        quantities, file = tuple(learner.quantities.values()), folder / "share-known.json"
        with reported(file, "writing which touches the memory has"), new_file(file, "w") as opened:
            json.dump(known, opened)
        share = Share((), folder / "share", learner._recipe, self._options, quantities, file)
        most = min(MOST_SOURCES, -(-len(found) // (SHARES_A_WORKER * workers)))
        shares = [(share.of(sources), memory) for sources, memory in _cut(found, most)]
        with ExitStack() as stack:
            self._executor = executor or stack.enter_context(Processes(workers))
            futures = [None if memory else self._submit(share) for share, memory in shares]
            try:
                for (share, memory), future in zip(shares, futures, strict=True):
                    if memory:
                        self._merge_memory(*share.sources)
                    else:
                        self._take(share, future)
                    self._came_in(len(share.sources))
            except BaseException:
                for future in filter(None, futures):
                    future.cancel()
                raise
        for path in folder.glob("share-*"):
            remove_tree(path)
        with suppress(OSError):  # somebody else's things are in it
            folder.rmdir()

    def _submit(self, share: Share) -> Future[None] | None:
        """Hand a share to a worker; None where its folder is complete."""
        if (done := share.learned()) is not None:
            if done.known <= self._known:
                return None
            remove_tree(share.folder)  # it left out touches that the memory had, and has no more
        try:
            return self._executor.submit(learn_share, share)
        except RuntimeError as error:  # such as BrokenProcessPool
            raise ScrollTactileError(
                f"{type(self._executor).__name__} takes no work any more: {error}. What was learned is kept: call "
                "again to go on"
            ) from error

    def _take(self, share: Share, future: Future[None] | None) -> None:
        """Merge a share. Where its worker died each source of it is tried once more, by itself."""
        try:
            self._merge_share(share, future)
            return
        except _LostError:
            self._report.deaths += 1
        alone = [share.of([source]) for source in share.sources]
        for each, second in [(each, self._submit(each)) for each in alone]:
            try:
                self._merge_share(each, second)
            except _LostError as error:
                self._report.deaths += 1
                why = f"its worker ended twice before it was learned; the last time: {error}"
                self._report.refused.append(Refused(each.sources[0], why))

    def _merge_share(self, share: Share, future: Future[None] | None) -> None:
        """Merge what a worker made, when it is there. Raises _LostError where it does not come, or is damaged."""
        try:
            if future is not None:
                future.result()
        except (CapacityError, StoreFullError):
            raise
        except Exception as error:
            raise _LostError(f"{type(error).__name__}: {error!s:.200}") from error
        done = share.learned()
        if done is None:
            raise _LostError(f"{share.folder} is not there, or not complete")
        try:
            self._merge(share.memory, done.clipped)
        except (StoreError, MismatchError) as error:
            if not _is_of(error, share.memory):
                raise
            remove_tree(share.folder)
            raise _LostError(str(error)) from error
        self._note(done)

    def _merge_memory(self, source: str) -> None:
        place = Path(source)
        try:
            with local(source) as place:
                self._merge(place, source=stored_source(source))
        except (InputError, MismatchError, StoreError, OSError) as error:
            if isinstance(error, StoreError) and not _is_of(error, place):
                raise
            self._report.refused.append(Refused.by(error, source))

    def _merge(self, path: Path, clipped: Collection[bytes] = (), source: str = "") -> None:
        """Merge a memory, each touch once. clipped: as of `Learned`. source: of touches that have none."""
        how: Any = {"choice": self._descriptions, "one_name": True, "clipped": clipped, "source": source or None}
        how["progress"] = lambda what, done, of: self._show(f"{what} {done} of {of} touches")
        merged, refused = self._learner._ledger.merge(path, **how)
        self._report.repeated += merged.shared
        self._report.refused += [Refused(str(head.attributes.get("source", source)), why) for head, why in refused]

    def _note(self, done: Learned) -> None:
        self._report.refused += done.refused
        self._report.repeated += done.skipped
        self._report.facts = merged([*self._report.facts, *done.facts])

    def _came_in(self, sources: int) -> None:
        report, learner = self._report, self._learner
        report.learned, report.held = Counter(learner.materials) - self.before, sum(learner.materials.values())
        self._done += sources
        rate = report.observations / (time.perf_counter() - self._begun)
        self._show(f"{report.observations} touches, {rate:.0f} a second, {len(report.refused)} refused")

    def _show(self, what: str, more: int = 0, _: int = 0) -> None:
        self._progress(what, self._done + more, self._report.sources)


def _cut(found: Sequence[str], most: int) -> list[tuple[list[str], bool]]:
    """The sources in shares, in order: at most so many recordings, or one memory, and which it is."""
    shares: list[tuple[list[str], bool]] = []
    for source in found:
        memory = is_memory(source)
        if not shares or memory or shares[-1][1] or len(shares[-1][0]) >= most:
            shares.append(([], memory))
        shares[-1][0].append(source)
    return shares


def _is_of(error: Exception, path: Path) -> bool:
    """Whether an error is of the memory at a path, and not of the one that it is merged into, which is open."""
    if isinstance(error, DamageError):
        return error.path == path or path in error.path.parents
    return isinstance(error, MismatchError | NotAStoreError | VersionError)


class Processes(ThreadPoolExecutor):
    """So many processes on this machine, each a pool of its own: one that dies takes nobody else's work with it."""

    def __init__(self, workers: int) -> None:
        # A process takes over what its thread is deaf to: ctrl-C reaches the parent, whose end ends it without a word.
        mask = getattr(signal, "pthread_sigmask", None)  # Windows has none
        if mask is not None:
            resource_tracker.ensure_running()  # which would take the mask off the first thread that begins a process
        super().__init__(workers, initializer=mask and partial(mask, signal.SIG_BLOCK, {signal.SIGINT}))
        self._context = get_context("spawn")
        self._theirs, self._ours = self._context.Pipe(duplex=False)  # processes end when our end is closed
        self._own = threading.local()
        self._pools: list[ProcessPoolExecutor] = []

    def submit(self, what: Callable[..., Any], /, *words: Any, **named: Any) -> Future[Any]:
        """As of any Executor."""
        return super().submit(self._in_a_process, what, *words, **named)

    def _in_a_process(self, what: Callable[..., Any], *words: Any, **named: Any) -> Any:
        """Call it in the process of this thread, which is begun anew where it died."""
        pool = getattr(self._own, "pool", None)
        if pool is None:
            how: Any = {"mp_context": self._context, "initializer": _begin, "initargs": (self._theirs,)}
            pool = self._own.pool = ProcessPoolExecutor(1, **how)
            self._pools.append(pool)
        try:
            return pool.submit(what, *words, **named).result()
        except BrokenProcessPool:
            self._own.pool = None
            raise

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """An error, or ctrl-C, waits for nothing and ends the processes."""
        self.shutdown(wait=kind is None, cancel_futures=kind is not None)
        for pool in self._pools:
            pool.shutdown(wait=kind is None)
        self._ours.close()


def _begin(ends: Connection) -> None:
    """Make a worker: it leaves arithmetic to one thread, for others are beside it, and ends when its parent does."""
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
    threading.Thread(target=lambda: (wait([ends]), os._exit(1)), daemon=True).start()
