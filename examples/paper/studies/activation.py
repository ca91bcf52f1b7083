"""`activation`: what the first block of a network looks for, fine-tuned on each sensor, and how alike it is.

The paper's last figure shows, for the pre-trained network and for those fine-tuned on each sensor, images that excite
each unit of the first block most (activation maximisation: Erhan et al. 2009, Univ. Montréal TR 1341), and leaves it at
looks. Beside the images there are figures here: whether the filters still point where they did, whether two
sensors moved them the same way, and whether two networks' first blocks say the same of the same touches.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import torch
import typer

from examples.paper.runs.cells import Cell, Figures
from examples.paper.runs.options import (
    QUICK_EPOCHS,
    Data,
    Device,
    Epochs,
    InPrecision,
    Json,
    Plot,
    Quick,
    Run,
    Seed,
    Weights,
    read,
)
from examples.paper.runs.pictures import draw_into, picture
from examples.paper.runs.results import show
from examples.paper.runs.study import SystemStudy, close
from examples.paper.systems.networks import ResNetClassifier
from examples.paper.systems.trained import TrainedNetwork
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.embeddings.weights import load_network
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.signals.image import tactile_image

__all__ = [
    "CONTROL",
    "START",
    "ActivationStudy",
    "Similarity",
    "activation",
    "cka",
    "compare",
    "first_block",
    "maximise",
]

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
            planes = torch.from_numpy(np.stack([image] * 3))[None]
            rows.append(first_block(net, planes)[0].flatten(1).T.numpy())
    return np.concatenate(rows)


START, CONTROL = "pre-trained", "random weights"
SYSTEM = "resnet-pretrained"
COMPARED = 10  # touches of each set on which first blocks are compared


@dataclass(frozen=True)
class ActivationStudy(SystemStudy):
    """Fine-tune on each set, all folds but those asked for; then `looks` and `likeness` of what came of it.

    tuned: set → the first layers of the network that was fine-tuned on it; they are kept beside the run's notes, too,
    so that a killed run resumes.

    Raises InputError where no weights are given: there would be nothing to be fine-tuned.
    """

    name = "activation"
    tuned: dict[str, dict[str, npt.NDArray[Any]]] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.systems != (SYSTEM,):
            raise InputError(f"expected the one system {SYSTEM}; came {', '.join(self.systems)}")
        if any(recordings.sensor.camera for recordings in self.sets):
            raise InputError("expected sets of streams: a camera's frames are not compared with tactile images")
        super().__post_init__()

    def _file(self, dataset: str) -> Path | None:
        return None if self.folder is None else self.folder / f"activation {dataset}.npz"

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        part = self._split(cell)
        system = self._system(cell)
        assert isinstance(system, TrainedNetwork)
        system.fit(part.streams, part.materials, part.validation, self.seed, progress)
        network = system.network
        assert isinstance(network, ResNetClassifier)
        self._keep(cell.dataset, {name: tensor.cpu().numpy() for name, tensor in network.net.state_dict().items()})
        predicted = system.predict(part.test_streams)
        right = sum(true == guess for true, guess in zip(part.truth, predicted, strict=True))
        return {"right": right, "tested": len(predicted)}

    def _keep(self, dataset: str, tensors: Mapping[str, npt.NDArray[Any]]) -> None:
        first: dict[str, Any] = {
            name: tensor for name, tensor in tensors.items() if name.startswith(("conv1.", "bn1.", "layer1."))
        }
        self.tuned[dataset] = first
        if (file := self._file(dataset)) is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            draft = file.with_name("draft.npz")
            np.savez(draft, **first)
            draft.replace(file)

    def networks(self) -> dict[str, ResNet]:
        """The pre-trained network, those fine-tuned on each set, and the control, by name; after `run` has ended.

        Of the fine-tuned ones only what leads to the first block differs from the pre-trained.

        Raises InputError where the first layers of a set that was finished before are no longer there.
        """
        assert self.weights is not None
        found = {START: load_network(self.weights)}
        for recordings in self.sets:
            net = load_network(self.weights)
            net.load_state_dict(self._first_layers(recordings.name), strict=False)
            found[f"fine-tuned on {recordings.name}"] = net
        return found | {CONTROL: ResNet.random(self.seed, found[START].stem)}

    def _first_layers(self, dataset: str) -> dict[str, torch.Tensor]:
        if dataset not in self.tuned:
            file = self._file(dataset)
            try:
                assert file is not None
                with np.load(file, allow_pickle=False) as kept:
                    self.tuned[dataset] = {name: kept[name] for name in kept.files}
            except (OSError, ValueError) as error:
                raise InputError(
                    f"the notes of the run say that {dataset} is finished, and its first layers cannot be read from "
                    f"{file} ({error}): take another folder"
                ) from error
        return {name: torch.from_numpy(np.array(tensor)) for name, tensor in self.tuned[dataset].items()}

    def looks(self, networks: Mapping[str, ResNet], progress: Progress) -> dict[str, npt.NDArray[np.floating]]:
        """For each network the images of `maximise`, from the same noise."""
        steps, size = (STEPS // 3, SIZE // 2) if self.quick else (STEPS, SIZE)
        return {
            name: maximise(
                net, seed=self.seed, steps=steps, size=size, report=partial(progress, f"what excites: {name}")
            )
            for name, net in networks.items()
        }

    def likeness(self, networks: Mapping[str, ResNet]) -> list[dict[str, Any]]:
        """`compare` of every two networks, on the same number of touches of each set."""
        random = np.random.default_rng(self.seed)
        images = [
            tactile_image(recordings.streams[i])
            for recordings in self.sets
            for i in random.choice(len(recordings), min(COMPARED, len(recordings)), replace=False)
        ]
        return [asdict(pair) for pair in compare(networks, images, start=START)]


def activation(
    context: typer.Context,
    data: Data,
    weights: Weights = None,
    sets: Annotated[str, typer.Option(help="Which data sets.")] = "biotac-20,roboskin-20",
    epochs: Epochs = None,
    device: Device = "cpu",
    precision: InPrecision = "float32",
    seed: Seed = 0,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
    plot: Plot = None,
) -> None:
    """Feature activation: what excites the first block, pre-trained and fine-tuned on each sensor; and how alike it is.

    The paper shows the images only. Here each two networks are compared: by the cosine of their stem's filters, by
    whether two sensors moved them the same way, and by what their first blocks make of the same touches (CKA).
    """
    if weights is None:
        raise InputError("expected --weights: without a trained ResNet there is nothing to be fine-tuned")
    with progress_bar() as progress:
        progress("reading", 0, 1)
        found = [*read("--sets", sets, data, seed, quick=quick).values()]
        few = epochs or (QUICK_EPOCHS if quick else 20)
        study = ActivationStudy(found, (SYSTEM,), weights, few, device, seed, quick, run, precision)
        results = list(study.run({item.name: [0] for item in found}, progress))
        networks = study.networks()
        likeness = study.likeness(networks)
        images = {} if plot is None else study.looks(networks, progress)
    columns = {"of": "{./one}", "and": "{./two}", "filters": "{./filters|.3f}"}
    show("alike", columns | {"moved the same way": "{./moved|.3f}", "first blocks (CKA)": "{./blocks|.3f}"}, likeness)
    close(context, study, results, {"likeness": likeness})
    draw_into(plot, lambda file: draw_activation(file, images))


def draw_activation(path: Path, images: Mapping[str, FloatArray]) -> None:
    """Draw what each network's first block looks for, by network, side by side; a unit has the same place in all.

    images: of `maximise`, each of shape (units, 3, size, size), any range.
    """
    with picture(path, 6 * len(images), 6.4, dots=72) as figure:
        panels = np.atleast_1d(figure.subplots(1, len(images)))
        for panel, (name, units) in zip(panels, images.items(), strict=True):
            panel.imshow(_sheet(units), interpolation="nearest")
            panel.set_title(name)
            panel.set_axis_off()


def _sheet(images: FloatArray, across: int = 8, gap: int = 2) -> FloatArray:
    """Images as one, in lines of eight: shape (height, width, 3), in [0, 1], two standard deviations either way."""
    count, planes, size, _ = images.shape
    step = size + gap
    sheet = np.ones((-(-count // across) * step - gap, min(count, across) * step - gap, planes))
    for i, image in enumerate(images):
        top, left = i // across * step, i % across * step
        shown = np.clip((image - image.mean()) / (4 * image.std() + 1e-12) + 0.5, 0, 1)
        sheet[top : top + size, left : left + size] = shown.transpose(1, 2, 0)
    return sheet
