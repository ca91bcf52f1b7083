"""Where a run's touches go: the memory that comes out of it, and the report of what came in."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from scroll_tactile_store import Head
from scroll_tactile_store.files import remove_tree

from scroll_tactile.clients.learning.learning import learn_sources, store_model
from scroll_tactile.clients.learning.sources import Refused, SourceOptions, has_touches
from scroll_tactile.clients.learning.workers.jobs import Made, Making, hush
from scroll_tactile.clients.learning.workers.steps import Step
from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.persistence.merge import Choice, MergeRules
from scroll_tactile.quantities import require_declarable
from scroll_tactile.recipe import RecipeRequest

__all__ = ["Destination", "FleetReport"]

SAVED_EVERY = 4096  # touches: what opening replays where a run was cut short; a checkpoint costs what 100 do

Progress = Callable[[str, int, int], object]


def _require_own_skin(learner: TactileLearner) -> None:
    """Raise InputError for a memory that reads through an adaptation: workers learn apart from it."""
    if learner.memory.corrections:
        raise InputError(
            f"{learner.path} was adapted to a changed skin by row {max(learner.memory.corrections)}, of which the "
            "workers of a fleet know nothing: learn with scroll-tactile learn, or retract that row first"
        )


@dataclass
class FleetReport:
    """What a run did.

    sources: how many were read, now or before the run was cut short. observations: touches that came in. repeated:
    those that had come before, by their names and contents. refused: what was not learned, and why; of touches that
    came under two names the first counts, of the destination and then of the sources in their order. deaths: jobs whose
    worker ended before them, or did not answer. seconds: of all, and of merging. processor: seconds of the workers,
    and of this process. held, digest: of the memory that came out. range_problem: where touches do not fit the
    sensor's range, what is wrong with the first, and what to do.
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
    processor: dict[str, float] = field(default_factory=lambda: {"learning": 0.0, "merging": 0.0})


class Destination:
    """The memory that comes out: made when the first touches come in.

    making: what it is made with. learned: whether it was there before the run, with touches.

    Raises AnnotationError where it has another quantity than is declared for it, under one name.
    """

    def __init__(
        self,
        place: Path,
        requested: RecipeRequest,
        options: SourceOptions,
        patience: float | None,
        stack: ExitStack,
        report: FleetReport,
        descriptions: Choice,
    ) -> None:
        self._place, self._stack, self._report, self._descriptions = place, stack, report, descriptions
        self.learner: TactileLearner | None = None
        if place.exists():
            self.learner = stack.enter_context(TactileLearner.open(place, **requested.arguments))
            hush(self.learner)
            _require_own_skin(self.learner)
        there = {} if self.learner is None else self.learner.quantities
        for quantity in options.declared:
            require_declarable(there, quantity)
        recipe = requested.recipe() if self.learner is None else self.learner._recipe
        self.making = Making(recipe, options, patience, tuple(there.values()))
        self.learned = self.learner is not None and bool(self.learner.observations())
        self._made = self.learner is None

    def opened(self) -> TactileLearner:
        """The memory, made where there is none."""
        if self.learner is None:
            self.learner = self._stack.enter_context(self.making.open(self._place))
            hush(self.learner)
        return self.learner

    def learn(self, step: Step, progress: Progress) -> None:
        """Learn the recordings of a step. Raises StoreError, CapacityError."""
        options, recipe = self.making.options, self.making.recipe
        if self.learner is None and not has_touches(recipe.sensor, step.sources, options, recipe.embedding):
            learner = TactileLearner(sensor=recipe.sensor, embedding=recipe.embedding)  # for what is refused
            hush(learner)
        else:
            learner = self.opened()
        done = learn_sources(learner, step.sources, options, progress)
        step.made, step.failed = Made("", range_problem=done.range_problem), done.failed
        self._report.observations += done.learned.total()
        self._report.repeated += done.skipped
        self._report.refused += done.refused
        self._save()

    def merge(
        self, path: Path, progress: Progress, clipped: Collection[bytes] = (), source: str | None = None
    ) -> list[tuple[Head, str]]:
        """Merge a memory, each touch once; its rows that are refused, and why. Raises as `Ledger.merge`."""
        begun, processor = time.perf_counter(), time.process_time()
        try:
            ledger = self.opened()._ledger
            # What our own workers made is taken as what this memory holds itself.
            rules = MergeRules(
                one_name=True,
                descriptions=self._descriptions,
                clipped=clipped,
                default_source=source,
                thorough=source is not None,
            )
            merged, refused = ledger.merge(path, rules, progress)
            self._save()
        finally:
            self._report.merging += time.perf_counter() - begun
            self._report.processor["merging"] += time.process_time() - processor
        self._report.observations += merged.observations
        self._report.repeated += merged.shared
        return refused

    def _save(self) -> None:
        ledger = None if self.learner is None else self.learner._ledger
        if ledger is not None:
            ledger.checkpoint_in_background(SAVED_EVERY)

    def close(self, progress: Progress) -> None:
        """Write a checkpoint and a fitted model, and close it.

        Raises InputError where nothing was learned; it is not there then.
        """
        if self.learner is None or (self._made and not self.learner.memory.sequence):
            if self.learner is not None:
                self.learner.close()
                remove_tree(self._place)
            refused = self._report.refused
            first = f", such as {refused[0].source}: {refused[0].why}" if refused else ""
            raise InputError(f"nothing was learned, and no memory made: {len(refused)} sources were refused{first}")
        self._report.held, self._report.digest = sum(self.learner.materials.values()), self.learner.digest()
        self.learner._ledger.saves = True
        store_model(self.learner, progress)
        self.learner.close()
