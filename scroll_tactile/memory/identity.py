"""What a memory was made with, and what it may be opened with."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError
from scroll_tactile_store import Store

from scroll_tactile.embeddings.protocol import (
    Capabilities,
    Embedding,
    embed_competing,
    embed_windows,
    require_rest,
    window_plan,
)
from scroll_tactile.embeddings.registry import configuration_of, from_configuration
from scroll_tactile.errors import EmbeddingError, EmbeddingMismatchError, MismatchError, SensorMismatchError
from scroll_tactile.memory.touch_rows import refusing
from scroll_tactile.recipe import Recipe, RecipeRequest
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.windows import COMPETING, ScaleKind, WindowPlan
from scroll_tactile.statistics.fields import first_wrong
from scroll_tactile.statistics.grid import BITS

__all__ = ["AbsentEmbedding", "EmbeddingIdentity", "Grid", "Identity", "absent_embedding", "differences"]

LARGEST_DIMENSION = 2**14  # of an embedding: a second moment of more takes over a GiB a scale
OTHER_READING = EmbeddingMismatchError, "Open it with an embedding that reads the same parts of a touch"
OTHER: dict[str, tuple[type[MismatchError], str]] = {  # part of an identity → the error of another one, and what to do
    "sensor": (SensorMismatchError, "Open it with its own sensor, or take another path"),
    "embedding": (
        EmbeddingMismatchError,
        "Features of one mean nothing to the other: open it with the embedding that made it, take another path, or "
        "carry the memory over to this one: scroll-tactile memory reembed {path}, or learner.reembed(embedding)",
    ),
    "reading": OTHER_READING,
    "views": OTHER_READING,
    "grid": (MismatchError, "Open it with the version that made it"),
    "exemplars": (MismatchError, "Readings that were not kept are gone: leave exemplars out"),
    "kept_touches": (MismatchError, "Touches that were not kept are gone: leave kept_touches out"),
}


class _Kept(BaseModel):
    """A part of an identity, as JSON keeps it; fields that a later version adds are ignored."""

    model_config = ConfigDict(frozen=True)


class EmbeddingIdentity(_Kept):
    """What a memory knows of its embedding; configuration: what makes it again, None for a user's own embedding."""

    name: Annotated[str, Field(min_length=1)]
    dimension: Annotated[int, Field(ge=1, le=LARGEST_DIMENSION)]
    bound: Annotated[FiniteFloat, Field(gt=0)]
    fingerprint: Annotated[str, Field(min_length=1)]
    configuration: dict[str, Any] | None

    @classmethod
    def of(cls, embedding: Embedding) -> Self:
        """The identity of an embedding. Raises EmbeddingError where its fields are none."""
        fields = {name: getattr(embedding, name) for name in ("name", "dimension", "bound", "fingerprint")}
        try:
            return cls(**fields, configuration=configuration_of(embedding))
        except ValidationError as error:
            raise EmbeddingError(f"the embedding {type(embedding).__name__} is none: {first_wrong(error)}") from None

    @property
    def bare(self) -> bool:
        """Whether rows of observations hold readings alone: the memory can make the embedding again, to the bit."""
        return self.configuration is not None and _is_exact(self.configuration)


class Grid(_Kept):
    """The grid of codes, and the widths of windows; frames: whether they are a camera's frames."""

    bits: int
    scales: tuple[int, ...]
    frames: bool


