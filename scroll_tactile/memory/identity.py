"""What a memory was made with, and what it may be opened with."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator
from scroll_tactile_store import DamageError, Store

from scroll_tactile.embeddings.protocol import (
    Capabilities,
    Embedding,
    embed_competing,
    embed_windows,
    require_rest,
    window_plan,
)
from scroll_tactile.embeddings.registry import MOST_DEPTH, configuration_of, from_configuration
from scroll_tactile.errors import EmbeddingError, EmbeddingMismatchError, InputError, MismatchError, SensorMismatchError
from scroll_tactile.recipe import Recipe, RecipeRequest
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.windows import COMPETING, ScaleKind
from scroll_tactile.statistics.fields import first_wrong
from scroll_tactile.statistics.grid import BITS

__all__ = ["AbsentEmbedding", "EmbeddingIdentity", "FingerprintCheck", "Grid", "Identity", "absent_embedding"]
LARGEST_DIMENSION = 2**14  # of an embedding: a second moment of more takes over a GiB a scale
MOST_STREAMS = 2**31
WIDEST = 2**31  # of a sensor at once, or in one channel of a touch

_Text = Annotated[str, Field(min_length=1, max_length=1000)]
_Streams = Annotated[int, Field(ge=0, le=MOST_STREAMS)]
_Width = Annotated[int, Field(ge=1, le=WIDEST)]


class _Kept(BaseModel):
    """A part of an identity, as JSON keeps it; fields that a later version adds are ignored."""

    model_config = ConfigDict(frozen=True)


class Identified(Protocol):
    """A store, as far as it says what it was made with."""

    @property
    def path(self) -> Path:
        """Where it is."""

    @property
    def identity(self) -> Mapping[str, Any]:
        """What it was made with."""


class EmbeddingIdentity(_Kept):
    """What a memory knows of its embedding; configuration: what makes it again, None for a user's own embedding."""

    name: _Text
    dimension: Annotated[int, Field(ge=1, le=LARGEST_DIMENSION)]
    bound: Annotated[FiniteFloat, Field(gt=0)]
    fingerprint: _Text
    configuration: dict[str, Any] | None

    @model_validator(mode="after")
    def _of_its_configuration(self) -> Self:
        made = self.configuration or {}
        if _depth(made) > MOST_DEPTH:
            raise ValueError(f"expected a configuration of at most {MOST_DEPTH} levels")
        if made.get("kind") == "kernels" and made.get("dimension") != self.dimension:
            raise ValueError(f"kernels of dimension {made.get('dimension')!r:.40} have not {self.dimension} features")
        return self

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

    def __str__(self) -> str:
        return f"{self.name!r} ({self.dimension} features, fingerprint {self.fingerprint[:12]})"


