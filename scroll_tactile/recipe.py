"""What a memory is made with, for whoever makes one, opens one, or carries one over to another embedding."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

from scroll_tactile.arguments import require_arguments
from scroll_tactile.embeddings.kernels import Kernels
from scroll_tactile.embeddings.protocol import Embedding, window_plan
from scroll_tactile.errors import InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.settings import Settings
from scroll_tactile.signals.windows import WindowPlan

__all__ = ["Recipe", "RecipeRequest", "default_embedding", "default_kept_touches"]

DEFAULT_EXEMPLARS = 400  # streams
MOST_KEPT = 1000  # touches
MOST_KEPT_BYTES = 16_000_000  # of levels; with all that is made of them for comparing it is three times as much


@dataclass(frozen=True)
class Recipe:
    """What a memory is made with. settings: of whoever has it open; its exemplars and kept touches are numbers."""

    sensor: Sensor
    embedding: Embedding
    settings: Settings

    @classmethod
    def of(cls, sensor: Sensor, embedding: Embedding, settings: Settings | None = None) -> Self:
        """The recipe with the default numbers of exemplars and kept touches where the settings say none."""
        given = Settings() if settings is None else settings
        exemplars, kept_touches = given.exemplars, given.kept_touches
        if exemplars is None:
            exemplars = 0 if sensor.camera else DEFAULT_EXEMPLARS
        if kept_touches is None:
            kept_touches = default_kept_touches(sensor, views=window_plan(sensor, embedding).whole > 0)
        resolved = given.model_copy(update={"exemplars": exemplars, "kept_touches": kept_touches})
        return cls(sensor, embedding, resolved)

    @cached_property
    def plan(self) -> WindowPlan:
        """Which windows of a touch are read, and which of them judge."""
        return window_plan(self.sensor, self.embedding)

    @property
    def exemplars(self) -> int:
        """Streams in the buffer, or 0."""
        return self.settings.exemplars or 0

    @property
    def kept_touches(self) -> int:
        """How many touches are kept to match with, or 0."""
        return self.settings.kept_touches or 0

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments by which `TactileLearner.open` makes a memory of this recipe."""
        return _arguments(self)


@dataclass(frozen=True)
class RecipeRequest:
    """What a caller says of a memory's recipe: all of it for a new one; of one that is there, what it is to have."""

    sensor: Sensor | None
    embedding: Embedding | None
    settings: Settings

    @classmethod
    def of(cls, sensor: Sensor | None, embedding: Embedding | None, settings: Mapping[str, Any]) -> Self:
        """What a public call was given. Raises InputError for anything else."""
        require_arguments({}, {"sensor": sensor, "embedding": embedding})
        return cls(sensor, embedding, Settings(**settings))

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments by which `TactileLearner.open` is asked the same."""
        return _arguments(self)

    def recipe(self) -> Recipe:
        """The recipe of a new memory. Raises InputError without a sensor."""
        if self.sensor is None:
            raise InputError("a new memory takes a sensor, sensor=: whose readings the sources are", argument="sensor")
        embedding = default_embedding(self.sensor) if self.embedding is None else self.embedding
        return Recipe.of(self.sensor, embedding, self.settings)


def _arguments(made: Recipe | RecipeRequest) -> dict[str, Any]:
    kept = {"exemplars": made.settings.exemplars, "kept_touches": made.settings.kept_touches}
    return {"sensor": made.sensor, "embedding": made.embedding, **kept}


def default_embedding(sensor: Sensor) -> Embedding:
    """The embedding of a memory for which none is given."""
    from scroll_tactile.embeddings.frames import Frames

    return Frames() if sensor.camera else Kernels()


def default_kept_touches(sensor: Sensor, *, views: bool) -> int:
    """How many touches a memory keeps for which nobody says it: of a BioTac 1000, of a camera, whose are large, none.

    views: whether whole touches are read, for a touch is matched beside what views say.
    """
    if sensor.camera or not views:
        return 0
    return max(1, min(MOST_KEPT, MOST_KEPT_BYTES // (sensor.channels * sensor.readings)))
