"""What a memory predicts, as an ONNX file: from the tactile image to the materials' scores, without this library."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from scroll_tactile.embeddings.protocol import TOGETHER
from scroll_tactile.embeddings.resnet import ResNet, folded
from scroll_tactile.embeddings.runtimes import Graph
from scroll_tactile.embeddings.vision import DEVIATION, MEAN, MOST_COLUMNS, Vision
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

__all__ = ["export_onnx"]

TINY = 1e-12  # below it a vector is taken for zero, as torch's normalize does


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
    graph = Graph()
    scores = _scores(graph, model, _features(graph, embedding, model, (channels, columns), read), read)
    graph.add("Cast", scores, name="scores", to=graph.onnx.TensorProto.FLOAT)
    serialised = graph.model(
        {"image": [channels, columns]},
        {"scores": [len(model.names)]},
        materials=json.dumps(model.names, ensure_ascii=False),
        sensor=learner.sensor.name,
        fingerprint=embedding.fingerprint,
    )
    Path(path).write_bytes(serialised)


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


def _features(graph: Graph, embedding: Vision, model: Model, shape: tuple[int, int], read: int) -> dict[Scale, str]:
    """Scale → the features (windows, d) of the windows that are scored, float32."""
    net = embedding.network().net
    quick, last = folded(net, embedding.stages[-1]), embedding.stages[-1]
    planes = _planes(graph, shape[1], read)
    windows = model.plan.extent(read)
    places = model.plan.places(read)
    whole: list[str] = []
    features = {}
    for scale in _scales(model, read)[1]:
        starts = [windows[scale.width][place] for place in places[scale]]
        width = min(scale.width, read)
        if scale.width >= TOGETHER and read <= MOST_COLUMNS:
            whole = whole or graph.network(quick, planes, last)
            spans = [(start, start + width) for start in starts]
            features[scale] = _pooled(graph, embedding, net, whole, (shape[0], read), spans)
        else:
            cuts = [_slice(graph, planes, start, start + width, axis=3) for start in starts]
            maps = graph.network(quick, graph.add("Concat", *cuts, axis=0), last, name=f"narrow_{scale}")
            features[scale] = _pooled(graph, embedding, net, maps, (shape[0], width), None)
    return features


def _planes(graph: Graph, columns: int, read: int) -> str:
    """The image's first columns as scaled colour planes (1, 3, C, T)."""
    image = "image" if read == columns else _slice(graph, "image", 0, read, axis=1)
    half = graph.add("Mul", graph.add("Add", image, graph.constant(np.float32(1))), graph.constant(np.float32(0.5)))
    mean, deviation = (np.array(planes, np.float32).reshape(1, 3, 1, 1) for planes in (MEAN, DEVIATION))
    return graph.add("Div", graph.add("Sub", half, graph.constant(mean)), graph.constant(deviation))


def _pooled(
    graph: Graph,
    embedding: Vision,
    net: ResNet,
    maps: list[str],
    shape: tuple[int, int],
    spans: list[tuple[int, int]] | None,
) -> str:
    """`pool_windows` of spans of an image of this shape, or of all of each image of a batch where there are none."""
    with torch.inference_mode():
        widths = [stage.shape[-1] for stage in net(torch.zeros(1, 3, *shape), embedding.stages[-1])]
    parts = []
    for stage in embedding.stages:
        if spans is None:
            means = graph.add("ReduceMean", maps[stage], axes=[2, 3], keepdims=0)
        else:
            across, columns = widths[stage], shape[1]
            covered = [
                (first := start * across // columns, max(first + 1, -(-end * across // columns)))
                for start, end in spans
            ]
            cuts = [_slice(graph, maps[stage], first, after, axis=3) for first, after in covered]
            rows = [graph.add("ReduceMean", cut, axes=[2, 3], keepdims=0) for cut in cuts]
            means = graph.add("Concat", *rows, axis=0)
        length = graph.add("ReduceL2", means, axes=[1], keepdims=1)
        parts.append(graph.add("Div", means, graph.add("Max", length, graph.constant(np.float32(TINY)))))
    return graph.add("Min", graph.add("Concat", *parts, axis=1), graph.constant(np.float32(1)))


def _scores(graph: Graph, model: Model, features: dict[Scale, str], columns: int) -> str:
    """Log probabilities (materials,) in double precision: the readouts' scores, weighed as the stage is calibrated.

    A share of them is left for touches that are unlike all others, as in a prediction.
    """
    stage, scales = _scales(model, columns)
    logits = ""
    for scale, weight in zip(scales, model.calibrations[stage].weights, strict=True):
        readout = model.readouts[scale]
        weights, offsets = readout.linear(model.names, model.kind)
        fine = graph.add("Cast", features[scale], to=graph.onnx.TensorProto.DOUBLE)
        units = graph.add("Mul", fine, graph.constant(np.float64(2.0**BITS / Vision.bound)))
        mean = graph.add("ReduceMean", units, axes=[0], keepdims=1)
        about = graph.add("Sub", mean, graph.constant(readout.origin))
        scores = graph.add("Add", graph.add("MatMul", about, graph.constant(weights)), graph.constant(offsets))
        weighed = graph.add("Mul", scores, graph.constant(np.float64(weight)))
        logits = graph.add("Add", logits, weighed) if logits else weighed
    odd = model.moment("complete" if columns >= model.least else "prefix", columns).model_outlier_rate
    familiar = graph.add("Mul", graph.add("Softmax", logits, axis=1), graph.constant(np.float64(1 - odd)))
    chances = graph.add("Add", familiar, graph.constant(np.float64(odd / len(model.names))))
    return graph.add("Squeeze", graph.add("Log", chances), graph.constant(np.array([0])))


def _slice(graph: Graph, what: str, first: int, after: int, *, axis: int) -> str:
    bounds = [graph.constant(np.array([bound])) for bound in (first, after, axis)]
    return graph.add("Slice", what, *bounds)
