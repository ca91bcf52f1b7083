"""What a fleet's workers learned comes into one memory, and what came of it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from scroll_tactile.errors import MismatchError, ObservationError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.memory.contents import Contents, refusal
from scroll_tactile.memory.descriptions import Description
from scroll_tactile.memory.merge import Choice
from scroll_tactile.memory.partial import Joint, Partial
from scroll_tactile.pipelines.choosing import choose
from scroll_tactile.pipelines.partials import Contained, Making, SumJob, sum_partials
from scroll_tactile.pipelines.sources import Refused
from store import DamageError

__all__ = ["FleetReport", "Gathering"]


@dataclass
class FleetReport:
    """What a run did.

    sources: how many were read, now or before the run was cut short. observations: touches that came in. repeated:
    those that had come before, by their names and contents. refused: what was not learned, and why; of touches that
    came under two names the first counts, of the destination and then of the sources in their order. deaths: jobs whose
    worker ended before them, or did not answer. seconds: of all, and of the merge at the end. processor: seconds of the
    workers' and of this process, of learning, of sums and of the merge. held, digest: of the memory that came out.
    range_problem: where touches do not fit the sensor's range, what is wrong with the first, and what to do.
    """

    sources: int = 0
    observations: int = 0
    repeated: int = 0
    refused: list[Refused] = field(default_factory=list)
    deaths: int = 0
    seconds: float = 0.0
    merging: float = 0.0
    held: int = 0
    digest: str = ""
    range_problem: str | None = None
    processor: dict[str, float] = field(default_factory=lambda: {"learning": 0.0, "sums": 0.0, "merge": 0.0})


@dataclass
class Gathering:
    """The merge at the end of a run. refused: sources of which something was.

    order: of the sources. progress: as of `TactileLearner.merge`.
    """

    folder: Path
    making: Making
    report: FleetReport
    order: Mapping[str, int]
    progress: Callable[[str, int, int], object]
    refused: set[str] = field(default_factory=set)

    def merge(
        self,
        held: TactileLearner,
        parts: Sequence[Contained],
        sums: str | None,
        wholes: Sequence[Contained],
        descriptions: Choice,
    ) -> None:
        """Put partials with rows, whose sum is in a file, and without into a memory; what is there is left out."""
        begun, processor = time.perf_counter(), time.process_time()
        rows = [row for row in held.observations() if row.state != "retracted"]
        there = Contents((row.material, row.key, row.sequence) for row in rows)
        self._merge_rows(held, parts, sums, descriptions, there)
        together, alone = self._apart(wholes, there)
        for whole in together:
            self._merge_whole(held, whole, descriptions)
        for whole in alone:
            other = [why for name, key in whole.touches if (why := refusal(there.names(key), name)) is not None]
            if other:
                more = f" (and {len(other) - 1} more of its touches)" if len(other) > 1 else ""
                self._refuse(whole.learned, f"{other[0]}{more}; it has no rows, of which one could be left out")
            elif self._merge_whole(held, whole, descriptions):
                _note(whole, there)
        self.report.merging = time.perf_counter() - begun
        self.report.processor["merge"] += time.process_time() - processor

    def _merge_rows(
        self,
        held: TactileLearner,
        parts: Sequence[Contained],
        sums: str | None,
        descriptions: Choice,
        there: Contents,
    ) -> None:
        with ExitStack() as stack:
            inside = sorted(parts, key=lambda part: min(map(self.order.__getitem__, part.sources), default=0))
            opened = [(part, stack.enter_context(Partial(Path(part.path)))) for part in inside]
            self.report.range_problem = next((part.range_problem for part in inside if part.range_problem), None)
            chosen = choose(opened, self.order, there)
            self.report.repeated += chosen.repeated
            for address, said, why in chosen.refused:
                self.report.refused.append(Refused(said, why))
                self.refused.add(address)
            if sums is None:
                return
            described = _described([partial for _, partial in opened], descriptions)
            rows = [(opened[number][1], out) for number, out in chosen.rows]
            joint = Joint(rows, stack.enter_context(Partial(Path(sums))), described, chosen.not_taken)
            try:
                done = held.merge(joint, shared="once", descriptions=descriptions, progress=self.progress)
            except DamageError as error:
                if self.folder not in error.path.parents:
                    raise
                why = f"{error.path} is not as it was written; call again: its sources are learned again"
                raise DamageError(why, path=error.path) from error
            self.report.observations += done.observations
            self.report.repeated += done.shared

    def _merge_whole(self, held: TactileLearner, whole: Contained, descriptions: Choice) -> bool:
        try:
            done = held.merge(whole.path, shared="once", descriptions=descriptions, progress=self.progress)
        except (MismatchError, ObservationError) as error:
            self._refuse(whole.learned, str(error))
            return False
        self.report.observations += done.observations
        return True

    def _refuse(self, sources: Sequence[str], why: str) -> None:
        self.report.refused += [Refused(source, why) for source in sources]
        self.refused.update(sources)

    def _apart(self, wholes: Sequence[Contained], there: Contents) -> tuple[list[Contained], list[Contained]]:
        """Partials without rows: those that add up and share no touch, as one, and each of the others."""
        together: list[Contained] = []
        alone: list[Contained] = []
        for whole in sorted(wholes, key=lambda whole: self.order[whole.sources[0]]):
            shares = any(there.names(key) for _, key in whole.touches)
            if whole.adds_up and not whole.described and not shares:
                together.append(whole)
                _note(whole, there)
            else:
                alone.append(whole)
        if len(together) > 1:
            target = self.folder / f"sum-{os.getpid()}-whole.part"
            done = sum_partials(SumJob(self.making, tuple((whole.path, ()) for whole in together), str(target)))
            self.report.processor["sums"] += done.processor
            sources = tuple(source for whole in together for source in whole.learned)
            together = [Contained(done.path, sources, (), (), has_rows=False)]
        return together, alone


def _note(whole: Contained, there: Contents) -> None:
    for name, key in whole.touches:
        if not there.names(key):
            there.add(name, key, 0)


def _described(partials: Sequence[Partial], choice: Choice) -> dict[str, Description]:
    """The descriptions of all; raises MismatchError where two differ and nobody chose."""
    found: dict[str, tuple[Description, Path]] = {}
    for partial in partials:
        for material, description in partial.descriptions.items():
            before = found.get(material)
            if before is not None and repr(before[0]) != repr(description) and choice == "same":
                raise MismatchError(
                    f"{before[1]} and {partial.path} describe {material!r} differently: as {before[0]}, and as "
                    f"{description}. Choose with descriptions='ours' (the first) or 'theirs' (the last)"
                )
            if before is None or choice == "theirs":
                found[material] = description, partial.path
    return {material: description for material, (description, _) in found.items()}
