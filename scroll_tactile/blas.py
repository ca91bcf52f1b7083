"""The threads of BLAS, which are the whole process's."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Any

from threadpoolctl import ThreadpoolController

__all__ = ["one_thread"]


@lru_cache(maxsize=1)
def _libraries() -> list[tuple[Any, Callable[[int], None]]]:
    """The BLAS libraries of this process, and what sets the threads of each."""
    found = [library for library in ThreadpoolController().lib_controllers if library.user_api == "blas"]
    # From version 3.8 on, threadpoolctl lets one thread alone set them, the first that ever did, and answers to others
    # by doing nothing; here whoever is inside is counted, of all threads, so its guard is passed by.
    return [(library, getattr(library, "_real_set_num_threads", library.set_num_threads)) for library in found]


class _Limit:
    """The limit of BLAS to one thread, which is the whole process's, and those that need it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._before: list[tuple[Callable[[int], None], int]] = []

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._before = [(put, library.num_threads) for library, put in _libraries()]
                for put, _ in self._before:
                    put(1)
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                for put, count in self._before:
                    put(count)


_LIMIT = _Limit()


def one_thread() -> AbstractContextManager[None]:
    """Run BLAS on one thread: on busy cores two made a 2 ms Cholesky take up to 439 ms.

    The limit holds for the whole process until the last of those that asked for it, of whatever thread, has left.
    """
    return _LIMIT
