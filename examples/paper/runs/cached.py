"""An embedding that remembers: for pipelines that read the same touches again and again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from hashlib import blake2b
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.protocol import (
    Capabilities,
    Embedding,
    capabilities_of,
    embed_competing,
    embed_windows,
    parts_of,
)

__all__ = ["Cached"]

FloatArray = npt.NDArray[np.floating]


class Cached:
    """An embedding in every respect the one it wraps, which embeds each touch once.

    What it gave for an image and its windows of a width is kept in RAM (a touch of BioTac is 0.1 MB with 1008
    features) and given again, the same bytes, read-only. A continual run reads each touch in five folds, for seven
    sizes of the buffer, in two orders.

    embedding: the wrapped one. All its other attributes, such as a network to be tuned, are found here too.

    >>> import numpy as np
    >>> from scroll_tactile import Kernels
    >>> cached = Cached(Kernels(dimension=64))
    >>> image = np.zeros((19, 400), dtype=np.float32)
    >>> cached.embed_windows(image, {300: [0, 50]})[300].shape, cached.held
    ((2, 64), 1)
    """

    def __init__(self, embedding: Embedding) -> None:
        self._embedding = embedding
        self._kept: dict[tuple[bytes, int, tuple[int, ...]], FloatArray] = {}

    def __repr__(self) -> str:
        return f"Cached({self._embedding!r})"

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # copying asks for these before there is anything wrapped
            raise AttributeError(name)
        return getattr(self._embedding, name)

    @property
    def capabilities(self) -> Capabilities:
        """The wrapped embedding's, which it reads all windows with, and it stands as its own part."""
        return replace(capabilities_of(self._embedding), embeds_windows=True, composite=True)

    @property
    def parts(self) -> tuple[Embedding, ...]:
        """The wrapped one or its parts, for images that will not be read again, such as augmented ones."""
        return parts_of(self._embedding)

    @property
    def name(self) -> str:
        """The wrapped embedding's."""
        return self._embedding.name

    @property
    def dimension(self) -> int:
        """The wrapped embedding's."""
        return self._embedding.dimension

    @property
    def bound(self) -> float:
        """The wrapped embedding's."""
        return self._embedding.bound

    @property
    def fingerprint(self) -> str:
        """The wrapped embedding's: a memory of the one is a memory of the other."""
        return self._embedding.fingerprint

    @property
    def held(self) -> int:
        """How much it remembers: touches times scales."""
        return len(self._kept)

    def embed(self, image: npt.NDArray[np.float32]) -> FloatArray:
        """Features of shape (d,) of an image of shape (C, T); these are not kept: touches are read in windows."""
        return self._embedding.embed(image)

    def embed_windows(
        self, image: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]]
    ) -> dict[int, FloatArray]:
        """Width → features of shape (windows, d), as `embed_windows` gives for the wrapped one, to the bit."""
        digest = _digest(image)
        keys = {width: (digest, width, tuple(starts)) for width, starts in windows.items()}
        missing = {width: starts for width, starts in windows.items() if keys[width] not in self._kept}
        if missing:
            for width, features in embed_windows(self._embedding, image, missing).items():
                features.setflags(write=False)  # all callers get the same array
                self._kept[keys[width]] = features
        return {width: self._kept[key] for width, key in keys.items()}

    def embed_competing(
        self, image: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]], width: int
    ) -> tuple[dict[int, FloatArray], FloatArray]:
        """What `embed_windows` gives, and features (d,) by competing kernels, as the wrapped one gives them."""
        key = (_digest(image), -width, ())
        if key not in self._kept:
            _, self._kept[key] = embed_competing(self._embedding, image, {}, width)
            self._kept[key].setflags(write=False)
        return self.embed_windows(image, windows), self._kept[key]


def _digest(image: npt.NDArray[np.float32]) -> bytes:
    digest = blake2b(f"{image.shape} {image.dtype}".encode(), digest_size=32)
    digest.update(np.ascontiguousarray(image).data.cast("B"))
    return digest.digest()
