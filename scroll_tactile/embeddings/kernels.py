"""The default embedding: random convolution kernels and level features, made from a seed, for any sensor.

Competing kernels (see `convolution`) tell at how many steps of time each kernel of a group responds most, and
least. Beside the proportions they gain 0.84 ± 0.26 points, the mean over fourteen sets.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from scroll_tactile.blas import one_thread
from scroll_tactile.embeddings.convolution import (
    GROUP,
    LEVELS,
    TAPS,
    Bank,
    CountRequest,
    Counts,
    TriangleFeatures,
    bank,
    bank_size,
    competing_groups,
    count,
    to_levels,
    triangle_features,
    window_statistics,
)
from scroll_tactile.embeddings.protocol import Capabilities, canary
from scroll_tactile.errors import InputError
from scroll_tactile.signals.windows import ENOUGH

__all__ = [
    "LEAST_FEATURES",
    "MOST_FEATURES",
    "Kernels",
    "angles",
    "groups_by_dilation",
]

SHORTEST = 12  # steps; a shorter image is continued by its mirror image
SHORT = 32  # steps
# The share of triangle features in short windows: with it the first 0.3 s of BioTac's touches are right in 87 %,
# without in 64 %. Wider windows have none: there they cost a tenth of a point.
SHARE_IN_SHORT = 0.3
REACH = 0.6  # of a window: a dilated kernel that spans more has too few positions left
LEAST_FEATURES: Final = 64
MOST_FEATURES: Final = 8192  # the shortest windows have one dilation, whose bank has 378 kernels of 24 thresholds
DEFAULT_SEED = 1  # measured with the seeds 0 to 5: BioTac-20 98.6 to 99.2 %, RoboSkin-20 97.6 to 98.3 %
MOST_STEPS = 2048  # of a whole image convolved at once; longer ones are read window by window


@dataclass(frozen=True)
class Part:
    """What one dilation gives of windows of some widths.

    features: the most that a width has of it. windows: first place of the convolution, and the one behind the last.
    groups: of competing kernels. pools: of each width the rows of its windows, its features, and the places of each.
    """

    dilation: int
    features: int
    windows: tuple[tuple[int, int], ...]
    groups: int
    pools: tuple[tuple[int, slice, int, int], ...]

    def request(self, bank: Bank) -> CountRequest:
        """What is counted of this dilation's bank."""
        groups = competing_groups(bank, self.groups) if self.groups else None
        return CountRequest(bank, self.features, self.windows, groups)


