"""From an embedding to its configuration in JSON and back, so that a memory can say what it was made with.

A configuration is read from a disk and may be damaged or hostile: its types, sizes and totals are checked before
anything is made, and what is made holds no features yet. It names a file of weights and the hash of its tensors, and no
path: weights are torchvision's, or a file's in the cache folder of weights.
"""

from __future__ import annotations

import base64
import binascii
import math
import zlib
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self, TypeAlias, cast

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from scroll_tactile.embeddings.kernels import LEAST_FEATURES, MOST_FEATURES
from scroll_tactile.embeddings.protocol import Embedding, cache_folder
from scroll_tactile.errors import EmbeddingError

__all__ = [
    "MOST_PARTS",
    "configuration_of",
    "from_configuration",
    "require_configuration",
]

MOST_PARTS: Final = 8  # of a Joined
MOST_COSINES = 2**14
MOST_PIXELS = 2**24  # of a resting picture, times colours: 64 MiB

_KINDS = {  # each a module's name, too
    "frames": "Frames",
    "joined": "Joined",
    "kernels": "Kernels",
    "vision": "Vision",
}

_Seed = Annotated[int, Field(ge=0, lt=2**63)]
_Hex = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Configuration(BaseModel):
    """What makes an embedding, in JSON's types; nothing is converted, and nothing unknown is passed over."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


class WeightsConfiguration(Configuration):
    """A file's name without its folder, or a published one; None for tensors that came from no file."""

    name: Annotated[str, Field(min_length=1, max_length=255, pattern=r"^[^/\\\x00]+$")] | None
    sha256: _Hex


class PictureConfiguration(Configuration):
    """A resting image: float32 of shape (height, width, 3), deflated."""

    shape: Annotated[list[Annotated[int, Field(ge=1, le=2**14)]], Field(min_length=3, max_length=3)]
    float32: Annotated[str, Field(max_length=8 * MOST_PIXELS)]

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.shape[2] != 3 or math.prod(self.shape) > MOST_PIXELS:
            raise ValueError(f"a resting picture is (height, width, 3), of at most {MOST_PIXELS} values")
        return self


class KernelsConfiguration(Configuration):
    """Of `Kernels`."""

    kind: Literal["kernels"]
    seed: _Seed
    dimension: Annotated[int, Field(ge=LEAST_FEATURES, le=MOST_FEATURES)]


class FramesConfiguration(Configuration):
    """Of `Frames`."""

    kind: Literal["frames"]
    weights: WeightsConfiguration | None
    rest: Literal["first"] | PictureConfiguration | None
    cosines: Annotated[int, Field(ge=0, le=MOST_COSINES)]
    seed: _Seed


class VisionConfiguration(Configuration):
    """Of `Vision`; seed: of random weights, where there are no others."""

    kind: Literal["vision"]
    weights: WeightsConfiguration | None
    seed: _Seed | None
    depth: Literal[18]
    stem: Literal["torchvision", "universal"]
    stages: Annotated[list[Annotated[int, Field(ge=0, le=4)]], Field(min_length=1, max_length=5)]


class JoinedConfiguration(Configuration):
    """Of `Joined`, part by part."""

    kind: Literal["joined"]
    parts: Annotated[list[AnyConfiguration], Field(min_length=2, max_length=MOST_PARTS)]


_Single: TypeAlias = KernelsConfiguration | FramesConfiguration | VisionConfiguration
AnyConfiguration: TypeAlias = Annotated[_Single | JoinedConfiguration, Field(discriminator="kind")]
JoinedConfiguration.model_rebuild()
ADAPTER: TypeAdapter[AnyConfiguration] = TypeAdapter(AnyConfiguration)


def configuration_of(embedding: Embedding) -> dict[str, Any] | None:
    """What makes an equal embedding, in JSON's types; None for one that `from_configuration` could not make.

    These are embeddings of the user's own, also where they derive from or wrap one that ships with scroll-tactile.
    """
    kind = type(embedding)
    if (kind.__module__, kind.__qualname__) not in {(f"{__package__}.{stem}", name) for stem, name in _KINDS.items()}:
        return None
    configuration = cast(Any, embedding).configuration()
    try:
        return None if configuration is None else dict(_validated(configuration).model_dump(mode="json"))
    except EmbeddingError:  # a seed of a hundred digits, say
        return None