class Grid(_Kept):
    """The grid of codes, and the widths of windows; frames: whether they are a camera's frames."""

    bits: Annotated[int, Field(ge=1, le=BITS)]
    scales: Annotated[tuple[_Width, ...], Field(min_length=1, max_length=64)]
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
    exemplars: _Streams
    kept_touches: _Streams

    @model_validator(mode="after")
    def _of_a_sensor_that_can_be(self) -> Self:
        if max(self.sensor.channels, self.sensor.readings) > WIDEST:
            raise ValueError(f"expected a sensor of at most {WIDEST} channels, and readings in a touch")
        return self

    @classmethod
    def of(cls, recipe: Recipe) -> Self:
        """The identity of a new memory.

        Raises InputError for an embedding that cannot read the sensor, or numbers beyond all bounds, EmbeddingError.
        """
        require_rest(recipe.embedding, recipe.sensor)
        plan, made = recipe.plan, EmbeddingIdentity.of(recipe.embedding)
        try:
            return cls(
                sensor=recipe.sensor,
                embedding=made,
                grid=Grid(bits=BITS, scales=plan.widths, frames=plan.frames),
                reading=(plan.partial, plan.judged),
                views=tuple(view.kind for view in plan.views),
                exemplars=recipe.exemplars,
                kept_touches=recipe.kept_touches,
            )
        except ValidationError as error:
            raise InputError(f"no memory can be made with {first_wrong(error)}") from None

    @classmethod
    def read(cls, store: Identified) -> Self:
        """The identity that a store was made with.

        Raises MismatchError for a store that holds no memory of touch, DamageError for one that is none.
        """
        if "sensor" not in store.identity:
            raise MismatchError(f"{store.path} is a store, but holds no memory of touch. Take another path")
        try:
            return cls.from_json(store.identity)
        except (ArithmeticError, RecursionError, TypeError, ValueError) as error:
            what = (
                first_wrong(error) if isinstance(error, ValidationError) else f"{type(error).__name__}: {error!s:.200}"
            )
            raise DamageError(f"the identity of {store.path} cannot be read: {what}", path=store.path) from error

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> Self:
        """The identity of fields that `to_json` gave: of JSON's types, none converted."""
        return cls.model_validate_json(json.dumps(dict(fields)), strict=True)

    def to_json(self) -> dict[str, Any]:
        """Its fields in JSON's types, as a store keeps them."""
        return self.model_dump(mode="json")

    def own_embedding(self, path: Path) -> Embedding:
        """The memory's embedding, made again from its configuration; nothing is embedded.

        Raises EmbeddingMismatchError for a user's own embedding, which has no configuration.
        """
        if self.embedding.configuration is None:
            raise EmbeddingMismatchError(
                f"{path} was made with embedding {self.embedding}, which does not ship with scroll-tactile: pass the "
                "one that made it, TactileLearner.open(path, embedding=...), or carry the memory over to the default "
                f"one: scroll-tactile memory reembed {path} --default"
            )
        return from_configuration(self.embedding.configuration)

    def recipe(self, path: Path, request: RecipeRequest) -> Recipe:
        """The recipe of the memory at a path, as it was made, for whoever opens it with this request.

        Raises MismatchError for anything there, where it is given, that the memory was not made with.
        """
        self._require(path, request)
        if request.embedding is None:
            embedding = self.own_embedding(path)
            self.require_plan(path, embedding)
        else:
            embedding = request.embedding
            self.require_embedding(path, embedding)
        kept = {"exemplars": self.exemplars, "kept_touches": self.kept_touches}
        return Recipe(self.sensor, embedding, request.settings.model_copy(update=kept))

    def _require(self, path: Path, request: RecipeRequest) -> None:
        sensor = request.sensor
        if sensor is not None and sensor != self.sensor:
            differing = [
                f"{name} {getattr(self.sensor, name)!r} there, {getattr(sensor, name)!r} here"
                for name in Sensor.model_fields
                if getattr(self.sensor, name) != getattr(sensor, name)
            ]
            raise SensorMismatchError(
                f"{path} holds the memory of sensor {self.sensor.name!r}; it was opened for {sensor.name!r} "
                f"({'; '.join(differing)}). Open it with its own sensor, or take another path"
            )
        for name, why in (
            ("exemplars", "Readings that were not kept are gone"),
            ("kept_touches", "Which touches are kept is a function of all that were observed"),
        ):
            made, asked = getattr(self, name), getattr(request.settings, name)
            if asked not in (None, made):
                raise MismatchError(
                    f"{path} was made with {name}={made}; it was opened with {asked}. {why}: leave {name} out"
                )

    def require_embedding(self, path: Path, embedding: Embedding) -> None:
        """Raise EmbeddingMismatchError for another embedding than the memory's; computing its fingerprint may embed."""
        mine, made = EmbeddingIdentity.of(embedding), self.embedding
        fields = ("name", "dimension", "bound", "fingerprint")
        if any(getattr(mine, field) != getattr(made, field) for field in fields):
            raise EmbeddingMismatchError(
                f"{path} was made with embedding {made}; it was opened with {mine}. Features of one mean nothing to "
                "the other: open it with the embedding that made it, take another path, or carry the memory over to "
                f"this one: scroll-tactile memory reembed {path}, or learner.reembed(embedding)"
            )
        self.require_plan(path, embedding)

    def require_plan(self, path: Path, embedding: Embedding) -> None:
        """Raise MismatchError for an embedding that reads other windows, or a memory of another grid."""
        plan = window_plan(self.sensor, embedding)
        views = tuple(view.kind for view in plan.views)
        made, reads = (*self.reading, self.views), (plan.partial, plan.judged, views)
        if made != reads:
            raise EmbeddingMismatchError(
                f"{path} was made with an embedding whose partial_windows, judged_scales and views of whole touches "
                f"are {made}; it was opened with one whose are {reads}. Open it with those"
            )
        grid = Grid(bits=BITS, scales=plan.widths, frames=plan.frames)
        if self.grid != grid:
            raise MismatchError(f"{path} was made with {self.grid!r}; this version works with {grid!r}")