class Kernels:
    """Random convolution kernels, pooled to proportions, beside triangle features of the channels' levels.

    Weight-free: everything is made from `seed`, nothing is downloaded, any number of channels and readings is
    read, and all arithmetic is on integers, so the features are the same bits on every machine. A proportion
    p is given as (2/π)·asin √p, which spreads evenly what is nearly always or nearly never exceeded.

    seed: of the kernels; no seed was better on both sensors than the default, the worst lay half a point below it.
    dimension: d, the number of features, 64 to 8192.

    Raises InputError for a dimension or a seed out of range, and for an image that has not two axes or is empty.

    >>> import numpy as np
    >>> Kernels(dimension=1008).embed(np.zeros((19, 400), dtype=np.float32)).shape
    (1008,)
    """

    name = "kernels"
    bound = 1.0
    capabilities = Capabilities(embeds_windows=True, competes=True, exact=True, reads_whole_touches=True)

    def __init__(self, *, seed: int = DEFAULT_SEED, dimension: int = 1008) -> None:
        if not LEAST_FEATURES <= dimension <= MOST_FEATURES:
            raise InputError(f"dimension must lie between {LEAST_FEATURES} and {MOST_FEATURES}; came {dimension}")
        if seed < 0:
            raise InputError(f"seed must not be negative; came {seed}")
        self.seed = seed
        self.dimension = dimension

    def bank_of(self, channels: int, dilation: int) -> Bank:
        """The kernels of a dilation, for images of so many channels."""
        return bank(self.seed, channels, dilation)

    def __repr__(self) -> str:
        return f"Kernels(seed={self.seed}, dimension={self.dimension})"

    def configuration(self) -> dict[str, Any]:
        """What makes an equal one, in JSON's types; see `embeddings.registry`."""
        return {"kind": "kernels", "seed": int(self.seed), "dimension": int(self.dimension)}

    @cached_property
    def fingerprint(self) -> str:
        """A hash of the settings and of the features of three fixed images, made by the code that embeds."""
        digest = hashlib.sha256(f"kernels 2 {self.seed} {self.dimension} {LEVELS}".encode())
        for channels, readings in ((1, 9), (3, 30), (5, 300)):
            embedded, competing = self.embed_competing(canary(channels, readings), {readings: [0]}, readings)
            digest.update(embedded[readings].astype("<f4").tobytes() + competing.astype("<f4").tobytes())
        return digest.hexdigest()

    def embed(self, image: npt.NDArray[np.float32], width: int | None = None) -> npt.NDArray[np.float32]:
        """Features in [0, 1], float32 of shape (d,), of a tactile image of shape (C, T) in [-1, 1].

        width: the width of window that the image stands for, its own steps unless given.
        """
        _require_image(image)
        width = image.shape[1] if width is None else width
        return np.asarray(self.embed_windows(image, {width: [0]})[width][0])

    def embed_windows(
        self, image: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]]
    ) -> dict[int, npt.NDArray[np.float32]]:
        """Embed windows of an image at once: width → first steps, to width → features (windows, d).

        Each row is what `embed` gives for the window alone, to the bit: one convolution serves all windows,
        and integers do not care how they are summed. A window may be wider than the image and begin at 0: then
        the image is read with that width's kernels as far as it goes, or, where it is less than 0.65 of the
        width, continued by its mirror image.
        """
        _require_image(image)
        steps = image.shape[1]
        if steps > MOST_STEPS and any(width < steps for width in windows):
            cut = {w: [np.ascontiguousarray(image[:, at : at + w]) for at in starts] for w, starts in windows.items()}
            return {width: np.stack([self.embed(part, width) for part in parts]) for width, parts in cut.items()}
        return self._embedded(to_levels(image), windows)[0]

    def embed_competing(
        self, image: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]], width: int
    ) -> tuple[dict[int, npt.NDArray[np.float32]], npt.NDArray[np.float32]]:
        """Embed windows of an image and, by the same responses, all of it by competing kernels; see `Counts`.

        image: shape (C, T), T at most 2048. width: that it stands for, at least T. Returns what `embed_windows` does,
        and features of shape (d,): proportions p of the steps of time, as (2/π)·asin √p; zeros behind the last group.
        """
        _require_image(image)
        levels, wide = to_levels(image), max(width, SHORTEST)
        if _suffices(image.shape[1], width):
            features, parts = self._embedded(levels, windows, wide)
        else:
            features, (_, parts) = self.embed_windows(image, windows), self._read(_mirrored(levels, wide), {}, wide)
        return features, np.concatenate([*parts, np.zeros(self.dimension % (2 * GROUP), np.float32)])

    def window_counts(
        self, levels: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]]
    ) -> dict[int, list[tuple[npt.NDArray[np.integer], int]]]:
        """What the proportions of windows are made of, for each width dilation by dilation: (counts, places).

        levels: whole numbers in ±LEVELS, float32 of shape (C, T). windows: width → first steps; T is at least 12 and
        0.65 of every width. counts: at how many of the places each threshold is exceeded, shape (windows, features).
        """
        widths = {width: tuple(starts) for width, starts in windows.items()}
        found: dict[int, list[tuple[npt.NDArray[np.integer], int]]] = {width: [] for width in windows}
        for part, counts in self._counted(levels, widths, None):
            for width, rows, features, places in part.pools:
                found[width].append((counts.features[rows, :features], places))
        return found

    def level_features(
        self, levels: npt.NDArray[np.float32], width: int, starts: Sequence[int]
    ) -> npt.NDArray[np.float32] | None:
        """The triangle features of windows, (windows, count), in steps of 1/64; None where their width has none."""
        triangles = self.triangles(len(levels), width)
        if triangles is None:
            return None
        cut = np.stack([levels[:, start : start + width] for start in starts])
        with one_thread():
            return triangles(window_statistics(cut))

    def triangles(self, channels: int, width: int) -> TriangleFeatures | None:
        """The features of levels of windows of a width; None where it has none."""
        count = self.dimension - _thresholded(self.dimension, width)
        return triangle_features(self.seed, channels, count) if count else None

    def dilations(self, channels: int, width: int) -> dict[int, int]:
        """Dilation → how many of the proportions of windows of a width it gives."""
        return _shares(channels, _thresholded(self.dimension, width), width)

    def _embedded(
        self, levels: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]], competing: int | None = None
    ) -> tuple[dict[int, npt.NDArray[np.float32]], list[npt.NDArray[np.float32]]]:
        """Features of windows, and those of competing kernels; see `_read`."""
        steps = levels.shape[1]
        whole = {w: tuple(starts) for w, starts in windows.items() if _suffices(min(w, steps), w)}
        features, proportions = self._read(levels, whole, competing) if whole or competing else ({}, [])
        for width, starts in windows.items():
            if width not in whole:
                wide = max(width, SHORTEST)
                cuts = (_mirrored(levels[:, start : start + width], wide) for start in starts)
                features[width] = np.stack([self._read(cut, {wide: (0,)})[0][wide][0] for cut in cuts])
        return features, proportions

    def _counted(
        self, levels: npt.NDArray[np.float32], windows: Mapping[int, tuple[int, ...]], competing: int | None
    ) -> Iterator[tuple[Part, Counts]]:
        """What is counted of each dilation."""
        channels, readings = levels.shape
        parts = _parts(self.dimension, channels, readings, tuple(windows.items()), competing)
        requests = [part.request(self.bank_of(channels, part.dilation)) for part in parts]
        return zip(parts, count(levels, requests), strict=True)

    def _read(
        self, levels: npt.NDArray[np.float32], windows: Mapping[int, tuple[int, ...]], competing: int | None = None
    ) -> tuple[dict[int, npt.NDArray[np.float32]], list[npt.NDArray[np.float32]]]:
        """Features of windows; and of competing kernels, dilation by dilation, where a width is given for these."""
        readings = levels.shape[1]
        pooled: dict[int, list[npt.NDArray[np.float32]]] = {width: [] for width in windows}
        proportions: list[npt.NDArray[np.float32]] = []
        for part, found in self._counted(levels, windows, competing):
            proportions.append(angles(readings - (TAPS - 1) * part.dilation)[found.competing.ravel()])
            for width, rows, features, places in part.pools:
                pooled[width].append(angles(places)[found.features[rows, :features]])
        for width, starts in windows.items():
            if (features_of_levels := self.level_features(levels, width, starts)) is not None:
                pooled[width].append(features_of_levels)
        return {width: np.concatenate(arrays, axis=1) for width, arrays in pooled.items()}, proportions


