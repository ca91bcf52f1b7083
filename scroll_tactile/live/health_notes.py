"""What a live session's touches, and its rest, tell of the sensor: noted for `health`, which calls back at a change."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from scroll_tactile_store import StoreError

from scroll_tactile.errors import ScrollTactileError
from scroll_tactile.live.answers import LiveTouch
from scroll_tactile.results import Health
from scroll_tactile.signals.stream import Stream

__all__ = ["HealthNotes", "Noting"]


class Noting(Protocol):
    """What is needed of a learner."""

    def sense(self, stream: Stream, material: str | None = None) -> None:
        """As `TactileLearner.sense`."""
        ...

    def health(self) -> Health:
        """As `TactileLearner.health`."""
        ...

    def names_of(self, stream: Stream) -> list[str]:
        """As `TactileLearner.names_of`."""
        ...


class HealthNotes:
    """Notes the rest before each touch, and touches that were decided, are known and were not learned.

    learner: whose memory it is. changed: called once with what `health` says, when it sees a change; again only after
    it saw none. warn: called with a text for each kind of failure once: a full disk must not end a session. materials:
    whether answers are by materials, without which touches have no name.

    A memory with a damaged row is warned of. Raises InputError as `TactileLearner.health` does: it needs one on disk.
    """

    def __init__(
        self,
        learner: Noting,
        changed: Callable[[Health], object] | None,
        warn: Callable[[str], object],
        *,
        materials: bool = True,
    ) -> None:
        self._learner, self._changed, self._warn, self._materials = learner, changed, warn, materials
        self._warned: set[type[Exception]] = set()
        self._last: LiveTouch | None = None  # until another ended: meanwhile it may be learned
        self._told = False
        try:
            learner.health()
        except StoreError as error:  # a damaged row is no reason to feel nothing: what comes is noted behind it
            self._warn_once(error)

    def take(self, ended: LiveTouch | None) -> None:
        """Take the touch that ended; None where the session did: note the touch before it and the rest, and look."""
        touch, self._last = self._last, ended
        try:
            if touch is not None and self._counts(touch):
                self._learner.sense(touch.stream, touch.prediction.material)
            if ended is not None and ended.rest is not None:
                self._learner.sense(ended.rest)
            found = None if self._changed is None else self._learner.health()
        except (ScrollTactileError, StoreError) as error:
            self._warn_once(error)
            return
        if self._changed is not None and found is not None:
            before, self._told = self._told, found.since is not None
            if self._told and not before:
                self._changed(found)

    def _counts(self, touch: LiveTouch) -> bool:
        """Whether a touch is noted: it was decided, is known, and was not learned, whose row has its channels, too."""
        answer = touch.prediction
        certain = self._materials and touch.decided and answer.known is True and answer.material is not None
        return certain and not self._learner.names_of(touch.stream)

    def _warn_once(self, error: Exception) -> None:
        if type(error) not in self._warned:
            self._warned.add(type(error))
            self._warn(f"the health of the sensor cannot be told: {error}")
