"""What an embedding has to be, what more it may declare, and how any embedding reads windows."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal, Protocol, cast, runtime_checkable

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import EmbeddingError, InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.contact import Rest
from scroll_tactile.signals.windows import WindowPlan, scales, whole_steps

__all__ = [
    "TOGETHER",
    "Capabilities",
    "CompetingEmbedding",
    "CompositeEmbedding",
    "Embedding",
    "WindowEmbedding",
    "cache_folder",
    "canary",
    "capabilities_of",
    "embed_competing",
    "embed_windows",
    "is_embedding",
    "parts_of",
    "require_features",
    "require_rest",
    "window_plan",
]

FloatArray = npt.NDArray[np.floating]

TOGETHER: Final = 48
"""Columns from which windows may share one pass over an image; narrower ones are always read as if cut out."""

NAMED = 5  # features in a message


@dataclass(frozen=True)
class Capabilities:
    """What an embedding declares beyond the `Embedding` protocol, in an attribute `capabilities`; defaults without one.

    partial_windows: a touch of 0.65 of a wide window or more is read at that scale, as far as it goes.
    judged_scales: "all" scales that fit a touch judge it, or the "widest" of them alone: one pass for a touch.
    reads_whole_touches: beside windows it embeds two views of each whole touch, see `signals.image`.
    shrinkage: how many times as far as its formula says the scatter of its features is shrunk; see
        `readouts.task`. More than once for features that are far from normally distributed.
    reads_frames: it reads a camera's frames, and no other sensor. rest: its resting image of them.
    embeds_windows: it has `embed_windows(image, windows)`, see `WindowEmbedding`.
    competes: it reads whole touches by competing kernels, too, a third view of them: it has `embed_competing(image,
        windows, width)`, see `CompetingEmbedding`.
    composite: it has `parts`, see `CompositeEmbedding`.
    tunable: it has `network()`, a copy of its network to be fine-tuned, see `Vision.network`.
    exact: its features are the same bits on every machine, so that a memory need not keep them beside the readings.
    """

    partial_windows: bool = True
    judged_scales: Literal["widest", "all"] = "all"
    reads_whole_touches: bool = False
    shrinkage: float = 1.0
    reads_frames: bool = False
    rest: Rest = field(default=None, compare=False)  # two arrays compare element by element
    embeds_windows: bool = False
    competes: bool = False
    composite: bool = False
    tunable: bool = False
    exact: bool = False


@runtime_checkable
class Embedding(Protocol):
    """A frozen map ψ from a tactile image to features, the same to the bit for the same image.

    name: what messages call it, such as "kernels".
    dimension: d, the number of features, the same for an image of any size.
    bound: no feature's magnitude exceeds it; features are rounded to a grid of bound · 2⁻²⁰.
    fingerprint: hex of a hash over everything that features depend on. A memory is refused to an embedding of
        another fingerprint.
    """

    @property
    def name(self) -> str:
        """What messages call it."""

    @property
    def dimension(self) -> int:
        """The number of features."""

    @property
    def bound(self) -> float:
        """The largest magnitude that a feature can have."""

    @property
    def fingerprint(self) -> str:
        """Hex of a hash over all that the features depend on."""

    def embed(self, image: npt.NDArray[np.float32]) -> FloatArray:
        """Features of shape (d,) for a tactile image of shape (C, T) in [-1, 1], whatever C and T."""


class WindowEmbedding(Embedding, Protocol):
    """An embedding that reads all windows of an image at once: `Capabilities.embeds_windows`."""

    def embed_windows(
        self, image: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]]
    ) -> Mapping[int, FloatArray]:
        """Width → features (windows, d) of width → first steps; see the function `embed_windows`."""


class CompetingEmbedding(WindowEmbedding, Protocol):
    """An embedding that counts which kernels respond most to a whole touch: `Capabilities.competes`."""

    def embed_competing(
        self, image: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]], width: int
    ) -> tuple[Mapping[int, FloatArray], FloatArray]:
        """What `embed_windows` gives; and features (d,) of all of the image, which stands for one of `width` steps."""


class CompositeEmbedding(Embedding, Protocol):
    """An embedding that is others side by side, each one's features divided by its bound: `Capabilities.composite`."""

    @property
    def parts(self) -> tuple[Embedding, ...]:
        """The embeddings, in the order of their features."""


def is_embedding(value: object) -> bool:
    """Whether a value has what the `Embedding` protocol asks for; unlike `isinstance`, it computes no fingerprint."""
    return {"name", "dimension", "bound", "fingerprint", "embed"} <= set(dir(value))


def capabilities_of(embedding: object) -> Capabilities:
    """What an embedding declares; the defaults for one that declares nothing.

    Raises EmbeddingError for an attribute `capabilities` of another type.
    """
    declared = getattr(embedding, "capabilities", Capabilities())
    if not isinstance(declared, Capabilities):
        raise EmbeddingError(
            f"expected the capabilities of {type(embedding).__name__} as scroll_tactile.Capabilities(...); "
            f"came {declared!r:.80}"
        )
    return declared


