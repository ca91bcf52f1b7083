"""Whether a learner keeps its promises, with its own sensor, embedding and settings."""

from __future__ import annotations

import copy
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import EmptyStreamError, LearnerError, NotFiniteError, StreamError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.quantities import Quantity
from scroll_tactile.sensors import Sensor
from scroll_tactile.simulation.gel import Gel
from scroll_tactile.simulation.scene import Scene

__all__ = ["check_learner"]

Labelled = tuple[str, npt.NDArray[np.float32]]
Make = Callable[[Path], TactileLearner]


@dataclass(frozen=True)
class _Bench:
    """What every check works with: how to make a learner, folders to make them in, and touches of three materials."""

    make: Make
    root: Path
    touches: list[Labelled]

    def learner(self, name: str, touches: Iterable[Labelled] = ()) -> TactileLearner:
        """A learner in a folder of this name that observed these touches, in this order."""
        learner = self.make(self.root / name)
        for material, readings in touches:
            learner.observe(material, readings.copy())
        return learner

    def require_same(self, name: str, ours: TactileLearner, theirs: TactileLearner) -> None:
        """Raise LearnerError where two learners differ in digest, materials, exemplars or answers."""
        for what, of in (
            ("digest", lambda learner: learner.digest()),
            ("materials", lambda learner: learner.materials),
            ("exemplars", lambda learner: learner.exemplars),
            ("axes", lambda learner: learner.axes),
            ("answers", lambda learner: [repr(learner.predict(readings)) for _, readings in self.touches[:3]]),
        ):
            if (here := of(ours)) != (there := of(theirs)):
                raise LearnerError(f"{name}: expected the same {what}; came {here!r:.200} and {there!r:.200}")


def check_learner(make_learner: Make, *, touches: Sequence[tuple[str, npt.ArrayLike]] | None = None) -> list[str]:
    """Try a learner of a user's own making on everything that is promised of it; what was found to hold, in words.

    make_learner: opens the memory in the folder that it is given, or makes it where there is nothing, always with the
    same sensor, embedding and settings. touches: (material, readings of shape (T, n)) of two materials or more, three
    touches each; simulated ones unless given.

    Raises LearnerError that names the first promise that does not hold, or what the learner raised.

    >>> from scroll_tactile import Kernels, TactileLearner, sensors
    >>> def make(path):
    ...     return TactileLearner.open(path, sensor=sensors.ROBOSKIN, embedding=Kernels(dimension=64))
    >>> check_learner(make)[0]
    'any order gives the same memory'
    """
    promises = [
        _any_order,
        _any_split,
        _merging_is_union,
        _retracting_undoes,
        _what_is_noted_is_exact,
        _predicting_changes_nothing,
        _opening_gives_back,
        _a_snapshot_knows_the_same,
        _nothing_is_known_at_first,
        _one_material_is_named,
        _a_new_material_needs_no_announcement,
        _what_cannot_be_read_is_refused,
        _read_only_arrays_are_read,
        _estimates_know_no_order,
    ]
    held = []
    with tempfile.TemporaryDirectory(prefix="check-learner-") as folder:
        with make_learner(Path(folder) / "first") as learner:
            chosen = _simulated(learner.sensor) if touches is None else touches
        given = [(name, np.asarray(readings, dtype=np.float32)) for name, readings in chosen]
        counts = Counter(name for name, _ in given)
        if len(counts) < 2 or min(counts.values()) < 3:
            raise LearnerError(f"expected three touches or more of two materials or more; came {dict(counts)}")
        for number, promise in enumerate(promises):
            promise(_Bench(make_learner, Path(folder) / str(number), given))
            held.append(str(promise.__doc__).rstrip("."))
    return held


def _any_order(bench: _Bench) -> None:
    """any order gives the same memory."""
    with bench.learner("a", bench.touches) as ours, bench.learner("b", bench.touches[::-1]) as theirs:
        bench.require_same("order", ours, theirs)


def _any_split(bench: _Bench) -> None:
    """touches observed one by one, or in a batch, give the same memory."""
    with bench.learner("a", bench.touches) as ours, bench.learner("b") as theirs:
        with theirs.batch():
            for material, readings in bench.touches:
                theirs.observe(material, readings)
        bench.require_same("batch", ours, theirs)


def _merging_is_union(bench: _Bench) -> None:
    """two merged memories are the one that observed everything."""
    half = len(bench.touches) // 2
    with bench.learner("a", bench.touches[:half]) as ours, bench.learner("whole", bench.touches) as whole:
        bench.learner("b", bench.touches[half:]).close()
        ours.merge(bench.root / "b")
        bench.require_same("merge", ours, whole)


def _retracting_undoes(bench: _Bench) -> None:
    """a retracted observation leaves the memory as if it had never been."""
    *others, (material, readings) = bench.touches
    with bench.learner("a", others) as ours, bench.learner("b", others[:1]) as theirs:
        receipt = theirs.observe(material, readings)
        for name, touch in others[1:]:
            theirs.observe(name, touch)
        theirs.retract(receipt)
        bench.require_same("retract", theirs, ours)


