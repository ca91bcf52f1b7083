"""What an embedding has to be, and how any embedding reads windows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

__all__ = ["Embedding", "canary", "embed_windows"]

FloatArray = npt.NDArray[np.floating]


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
        ...

    @property
    def dimension(self) -> int:
        """The number of features."""
        ...

    @property
    def bound(self) -> float:
        """The largest magnitude that a feature can have."""
        ...

    @property
    def fingerprint(self) -> str:
        """Hex of a hash over all that the features depend on."""
        ...

    def embed(self, image: npt.NDArray[np.float32]) -> FloatArray:
        """Features of shape (d,) for a tactile image of shape (C, T) in [-1, 1], whatever C and T."""
        ...


def embed_windows(
    embedding: Embedding, image: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]]
) -> dict[int, FloatArray]:
    """Embed windows of a tactile image: for each width, those that begin at the given columns.

    image: shape (C, T), in [-1, 1]. windows: width in columns → first columns. Returns width → features of
    shape (number of windows, d), where row i equals `embedding.embed(image[:, start_i : start_i + width])`
    to the bit. A window that begins at 0 may be wider than the image: it is read as far as it goes. An embedding
    with an `embed_windows(image, windows)` of its own is asked for all at once, and told the width there too.
    """
    together = getattr(embedding, "embed_windows", None)
    if together is not None:
        embedded: dict[int, FloatArray] = together(image, windows)
        return embedded
    return {
        width: np.stack([embedding.embed(np.ascontiguousarray(image[:, start : start + width])) for start in starts])
        for width, starts in windows.items()
    }


def canary(channels: int, columns: int) -> npt.NDArray[np.float32]:
    """A fixed image of shape (C, T) in [-1, 1] whose features a fingerprint holds.

    A sawtooth of integers: no sine, whose last bit differs between machines.
    """
    place = np.arange(channels * columns).reshape(channels, columns)
    image: npt.NDArray[np.float32] = ((place * (place + 7) * 13 % 255) / 127.0 - 1).astype(np.float32)
    return image
