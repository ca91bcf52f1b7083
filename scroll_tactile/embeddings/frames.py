"""The embedding for cameras: of each frame its light and its surface, or what a trained network sees of that."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from functools import cached_property

import numpy as np
import numpy.typing as npt
import torch
from torch.nn import functional

from scroll_tactile.embeddings.banks import LEVELS, to_levels
from scroll_tactile.embeddings.protocol import Capabilities, canary
from scroll_tactile.embeddings.runtimes import RuntimeName, make_runtime, steady, version_of
from scroll_tactile.embeddings.surfaces import COLOURS, LIGHT, SURFACE, light, surface
from scroll_tactile.embeddings.vision import to_planes
from scroll_tactile.embeddings.weights import load_network
from scroll_tactile.errors import InputError
from scroll_tactile.signals.contact import Rest

__all__ = ["Frames"]

FloatArray = npt.NDArray[np.float32]

STAGES = (1, 2, 3)  # of the network
# Columns of a frame in the standard deviation of the blur that is taken off before the network sees it.
SMOOTH = 20
GAIN = 4.0  # relief is faint: a few levels of 255
BLURRED = 3  # standard deviations that the blur reaches
REACH = 1.2  # between two frames' counts, at which cosines tell them apart: about the usual distance
STEPS = 2**12  # of a cosine


class Frames:
    """What a camera behind a gel sees, frame by frame: its light, beside the relief of what is pressed into it.

    rest: the gel at rest, from which frames are told to be in contact, and whose picture is taken off them: "first",
        the first frame of every stream; one picture for all, an array (height, width, 3) in the sensor's unit; or None:
        every frame counts, and is read as it is.
    weights: of a trained ResNet, as for `Vision`. The relief is read by its stages 1 to 3, each one's mean and standard
        deviation over the frame scaled to length 1: 1040 features, and `Vision`'s promise: the same bytes on one
        machine. Without: by counts of slopes and bumps (see `embeddings.surfaces`), 1164 features, the same bytes on
        any machine.

    cosines: where not 0, so many random Fourier features (Rahimi and Recht 2007) of the counts, without the light, take
        the place of all: attributes of objects never touched are told better by them, objects that were touched worse.
        seed: of the cosines. They are rounded, so that another machine's last bits rarely matter.
    runtime: of the network, as for `Vision`.

    The network is shown the relief alone: less its blur, and four times as strong.

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
        runtime: RuntimeName = "torch",
    ) -> None:
        whole = all(isinstance(one, int) and not isinstance(one, bool) and one >= 0 for one in (cosines, seed))
        if not whole or (cosines and weights is not None):
            raise InputError(
                "expected cosines and a seed as whole numbers of 0 or more, and no weights beside cosines; came "
                f"{cosines!r} and {seed!r}" + (" with weights" if weights is not None else "")
            )
        if weights is None and runtime != "torch":
            raise InputError(f"expected a runtime with weights, which it is to run; came {runtime!r} without")
        self.rest: Rest = _checked(rest)
        self.capabilities = Capabilities(reads_frames=True, rest=self.rest)
        self.cosines = cosines
        self.seed = seed
        self.runtime: RuntimeName = runtime
        self._net = None if weights is None else load_network(weights)
        self._source = "weights" if isinstance(weights, Mapping) else repr(weights and os.fspath(weights))
        self.dimension = cosines or LIGHT + SURFACE
        if self._net is not None:
            self._net.requires_grad_(False)
            self._run = make_runtime(runtime, self._net, STAGES[-1])
            self.dimension = LIGHT + 2 * sum(self._net.widths[stage] for stage in STAGES)

    def __repr__(self) -> str:
        rest = "<picture>" if isinstance(self.rest, np.ndarray) else repr(self.rest)
        waves = f", cosines={self.cosines}, seed={self.seed}" if self.cosines else ""
        return f"Frames({self._source}, rest={rest}{waves})"

    @cached_property
    def fingerprint(self) -> str:
        """A hash of the resting image, the network and its runtime, and of the features of three fixed images."""
        digest = hashlib.sha256(f"frames 1 {LEVELS} {SMOOTH} {GAIN} {STAGES} {self.cosines} {self.seed}".encode())
        digest.update(self.rest.tobytes() if isinstance(self.rest, np.ndarray) else repr(self.rest).encode())
        if self._net is not None:
            digest.update(f"{self._net.depth} {self._net.stem} {self.runtime} {version_of(self.runtime)}".encode())
            for name, tensor in sorted(self._net.state_dict().items()):
                digest.update(f"\n{name} {tuple(tensor.shape)}".encode())
                digest.update(tensor.contiguous().numpy().tobytes())
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
        rng = np.random.default_rng([self.seed, self.cosines])
        weights = rng.standard_normal((self.cosines, SURFACE)) / REACH
        return torch.from_numpy(weights), torch.from_numpy(rng.uniform(0, 2 * np.pi, self.cosines))

    def _waved(self, counts: FloatArray) -> FloatArray:
        """Cosines of counts, rounded so coarsely that a machine's own last bits rarely matter."""
        weights, phases = self._waves
        with steady():
            waves = torch.cos(weights @ torch.from_numpy(counts).double() + phases)
            told: FloatArray = (torch.round(waves * STEPS) / STEPS).float().numpy()
            return told

    def _seen(self, planes: npt.NDArray[np.float32]) -> FloatArray:
        """What the network sees of the relief: of each stage the mean and the spread of its maps, of length 1 each."""
        with steady():
            shown = torch.tensor(planes[None], dtype=torch.float32)
            shown = (GAIN * (shown - _blurred(shown, max(1, planes.shape[2] // SMOOTH)))).clamp(-1, 1)
            maps = self._run(to_planes(shown).numpy())
            parts = []
            for stage in STAGES:
                found = torch.from_numpy(maps[stage])[0].flatten(1)
                parts += [found.mean(dim=1), found.std(dim=1, correction=0)]
            told = torch.cat([functional.normalize(part, dim=0) for part in parts])
            # Rounding may pass 1 by a unit in the last place.
            features: FloatArray = np.minimum(told.numpy(), np.float32(1))
            return features


def _blurred(planes: torch.Tensor, deviation: int) -> torch.Tensor:
    """Planes (1, 3, H, W) less what is finer than a Gaussian; beyond its edges a plane goes on as at them."""
    reach = BLURRED * deviation
    taps = torch.exp(-torch.arange(-reach, reach + 1).square() / (2 * deviation**2))
    taps = (taps / taps.sum()).expand(COLOURS, 1, 1, -1)
    wide = functional.pad(planes, (reach,) * 4, mode="replicate")
    return functional.conv2d(functional.conv2d(wide, taps, groups=COLOURS), taps.transpose(2, 3), groups=COLOURS)


def _checked(rest: Rest | npt.ArrayLike) -> Rest:
    if rest is None:
        return None
    if isinstance(rest, str) and rest == "first":
        return "first"
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
