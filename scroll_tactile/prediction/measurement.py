"""How beginnings are judged with a model: measured when that is first asked for, by one thread, while others go on."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from scroll_tactile.readouts.early import Early

__all__ = ["Beginnings", "Measurement"]

M = TypeVar("M")


@dataclass(frozen=True)
class Beginnings:
    """How beginnings are judged, None where nothing could be measured; touches: of the memory when that was done."""

    early: Early | None
    touches: int


class Measurement(Generic[M]):
    """How beginnings are judged with a model M, measured at most once; what was found stays.

    earlier: that of an earlier model of the same memory, which serves until this one is made, also where it is still
    under way. It takes seconds, and a session beside a thread that observes would never come to an end of them.
    """

    def __init__(self, earlier: Measurement[M] | None = None, found: Beginnings | None = None) -> None:
        self._earlier = None if earlier is None else earlier._serving()
        self._found = found
        self._measures: Callable[[M], Early | None] | None = None
        self._lock = threading.Lock()

    def _serving(self) -> Measurement[M] | None:
        """The one whose result serves, or will when it is there; None where none was asked for."""
        earlier = self._earlier  # first: it is let go once there is a result
        if self._found is not None or self._lock.locked():
            return self
        return earlier

    @property
    def found(self) -> Beginnings | None:
        """How beginnings are judged, once that was measured."""
        earlier = self._earlier  # first: it is let go once there is a result
        if self._found is not None or earlier is None:
            return self._found
        return earlier._found

    @property
    def asked_for(self) -> bool:
        """Whether it was measured, or is being measured."""
        return self._serving() is not None

    @property
    def measures(self) -> Callable[[M], Early | None] | None:
        """By what it was measured; None before that."""
        serving = self._serving()
        return None if serving is None else serving._measures

    def of(self, model: M, touches: int, measures: Callable[[M], Early | None]) -> Early | None:
        """How the model judges beginnings, which was fitted to so many touches: found, or measured now."""
        with self._lock:
            earlier = self._earlier
            if self._found is None and earlier is not None:
                with earlier._lock:  # it may be under way in another thread: to measure beside it would take longer
                    pass
            found = self.found
            if found is None:
                found = Beginnings(measures(model), touches)
            if self._found is None:
                # From here on it stays: an earlier one that comes later makes no difference, and would hold its own.
                self._measures, self._found = measures, found
                self._earlier = None
        return found.early
