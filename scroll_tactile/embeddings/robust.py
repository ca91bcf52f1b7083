"""Any embedding, read so that short and noisy touches are known, too; and what is left of a touch under heavy noise.

Convolutions see little then (RoboSkin under uniform noise of half the range: 20 to 30 %). Averages over the whole touch
see more, and the edges of the noise most of all: the range ends the noise at the low end, and noise of bounded
amplitude never lifts a channel at rest beyond its edge, so that a single reading beyond it is evidence. So the noise's
edge is estimated from the touch itself, and each channel is described by how often it passes the edge by some margins,
by its highest readings, its mean, and how often it lies at the low end. Roots of frequencies have a spread that does
not depend on them. Each of these is turned by the edge into what it says of the reading beneath: noise spread evenly in
± e lets a reading s pass e with frequency s / 2e, and leaves it at the low end with (e − s) / 2e. So touches through
little noise and much are alike, and one set of statistics serves all amplitudes (RoboSkin 80 % with copies of 30 to
70 % of the range in it, 77 without the turning). The estimate is a function of the touch alone, and all arithmetic is
exact, as in `levels`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.banks import LEVELS, PERIOD, TriangleFeatures, to_levels
from scroll_tactile.embeddings.kernels import Kernels
from scroll_tactile.embeddings.protocol import Capabilities, Embedding, canary, capabilities_of, embed_windows
from scroll_tactile.embeddings.registry import configuration_of
from scroll_tactile.errors import InputError

__all__ = ["SETS", "NoisyFeatures", "Robust", "is_noisy", "noisy_features", "noisy_statistics"]

NOISY = 0.03  # of the range: the mean step between neighbours in the quieter channels of a noisy touch
QUIET_CHANNELS = 4  # a quarter of the channels: enough of them are at rest
MARGINS = (0.0, 0.02, 0.05, 0.1, 0.18, 0.28)  # of the range, above the noise's edge
MARGINS_OF_PARTS = (0.0, 0.05)
HIGHEST = (0, 1, 3, 7)  # places among a channel's readings, from the top, of a hundred
RANGE = 2 * LEVELS
UNIT = 2**11  # statistics are integers, in 1/UNIT of what they are a share of
# By how much each statistic is multiplied so that noise of half the range spreads all of them alike.
FREQUENCY, LOW, MEAN, TOP = 2, 2, 6, 3
MOST_TERMS = 64
PACE = 1.2  # how many spreads of the noise turn a feature by one radian
# Of each set: how many stretches of time where there is room for them, as for sensors of few channels; and the share
# of features that are the statistics themselves, at most.
SETS = ((4, 0.5), (20, 0.9))


class Robust:
    """An embedding whose memories know short touches, noisy ones and dead channels by statistics of their own.

    The beginning: a touch's first 0.3 s differ from the rest, and are all that there is of a short one. Statistics of
    them alone, and not of all narrow windows, know them better (BioTac: 95 % instead of 87).

    Noise: a touch through noise (`is_noisy`, a function of the touch) is read with features made for it, two sets of
    them, and judged by readouts of noisy copies alone; so its readouts give nothing up for it on clean touches, and
    probability and novelty are calibrated on noisy copies. It takes an augmentation with `noisy` copies: without any,
    noisy touches are judged as others are.

    inner: the embedding that reads windows, Kernels(dimension=2016) unless given. seed: of the noisy features.

    Dead channels: a channel that reads the low end of the range throughout is filled in from the others before anything
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
            raise InputError(
                f"expected an embedding of channels, whose noise and dead channels are known; came {self.inner!r}"
            )
        # Not tunable, and no composite: f* is made of windows alone.
        self.capabilities = Capabilities(
            partial_windows=inside.partial_windows,
            judged_scales=inside.judged_scales,
            reads_beginnings=True,
            fills_channels=True,
            embeds_windows=True,
            embeds_noise=True,
            exact=inside.exact,
        )

    def __repr__(self) -> str:
        return f"Robust({self.inner!r}, seed={self.seed})"

    def configuration(self) -> dict[str, Any] | None:
        """What makes an equal one, in JSON's types; None around an embedding that does not ship with scroll-tactile."""
        inner = configuration_of(self.inner)
        return None if inner is None else {"kind": "robust", "inner": inner, "seed": int(self.seed)}

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
        """Two sets of features in [-1, 1], float32 of shape (2, N, d), of N ≥ 1 whole noisy touches.

        images: each of shape (C, T) in [-1, 1], all of as many channels.
        """
        return np.stack([features(images) for features in noisy_features(self.seed, len(images[0]), self.dimension)])


