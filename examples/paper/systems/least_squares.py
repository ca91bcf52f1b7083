"""Least squares on a frozen network's features: the paper's row, and its control with random weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from examples.benchmarks.solvers.floating import Gram64
from examples.paper.systems.inputs import Image, picture
from examples.paper.systems.system_protocol import Watch, require_touches, silent, unwatched
from scroll_tactile.clients.learning.metrics import Labelled
from scroll_tactile.embeddings.steady import full_float32
from scroll_tactile.embeddings.vision import Vision
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.signals.stream import Stream

__all__ = ["PENALTIES", "LeastSquares", "Ridge", "ridge"]

FloatArray = npt.NDArray[np.float64]

PENALTIES = tuple(10.0**power for power in range(-6, 3))
"""λ, from which the validation chooses: features are of unit length, a few hundred rows."""


@dataclass(frozen=True)
class Ridge:
    """Outputs (x − center)ᵀ weights + offset of features x; center (d,), weights (d, C), offset (C,)."""

    center: FloatArray
    weights: FloatArray
    offset: FloatArray

    def __call__(self, features: FloatArray) -> FloatArray:
        """Outputs (N, C) of features (N, d)."""
        outputs: FloatArray = (features - self.center) @ self.weights + self.offset
        return outputs


def ridge(features: FloatArray, wanted: FloatArray, penalty: float) -> Ridge:
    """W = argmin Σ ‖y − Wᵀ x‖² + λ ‖W‖² of centred features x, (N, d), and targets y, (N, C); λ is the penalty."""
    center, offset = features.mean(axis=0), wanted.mean(axis=0)
    solver = Gram64()  # λ ≥ 1e-6 on unit vectors: exactness is not what this row is about
    solver.start(features.shape[1], wanted.shape[1], penalty)
    solver.update(features - center, wanted - offset)
    return Ridge(center, solver.weights(), offset)


class LeastSquares:
    """Ridge regression on 0/1 targets of a `Vision`'s features of the whole image, one vector a touch.

    A touch is of the material of the largest output of `ridge`. λ is what is right most often on the validation, the
    largest of equals; then all touches are learned.

    vision: frozen, on any stages; its network is copied. Features are kept by stream, for the next fold.
    device: where the network runs. read: from a touch's image to what the network reads, both (…, T).
    """

    def __init__(
        self, name: str, vision: Vision, device: str = "cpu", read: Callable[[Image], Image] = lambda image: image
    ) -> None:
        self.name = name
        self._read = read
        self._net = vision.network().requires_grad_(False).to(device)
        self._device = device
        self._kept: dict[bytes, FloatArray] = {}
        self._names: list[str] = []
        self._solved: Ridge | None = None
        self.penalty = 0.0

    def fit(
        self,
        streams: Sequence[Stream],
        materials: Sequence[str],
        validation: Sequence[Labelled],
        seed: int,
        progress: Progress = silent,
        watch: Watch = unwatched,
    ) -> None:
        """See `System.fit`; nothing is drawn, so the seed is of no effect. λ is 1e-3 where there is no validation."""
        names = require_touches(streams, materials, validation)
        targets = np.array([names.index(name) for name in materials])
        features = self.features(streams, progress)
        held = self.features([stream for _, stream in validation], progress)
        held_targets = np.array([names.index(name) for name, _ in validation], dtype=np.int64)
        self._names, self.penalty = names, 1e-3
        wanted, classes = np.eye(len(names))[targets], np.eye(len(names))[held_targets]
        if len(held):
            right = [
                int((ridge(features, wanted, penalty)(held).argmax(axis=1) == held_targets).sum())
                for penalty in PENALTIES
            ]
            self.penalty = max(zip(right, PENALTIES, strict=True))[1]
        self._solved = ridge(np.concatenate([features, held]), np.concatenate([wanted, classes]), self.penalty)

    def predict(self, streams: Sequence[Stream]) -> list[str]:
        """See `System.predict`."""
        if self._solved is None:
            raise InputError(f"{self.name} has learned nothing yet: call fit first")
        return [self._names[i] for i in self._solved(self.features(streams)).argmax(axis=1)]

    def features(self, streams: Sequence[Stream], progress: Progress = silent) -> FloatArray:
        """One vector for each of N streams, (N, d)."""
        for done, stream in enumerate(streams):
            if stream.key not in self._kept:
                # One at a time: a batch of another size would give other last bits.
                image = torch.from_numpy(self._read(picture(stream)))[None].to(self._device)
                with torch.inference_mode(), full_float32():
                    vector = self._net(image, [(0, image.shape[-1])])[0, 0]
                self._kept[stream.key] = vector.double().cpu().numpy()
                progress("embedding", done + 1, len(streams))
        width = sum(self._net.net.widths[stage] for stage in self._net.stages)
        return np.array([self._kept[stream.key] for stream in streams]).reshape(-1, width)
