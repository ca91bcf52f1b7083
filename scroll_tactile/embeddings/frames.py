"""The embedding for cameras: of each frame its light and its surface, or what a trained network sees of that.

The lamps beside the gel colour a slope by its direction, so the colours show the shape of what is pressed into it, and
their gradients its relief (Yuan, Dong and Adelson 2017, GelSight). The light is averaged over a few cells of the frame.
Gradients are taken at five scales, each the last one's sums over 2 × 2 pixels, and counted: how often each direction
occurs in each strength (after histograms of oriented gradients, Dalal and Triggs 2005), and how often the surface is
bent so much, up or down. All of it is counts and sums of integers: the same bits on every machine.
"""

from __future__ import annotations

import base64
import hashlib
import os
import zlib
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.convolution import LEVELS, to_levels
from scroll_tactile.embeddings.kernels import angles
from scroll_tactile.embeddings.protocol import Capabilities, canary
from scroll_tactile.embeddings.steady import steady
from scroll_tactile.errors import InputError
from scroll_tactile.libraries import require
from scroll_tactile.signals.contact import Rest

if TYPE_CHECKING:
    import torch

    from scroll_tactile.embeddings.resnet import ResNet

__all__ = ["COLOURS", "LIGHT", "SURFACE", "Frames", "light", "surface"]

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float32]

NETWORK_STAGES = (1, 2, 3)
SMOOTH = 20  # columns of a frame in the standard deviation of the blur that is taken off for the network
GAIN = 4.0  # relief is faint: a few levels of 255
BLURRED = 3  # standard deviations that the blur reaches
REACH = 1.2  # between two frames' counts, at which cosines tell them apart: about the usual distance
STEPS = 2**12  # of a cosine

COLOURS = 3
SCALES = 5
OCTANTS = 8
STRENGTHS = (2, 4, 8, 16, 32)  # of a gradient or a curvature, in 1/255 of the range
STEP = 2 * LEVELS / 255  # levels in 1/255 of the range
CELLS = (6, 8)  # rows and columns that colours are averaged over

_HISTOGRAM = OCTANTS * (len(STRENGTHS) + 1)
_CURVATURES = 2 * 2 * len(STRENGTHS)  # of two kinds, up and down
LIGHT = COLOURS * CELLS[0] * CELLS[1]  # features
SURFACE = COLOURS * SCALES * (_HISTOGRAM + _CURVATURES)  # features of slopes and bumps


