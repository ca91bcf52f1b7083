"""A readout as arrays: all that the answers for the materials that it holds rest on, but the names and K."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.held_means import HeldMeans
from scroll_tactile.readouts.readout import Numbers, Readout
from scroll_tactile.readouts.system import System
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["readout_from_arrays", "readout_to_arrays"]


def readout_to_arrays(readout: Readout) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a readout.

    reference: places, (R,). held: places in the order of what is held, (H,). rows: their means about the origin,
    and K⁻¹ times these, (H, 2, d). sizes: (H,). origin, precision: (d,). counts: (C,). shape: share and penalty.
    """
    held = readout.held_means
    return {
        "reference": readout.reference,
        "held": np.array(held.places, dtype=np.int64),
        "rows": held.pairs,
        "sizes": held.sizes,
        "origin": readout.origin,
        "precision": readout.precision,
        "counts": readout.counts,
        "shape": np.array([readout.share, readout.penalty]),
    }


def readout_from_arrays(
    scale: Scale, names: Sequence[str], arrays: Mapping[str, npt.NDArray[Any]], statistics: Statistics
) -> Readout:
    """The readout of which `readout_to_arrays` gave the arrays, which are taken over; it can follow nothing."""
    reference, origin, counts, precision = (arrays[name] for name in ("reference", "origin", "counts", "precision"))
    share, penalty = arrays["shape"].tolist()
    numbers = Numbers(reference, origin, counts, share, penalty, precision)
    held = HeldMeans(arrays["held"].tolist(), arrays["rows"], arrays["sizes"])
    return Readout(scale, names, statistics, System.unkept(len(origin)), held, numbers)
