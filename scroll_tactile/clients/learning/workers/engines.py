"""Who runs a fleet's jobs: processes of our own, or an Executor of the caller's, such as a cluster's client gives."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_all_start_methods, get_context, parent_process
from multiprocessing.connection import wait as wait_for
from typing import Any

from scroll_tactile.clients.learning.workers.jobs import LearnJob, Made, learn_job
from scroll_tactile.errors import InputError, ScrollTactileError

__all__ = ["Engine", "Processes", "engine", "require_workers"]

STARTS = 5  # of a worker: what starts it may have been killed as well, and takes a moment to be noticed
PAUSE = 0.1


class Engine:
    """Who runs the jobs: an Executor of the caller's.

    workers: how many jobs run at once, as far as is known. room: how many are handed over at once. own: whether they
    are processes of ours, which can be ended.
    """

    own = False

    def __init__(self, executor: Executor, workers: int) -> None:
        self._executor, self.workers, self.room = executor, workers, 2 * workers

    def submit(self, what: Callable[[Any], Made], job: LearnJob) -> Future[Made]:
        """Have a job done; the future raises where it could not be."""
        return self._executor.submit(what, job)

    def abandon(self, future: Future[Made]) -> None:
        """Wait no longer for a job."""
        future.cancel()

    @property
    def name(self) -> str:
        """What runs the jobs."""
        return type(self._executor).__name__

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """The executor is the caller's."""


class Processes(Engine):
    """So many processes, each a pool of its own: one that dies takes nobody else's job with it."""

    own = True

    def __init__(self, workers: int) -> None:
        self.workers = self.room = workers
        self._free: list[ProcessPoolExecutor] = []
        self._all: set[ProcessPoolExecutor] = set()
        self._busy: dict[Future[Made], ProcessPoolExecutor] = {}
        method = "forkserver" if "forkserver" in get_all_start_methods() else "spawn"
        self._context: Any = get_context(method)
        if method == "forkserver":  # whoever comes after a worker that died need not import all of it again
            self._context.set_forkserver_preload([learn_job.__module__])

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


def require_workers(workers: object) -> None:
    """Raise InputError for workers that are no number."""
    if workers is not None and (isinstance(workers, bool) or not isinstance(workers, int) or workers < 1):
        raise InputError(f"expected workers as a whole number of 1 or more; came {workers!r}")


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