class Frames:
    """What a camera behind a gel sees, frame by frame: its light, beside the relief of what is pressed into it.

    rest: the gel at rest, against which frames are in contact or not, and whose picture is taken off them: "first",
        the first frame of every stream; one picture for all, an array (height, width, 3) in the sensor's unit; or None:
        every frame counts, and is read as it is.
    weights: of a trained ResNet, as for `Vision`. The relief is read by its stages 1 to 3, each one's mean and standard
        deviation over the frame scaled to length 1: 1040 features, the same bytes on one machine. It is shown the
        relief alone: less its blur, and four times as strong. Without weights: by counts of slopes and bumps (see
        above), 1164 features, the same bytes on any machine.
    cosines: where not 0, so many random Fourier features (Rahimi and Recht 2007) of the counts, without the light, take
        the place of all: they tell attributes of new objects better, and objects that were touched worse.
        seed: of the cosines. They are rounded, so that another machine's last bits rarely matter.

    Raises InputError for a resting image that is none, cosines or a seed below 0, and cosines beside weights;
    WeightsError for weights that cannot be used.

    >>> import numpy as np
    >>> Frames().embed(np.zeros((360, 160), dtype=np.float32)).shape
    (1164,)
    """

    name = "frames"
    bound = 1.0

    def __init__(
        self,
        weights: str | os.PathLike[str] | Mapping[str, torch.Tensor] | None = None,
        *,
        rest: Rest | npt.ArrayLike = "first",
        cosines: int = 0,
        seed: int = 1,
    ) -> None:
        whole = all(type(number) is int and number >= 0 for number in (cosines, seed))
        if not whole or (cosines and weights is not None):
            raise InputError(
                "expected cosines and a seed as whole numbers of 0 or more, and no weights beside cosines; came "
                f"{cosines!r} and {seed!r}" + (" with weights" if weights is not None else "")
            )
        require("torch", "torch", "the embedding Frames")
        self.rest: Rest = _checked(rest)
        self.capabilities = Capabilities(reads_frames=True, rest=self.rest)
        self.cosines = cosines
        self.seed = seed
        self._net: ResNet | None = None
        self._source: str | None = None
        self.dimension = cosines or LIGHT + SURFACE
        if weights is not None:
            from scroll_tactile.embeddings.resnet import folded
            from scroll_tactile.embeddings.weights import load_network, source_name

            self._source = source_name(weights)
            self._net = load_network(weights).requires_grad_(False)
            self._quick = folded(self._net, NETWORK_STAGES[-1])
            self.dimension = LIGHT + 2 * sum(self._net.widths[stage] for stage in NETWORK_STAGES)

    def __repr__(self) -> str:
        rest = "<picture>" if isinstance(self.rest, np.ndarray) else repr(self.rest)
        waves = f", cosines={self.cosines}, seed={self.seed}" if self.cosines else ""
        weights = None if self._net is None else self._source or "<state dict>"
        return f"Frames({weights!r}, rest={rest}{waves})"

    def configuration(self) -> dict[str, Any]:
        """What makes an equal one, in JSON's types; see `embeddings.registry`."""
        weights = None
        if self._net is not None:
            from scroll_tactile.embeddings.weights import digest_of

            weights = {"name": self._source, "sha256": digest_of(self._net)}
        rest: Any = self.rest
        if isinstance(rest, np.ndarray):
            deflated = zlib.compress(np.ascontiguousarray(rest, "<f4").tobytes(), 9)
            rest = {"shape": list(rest.shape), "float32": base64.b64encode(deflated).decode("ascii")}
        return {"kind": "frames", "weights": weights, "rest": rest, "cosines": self.cosines, "seed": self.seed}

    @cached_property
    def fingerprint(self) -> str:
        """A hash of the resting image, the network and torch's version, and of the features of three fixed images."""
        digest = hashlib.sha256(
            f"frames 1 {LEVELS} {SMOOTH} {GAIN} {NETWORK_STAGES} {self.cosines} {self.seed}".encode()
        )
        digest.update(self.rest.tobytes() if isinstance(self.rest, np.ndarray) else repr(self.rest).encode())
        if self._net is not None:
            import torch

            from scroll_tactile.embeddings.resnet import DEPTH
            from scroll_tactile.embeddings.weights import hash_tensors

            digest.update(f"{DEPTH} {self._net.stem} {torch.__version__}".encode())
            hash_tensors(digest, self._net)
        for channels, columns in ((3, 1), (24, 9), (120, 64)):
            digest.update(self.embed(canary(channels, columns)).astype("<f4").tobytes())
        return digest.hexdigest()

    def embed(self, image: npt.NDArray[np.float32]) -> FloatArray:
        """Features in [-1, 1], float32 of shape (d,), of the tactile image of one frame, (3 · rows, columns).

        Raises InputError for an image that is none of a camera's.
        """
        if image.ndim != 2 or 0 in image.shape or image.shape[0] % COLOURS:
            raise InputError(
                f"expected the tactile image of a camera's frame, (rows × {COLOURS}, columns); came {image.shape}"
            )
        planes = image.reshape(-1, COLOURS, image.shape[1]).swapaxes(0, 1)
        levels = to_levels(planes).astype(np.int64)
        if self.cosines:
            return self._waved(surface(levels))
        relief = surface(levels) if self._net is None else self._seen(planes)
        return np.concatenate([light(levels), relief])

    @cached_property
    def _waves(self) -> tuple[torch.Tensor, torch.Tensor]:
        import torch

        rng = np.random.default_rng([self.seed, self.cosines])
        weights = rng.standard_normal((self.cosines, SURFACE)) / REACH
        return torch.from_numpy(weights), torch.from_numpy(rng.uniform(0, 2 * np.pi, self.cosines))

    def _waved(self, counts: FloatArray) -> FloatArray:
        """Cosines of counts, rounded so coarsely that a machine's own last bits rarely matter."""
        import torch

        weights, phases = self._waves
        with steady():
            waves = torch.cos(weights @ torch.from_numpy(counts).double() + phases)
            return np.asarray((torch.round(waves * STEPS) / STEPS).float().numpy())

    def _seen(self, planes: npt.NDArray[np.float32]) -> FloatArray:
        """What the network sees of the relief: of each stage the mean and the spread of its maps, of length 1 each."""
        import torch
        from torch.nn import functional

        from scroll_tactile.embeddings.vision import to_planes

        with steady():
            shown = torch.tensor(planes[None], dtype=torch.float32)
            shown = (GAIN * (shown - _blurred(shown, max(1, planes.shape[2] // SMOOTH)))).clamp(-1, 1)
            maps = self._quick(to_planes(shown).contiguous(memory_format=torch.channels_last), NETWORK_STAGES[-1])
            parts = []
            for stage in NETWORK_STAGES:
                found = maps[stage][0].flatten(1)
                parts += [found.mean(dim=1), found.std(dim=1, correction=0)]
            normalised = torch.cat([functional.normalize(part, dim=0) for part in parts])
            # Rounding may pass 1 by a unit in the last place.
            return np.asarray(np.minimum(normalised.numpy(), np.float32(1)))


def _blurred(planes: torch.Tensor, deviation: int) -> torch.Tensor:
    """Planes (1, 3, H, W) less what is finer than a Gaussian; beyond its edges a plane goes on as at them."""
    import torch
    from torch.nn import functional

    reach = BLURRED * deviation
    taps = torch.exp(-torch.arange(-reach, reach + 1).square() / (2 * deviation**2))
    taps = (taps / taps.sum()).expand(COLOURS, 1, 1, -1)
    wide = functional.pad(planes, (reach,) * 4, mode="replicate")
    return functional.conv2d(functional.conv2d(wide, taps, groups=COLOURS), taps.transpose(2, 3), groups=COLOURS)


def _checked(rest: Rest | npt.ArrayLike) -> Rest:
    if rest is None or (isinstance(rest, str) and rest == "first"):
        return cast(Rest, rest)
    try:
        picture = np.array(rest, dtype=np.float32)
    except (TypeError, ValueError):
        picture = np.empty(0, np.float32)
    if picture.ndim != 3 or picture.shape[2] != COLOURS or not picture.size or not np.isfinite(picture).all():
        raise InputError(
            "expected the gel at rest as 'first', None, or one picture of finite numbers (height, width, 3); came "
            f"{rest if isinstance(rest, str) else np.shape(picture)!r:.80}"
        )
    picture.setflags(write=False)
    return picture


def light(frame: IntArray) -> FloatArray:
    """Mean colours of 6 × 8 cells, in [-1, 1], float32 of shape (LIGHT,), of a frame of levels in ±LEVELS, (3, H, W).

    Of a frame with fewer rows or columns than cells some pixels lie in several of them.
    """
    (top, under), (left, after) = (_edges(size, count) for size, count in zip(frame.shape[1:], CELLS, strict=True))
    total = np.pad(frame.cumsum(axis=1).cumsum(axis=2), ((0, 0), (1, 0), (1, 0)))
    rows = total[:, under] - total[:, top]
    sums = rows[:, :, after] - rows[:, :, left]
    return np.asarray(sums / (LEVELS * np.outer(under - top, after - left)), np.float32).ravel()


def _edges(size: int, count: int) -> tuple[IntArray, IntArray]:
    first = np.arange(count) * size // count
    return first, np.maximum(first + 1, (np.arange(count) + 1) * size // count)


def surface(frame: IntArray) -> FloatArray:
    """How sloped and bent it is, in [0, 1], float32 of shape (SURFACE,), of a frame of levels in ±LEVELS, (3, H, W).

    A frame may be of any size, down to a single pixel: it goes on beyond its edges as at them.
    """
    parts: list[FloatArray] = []
    sums = frame
    for scale in range(SCALES):
        if scale:
            sums = _halved(sums)
        parts += _at_scale(sums, STEP * 4**scale)
    return np.concatenate([part.ravel() for part in parts])


def _at_scale(sums: IntArray, step: float) -> list[FloatArray]:
    """Counts of one scale; step: what a difference of 1/255 of the range is in these sums."""
    wide = np.pad(sums, ((0, 0), (1, 1), (1, 1)), mode="edge")
    up, down, left, right = wide[:, :-2, 1:-1], wide[:, 2:, 1:-1], wide[:, 1:-1, :-2], wide[:, 1:-1, 2:]
    bump = 4 * sums - up - down - left - right
    saddle = wide[:, 2:, 2:] + wide[:, :-2, :-2] - wide[:, 2:, :-2] - wide[:, :-2, 2:]
    edges = [int(step * strength) for strength in STRENGTHS]
    return [_directions(right - left, down - up, edges), _curvatures(bump, edges), _curvatures(saddle, edges)]


def _directions(along: IntArray, across: IntArray, edges: list[int]) -> FloatArray:
    """How often each octant of directions occurs in each strength: (3, _HISTOGRAM)."""
    squared = along * along + across * across
    octant = (along < 0) * 4 + (across < 0) * 2 + (np.abs(along) < np.abs(across))
    strength = sum((squared > edge * edge).astype(np.int64) for edge in edges)
    kind = (octant * (len(edges) + 1) + strength).reshape(COLOURS, -1)
    counts = np.stack([np.bincount(plane, minlength=_HISTOGRAM) for plane in kind])
    return np.asarray(angles(kind.shape[1])[counts])


def _curvatures(bent: IntArray, edges: list[int]) -> FloatArray:
    """How often the surface is bent by more than each edge, up and down: (2 · edges, 3)."""
    counts = [np.count_nonzero(beyond, axis=(1, 2)) for edge in edges for beyond in (bent > edge, bent < -edge)]
    return np.asarray(angles(bent[0].size)[np.stack(counts)])


def _halved(sums: IntArray) -> IntArray:
    """Sums over 2 × 2 pixels; of an odd row or column at the end, twice itself."""
    padded = np.pad(sums, ((0, 0), (0, sums.shape[1] % 2), (0, sums.shape[2] % 2)), mode="edge")
    return np.asarray(padded[:, ::2, ::2] + padded[:, 1::2, ::2] + padded[:, ::2, 1::2] + padded[:, 1::2, 1::2])
