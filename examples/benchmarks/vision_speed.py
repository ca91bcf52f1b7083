"""`python -m examples.benchmarks vision`: what the vision embedding costs beside a bare forward pass of its network.

For the images of BioTac and RoboSkin all alternatives take turns in one run; beside each stands how far its features
lie from those of torch in float32. Streams are simulated: their content does not change the cost.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from itertools import cycle
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import torch
import typer
from torch import nn
from torch.nn import functional

from examples.benchmarks.timing import take_turns
from examples.paper.readers.biotac_slide import load
from examples.paper.runs.options import Json, Seed
from examples.paper.runs.results import show, write
from scroll_tactile import sensors
from scroll_tactile.clients.cli.terminal import percent, progress_bar, say
from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.embeddings.runtimes import Precision, Run, RuntimeName, make_runtime, one_torch_thread
from scroll_tactile.embeddings.vision import Vision, to_planes
from scroll_tactile.embeddings.weights import load_network
from scroll_tactile.learner import TactileLearner
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.simulation.scene import Scene

__all__ = ["BareResNet", "run_vision", "vision"]

Record = dict[str, Any]
Note = Callable[[str], None]
Image = npt.NDArray[np.float32]

USUAL, ALL = (1, 2, 3), (0, 1, 2, 3, 4)  # stages: those that Vision has by default, and all
TOUCHES = 3  # of each material, learned before `predict` is timed
YARDSTICK, ONE_THREAD = "bare forward, torch", "bare forward, torch, one thread"


class BareResNet(nn.Module):
    """A network without its classifier, the yardstick: all layers, batch normalisation as trained, a global average."""

    def __init__(self, net: ResNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, planes: torch.Tensor) -> torch.Tensor:
        """(B, 3, H, W) → (B, planes of layer 4, 1, 1)."""
        return functional.adaptive_avg_pool2d(self.net(planes)[-1], 1)


@dataclass(frozen=True)
class _Way:
    """A way to run Vision."""

    runtime: RuntimeName
    precision: Precision
    stages: tuple[int, ...] = USUAL

    @property
    def name(self) -> str:
        """What the table calls it."""
        stages = ", all stages" if self.stages == ALL else ""
        return f"Vision, {self.runtime}, {self.precision}{stages}"

    def make(self, state: dict[str, torch.Tensor]) -> Vision:
        """Make the embedding of these weights."""
        return Vision(state, stages=self.stages, runtime=self.runtime, precision=self.precision)


WAYS = [
    _Way("torch", "float32"),
    _Way("torch", "float32", ALL),  # the same work as the bare pass
    _Way("torch", "bfloat16"),
    _Way("onnxruntime", "float32"),
    _Way("onnxruntime", "float32", ALL),
]


def run_vision(
    *,
    weights: Path | None = None,
    data: Path | None = None,
    seed: int = 0,
    rounds: int = 30,
    note: Note = lambda _: None,
) -> Record:
    """Measure everything; `note` is told what is being done. Returns circumstances and a list of records.

    weights: of a ResNet, a random ResNet-18 where it is None: the cost is the same, the errors are not.
    data: folder of BioTac_slide_20_50, for the accuracy on RoboSkin beside each runtime (a minute for each); or None.
    """
    result = {"bench": "vision", "threads": torch.get_num_threads(), "rounds": rounds}
    net = ResNet.random(seed) if weights is None else load_network(weights)
    state = net.state_dict()
    here = [name for name in ("onnxruntime",) if find_spec(name) and find_spec("onnx")]
    ways = [way for way in WAYS if way.runtime in ("torch", *here)]
    records: list[Record] = []
    for sensor in (sensors.BIOTAC, sensors.ROBOSKIN):
        note(f"{sensor.name}: embeddings beside a bare forward pass")
        records += _one_sensor(sensor, net, [(way.name, way.make(state)) for way in ways], here, seed, rounds)
    usual = [way for way in ways if way.stages == USUAL]
    return result | {
        "runtimes": {name: version(name) for name in here},
        "weights": "random" if weights is None else weights.name,
        "records": records,
        "accuracy": {} if data is None else _accuracies(data, state, usual, note),
    }


def _one_sensor(
    sensor: Sensor, net: ResNet, embeddings: list[tuple[str, Vision]], here: list[str], seed: int, rounds: int
) -> list[Record]:
    scene = Scene(sensor=sensor, seed=seed)
    stream = scene.touch(scene.materials[0], 99)
    image = tactile_image(stream)
    planes = to_planes(torch.from_numpy(image[None]))
    calls = _bare(net, planes, here)
    calls |= {name: _embedding(embedding, image) for name, embedding in embeddings}
    with ExitStack() as stack:
        for name, embedding in embeddings:
            if "all stages" not in name and "bfloat16" not in name:
                calls[f"predict with {name}"] = stack.enter_context(_predicting(scene, embedding))
        timings = take_turns(calls, rounds)
    errors = _errors(embeddings, image)
    return [
        {
            "case": case,
            "image": f"{image.shape[0]} × {image.shape[1]} ({sensor.name})",
            **timing.record(),
            "calls": timing.calls,
            "clock": timing.clock,
            "ratio": timing.median / timings[YARDSTICK].median,
            "ratio_to_one_thread": timing.median / timings[ONE_THREAD].median,
            "relative_error": errors.get(case),
        }
        for case, timing in timings.items()
    ]


def _bare(net: ResNet, planes: torch.Tensor, here: list[str]) -> dict[str, Callable[[], object]]:
    """The networks alone: all their layers, with the image made ready."""
    plain = BareResNet(net).eval()
    made: dict[str, Run] = {}
    if "onnxruntime" in here:
        made["bare session, onnxruntime, one thread"] = make_runtime("onnxruntime", net, 4)

    def forward() -> None:
        with torch.inference_mode():
            plain(planes)

    def forward_on_one() -> None:
        with torch.inference_mode(), one_torch_thread():
            plain(planes)

    ready = planes.numpy()
    return {YARDSTICK: forward, ONE_THREAD: forward_on_one} | {name: _running(run, ready) for name, run in made.items()}


def _running(run: Run, planes: Image) -> Callable[[], object]:
    return lambda: run(planes)


def _embedding(embedding: Vision, image: Image) -> Callable[[], object]:
    return lambda: embedding.embed(image)


@contextmanager
def _predicting(scene: Scene, embedding: Vision) -> Iterator[Callable[[], object]]:
    """A prediction of touches in turn, by a memory on disk."""
    with (
        tempfile.TemporaryDirectory() as folder,
        TactileLearner.open(folder, sensor=scene.sensor, embedding=embedding) as learner,
    ):
        for name in scene.materials:
            for repetition in range(TOUCHES):
                learner.observe(name, scene.touch(name, repetition))
        test = cycle([np.array(scene.touch(name, TOUCHES).readings) for name in scene.materials])
        yield lambda: learner.predict(next(test))


def _accuracies(data: Path, state: dict[str, torch.Tensor], ways: list[_Way], note: Note) -> dict[str, float]:
    """Way → share of RoboSkin's first fold told apart rightly, learned from the other four."""
    recordings = load(data, "roboskin", 0)
    touches = list(zip(recordings.materials, recordings.streams, (recordings.fold == 0).tolist(), strict=True))
    shares = {}
    for way in ways:
        note(f"accuracy of {way.name}")
        learner = TactileLearner(sensor=recordings.sensor, embedding=way.make(state), exemplars=0)
        for material, stream, held_out in touches:
            if not held_out:
                learner.observe(material, stream)
        test = [(material, stream) for material, stream, held_out in touches if held_out]
        right = [learner.predict(stream).material == material for material, stream in test]
        shares[way.name] = sum(right) / len(right)
    return shares


