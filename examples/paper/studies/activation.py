"""What the first block of a network looks for, and how alike it is in two networks.

The paper's last figure shows, for the pre-trained network and for those fine-tuned on each sensor, images that excite
each unit of the first block most (activation maximisation: Erhan et al. 2009, Univ. Montréal TR 1341), and leaves it at
looks. Beside the images there are figures here: whether the filters still point where they did, whether two
sensors moved them the same way, and whether two networks' first blocks say the same of the same touches.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.errors import InputError
from scroll_tactile.signals.image import three_planes

__all__ = ["Similarity", "cka", "compare", "first_block", "maximise"]

FloatArray = npt.NDArray[np.floating]

SIZE = 48  # pixels: the first block of a ResNet-18 sees 43
STEPS = 60
STRIDE = 0.5  # of a step, in standard deviations of the image
CALM = 0.02  # share of an image's roughness that a step takes away


def first_block(net: ResNet, planes: torch.Tensor) -> torch.Tensor:
    """The map of the first residual block, shape (B, units, rows, columns), of images (B, 3, H, W)."""
    maps = torch.relu(net.bn1(net.conv1(planes)))
    if net.stem == "torchvision":
        maps = torch.nn.functional.max_pool2d(maps, 3, 2, 1)
    block: torch.Tensor = net.get_submodule("layer1")[0](maps)  # type: ignore[index]
    return block


def maximise(
    net: ResNet,
    *,
    seed: int = 0,
    steps: int = STEPS,
    size: int = SIZE,
    report: Callable[[int, int], object] = lambda done, of: None,
) -> FloatArray:
    """For each unit of the first block the image that excites it most, float32 of shape (units, 3, size, size).

    Gradient ascent on the unit's mean activation, from noise drawn from the seed. After each step the image is
    smoothed a little and brought back to mean 0 and standard deviation 1: contrast alone excites every unit.

    Raises InputError for a size that the block does not fit in, or no steps.
    """
    if size < 16 or steps < 1:
        raise InputError(f"expected images of 16 pixels or more and a step or more; came {size} and {steps}")
    units = net.widths[1]
    rng = np.random.default_rng(seed)
    images = torch.from_numpy(rng.standard_normal((units, 3, size, size), dtype=np.float32))
    own = torch.arange(units)
    for step in range(steps):
        images.requires_grad_(True)
        excited = first_block(net, images).mean(dim=(2, 3))[own, own].sum()
        (slope,) = torch.autograd.grad(excited, images)
        with torch.no_grad():
            # Dead units have no slope: their image stays smoothed noise.
            images = images + STRIDE * slope / slope.square().mean(dim=(1, 2, 3), keepdim=True).sqrt().clamp_min(1e-12)
            images = _standardised(images + CALM * _roughness(images))
        report(step + 1, steps)
    found: FloatArray = images.numpy()
    return found


def _roughness(images: torch.Tensor) -> torch.Tensor:
    """The discrete Laplacian, with edges continued."""
    padded = torch.nn.functional.pad(images, (1, 1, 1, 1), mode="replicate")
    around = padded[..., 1:-1, :-2] + padded[..., 1:-1, 2:] + padded[..., :-2, 1:-1] + padded[..., 2:, 1:-1]
    return around - 4 * images


def _standardised(images: torch.Tensor) -> torch.Tensor:
    centred = images - images.mean(dim=(1, 2, 3), keepdim=True)
    return centred / centred.square().mean(dim=(1, 2, 3), keepdim=True).sqrt().clamp_min(1e-12)


def cka(one: FloatArray, two: FloatArray) -> float:
    """Linear centred kernel alignment of two sets of features of the same N rows (Kornblith et al. 2019, 1905.00414).

    |Yᵀ X|² / (|Xᵀ X| |Yᵀ Y|) of centred X of shape (N, p) and Y of shape (N, q): 1 where one is the other turned and
    scaled, near 0 where they have nothing in common. NaN where one of them is constant.

    Raises InputError for other numbers of rows, or fewer than 2.
    """
    if len(one) != len(two) or len(one) < 2:
        raise InputError(f"expected features of the same 2 rows or more; came {len(one)} and {len(two)}")
    x, y = (np.asarray(part, dtype=np.float64) - np.mean(part, axis=0, dtype=np.float64) for part in (one, two))
    of_both = np.square(y.T @ x).sum()
    size = np.linalg.norm(x.T @ x) * np.linalg.norm(y.T @ y)
    return float(of_both / size) if size > 0 else float("nan")


@dataclass(frozen=True)
class Similarity:
    """Of two networks: how alike their filters and their first blocks are.

    filters: mean over the stem's filters of the cosine between the two networks' own, but for filters of zeros.
    moved: cosine between the two ways in which the stem's filters moved from a common start; NaN without one, or where
    one of the two is the start.
    blocks: `cka` of the first blocks' maps of some images, position by position.
    """

    one: str
    two: str
    filters: float
    moved: float
    blocks: float


def compare(
    networks: Mapping[str, ResNet], images: Sequence[npt.NDArray[np.float32]], *, start: str | None = None
) -> list[Similarity]:
    """Compare every two of some networks on some tactile images, each of shape (C, T).

    start: the name of the network that the others were fine-tuned from.

    Raises InputError for fewer than two networks, no images, or a start that is not among them.
    """
    if len(networks) < 2 or not images or (start is not None and start not in networks):
        raise InputError(
            f"expected two networks or more, an image or more and a start among them; came {sorted(networks)}, "
            f"{len(images)} images and {start!r}"
        )
    filters = {name: _filters(net) for name, net in networks.items()}
    maps = {name: _maps(net, images) for name, net in networks.items()}
    found = []
    for one, two in itertools.combinations(networks, 2):
        moved = float("nan")
        if start is not None and start not in (one, two):
            ways = [(filters[name] - filters[start]).reshape(1, -1) for name in (one, two)]
            moved = float(_cosines(*ways)[0])
        cosines = _cosines(filters[one], filters[two])
        pointing = cosines[np.isfinite(cosines)]
        alike = float(pointing.mean()) if len(pointing) else float("nan")
        found.append(Similarity(one, two, alike, moved, cka(maps[one], maps[two])))
    return found


def _filters(net: ResNet) -> FloatArray:
    """The stem's filters, shape (units, 3 · kernel²)."""
    weight: FloatArray = net.conv1.weight.detach().double().numpy()
    return weight.reshape(len(weight), -1)


def _cosines(one: FloatArray, two: FloatArray) -> FloatArray:
    sizes = np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1)
    with np.errstate(invalid="ignore"):
        cosines: FloatArray = (one * two).sum(axis=1) / sizes
    return np.clip(cosines, -1.0, 1.0)  # rounding may pass 1 by a unit in the last place


def _maps(net: ResNet, images: Sequence[npt.NDArray[np.float32]]) -> FloatArray:
    """The first block's maps of images, one row a position: shape (positions of all, units)."""
    rows = []
    with torch.inference_mode():
        for image in images:
            planes = torch.from_numpy(three_planes(image))[None]
            rows.append(first_block(net, planes)[0].flatten(1).T.numpy())
    return np.concatenate(rows)
