"""`python -m examples.benchmarks adapt`: right answers after a new unit, before and after five touches with it.

Half of each set's touches are learned, from one unit. Another unit reads the others: low + gain · (x − low) + offset,
clipped to the range, gains even within ± 20 %, offsets within ± 5 % of the range, or of what readings of the channel
span (four standard deviations of all that were learned). Five of those touches, of different materials as far as there
are five, adapt the memory; the rest are judged, as they were recorded, as the other unit reads them, and adapted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from examples.benchmarks.health import Measured, Touches, read_sets
from examples.paper.runs.options import Json, Seed
from examples.paper.runs.results import show, write
from scroll_tactile import TactileLearner
from scroll_tactile.blas import one_thread
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.signals.stream import Stream, validate

__all__ = ["adapt", "run_adapting"]

Record = dict[str, Any]
Floats = npt.NDArray[np.float64]

GAIN, OFFSET = 0.2, 0.05
FIVE = 5
CASES = ("the same unit", "offsets of what is used", "offsets of the range", "one channel dead")
HALF = 400  # touches that are learned at most


@dataclass(frozen=True)
class Unit:
    """What another unit reads in place of this one: gains (n,), offsets (n,) in the sensor's unit; dead: a channel."""

    low: Floats
    high: Floats
    gains: Floats
    offsets: Floats
    dead: int | None

    def reads(self, stream: Stream) -> Floats:
        """The readings of a touch, (T, n)."""
        found = np.clip(self.low + self.gains * (stream.readings - self.low) + self.offsets, self.low, self.high)
        if self.dead is not None:
            found[:, self.dead] = self.low[self.dead]
        return np.asarray(found, np.float32)