class Identity(_Kept):
    """Everything that a memory is made with and that never changes.

    reading: whether wide windows may be partial, and which scales judge. views: of whole touches, that are read beside
    windows. exemplars: streams in the buffer. kept_touches: how many are kept.
    """

    sensor: Sensor
    embedding: EmbeddingIdentity
    grid: Grid
    reading: tuple[bool, Literal["all", "widest"]]
    views: tuple[ScaleKind, ...]
    exemplars: Annotated[int, Field(ge=0)]
    kept_touches: Annotated[int, Field(ge=0)]

    @classmethod
    def of(cls, recipe: Recipe) -> Self:
        """The identity of a new memory. Raises InputError for an embedding that cannot read the sensor, EmbeddingError.

        It may embed, for the fingerprint.
        """
        require_rest(recipe.embedding, recipe.sensor)
        parts = _parts_of(recipe.plan) | {"exemplars": recipe.exemplars, "kept_touches": recipe.kept_touches}
        return cls(sensor=recipe.sensor, embedding=EmbeddingIdentity.of(recipe.embedding), **parts)

    @classmethod
    def read(cls, store: Any) -> Self:
        """The identity that a store was made with, of any kind that has a `path` and an `identity`.

        Raises MismatchError for a store that holds no memory of touch, DamageError for one that is none.
        """
        if "sensor" not in store.identity:
            raise MismatchError(f"{store.path} is a store, but holds no memory of touch. Take another path")
        with refusing(store.path, "the identity"):
            # Of JSON's types, none converted.
            return cls.model_validate_json(json.dumps(dict(store.identity)), strict=True)

    def to_json(self) -> dict[str, Any]:
        """Its fields in JSON's types, as a store keeps them."""
        return self.model_dump(mode="json")

    def own_embedding(self, path: Path) -> Embedding:
        """The memory's embedding, made again from its configuration; nothing is embedded.

        Raises EmbeddingMismatchError for a user's own embedding, which has no configuration.
        """
        if self.embedding.configuration is None:
            raise EmbeddingMismatchError(
                f"{path} was made with embedding {self.embedding.name!r} ({self.embedding.dimension} features), which "
                "does not ship with scroll-tactile: pass the one that made it, "
                "TactileLearner.open(path, embedding=...), or carry the memory over to the default one: "
                f"scroll-tactile memory reembed {path} --default"
            )
        return from_configuration(self.embedding.configuration)

    def recipe(self, path: Path, request: RecipeRequest) -> Recipe:
        """The recipe of the memory at a path, as it was made, for whoever opens it with this request.

        Raises MismatchError for anything there, where it is given, that the memory was not made with.
        """
        asked = request.arguments
        self._require(path, {name: came for name, came in asked.items() if name != "embedding" and came is not None})
        if (embedding := request.embedding) is None:
            embedding = self.own_embedding(path)
            self._require(path, _parts_of(window_plan(self.sensor, embedding)))
        else:
            self.require_embedding(path, embedding)
        kept = {"exemplars": self.exemplars, "kept_touches": self.kept_touches}
        return Recipe(self.sensor, embedding, request.settings.model_copy(update=kept))

    def require_embedding(self, path: Path, embedding: Embedding) -> None:
        """Raise MismatchError for another embedding than the memory's; computing its fingerprint may embed."""
        own = {"embedding": EmbeddingIdentity.of(embedding)}
        self._require(path, own | _parts_of(window_plan(self.sensor, embedding)))

    def _require(self, path: Path, parts: Mapping[str, Any]) -> None:
        """Raise MismatchError where the memory was made with another part than one of these."""
        for part, came in parts.items():
            if differing := differences(part, getattr(self, part), came):
                error, advice = OTHER[part]
                raise error(f"{path} was made with other values: {differing}. {advice.format(path=path)}")


def differences(part: str, there: Any, here: Any) -> str:
    """In which fields a part of an identity differs from another, in words; "" where it does not.

    Of an embedding its configuration does not count: a file of weights may have any name. Nor does what a sensor's
    columns are called.
    """
    if not isinstance(there, BaseModel):
        return "" if there == here else f"{part} {there!r} there, {here!r} here"
    names = [name for name in type(there).model_fields if name not in ("configuration", "columns")]
    return "; ".join(filter(None, (differences(name, getattr(there, name), getattr(here, name)) for name in names)))


def _parts_of(plan: WindowPlan) -> dict[str, Any]:
    """The parts of an identity that say how touches are read."""
    return {
        "reading": (plan.partial, plan.judged),
        "views": tuple(view.kind for view in plan.views),
        "grid": Grid(bits=BITS, scales=plan.widths, frames=plan.frames),
    }


class AbsentEmbedding:
    """Takes the place of a memory's embedding where hardly anything is embedded; made when something is, if it can be.

    path: of the memory.
    """

    def __init__(self, identity: Identity, path: Path) -> None:
        own = identity.embedding
        self.name, self.dimension, self.bound, self.fingerprint = own.name, own.dimension, own.bound, own.fingerprint
        self._identity, self._path = identity, path
        partial, judged = identity.reading
        self.capabilities = Capabilities(
            partial_windows=partial,
            judged_scales=judged,
            reads_whole_touches=bool(identity.views),
            embeds_windows=True,
            competes=COMPETING.kind in identity.views,
            exact=own.bare,
        )

    @cached_property
    def _made(self) -> Embedding:
        made = self._identity.own_embedding(self._path)
        self._identity.require_embedding(self._path, made)
        return made

    def embed(self, *image: Any) -> Any:
        """As the embedding does. Raises EmbeddingMismatchError where only its user can make it."""
        return self._made.embed(*image)

    def embed_windows(self, *windows: Any) -> Any:
        """As `embed`."""
        return embed_windows(self._made, *windows)

    def embed_competing(self, *windows: Any) -> Any:
        """As `embed`."""
        return embed_competing(self._made, *windows)


def absent_embedding(path: Path) -> AbsentEmbedding:
    """The embedding with which a memory is opened whatever its own is. Raises StoreError where there is none."""
    with Store.open(path, mode="read") as store:
        return AbsentEmbedding(Identity.read(store), path)


def _is_exact(configuration: Mapping[str, Any]) -> bool:
    """Whether the embedding of a configuration declares `Capabilities.exact`; it is not made for that."""
    inside = configuration.get("parts")
    return all(map(_is_exact, inside)) if isinstance(inside, list) else configuration.get("kind") == "kernels"
