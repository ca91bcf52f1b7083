"""All that the page of a memory rests on, each found once and when it is first needed."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from scroll_tactile.clients.report.drawing import as_counted
from scroll_tactile.clients.report.growing import Growing, Soon, chosen, growing, soon
from scroll_tactile.clients.report.knowledge import MOST_NEAR, Mistake, Trust, mistakes, separations, trust_in
from scroll_tactile.clients.report.page import note
from scroll_tactile.errors import (
    CapacityError,
    EmbeddingError,
    MismatchError,
    ScrollTactileError,
    StreamError,
    WeightsError,
)
from scroll_tactile.learner import TactileLearner
from scroll_tactile.live.decision import DecisionRule, decision_rule
from scroll_tactile.matching.match import KeptTouch
from scroll_tactile.memory.axes import axis_memory
from scroll_tactile.memory.exemplars import Exemplar
from scroll_tactile.memory.state import Memory
from scroll_tactile.prediction.current import estimator_of
from scroll_tactile.prediction.features import FeatureExtractor, stream_of
from scroll_tactile.prediction.fitting import Draft
from scroll_tactile.prediction.judging import HeldOutTouch, held_out_touches
from scroll_tactile.prediction.model import Model, enough_memory
from scroll_tactile.readouts.estimation import Estimator
from scroll_tactile.results import Observation
from scroll_tactile.signals.stream import validate

__all__ = ["MemoryFacts"]

CANNOT_EMBED = EmbeddingError, MismatchError, StreamError, WeightsError


@dataclass
class MemoryFacts:
    """What a memory knows.

    risk: the share of wrong answers among those decided. of: an axis, whose labels it then knows in place of materials.
    missing: what the page lacks and why, filled as it is made. unread: whether the embedding is not at hand, and
    nothing was fitted to beginnings.
    """

    learner: TactileLearner
    risk: float
    of: str | None = None
    missing: list[str] = field(default_factory=list)
    unread: bool = False

    def lacks(self, what: str, why: str) -> str:
        """Note that something is missing, and say so in its place."""
        self.missing.append(f"{what}: {why}")
        return note(f"Not shown: {why}")

    def by(self, axis: str) -> MemoryFacts:
        """What it knows by the labels on an axis; what is missing there is noted here."""
        return MemoryFacts(self.learner, self.risk, axis, self.missing)

    @cached_property
    def memory(self) -> Memory:
        """What was learned, by materials or by labels."""
        return self.learner.memory if self.of is None else axis_memory(self.learner.memory, self.of)

    @property
    def names(self) -> str:
        """What touches are called by."""
        return "materials" if self.of is None else f"labels on {self.of}"

    @cached_property
    def counts(self) -> dict[str, int]:
        """Material → touches, in the order of names."""
        return dict(sorted(self.memory.statistics.materials.items(), key=lambda pair: as_counted(pair[0])))

    @cached_property
    def journal(self) -> list[Observation]:
        """All observations in order; none of a memory without a path."""
        return self.learner.observations()

    @cached_property
    def model(self) -> Model | None:
        """The model that answers, touches held out of it; None of an empty memory, and where none can be fitted."""
        try:
            return self._fitted() if self.counts else None
        except CapacityError:
            raise
        except ScrollTactileError as error:  # sums that came from elsewhere have no readout, and the ridge has a limit
            self.missing.append(f"Nothing could be fitted: {error}")
            return None

    def _fitted(self) -> Model:
        try:
            return self.learner._by(self.of).examined()
        except CANNOT_EMBED as error:
            self.missing.append(f"When answers are decided: {error}")
            self.unread = True
            with enough_memory():
                return Draft.of(self.memory, self.learner.settings.readout).fit(None)

    @cached_property
    def held_out(self) -> list[HeldOutTouch]:
        """The answers to held-out touches."""
        return [] if self.model is None else held_out_touches(self.model, self.learner.settings.false_alarms)

    @cached_property
    def trust(self) -> Trust | None:
        """How far answers can be believed; None where nothing could be left out."""
        return trust_in(self.held_out) if self.held_out else None

    @cached_property
    def mistakes(self) -> list[Mistake]:
        """All confusions, the most frequent first."""
        return mistakes(self.held_out)

    @cached_property
    def near(self) -> tuple[list[str], npt.NDArray[np.float64]]:
        """Materials and their separations; none where there are too few, or too many."""
        if self.model is None or not 1 < len(self.counts) <= MOST_NEAR:
            return [], np.zeros((0, 0))
        return separations(self.memory.statistics, self.model)

    @cached_property
    def kept(self) -> list[KeptTouch]:
        """The kept touches, in the order of observation where that is known."""
        touches = self.memory.kept.touches() if self.memory.kept is not None else []
        place = {row.key: row.sequence for row in self.journal}
        return sorted(touches, key=lambda touch: (place.get(touch.key, 0), touch.material, touch.key))

    @property
    def ordered(self) -> bool:
        """Whether that order is known."""
        return bool(self.journal)

    @cached_property
    def exemplars(self) -> dict[str, list[Exemplar]]:
        """Material → its exemplars with readings."""
        return self.learner.ranked_exemplars()

    @cached_property
    def extractor(self) -> FeatureExtractor:
        """What makes features of touches."""
        learner = self.learner
        return FeatureExtractor(learner.sensor, learner.embedding, learner.plan)

    @cached_property
    def rule(self) -> DecisionRule | None:
        """When an answer is safe to act on; None where nothing can be left out, or embedded."""
        if self.model is None or not self.held_out or self.unread:
            return None
        return decision_rule(self.model, self.risk)

    @cached_property
    def estimator(self) -> Estimator | None:
        """What estimates quantities; None where none was declared."""
        return estimator_of(self.memory) if self.memory.quantities else None

    @cached_property
    def soon(self) -> Soon | None:
        """How soon answers come; None where that was not measured."""
        if self.model is None or self.rule is None:
            return None
        return soon(self.model, self.extractor, self.rule, self.learner.settings.false_alarms)

    @cached_property
    def growing(self) -> tuple[list[Growing], str]:
        """How answers to a few left-out touches grow, or why there are none."""
        if self.model is None or not self.held_out:
            return [], self.nothing_left_out
        if self.rule is None:
            return [], "the embedding is not at hand; see below."
        sensor, kept = self.learner.sensor, {touch.key: touch for touch in self.kept}
        held = {} if kept else {exemplar.key: exemplar for own in self.exemplars.values() for exemplar in own}
        touches = chosen(self.held_out, kept or held, sensor.camera)
        if not touches:
            return [], "of no touch that could be left out the readings are kept."
        streams = {
            touch.key: stream_of(kept[touch.key].levels, sensor) if kept else validate(held[touch.key].readings, sensor)
            for touch in touches
        }
        try:
            return growing(self.learner, self.model, self.extractor, self.rule, touches, streams), ""
        except CANNOT_EMBED as error:
            return [], str(error)

    @property
    def nothing_left_out(self) -> str:
        """Why no touch could be left out."""
        if not self.counts:
            return "no touch was observed yet."
        if len(self.counts) == 1:
            return f"there is one of the {self.names}, with nothing to be mixed up with; teach a second one."
        return f"nothing can be left out: that takes two {self.names} with two touches or more of each."