def is_noisy(image: npt.NDArray[np.float32]) -> bool:
    """Whether a touch was recorded through noise: a tactile image of shape (C, T) in [-1, 1].

    The mean step between neighbours, in the quarter of the channels where it is smallest, is compared to 3 % of the
    range: clean touches have 0.1 to 2.9 %, uniform noise of a tenth of the range makes 2.9 to 5.4 %.
    """
    if image.shape[1] < 2:
        return False
    steps = np.abs(np.diff(to_levels(image).astype(np.int64), axis=1)).sum(axis=1)
    quiet = int(np.sort(steps)[len(steps) // QUIET_CHANNELS])
    return bool(quiet > NOISY * 2 * LEVELS * (image.shape[1] - 1))


def noisy_statistics(image: npt.NDArray[np.float32], parts: int = 0) -> npt.NDArray[np.float64]:
    """Statistics of each channel about the noise's edge, shape (12 + 4 · parts, C), integers in ± 2¹⁵.

    image: shape (C, T) in [-1, 1]. The noise's edge is how far the highest reading lies above the middle one, in the
    quarter of the channels where that is least. parts: equal stretches of time that a third of the statistics are
    taken of, too.
    """
    above = to_levels(image).astype(np.int64) + LEVELS  # 0 to 2 · LEVELS, the range
    columns = above.shape[1]
    ordered = np.sort(above, axis=1)[:, ::-1]
    edge = int(np.sort(ordered[:, 0] - ordered[:, columns // 2])[len(above) // QUIET_CHANNELS])
    tops = [(ordered[:, place * columns // 100] - edge) * UNIT // RANGE * TOP for place in HIGHEST]
    rows = [*_frequencies(above, edge, MARGINS), *tops]
    for part in range(parts):
        first = min(part * columns // parts, columns - 1)
        stretch = above[:, first : max(first + 1, (part + 1) * columns // parts)]
        rows += _frequencies(stretch, edge, MARGINS_OF_PARTS)
    return np.stack(rows).astype(np.float64)


def _frequencies(above: npt.NDArray[np.int64], edge: int, margins: tuple[float, ...]) -> list[npt.NDArray[np.integer]]:
    """Of each channel's readings: how often they pass the edge by each margin, how often they lie at the low end, and
    their mean, as shares of the range; of the first the roots."""
    columns = above.shape[1]
    passed = [_root(np.count_nonzero(above - edge > margin * RANGE, axis=1) * 2 * edge, columns) for margin in margins]
    low = (columns - 2 * np.count_nonzero(above == 0, axis=1)) * edge * UNIT // (RANGE * columns)
    mean = (4 * above.sum(axis=1) - edge * columns) * UNIT // (4 * RANGE * columns)
    return [*(share * FREQUENCY for share in passed), low * LOW, mean * MEAN]


def _root(sums: npt.NDArray[np.integer], columns: int) -> npt.NDArray[np.int64]:
    roots: npt.NDArray[np.int64] = np.floor(np.sqrt(sums / (RANGE * columns)) * UNIT).astype(np.int64)
    return roots


class NoisyFeatures:
    """`dimension` features of a noisy touch of C channels: statistics as they are, and triangle features of them.

    parts: stretches of time with statistics of their own, where they fit. linear: the largest share of the former.
    """

    def __init__(self, seed: int, channels: int, dimension: int, parts: int, linear: float) -> None:
        room = int(dimension * linear)
        whole, part = (len(MARGINS) + 2 + len(HIGHEST)) * channels, (len(MARGINS_OF_PARTS) + 2) * channels
        self.parts = parts if whole + parts * part <= room else 0
        inputs = whole + self.parts * part
        self.linear = min(inputs, room)
        self.triangles = _triangles(seed, inputs, dimension - self.linear)

    def __call__(self, images: Sequence[npt.NDArray[np.float32]]) -> npt.NDArray[np.float32]:
        """Features in [-1, 1], float32 of shape (N, dimension), of N ≥ 1 images of shape (C, T) in [-1, 1].

        Together, for the weights of the triangles are the larger part of what is read; the bits do not depend on it.
        """
        statistics = np.stack([noisy_statistics(image, self.parts).reshape(-1) for image in images])
        plain = (statistics[:, : self.linear] / (8 * UNIT)).astype(np.float32)
        return np.concatenate([plain, self.triangles(statistics)], axis=1)


@lru_cache(maxsize=16)
def noisy_features(seed: int, channels: int, dimension: int) -> list[NoisyFeatures]:
    """Make the sets of features for touches of `channels` channels; the same arguments give the same features."""
    return [NoisyFeatures(seed + i, channels, dimension, *settings) for i, settings in enumerate(SETS)]


def _triangles(seed: int, inputs: int, count: int) -> TriangleFeatures:
    import torch

    rng = np.random.default_rng([seed, inputs, count, 2])
    weights = np.zeros((count, inputs))
    turn = PERIOD / (2 * np.pi * PACE * UNIT / 10)  # statistics are spread by about a tenth of UNIT
    for feature in range(count):
        terms = min(inputs, int(MOST_TERMS ** rng.random() * 2))
        weights[feature, rng.permutation(inputs)[:terms]] = rng.standard_normal(terms) * turn / np.sqrt(terms)
    rounded = np.clip(np.rint(weights.T), -(2.0**20), 2.0**20)
    phases = np.floor(rng.random(count) * PERIOD)
    return TriangleFeatures(torch.from_numpy(np.ascontiguousarray(rounded)), torch.from_numpy(phases))