def from_configuration(configuration: Mapping[str, Any]) -> Embedding:
    """Make the embedding of a configuration that `configuration_of` gave.

    Published weights are fetched where the cache has none. No fingerprint is computed: compare it.

    Raises EmbeddingError that names what is wrong or missing and what to pass instead, WeightsError for weights that
    cannot be had or read, InputError where torch is missing.
    """
    return _made(_validated(configuration))


def require_configuration(configuration: Mapping[str, Any]) -> None:
    """Raise EmbeddingError for what `from_configuration` would make nothing of; nothing is made or fetched."""
    _validated(configuration)


def _picture(held: PictureConfiguration) -> npt.NDArray[np.float32]:
    size = 4 * math.prod(held.shape)
    try:
        inflate = zlib.decompressobj()
        values = inflate.decompress(base64.b64decode(held.float32, validate=True), size + 1)
    except (binascii.Error, ValueError, zlib.error) as error:
        raise EmbeddingError(f"the resting picture in a Frames' configuration is damaged ({error})") from error
    if len(values) != size:
        raise EmbeddingError(
            f"the resting picture in a Frames' configuration is damaged: expected {size} bytes; came "
            f"{'more' if len(values) > size else len(values)}. Pass embedding=Frames(rest=…) with the picture itself"
        )
    return np.frombuffer(values, "<f4").reshape(held.shape)


def _validated(configuration: Mapping[str, Any]) -> AnyConfiguration:
    try:
        return ADAPTER.validate_python(configuration)
    except ValidationError as error:
        # Of a union's alternatives the one that went deepest is the one that was meant.
        wrong = max(reversed(error.errors(include_url=False)), key=lambda each: len(each["loc"]))
        place = ".".join(str(step) for step in wrong["loc"]) or "it"
        raise EmbeddingError(
            f"expected the configuration of an embedding that ships with scroll-tactile, of kind {', '.join(_KINDS)}; "
            f"{place}: {wrong['msg']}, came {wrong['input']!r:.80}. Pass the embedding itself: embedding=…"
        ) from error


def _made(held: AnyConfiguration) -> Embedding:
    make = getattr(import_module(f"{__package__}.{held.kind}"), _KINDS[held.kind])
    if isinstance(held, JoinedConfiguration):
        return cast(Embedding, make(*map(_made, held.parts)))
    if isinstance(held, FramesConfiguration):
        rest = _picture(held.rest) if isinstance(held.rest, PictureConfiguration) else held.rest
        return _weighted(make, held.weights, rest=rest, cosines=held.cosines, seed=held.seed)
    if isinstance(held, VisionConfiguration):
        return _weighted(make, held.weights, stages=held.stages, seed=held.seed)
    return cast(Embedding, make(seed=held.seed, dimension=held.dimension))


def _weighted(make: Callable[..., Any], held: WeightsConfiguration | None, **settings: Any) -> Embedding:
    if held is None:
        return cast(Embedding, make(None, **settings))
    source = _source(held, make.__name__)
    embedding = make(source, **settings)
    found = embedding.configuration()["weights"]["sha256"]
    if found != held.sha256:
        raise EmbeddingError(
            f"expected weights whose tensors have the SHA-256 {held.sha256[:12]}…; those of {source} have "
            f"{found[:12]}…. Pass embedding={make.__name__}(weights=…) with the weights that the memory was made with"
        )
    return cast(Embedding, embedding)


def _source(held: WeightsConfiguration, kind: str) -> str | Path:
    """The published name, or the file of that name in the cache folder of weights."""
    from scroll_tactile.embeddings.weights import PUBLISHED

    if held.name in PUBLISHED:
        return held.name
    folder = cache_folder("weights")
    if held.name is not None and (folder / held.name).is_file():
        return folder / held.name
    came, put = ("a state dict", "") if held.name is None else (repr(held.name), f", or put that file into {folder}")
    raise EmbeddingError(
        f"expected the weights of a {kind} that came from {came} and whose tensors have the SHA-256 "
        f"{held.sha256[:12]}…; they are not at hand. Pass embedding={kind}(weights=…) with them{put}"
    )
