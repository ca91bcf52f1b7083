"""One job at a time in one thread, of which only the newest waiting one is worth doing."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from store.errors import StoreError

__all__ = ["Background"]

logger = logging.getLogger(__name__)


class Background:
    """Run jobs in a single thread; a job that is still waiting is replaced by a newer one.

    The thread lives only as long as there are jobs, so that a program which forgets to close its store
    still ends. A job's failure is logged and kept until `check` raises it.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._changed = threading.Condition()
        self._waiting: Callable[[], object] | None = None
        self._running = False
        self._failure: Exception | None = None

    def submit(self, job: Callable[[], object]) -> None:
        """Run `job` after the one that is running, in place of any that waits."""
        with self._changed:
            self._waiting = job
            if not self._running:
                threading.Thread(target=self._work, name=self._name).start()
                self._running = True

    def wait(self) -> None:
        """Return when nothing runs and nothing waits."""
        with self._changed:
            self._changed.wait_for(lambda: not self._running)

    def check(self) -> None:
        """Raise the failure of an earlier job, once, as a StoreError."""
        with self._changed:
            failure, self._failure = self._failure, None
        if isinstance(failure, StoreError):
            raise failure
        if failure is not None:
            raise StoreError(f"a background commit failed: {failure!r}") from failure

    def _work(self) -> None:
        while (job := self._next()) is not None:
            try:
                job()
            except Exception as error:
                logger.exception("%s: a background commit failed; the journal still holds its rows", self._name)
                with self._changed:
                    self._failure = error
            # Dropped before the wait: the job holds the arrays that were handed over.
            del job

    def _next(self) -> Callable[[], object] | None:
        with self._changed:
            job, self._waiting = self._waiting, None
            if job is None:
                self._running = False
                self._changed.notify_all()
            return job
