"""The states that a memory had, told by its journal, and whether what a call said is of one of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from faults.model import Row, State
from scroll_tactile import Kernels, Sensor, TactileLearner
from scroll_tactile.matching.conformal import Conformal
from scroll_tactile.matching.kept_arrays import KeptArrays, KeptTouch
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import Kind, unspanned
from scroll_tactile.results import Prediction
from scroll_tactile.signals.stream import Stream

Array = npt.NDArray[np.float64]

SKIN = Sensor(name="skin", channels=4, rate=50.0, low=0.0, high=1.0, unit="N", duration=0.4)
SETTINGS: dict[str, Any] = {
    "sensor": SKIN,
    "embedding": Kernels(seed=0, dimension=64),
    "exemplars": 4,
    "kept_touches": 500,
}
LENGTH = 20  # readings of a touch


Learned = dict[int, dict[str, tuple[int, bytes]]]
"""Scale → material → its rows, and their sum."""


def learned_of(names: Sequence[str], counts: Array, sums: Array) -> dict[str, tuple[int, bytes]]:
    """What is learned at one scale: rows and their sums are integers."""
    whole = sums.astype(np.int64)
    return {name: (int(count), total.tobytes()) for name, count, total in zip(names, counts, whole, strict=True)}


def as_row(head: Any) -> Row:
    """A row of a journal as a `State` has it; a touch is its key."""
    if head.kind == Kind.RETRACT:
        return "retract", tuple(unspanned(head.attributes["sequences"])), head.label
    if head.kind == Kind.DESCRIBE:
        said = head.attributes.get("constituents")
        return "describe", head.label, None if said is None else tuple(said.items())
    return "observe", head.label, head.key


class Truth:
    """The states that there were, and what is to be said in each.

    rows: heads of the journal. readings: by key. groups: first and last of rows that became visible at once.
    """

    def __init__(self, rows: Sequence[Any], readings: dict[bytes, Array], groups: Sequence[tuple[int, int]]) -> None:
        self.rows, self._readings = rows, readings
        self._learner = TactileLearner(**SETTINGS)
        self._within = {row for first, last in groups for row in range(first, last)}
        self._sums: dict[tuple[tuple[str, bytes], ...], tuple[str, Learned]] = {}
        self._conformal: dict[int, Conformal] = {}
        self._codes: dict[bytes, Any] = {}
        self.states = [State()]
        for row in rows:
            self.states.append(self.states[-1].plus(as_row(row)))

    def stream(self, key: bytes) -> Stream:
        """A touch that was observed."""
        return self._learner.stream(self._readings[key])

    def codes(self, key: bytes) -> Any:
        """What it added to the sums."""
        if key not in self._codes:
            extractor = self._learner._predictor.extractor
            self._codes[key] = extractor.codes(extractor.image(self.stream(key)))
        return self._codes[key]

    def between(self, since: int, until: int, *, inside: bool) -> Iterator[int]:
        """The states after which rows others could see; inside: or who made several rows at once."""
        for row in range(since, min(until, len(self.rows)) + 1):
            if inside or row not in self._within:
                yield row

    def digest(self, row: int) -> str:
        """The digest after a row."""
        return self._summed(row)[0]

    def learned(self, row: int) -> Learned:
        """What readouts are of after a row."""
        return self._summed(row)[1]

    def _summed(self, row: int) -> tuple[str, Learned]:
        touches = self.states[row].pairs
        if touches not in self._sums:
            sums = Memory(self._learner._predictor.recipe).statistics
            for material, key in touches:
                sums.add(material, self.codes(key), LENGTH)
            self._sums[touches] = (
                sums.digest(),
                {
                    int(scale): learned_of(
                        names := sums.names(scale), sums.counts(scale, names), sums.sums(scale, names)
                    )
                    for scale in sums.scales
                },
            )
        return self._sums[touches]

    def typical(self, row: int, names: Sequence[str], streams: Sequence[Stream]) -> tuple[float, ...]:
        """How typical touches of one thing are of some materials."""
        kept_touches = Memory(self._learner._predictor.recipe)
        if row not in self._conformal:
            kept = [
                KeptTouch(name, key, kept_touches.levels(self.stream(key).readings))
                for name, key in self.states[row].pairs
            ]
            self._conformal[row] = Conformal(KeptArrays(kept))
        once = {stream.key: stream for stream in streams} if len(streams) > 1 else {b"": streams[0]}
        conformal = self._conformal[row]
        levels = [kept_touches.levels(once[key].readings) for key in sorted(once)]
        found = [conformal.p_rows(own, names)[:, 0].tolist() for own in levels]
        if len(found) == 1:
            return tuple(found[0])
        return tuple(min(1.0, 2 * math.fsum(of) / len(found)) for of in zip(*found, strict=True))


@dataclass
class Told:
    """What a call said. since, until: rows of the memory before the call and after its return.

    of: "digest", "materials" and so on, or "prediction": then streams are those that it is of, where they are known,
    and learned is what the readouts are of.
    """

    of: str
    since: int
    until: int
    what: Any
    inside: bool = False
    streams: Sequence[Stream] = ()
    learned: Learned | None = None

    def is_of(self, truth: Truth, row: int) -> bool:
        """Whether it is what the memory says after a row."""
        return self.differs(truth, row) is None

    def differs(self, truth: Truth, row: int) -> str | None:
        """What of it the memory does not say after a row."""
        state = truth.states[row]
        if self.of == "prediction":
            return self._predicted(truth, row)
        if self.of == "exemplars":
            same = all((name, key) in state.pairs for name, keys in self.what.items() for key in keys)
        elif self.of == "digest":
            same = self.what == truth.digest(row)
        elif self.of == "materials":
            same = self.what == state.materials
        else:
            same = repr(self.what) == repr(dict(sorted(state.said.items())))
        return None if same else self.of

    def _predicted(self, truth: Truth, row: int) -> str | None:
        said: Prediction = self.what
        materials, names = truth.states[row].materials, [name for name, _ in said.ranking]
        if sorted(names) != list(materials):
            return f"materials {sorted(names)} of {materials}"
        learned = truth.learned(row)
        if self.learned is not None and self.learned != learned:
            differ = {
                (scale, name): (of, learned[scale].get(name, (0, b""))[0])
                for scale, found in self.learned.items()
                for name, (of, total) in found.items()
                if learned[scale].get(name) != (of, total)
            }
            return f"readouts of other rows, of some as many as in (these, those): {differ}"
        if self.streams and said.typicality != truth.typical(row, names, self.streams):
            return f"typicality {said.typicality}, and not {truth.typical(row, names, self.streams)}"
        return None

    def unsound(self) -> str | None:
        """What is wrong with it by itself."""
        if self.of == "prediction" and self.what.ranking:
            said, total = self.what, math.fsum(share for _, share in self.what.ranking)
            if not (abs(total - 1) < 1e-9 and math.isfinite(said.novelty)):
                return f"a prediction whose shares sum to {total}, of novelty {said.novelty}"
        return None


@dataclass
class LiveTold:
    """All that was said of one live touch, which began while a call lasted."""

    said: list[Told] = field(default_factory=list)