def parts_of(embedding: Embedding) -> tuple[Embedding, ...]:
    """The parts of a composite embedding; of another, itself."""
    if capabilities_of(embedding).composite:
        return cast(CompositeEmbedding, embedding).parts
    return (embedding,)


def window_plan(sensor: Sensor, embedding: Embedding) -> WindowPlan:
    """How an embedding reads the touches of a sensor: which windows, and which scales judge, as it declares."""
    declared = capabilities_of(embedding)
    whole = whole_steps(sensor) if declared.reads_whole_touches else 0
    return WindowPlan(
        scales(sensor),
        declared.partial_windows,
        declared.judged_scales,
        declared.shrinkage,
        sensor.camera,
        whole,
        declared.competes and whole > 0,
    )


def require_rest(embedding: Embedding, sensor: Sensor) -> None:
    """Raise InputError where an embedding of frames is to read channels, or its resting image is not the sensor's."""
    declared = capabilities_of(embedding)
    if declared.reads_frames and not sensor.camera:
        raise InputError(
            f"embedding {embedding.name!r} reads a camera's frames, and sensor {sensor.name!r} has "
            f"{sensor.channels} channels: take Kernels()"
        )
    if isinstance(declared.rest, np.ndarray) and declared.rest.shape != sensor.shape:
        raise InputError(
            f"expected a resting image of sensor {sensor.name!r} of shape {sensor.shape}; {embedding.name!r} has one "
            f"of {declared.rest.shape}"
        )


def embed_windows(
    embedding: Embedding, image: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]]
) -> dict[int, FloatArray]:
    """Embed windows of a tactile image: for each width, those that begin at the given steps of time.

    image: shape (C, T), in [-1, 1]. windows: width in steps → first steps. Returns width → features of
    shape (number of windows, d), where row i equals `embedding.embed(image[:, start_i : start_i + width])`
    to the bit. A window that begins at 0 may be wider than the image: it is read as far as it goes. An embedding
    whose capabilities say `embeds_windows` reads them all at once.
    """
    if capabilities_of(embedding).embeds_windows:
        return dict(cast(WindowEmbedding, embedding).embed_windows(image, windows))
    return {
        width: np.stack([embedding.embed(np.ascontiguousarray(image[:, start : start + width])) for start in starts])
        for width, starts in windows.items()
    }


def embed_competing(
    embedding: Embedding, image: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]], width: int
) -> tuple[dict[int, FloatArray], FloatArray]:
    """Embed windows of a tactile image, as `embed_windows`, and all of it by competing kernels: features (d,).

    embedding: one whose capabilities say that it `competes`. width: of the touch that the image stands for.
    """
    features, competing = cast(CompetingEmbedding, embedding).embed_competing(image, windows, width)
    return dict(features), competing


def require_features(
    embedding: Embedding, features: npt.NDArray[np.floating], shape: tuple[int, ...], what: str
) -> None:
    """Raise EmbeddingError for features of another shape, that are not finite, or that exceed the embedding's bound.

    what: whose features they are, for the message.
    """
    broken = f"embedding {embedding.name!r} breaks a promise"
    if features.shape != shape:
        raise EmbeddingError(f"{broken}: expected features of shape {shape} of {what}; came {features.shape}")
    if float(np.abs(features).max(initial=0.0)) <= embedding.bound:  # NaN is not
        return
    endless = ~np.isfinite(features)
    bad = endless if endless.any() else ~(np.abs(features) <= embedding.bound)
    wrong = "are not finite" if endless.any() else f"lie beyond its bound {embedding.bound}"
    columns = np.flatnonzero(bad.reshape(-1, shape[-1]).any(axis=0))
    listed = ", ".join(map(str, columns[:NAMED].tolist())) + (", …" if len(columns) > NAMED else "")
    edges = np.cumsum([part.dimension for part in parts_of(embedding)])
    parts = [parts_of(embedding)[i].name for i in np.unique(np.searchsorted(edges, columns, side="right")).tolist()]
    theirs = "" if len(edges) == 1 else f" They are those of its {', '.join(map(repr, parts))}."
    raise EmbeddingError(
        f"{broken}: the features of {what} {wrong}: {len(columns)} of {shape[-1]} features, [{listed}], the first "
        f"{features[bad][0]}.{theirs} Nothing was learned or answered. Mend the embedding, which `check_embedding` "
        "tries, or take another, such as Kernels()"
    )


def canary(channels: int, steps: int) -> npt.NDArray[np.float32]:
    """A fixed image of shape (C, T) in [-1, 1] whose features a fingerprint holds.

    A sawtooth of integers: no sine, whose last bit differs between machines.
    """
    place = np.arange(channels * steps).reshape(channels, steps)
    return np.asarray((place * (place + 7) * 13 % 255) / 127.0 - 1, np.float32)


def cache_folder(what: str) -> Path:
    """Where files are kept that can be made again: in $SCROLL_TACTILE_CACHE, or in the user's cache of scroll-tactile.

    Raises RuntimeError for a user without a home.
    """
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(os.environ.get("SCROLL_TACTILE_CACHE") or f"{cache}/scroll-tactile").expanduser() / what
