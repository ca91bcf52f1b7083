"""Systems of one's own where touches come one by one, go again, or are changed: `--system` of all studies but table 1.

A system that has `observe(material, stream)` learns touch by touch, and one that has `retract(material, stream)`, too,
gives touches up. Any other is fitted anew to the touches that are there, before it is asked: it may keep all of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from examples.paper.studies.default_learner import Answering, Answers, Progress, Readings, Touch
from examples.paper.systems.own import code_digest, is_own_embedding, own_system
from scroll_tactile.clients.learning.metrics import Labelled
from scroll_tactile.errors import InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream, validate

__all__ = ["Coming", "answering", "code_of", "require_systems"]


def require_systems(keys: Sequence[str] | None) -> tuple[str, ...]:
    """The keys of --system, each once. Raises InputError where one makes no system."""
    found = tuple(dict.fromkeys(keys or ()))
    for key in found:
        if is_own_embedding(key):
            raise InputError(f"expected --system module:factory, without a readout behind it; came {key!r}")
        own_system(key)
    return found


def code_of(keys: Sequence[str]) -> dict[str, str]:
    """What a run with these systems cannot be resumed without, by name."""
    return {f"the file of {key}": code_digest(key) for key in keys}


class Coming:
    """A system of one's own, whose touches come and go. key: `module:factory`. seed: of all that it draws."""

    def __init__(self, key: str, seed: int) -> None:
        self._key, self._seed = key, seed
        self._there: dict[int, Labelled] = {}
        self._made: Any = own_system(key)
        self._new = True  # whether what it learned is not of the touches that are there
        self.one_pass = callable(getattr(self._made, "observe", None))

    def observe(self, number: int, touch: Labelled) -> None:
        """Learn a touch, known by a number from then on."""
        self._there[number] = touch
        if self.one_pass:
            self._made.observe(*touch)
        self._new = True

    def retract(self, number: int) -> None:
        """Give a touch up."""
        touch = self._there.pop(number)
        if self.one_pass and callable(getattr(self._made, "retract", None)):
            self._made.retract(*touch)
        elif self.one_pass:
            self._made = own_system(self._key)
            for other in self._there.values():
                self._made.observe(*other)
        self._new = True

    def predict(self, streams: Sequence[Stream]) -> list[str]:
        """The material of each stream. With one material there is nothing to fit: it is the answer."""
        names = sorted({name for name, _ in self._there.values()})
        if not streams or len(names) < 2:
            return names * len(streams)
        if self._new and not self.one_pass:
            self._made = own_system(self._key)
            streams_there = [stream for _, stream in self._there.values()]
            self._made.fit(streams_there, [name for name, _ in self._there.values()], [], self._seed)
        self._new = False
        return list(map(str, self._made.predict(streams)))


def answering(key: str, seed: int) -> Answering:
    """What a system of one's own answers to tests after learning touches: materials alone."""

    def answers(
        sensor: Sensor, train: Sequence[Touch], tests: Mapping[str, Sequence[Readings]], progress: Progress
    ) -> Iterator[tuple[str, Answers]]:
        system = Coming(key, seed)
        for i, (material, readings) in enumerate(train):
            system.observe(i, (material, validate(readings, sensor)))
        for done, (name, touches) in enumerate(tests.items()):
            progress(name, done, len(tests))
            yield name, {"material": list(system.predict([validate(readings, sensor) for readings in touches]))}

    return answers
