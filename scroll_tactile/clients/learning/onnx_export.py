"""What a memory predicts, as an ONNX file: from the tactile image to the materials' scores, without this library."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from scroll_tactile.embeddings.protocol import TOGETHER
from scroll_tactile.embeddings.resnet import folded
from scroll_tactile.embeddings.runtimes import onnx_model
from scroll_tactile.embeddings.vision import MOST_STEPS, Vision, pool_windows, to_planes
from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.libraries import optional
from scroll_tactile.prediction.model import Model
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import validate
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import BITS

with optional("torch", "torch", "an export to ONNX"):
    import torch
    from torch import nn

__all__ = ["export_onnx"]


def export_onnx(learner: TactileLearner, path: str | os.PathLike[str]) -> None:
    """Write what a learner predicts of a touch of its sensor's usual length as an ONNX file.

    Input `image`: the tactile image of the touch (of one frame, for a camera), float32 of shape (C, T), as
    `signals.image.tactile_image` makes it. Output `scores`: float32 of shape (materials,), the logarithms of
    the probabilities that `predict` gives them all. The model's metadata hold `materials`, the names in the order
    of the scores, as JSON, beside `sensor` and `fingerprint`. What is not in the file: novelty, and so "unknown".

    It is what the memory predicts now; observe more, and export again. Two runtimes' networks differ in the last bits,
    which the readouts enlarge: in ONNX Runtime, of 400 real touches, the probabilities lay within 8e-6 of those
    of torch, the scores within 4e-4, and the best material was the same.

    Raises InputError for a memory of another embedding than Vision in float32, for one that holds nothing or a
    material that was never observed for long enough, and where the package onnx is missing.
    """
    embedding = learner.embedding
    if not isinstance(embedding, Vision) or embedding.precision != "float32":
        raise InputError(
            f"only memories of a Vision embedding in float32 can be exported; this one's is {embedding!r}. Observe the "
            "same touches with TactileLearner(embedding=Vision(...))"
        )
    if not learner.materials:
        raise InputError("expected a memory that has observed something; this one is empty, and would have no scores")
    model = learner.model()
    channels, columns = _shape(learner.sensor)
    read = min(columns, model.longest) if not learner.sensor.camera else columns  # no further than was learned
    metadata = {
        "materials": json.dumps(model.names, ensure_ascii=False),
        "sensor": learner.sensor.name,
        "fingerprint": embedding.fingerprint,
    }
    example = torch.zeros(channels, columns)
    scores = _Scores(embedding, model, read)
    Path(path).write_bytes(onnx_model(scores, (example,), "image", ["scores"], metadata=metadata))


def _shape(sensor: Sensor) -> tuple[int, int]:
    """Channels and columns of the image of a touch of the usual length, or of one frame."""
    readings = np.zeros((1 if sensor.camera else sensor.readings, *sensor.shape), np.float32) + sensor.limits[0]
    channels, columns = tactile_image(validate(readings, sensor)).shape
    return channels, columns


def _scales(model: Model, columns: int) -> tuple[int, list[Scale]]:
    """The stage that a touch of so many columns is judged at, and its scales."""
    stage = min(len(model.plan.stages(columns)), len(model.calibrations)) - 1
    scales = list(model.stages[stage])
    for name in model.names:
        if any(name not in model.readouts[scale].places for scale in scales):
            raise InputError(
                f"expected every material to have been observed for the sensor's usual length; {name!r} was "
                "only observed briefly, and would have no score. Observe a longer touch of it first"
            )
    return stage, scales


class _Scores(nn.Module):
    """Log probabilities (materials,) of a tactile image (C, T): the readouts' scores, weighed as they are calibrated.

    A share of them is left for touches that are unlike all others, as in a prediction.
    """

    def __init__(self, embedding: Vision, model: Model, columns: int) -> None:
        super().__init__()
        self.stages, self.columns = embedding.stages, columns
        self.net = folded(embedding.network().net, embedding.stages[-1])
        stage, self.scales = _scales(model, columns)
        windows, places = model.plan.extent(columns), model.plan.places(columns)
        self.starts = {scale: [windows[scale.width][place] for place in places[scale]] for scale in self.scales}
        # As arrays of doubles: the exporter rounds numbers of Python to float32.
        self.readouts = []
        for scale, weight in zip(self.scales, model.calibrations[stage].weights, strict=True):
            slopes, offsets = model.readouts[scale].linear(model.names, model.kind)
            arrays = model.readouts[scale].origin, weight * slopes, weight * offsets
            self.readouts.append([torch.from_numpy(array) for array in arrays])
        self.odd = model.moment("complete" if columns >= model.least else "prefix", columns).model_outlier_rate

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        planes = to_planes(image[None, :, : self.columns])
        whole = [scale for scale in self.scales if scale.width >= TOGETHER and self.columns <= MOST_STEPS]
        maps = self._maps(planes) if whole else []
        logits = torch.zeros(1)
        for scale, (origin, slopes, offsets) in zip(self.scales, self.readouts, strict=True):
            width, starts = min(scale.width, self.columns), self.starts[scale]
            if scale in whole:
                features = pool_windows(maps, self.columns, [(start, width) for start in starts])[0]
            else:
                cuts = torch.cat([planes[..., start : start + width] for start in starts])
                features = pool_windows(self._maps(cuts), width, [(0, width)])[:, 0]
            units = features.clamp(max=1).double() * (2.0**BITS / Vision.bound)
            logits = logits + (units.mean(dim=0) - origin) @ slopes + offsets
        return torch.log(torch.softmax(logits, -1) * (1 - self.odd) + self.odd / len(logits)).float()

    def _maps(self, planes: torch.Tensor) -> list[torch.Tensor]:
        maps = self.net(planes, self.stages[-1])
        return [maps[stage] for stage in self.stages]
