"""The result of a fine-tune: the tuned model as arrays, and the report that says whether it is used."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.statistics.fields import Must, Name

__all__ = ["TuneMode", "TuneReport", "Tuned"]

TuneMode = Literal["head", "adapters", "network"]
"""What is trained: the readout's weights alone, residual adapters too, or the whole network too."""


@dataclass(frozen=True)
class TuneReport:
    """The report of a fine-tune.

    kept: whether `predict(tuned=True)` answers with it; f answers where it did worse on exemplars held out.
    reason: why. mode: what was trained. exemplars: trained on. epochs: chosen on exemplars held out.
    held_out: "f" and "f*" → {"loss": mean log loss, "wrong": share of wrong answers} on them; empty without any.
    seconds: that it took. digest: hex of the SHA-256 of the tuned model's weights.
    """

    kept: bool
    reason: str
    mode: TuneMode
    exemplars: int
    epochs: int
    held_out: dict[str, dict[str, float]]
    seconds: float
    digest: str


@dataclass(frozen=True, eq=False)
class Tuned:
    """The tuned model: a linear head over mean features of each scale, and the network's tensors that were trained.

    names: the materials it tells apart, C of them. heads: width of windows → float64 (d, C), of features as shares of
    the embedding's bound. bias: (C,). network: tensor name → float32, to be put over the embedding's own; empty
    where only the head was trained. mode: see TuneMode. kept: whether it answers. report: of how it
    was made, without what differs between two runs that give the same bytes.
    """

    names: Annotated[list[Name], Must("", "C")]
    heads: Annotated[dict[int, npt.NDArray[np.float64]], Must("float64", "d C")]
    bias: Annotated[npt.NDArray[np.float64], Must("float64", "C")]
    network: Annotated[dict[str, npt.NDArray[np.float32]], Must("float32", "...")]
    mode: TuneMode
    kept: bool
    report: dict[str, Any] = field(default_factory=dict)

    def digest(self) -> str:
        """Hex of a SHA-256 over the materials and all weights: equal if and only if these are, byte for byte."""
        digest = hashlib.sha256(repr((self.mode, self.names, sorted(self.heads), sorted(self.network))).encode())
        for _, head in sorted(self.heads.items()):
            digest.update(head.astype("<f8").tobytes())
        digest.update(self.bias.astype("<f8").tobytes())
        for _, tensor in sorted(self.network.items()):
            digest.update(repr(tensor.shape).encode() + tensor.astype("<f4").tobytes())
        return digest.hexdigest()