def _thresholded(features: int, width: int) -> int:
    """How many of so many features are proportions in a window of this width; the rest are of levels."""
    return features - (round(features * SHARE_IN_SHORT) if width <= SHORT else 0)


def _require_image(image: npt.NDArray[np.float32]) -> None:
    if image.ndim != 2 or 0 in image.shape:
        raise InputError(f"expected a tactile image of shape (C, T); came {image.shape}")


def _suffices(steps: int, width: int) -> bool:
    return steps >= SHORTEST and steps >= ENOUGH * width


def _mirrored(levels: npt.NDArray[np.float32], steps: int) -> npt.NDArray[np.float32]:
    return np.pad(levels, ((0, 0), (0, steps - levels.shape[1])), mode="symmetric")


def _dilations(width: int) -> list[int]:
    dilations = [1]
    while (TAPS - 1) * 2 * dilations[-1] <= REACH * width:
        dilations.append(2 * dilations[-1])
    return dilations


@lru_cache(maxsize=256)
def _parts(
    dimension: int,
    channels: int,
    readings: int,
    widths: tuple[tuple[int, tuple[int, ...]], ...],
    competing: int | None,
) -> list[Part]:
    """What is counted of each dilation: for windows, by width their first steps, and for an image that competes."""
    shares = {width: _shares(channels, _thresholded(dimension, width), width) for width, _ in widths}
    contests = _dilations(competing) if competing else []
    groups = dict(zip(contests, groups_by_dilation(dimension, len(contests)), strict=True))
    parts = []
    for dilation in _dilations(max([*shares, competing or 0])):
        windows: list[tuple[int, int]] = []
        pools: list[tuple[int, slice, int, int]] = []
        span = (TAPS - 1) * dilation
        for width, starts in widths:
            if features := shares[width].get(dilation, 0):
                first, places = len(windows), min(width, readings) - span
                windows += [(start, start + places) for start in starts]
                pools.append((width, slice(first, len(windows)), features, places))
        most = max((features for _, _, features, _ in pools), default=0)
        parts.append(Part(dilation, most, tuple(windows), groups.get(dilation, 0), tuple(pools)))
    return parts


def _shares(channels: int, features: int, width: int) -> dict[int, int]:
    """Dilation → how many of the proportions it gives, by the sizes of the banks that fit a width."""
    dilations = _dilations(width)
    sizes = np.array([bank_size(channels, dilation) for dilation in dilations])
    edges = np.rint(np.cumsum(sizes) * (features / sizes.sum())).astype(int)
    return dict(zip(dilations, np.diff(edges, prepend=0).tolist(), strict=True))


@lru_cache(maxsize=1024)
def angles(places: int) -> npt.NDArray[np.float32]:
    """(2/π)·asin √(k/places) for k = 0 … places, rounded to 2⁻²⁰, so that machines' sines do not matter."""
    exact = np.arcsin(np.sqrt(np.arange(places + 1) / places)) * (2 / np.pi)
    return (np.rint(exact * 2.0**20) / 2.0**20).astype(np.float32)


def groups_by_dilation(features: int, dilations: int) -> list[int]:
    """The number of groups of each dilation: as even as can be; a group has two features a kernel."""
    total = features // (2 * GROUP)
    return [total // dilations + (i < total % dilations) for i in range(dilations)]
