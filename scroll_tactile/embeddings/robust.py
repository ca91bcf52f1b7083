"""Any embedding, read so that short and noisy touches are known, too."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.kernels import Kernels
from scroll_tactile.embeddings.noisy import is_noisy, noisy_features
from scroll_tactile.embeddings.protocol import Capabilities, Embedding, canary, capabilities_of, embed_windows
from scroll_tactile.errors import InputError

__all__ = ["Robust"]


class Robust:
    """An embedding whose memories know short touches, noisy ones and broken wires by statistics of their own.

    The beginning: a touch's first 0.3 s differ from the rest, and are all that there is of a short one. Statistics of
    them alone, and not of all narrow windows, know them better (BioTac: 95 % instead of 87).

    Noise: a touch through noise (`is_noisy`, a function of the touch) is read with features made for it, two sets of
    them, and judged by readouts of noisy copies alone; so its readouts give nothing up for it on clean touches, and
    probability and novelty are calibrated on noisy copies. It takes an augmentation with `noisy` copies: without any,
    noisy touches are judged as others are.

    inner: the embedding that reads windows, Kernels(dimension=2016) unless given. seed: of the noisy features.

    Broken wires: a channel that reads the low end of the range throughout is filled in from the others before anything
    is embedded, see `scroll_tactile.prediction.filling`.

    Raises InputError for an embedding of a camera's frames.

    >>> Robust(Kernels(dimension=64))
    Robust(Kernels(seed=1, dimension=64), seed=1)
    """

    def __init__(self, inner: Embedding | None = None, *, seed: int = 1) -> None:
        self.inner: Embedding = Kernels(dimension=2016) if inner is None else inner
        self.seed = seed
        self.name = f"robust {self.inner.name}"
        self.dimension = self.inner.dimension
        self.bound = max(1.0, self.inner.bound)
        inside = capabilities_of(self.inner)
        if inside.reads_frames:
            raise InputError(f"expected an embedding of channels, whose noise and wires are known; came {self.inner!r}")
        # Not tunable, and no composite: f* is made of windows alone.
        self.capabilities = Capabilities(
            partial_windows=inside.partial_windows,
            judged_scales=inside.judged_scales,
            reads_beginnings=True,
            fills_channels=True,
            penalties=inside.penalties,
            embeds_windows=True,
            embeds_noise=True,
        )

    def __repr__(self) -> str:
        return f"Robust({self.inner!r}, seed={self.seed})"

    @cached_property
    def fingerprint(self) -> str:
        """A hash of the inner embedding's fingerprint, the seed and noisy features of two fixed images."""
        digest = hashlib.sha256(f"robust 2 {self.inner.fingerprint} {self.inner.bound!r} {self.seed}".encode())
        for channels, readings in ((1, 9), (5, 300)):
            digest.update(self.embed_noisy([canary(channels, readings)]).astype("<f4").tobytes())
        return digest.hexdigest()

    def embed(self, image: npt.NDArray[np.float32]) -> npt.NDArray[np.floating]:
        """Features of shape (d,) of a tactile image of shape (C, T) in [-1, 1], as the inner embedding gives them."""
        return self.inner.embed(image)

    def embed_windows(
        self, image: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]]
    ) -> dict[int, npt.NDArray[np.floating]]:
        """Width → features (windows, d), as the inner embedding gives them."""
        return embed_windows(self.inner, image, windows)

    def is_noisy(self, image: npt.NDArray[np.float32]) -> bool:
        """Whether a touch is to be read by `embed_noisy`; image: (C, T) in [-1, 1]."""
        return is_noisy(image)

    def embed_noisy(self, images: Sequence[npt.NDArray[np.float32]]) -> npt.NDArray[np.float32]:
        """Two sets of features in [-1, 1], float32 of shape (2, N, d), of N ≥ 1 whole touches felt through noise.

        images: each of shape (C, T) in [-1, 1], all of as many channels.
        """
        return np.stack([features(images) for features in noisy_features(self.seed, len(images[0]), self.dimension)])