class Learned:
    """A set of touches, half of which a memory in a folder has learned as it is first needed."""

    def __init__(self, touches: Touches, folder: Path, seed: int) -> None:
        self.touches, self._folder = touches, folder
        names, random = np.unique(touches.materials), np.random.default_rng([seed, 36])
        own = [random.permutation(np.flatnonzero(touches.materials == name)) for name in names]
        most = HALF // len(names)
        self.learned = np.concatenate([of[: min(len(of) // 2, most)] for of in own])
        self.others = np.concatenate([of[min(len(of) // 2, most) :] for of in own])

    @cached_property
    def learner(self) -> TactileLearner:
        """The memory."""
        learner = TactileLearner.open(self._folder / self.touches.name, sensor=self.touches.sensor)
        with learner.batch():
            for i in self.learned.tolist():
                learner.observe(str(self.touches.materials[i]), self.touches.streams[i])
        learner.settle()
        return learner

    @cached_property
    def spans(self) -> Floats:
        """What the readings of each channel span, (n,), in the sensor's unit."""
        return np.asarray(
            4 * np.concatenate([self.touches.streams[i].readings for i in self.learned]).std(axis=0), np.float64
        )

    def unit(self, case: str, random: np.random.Generator) -> Unit:
        """Another unit."""
        n = self.touches.sensor.channels
        low, high = (np.broadcast_to(np.asarray(limit, np.float64), n) for limit in self.touches.sensor.limits)
        gains, shares = random.uniform(1 - GAIN, 1 + GAIN, n), random.uniform(-OFFSET, OFFSET, n)
        dead = int(random.choice(self.touches.active)) if case == CASES[3] else None
        if case == CASES[0]:
            return Unit(low, high, np.ones(n), np.zeros(n), None)
        return Unit(low, high, gains, shares * (high - low if case == CASES[2] else self.spans), dead)

    def drawn(self, random: np.random.Generator, judged: int) -> tuple[list[int], list[int]]:
        """Five touches to adapt by, of different materials as far as there are five, and those to be judged."""
        materials, order = self.touches.materials, random.permutation(self.others).tolist()
        wanted = np.resize(random.permutation(np.unique(materials)), FIVE)
        by: list[int] = []
        for name in wanted:
            by.append(next(i for i in order if materials[i] == name and i not in by))
        return by, [i for i in order if i not in by][:judged]

    def answers(self, which: list[int], unit: Unit) -> Record:
        """Shares of right answers, and of those called unknown."""
        sensor, materials = self.touches.sensor, self.touches.materials
        found = [self.learner.predict(validate(unit.reads(self.touches.streams[i]), sensor)) for i in which]
        right = [each.material == materials[i] for each, i in zip(found, which, strict=True)]
        return {"right": float(np.mean(right)), "unknown": float(np.mean([each.known is False for each in found]))}


def run_unit(learned: Learned, case: str, seed: int, judged: int) -> Record:
    """One other unit: answers to touches as recorded, as it reads them, and adapted by five of them."""
    random = np.random.default_rng([seed, CASES.index(case), 37])
    by, which = learned.drawn(random, judged)
    unit, same = learned.unit(case, random), learned.unit(CASES[0], random)
    learner, touches = learned.learner, learned.touches
    found = {"clean": learned.answers(which, same)}
    found["before"] = found["clean"] if case == CASES[0] else learned.answers(which, unit)
    done = learner.adapt([(str(touches.materials[i]), unit.reads(touches.streams[i])) for i in by])
    found["after"] = learned.answers(which, unit) if done.kept else found["before"]
    if done.kept:
        learner.retract(done)
    named = case == CASES[3] and done.left_out == (unit.dead,)
    return {**found, "kept": done.kept, "left_out": len(done.left_out), "named": named, "touches": len(which)}


def summed(name: str, case: str, units: list[Record]) -> Record:
    """A row of the table: means over units."""
    found: Record = {"set": name, "case": case, "units": len(units), "touches": units[0]["touches"]}
    for when in ("clean", "before", "after"):
        for what in ("right", "unknown"):
            found[f"{when}_{what}"] = float(np.mean([unit[when][what] for unit in units]))
    found["worst"] = float(min(unit["after"]["right"] - unit["clean"]["right"] for unit in units))
    return found | {"kept": sum(unit["kept"] for unit in units), "left_out": sum(unit["left_out"] for unit in units)}


def _sets(data: Path | None, seed: int, only: str | None) -> Iterator[Touches]:
    return (touches for touches in read_sets(data, seed) if only is None or touches.name.startswith(only))


def run_adapting(
    data: Path | None,
    *,
    units: int,
    judged: int,
    seed: int,
    only: str | None = None,
    cache: Path | None = None,
    note: Callable[[str], None],
) -> Record:
    """A record for each set and case. cache: a file of what was measured already, one line a unit."""
    measured, records = Measured(cache), []
    with one_thread(), TemporaryDirectory() as folder:
        for touches in _sets(data, seed, only):
            learned = Learned(touches, Path(folder), seed)
            for case in CASES:
                note(f"{touches.name}: {case}")
                own = [
                    measured.get((touches.name, case, unit, judged), partial(run_unit, learned, case, unit, judged))
                    for unit in range(seed, seed + units)
                ]
                records.append(summed(touches.name, case, own))
            if "learner" in vars(learned):
                learned.learner.close()
    return {"bench": "adapt", "gain": GAIN, "offset": OFFSET, "records": records}


def adapt(
    context: typer.Context,
    data: Annotated[Path | None, typer.Option(help="Folder of FabricSlide and biotac_slide_20_50.")] = None,
    units: Annotated[int, typer.Option(min=1, help="Other units for each set and case.")] = 3,
    judged: Annotated[int, typer.Option(min=1, help="Touches judged for each.")] = 100,
    only: Annotated[str | None, typer.Option(help="The set whose name begins so; all unless given.")] = None,
    cache: Annotated[Path | None, typer.Option(help="A file to go on from after an interruption.")] = None,
    seed: Seed = 200,
    json: Json = None,
) -> None:
    """Read touches by another unit, and adapt to it by five: right answers before and after."""
    with progress_bar() as progress:
        how: dict[str, Any] = {"units": units, "judged": judged, "seed": seed, "only": only, "cache": cache}
        result = run_adapting(data, **how, note=lambda what: progress(what, 0, 1))
    columns = {"set": "{./set}", "other unit": "{./case}", "units": "{./units}"}
    for when in ("clean", "before", "after"):
        columns |= {when: f"{{./{when}_right|.1%}}", f"unknown {when}": f"{{./{when}_unknown|.0%}}"}
    columns |= {"kept": "{./kept}", "left out": "{./left_out}"}
    show("right answers after a new unit", columns, result["records"])
    write(context, result)
