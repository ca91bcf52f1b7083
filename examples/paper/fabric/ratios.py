"""A Contactile array's touch without how hard it was pressed and which way it was rubbed: ratios of forces."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.sensors import CONTACTILE, Sensor
from scroll_tactile.signals.stream import Stream, validate

__all__ = ["CONTACTILE_RATIOS", "ratios"]

CONTACTILE_RATIOS = Sensor(
    name="contactile-ratios",
    channels=27,
    rate=CONTACTILE.rate,
    low=-1.5,
    high=1.5,
    unit="",
    duration=CONTACTILE.duration,
)
"""The array's pillars as ratios of forces: friction along the way and across it, and ln of the load's changes."""

_AXES = 3
_LEAST_LOAD = 0.02  # of the largest: a pillar that is lifted has no ratio
_STEADY = 0.5  # s over which load and way are averaged


def ratios(stream: Stream) -> Stream:
    """A touch without its force and direction: (T, 27), for each pillar friction along, friction across, and ln load.

    Pressing harder raises all forces of a pillar together, and going another way turns its shear. So each pillar's
    shear is divided by its load N, and turned so that the first of its two parts lies along the shear of all pillars;
    the third is ln N less the logarithm of its mean over half a second around, which is what the relief makes of it.
    Friction is taken as the amount is: a touch to the left is as one to the right.

    stream: of 27 channels as `CONTACTILE` has them, in any range. Raises InputError for another number of channels.
    """
    if stream.sensor.channels != CONTACTILE.channels:
        raise InputError(f"expected a stream of {CONTACTILE.channels} channels; came {stream!r}")
    forces = stream.readings.astype(np.float64).reshape(len(stream), -1, _AXES)
    load = np.abs(forces[..., 2])
    load = np.maximum(load, max(_LEAST_LOAD * float(load.max()), 1e-9))
    span = max(1, round(_STEADY * stream.sensor.rate))
    whole = _around(forces[..., :2].sum(axis=1), span)
    way = whole / np.maximum(np.linalg.norm(whole, axis=1, keepdims=True), 1e-9)
    shear = forces[..., :2] / load[..., None]
    along = (shear * way[:, None]).sum(axis=2)
    across = shear[..., 1] * way[:, None, 0] - shear[..., 0] * way[:, None, 1]
    changes = np.log(load) - np.log(_around(load, span))
    return validate(np.stack([along, across, changes], axis=2).reshape(len(stream), -1), CONTACTILE_RATIOS)


def _around(values: npt.NDArray[np.float64], span: int) -> npt.NDArray[np.float64]:
    """Means over `span` readings around each of T, fewer at the ends, of values (T, n)."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    i = np.arange(len(values))
    first, after = np.maximum(i - span // 2, 0), np.minimum(i + span // 2 + 1, len(values))
    means: npt.NDArray[np.float64] = (total[after] - total[first]) / (after - first)[:, None]
    return means