def _what_is_noted_is_exact(bench: _Bench) -> None:
    """values and labels of touches come in any order, merged or not, and leave with their touch."""
    noted = [({"check": number / 8}, {"check": "ab"[number % 2]}) for number in range(len(bench.touches))]
    everything = list(zip(bench.touches, noted, strict=True))

    def learned(name: str, chosen: Sequence[tuple[Labelled, Any]]) -> TactileLearner:
        learner = bench.learner(name)
        learner.declare(Quantity(name="check", unit="1", low=0, high=len(everything), resolution=1 / 8))
        for (material, readings), (values, labels) in chosen:
            learner.observe(material, readings.copy(), values=values, labels=labels)
        return learner

    (material, readings), _ = everything[0]
    with learned("a", everything) as ours, learned("b", everything[:0:-1]) as theirs:
        learned("c", everything[:1]).close()
        theirs.retract(theirs.observe(material, readings.copy(), values={"check": 0.5}, labels={"check": "c"}))
        theirs.merge(bench.root / "c")
        bench.require_same("values and labels", ours, theirs)
        if ours.digest() == bench.learner("d", bench.touches).digest():
            raise LearnerError("values and labels: expected another digest with them than without; it is the same")


def _predicting_changes_nothing(bench: _Bench) -> None:
    """a prediction changes nothing, and repeats itself."""
    with bench.learner("a", bench.touches) as learner:
        digest, answers = (
            learner.digest(),
            [repr([learner.predict(touch) for _, touch in bench.touches]) for _ in range(2)],
        )
        if learner.digest() != digest or answers[0] != answers[1]:
            raise LearnerError(f"predict: the memory or its answer changed: {answers[0]:.200}, then {answers[1]:.200}")


def _opening_gives_back(bench: _Bench) -> None:
    """a memory that was closed opens as it was."""
    bench.learner("a", bench.touches).close()
    with bench.learner("a") as again, bench.learner("b", bench.touches) as whole:
        bench.require_same("open", again, whole)


def _a_snapshot_knows_the_same(bench: _Bench) -> None:
    """a deep copy is a snapshot that knows the same."""
    with bench.learner("a", bench.touches) as learner:
        bench.require_same("deepcopy", copy.deepcopy(learner), learner)


def _nothing_is_known_at_first(bench: _Bench) -> None:
    """before anything is observed the answer is unknown."""
    with bench.learner("a") as learner:
        answer = learner.predict(bench.touches[0][1])
        if answer.material is not None or answer.known is not False:
            raise LearnerError(f"an empty memory: expected no material, unknown; came {answer!r:.200}")


def _one_material_is_named(bench: _Bench) -> None:
    """with one material observed that one is the answer."""
    with bench.learner("a", bench.touches[:1]) as learner:
        answer = learner.predict(bench.touches[0][1])
        if answer.material != bench.touches[0][0]:
            raise LearnerError(f"one material: expected {bench.touches[0][0]!r}; came {answer!r:.200}")


def _a_new_material_needs_no_announcement(bench: _Bench) -> None:
    """a new material is a candidate from its first touch on."""
    new, readings = bench.touches[-1]
    with bench.learner("a", [touch for touch in bench.touches if touch[0] != new]) as learner:
        learner.predict(readings)
        learner.observe(new, readings)
        answer = learner.predict(readings)
        if new not in dict(answer.ranking):
            raise LearnerError(f"a new material: {new!r} was observed and is no candidate in {answer!r:.200}")


def _what_cannot_be_read_is_refused(bench: _Bench) -> None:
    """NaN and empty streams are refused, and leave the memory as it was."""
    readings = bench.touches[0][1].astype(np.float64)
    with bench.learner("a", bench.touches[:3]) as learner:
        few = learner.sensor.non_finite == "refused"
        readings.reshape(-1)[-1 if few else slice(None)] = np.nan
        digest = learner.digest()
        for wrong, error in ((readings, NotFiniteError), (readings[:0], EmptyStreamError)):
            try:
                learner.observe("wrong", wrong)
                raise LearnerError(f"expected {error.__name__}; the stream was observed")
            except error:
                pass
            except StreamError as other:
                raise LearnerError(f"expected {error.__name__}; came {type(other).__name__}: {other}") from other
        if learner.digest() != digest:
            raise LearnerError("a refused stream changed the memory")


def _read_only_arrays_are_read(bench: _Bench) -> None:
    """arrays that are read-only are read, and none is written into."""
    readings = bench.touches[0][1].copy()
    before = readings.tobytes()
    readings.flags.writeable = False
    with bench.learner("a") as learner:
        learner.observe("a", readings)
        learner.predict(readings)
    if readings.tobytes() != before:
        raise LearnerError("an array that was observed was written into")


def _estimates_know_no_order(bench: _Bench) -> None:
    """values of touches give the same estimates in any order, and after opening again."""
    quantity = Quantity(name="number", unit="1", low=0.0, high=float(len(bench.touches)), resolution=1.0)

    numbered, answers = list(enumerate(bench.touches)), []
    for name, order in (("a", numbered), ("a", []), ("b", numbered[::-1])):
        with bench.learner(name) as learner:
            learner.declare(quantity)
            for number, (material, readings) in order:
                learner.observe(material, readings, values={"number": number})
            learner.settle()
            answers.append(repr([learner.estimate(touch, risk=0.5) for _, touch in bench.touches[:3]]))
    if len(set(answers)) > 1:
        raise LearnerError(
            f"estimates: expected the same; came {answers[0]:.200}, {answers[1]:.200}, {answers[2]:.200}"
        )


def _simulated(sensor: Sensor) -> list[Labelled]:
    """Three touches of each of three materials, in turns."""
    scene = Gel(sensor) if sensor.camera else Scene(sensor)
    names = scene.materials[:3]
    return [(name, scene.touch(name, repetition).readings) for repetition in range(3) for name in names]
