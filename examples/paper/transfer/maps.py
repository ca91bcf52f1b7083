"""What happens where, and when: coarse maps of a touch, for sensors whose channels lie in a known layout."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, shift

from scroll_tactile.embeddings.protocol import Capabilities, canary
from scroll_tactile.embeddings.steady import one_torch_thread
from scroll_tactile.errors import InputError
from scroll_tactile.libraries import optional

if TYPE_CHECKING:
    import torch

__all__ = ["Maps", "View"]

FloatArray = npt.NDArray[np.float64]
View = Literal["as-felt", "centre", "corner"]

VIEWS: tuple[View, ...] = ("as-felt", "centre", "corner")
SUMMARIES = 3  # maps of a whole touch: peak, mean, and how often the value moved

SPREAD = 0.5  # taxels: a dot between two of them presses either
PRESSED = 0.5  # of the square root of the range: a quarter of it is a taxel that is pressed
MARGIN = 4  # taxels that a map may be moved by without losing an edge
STEPS = 2**12  # of a random feature: coarse enough for a machine's cosine not to matter
STEEPEST = 2.0**10  # of a cosine's weights, of which one in 1600 would be steeper: more turns say no more


class Maps:
    """Means of each channel over parts of a touch, or random cosines of them: where it is pressed, and in what order.

    `Kernels` says how often a rhythm occurs in a touch, wherever it does. Here place and order count: how the pressure
    lies over the channels as the touch goes on. Of channels in a grid there are also the peak, the mean and how often
    the value moved, all as square roots, so that light touches count; and they are read by one or more views, for a
    shape is the same shape a taxel further on.

    layout: how the channels lie, (n,) or (rows, columns) in the order of the channels. parts: of a touch, of equal
    length, whose means are taken. views: of a grid: "as-felt"; "centre", moved so that the centre of pressure lies in
    the middle; "corner", moved so that the first row and the first column that are pressed come first.
    cosines: where not 0, so many random Fourier features (Rahimi and Recht 2007), dealt out evenly among the views,
    take the maps' place: they tell known shapes apart as wholes, where the maps tell of a new shape what parts it has.
    Their weights are Cauchy's, so that together they come to Σ exp(−‖x − x'‖₁ / reach) over the views: a touch that
    was nearly so in any one view is near. reach: the sum of absolute differences at which that is 1/e.
    seed: of the cosines.

    Raises InputError for settings that cannot be, and for an image of other channels than the layout's.

    >>> Maps(layout=(8, 10), parts=3, views=["corner"]).embed(np.zeros((80, 187), np.float32)).shape
    (480,)
    """

    name = "maps"
    bound = 1.0

    def __init__(
        self,
        *,
        layout: Sequence[int],
        parts: int = 6,
        views: Sequence[View] = VIEWS,
        cosines: int = 0,
        reach: float = 9.0,
        seed: int = 1,
    ) -> None:
        if not 1 <= len(layout) <= 2 or any(not isinstance(size, int) or size < 1 for size in layout):
            raise InputError(f"expected a layout of one or two sizes of at least 1; came {layout!r}")
        if not views or set(views) - set(VIEWS):
            raise InputError(f"expected one or more views out of {VIEWS}; came {views!r}")
        if 0 < cosines < len(views):
            raise InputError(f"expected no cosines, or one or more for each of {len(views)} views; came {cosines}")
        if parts < 1 or cosines < 0 or seed < 0 or not 0 < reach < math.inf:
            raise InputError(
                f"expected parts of at least 1, cosines and a seed of at least 0 and a positive reach; came {parts}, "
                f"{cosines}, {seed} and {reach}"
            )
        self.layout = tuple(layout)
        self.parts = parts
        self.views = tuple(dict.fromkeys(views))
        self.cosines = cosines
        self.reach = reach
        self.seed = seed
        self._seen = math.prod(layout) * (parts if len(layout) == 1 else parts + SUMMARIES)  # by each view
        self._read = 1 if len(layout) == 1 else len(self.views)
        self.dimension = cosines or self._read * self._seen
        # As many cosines as touches are far from normal: letters' dots 93.4 % right, and 92.5 as the formula says.
        self.capabilities = Capabilities(judged_scales="widest", shrinkage=2.0 if cosines else 1.0)

    def __repr__(self) -> str:
        return (
            f"Maps(layout={self.layout}, parts={self.parts}, views={self.views}, cosines={self.cosines}, "
            f"reach={self.reach}, seed={self.seed})"
        )

    @cached_property
    def fingerprint(self) -> str:
        """A hash of the settings and of the features of two fixed images."""
        digest = hashlib.sha256(f"maps 2 {self!r} {SPREAD} {PRESSED} {MARGIN} {STEPS} {STEEPEST}".encode())
        for columns in (9, 75):
            features = self.embed(canary(math.prod(self.layout), columns))
            # To what a machine's own square roots and filters cannot change.
            digest.update(np.rint(features * 2**8).astype("<i4").tobytes())
        return digest.hexdigest()

    @cached_property
    def _waves(self) -> list[tuple[torch.Tensor, FloatArray]]:
        """Weights, (cosines, maps' values), and phases, (cosines,), of each view."""
        with optional("torch", "torch", "Maps with cosines"):
            import torch

        rng = np.random.default_rng([self.seed, *self.layout, self.parts, self.cosines])
        each, more = divmod(self.cosines, self._read)
        made = []
        for view in range(self._read):
            count = each + (view < more)
            weights = np.clip(rng.standard_cauchy((count, self._seen)), -STEEPEST, STEEPEST) / self.reach
            made.append((torch.from_numpy(weights), rng.uniform(0, 2 * np.pi, count)))
        return made

    def embed(self, image: npt.NDArray[np.float32]) -> FloatArray:
        """Features in [-1, 1], shape (d,), of a tactile image of shape (C, T) in [-1, 1], C as in the layout."""
        if image.ndim != 2 or len(image) != math.prod(self.layout) or not image.shape[1]:
            raise InputError(f"expected a tactile image of shape ({math.prod(self.layout)}, T); came {image.shape}")
        values = image.astype(np.float64)
        plain = _means(values, self.parts).ravel() if len(self.layout) == 1 else self._grids(values)
        if not self.cosines:
            return plain
        waves, views = self._waves, plain.reshape(self._read, self._seen)
        import torch

        with one_torch_thread():  # in one order, whatever the threads
            turned = [
                torch.mv(weights, torch.from_numpy(view)).numpy() + phases
                for view, (weights, phases) in zip(views, waves, strict=True)
            ]
        rounded: FloatArray = np.rint(np.cos(np.concatenate(turned)) * STEPS) / STEPS
        return rounded

    def _grids(self, values: FloatArray) -> FloatArray:
        pressed = np.clip((values + 1) / 2, 0.0, 1.0)
        moving = (np.diff(pressed, axis=1, prepend=pressed[:, :1]) != 0).mean(axis=1)
        rows = [pressed.max(axis=1), pressed.mean(axis=1), moving, *_means(pressed, self.parts)]
        maps = np.sqrt(np.stack(rows)).reshape(-1, *self.layout)
        places = np.stack(np.meshgrid(*map(np.arange, self.layout), indexing="ij"))
        ways = {"as-felt": _nowhere, "centre": self._to_centre, "corner": self._to_corner}
        read = [_moved(maps, ways[view](maps[0], places)) for view in self.views]
        clipped: FloatArray = np.clip(np.stack(read), 0.0, 1.0)
        return clipped.ravel()

    def _to_centre(self, peak: FloatArray, places: npt.NDArray[np.intp]) -> FloatArray:
        weight = float(np.square(peak).sum())
        middle = (np.array(self.layout) - 1) / 2
        if weight == 0:
            return np.zeros(2)
        return np.asarray(middle - (np.square(peak) * places).sum(axis=(1, 2)) / weight)

    def _to_corner(self, peak: FloatArray, places: npt.NDArray[np.intp]) -> FloatArray:
        pressed = peak >= min(PRESSED, float(peak.max()))
        # One taxel is left in front: what is pressed lightly there belongs to the shape.
        by: FloatArray = 1.0 - places[:, pressed].min(axis=1)
        return by


def _nowhere(peak: FloatArray, places: npt.NDArray[np.intp]) -> FloatArray:
    return np.zeros(2)


def _means(values: FloatArray, parts: int) -> FloatArray:
    """Means of (C, T) values over so many parts of equal length, shape (parts, C); edges divide no reading."""
    length = values.shape[1]
    edges = np.linspace(0, length, parts + 1).round().astype(int)
    firsts = np.minimum(edges[:-1], length - 1)
    return np.stack([values[:, i : max(i + 1, end)].mean(axis=1) for i, end in zip(firsts, edges[1:], strict=True)])


def _moved(maps: FloatArray, by: FloatArray) -> FloatArray:
    """Maps, shape (M, rows, columns), moved by so many rows and columns and blurred."""
    wide = np.pad(maps, ((0, 0), (MARGIN, MARGIN), (MARGIN, MARGIN)))
    moved = np.stack([shift(gaussian_filter(values, SPREAD), by, order=1) for values in wide])
    return moved[:, MARGIN:-MARGIN, MARGIN:-MARGIN]