def _errors(embeddings: list[tuple[str, Vision]], image: Image) -> dict[str, float]:
    """‖features − torch's‖ / ‖torch's‖, against torch in float32 at the same stages."""
    truth: dict[tuple[int, ...], npt.NDArray[np.float32]] = {}
    errors = {}
    for name, embedding in embeddings:
        features = embedding.embed(image)
        reference = truth.setdefault(embedding.stages, features)
        errors[name] = float(np.linalg.norm(features - reference) / np.linalg.norm(reference))
    return errors


def vision(
    context: typer.Context,
    weights: Annotated[
        Path | None, typer.Option(help="A .safetensors or .pth file; random weights cost the same.")
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="BioTac_slide_20_50: also the accuracy of each runtime on RoboSkin. Minutes.")
    ] = None,
    seed: Seed = 0,
    quick: Annotated[bool, typer.Option("--quick", help="A few rounds: for a look, not for a report.")] = False,
    json: Json = None,
) -> None:
    """Time the vision embedding beside a bare forward pass of its network, in each runtime that is installed."""
    rounds = 5 if quick else 30
    with progress_bar() as progress:
        result = run_vision(
            weights=weights, data=data, seed=seed, rounds=rounds, note=lambda what: progress(what, 0, 1)
        )
    columns = {"what": "{./case}", "image": "{./image}", "ms, p50": "{./median_milliseconds|.2f}"}
    columns |= {"p99": "{./p99_milliseconds|.2f}", "ratio": "{./ratio|.2f}"}
    columns |= {"to one thread": "{./ratio_to_one_thread|.2f}", "error of features": "{?./relative_error|.1e}"}
    show("vision", columns, result["records"])
    for name, share in result["accuracy"].items():
        say(f"RoboSkin-20, fold 0, {name}: {percent(share)}")
    write(context, result)