class FingerprintCheck:
    """Whether an embedding that was made again is the one that a memory was made with; it is compared once.

    pending: whether that is still to be done for the memory's own embedding.
    """

    def __init__(self, identity: Identity, path: Path) -> None:
        self._identity, self._path = identity, path
        self.pending = True

    def require(self, embedding: Embedding) -> None:
        """Compare the memory's own embedding. Raises EmbeddingMismatchError."""
        if self.pending:
            self._identity.require_embedding(self._path, embedding)
            self.pending = False


class AbsentEmbedding:
    """Takes the place of a memory's embedding where hardly anything is embedded; made when something is, if it can be.

    path: of the memory.
    """

    def __init__(self, identity: Identity, path: Path) -> None:
        made = identity.embedding
        self.name, self.dimension, self.bound = made.name, made.dimension, made.bound
        self.fingerprint = made.fingerprint
        self._identity, self._path = identity, path
        partial, judged = identity.reading
        self.capabilities = Capabilities(
            partial_windows=partial,
            judged_scales=judged,
            reads_whole_touches=bool(identity.views),
            embeds_windows=True,
            competes=COMPETING.kind in identity.views,
            exact=made.bare,
        )

    @cached_property
    def _made(self) -> Embedding:
        made = self._identity.own_embedding(self._path)
        self._identity.require_embedding(self._path, made)
        return made

    def embed(self, image: npt.NDArray[np.float32]) -> npt.NDArray[np.floating]:
        """As the embedding does. Raises EmbeddingMismatchError where only its user can make it."""
        return self._made.embed(image)

    def embed_windows(
        self, image: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]]
    ) -> Mapping[int, npt.NDArray[np.floating]]:
        """As `embed`."""
        return embed_windows(self._made, image, windows)

    def embed_competing(
        self, image: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]], width: int
    ) -> tuple[Mapping[int, npt.NDArray[np.floating]], npt.NDArray[np.floating]]:
        """As the embedding does. Raises EmbeddingMismatchError where only its user can make it."""
        return embed_competing(self._made, image, windows, width)


def absent_embedding(path: Path) -> AbsentEmbedding:
    """The embedding with which a memory is opened whatever its own is. Raises StoreError where there is none."""
    with Store.open(path, mode="read") as store:
        return AbsentEmbedding(Identity.read(store), path)


def _is_exact(configuration: Mapping[str, Any]) -> bool:
    """Whether the embedding of a configuration declares `Capabilities.exact`; it is not made for that."""
    if not isinstance(configuration, Mapping):
        return False
    inside = configuration.get("parts")
    return all(map(_is_exact, inside)) if isinstance(inside, list) else configuration.get("kind") == "kernels"


def _depth(value: Any) -> int:
    """How many mappings and lists lie within each other, counted without recursion, and no further than is of use."""
    depth, inside = 0, [value]
    while inside and depth <= MOST_DEPTH:
        parts = [part.values() if isinstance(part, Mapping) else part for part in inside]
        inside = [each for part in parts for each in part if isinstance(each, Mapping | list)]
        depth += 1
    return depth
