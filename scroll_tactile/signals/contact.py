"""Which of a camera's frames count: those in which the gel is pressed, and so looks unlike the gel at rest.

The resting image is the first frame of every stream, or one image for all streams; or there is none, and every frame
counts. An embedding that reads frames declares which, by `Capabilities.rest`. A frame is in contact where enough of it
is brighter or darker than at rest, in any colour. That depends on the stream alone, so the memory stays a function of
its streams.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import NoContactError
from scroll_tactile.signals.image import scaled_down, tactile_image
from scroll_tactile.signals.stream import Stream

__all__ = ["Rest", "image_of", "in_contact", "pressed"]

Rest = Literal["first"] | npt.NDArray[np.float32] | None

# Of the range. The camera's noise, averaged over the cells of `_CELLS`, is below 1 % of it, the slow drift of its lamps
# about that; of 1892 frames of GelSight in contact every one passes, against the median of them all.
DIFFERENCE = 0.02
AREA = 0.01  # of the frame, that has to differ
_CELLS = (60, 80)  # at most, rows and columns that a frame is averaged to before it is compared
MOST_FRAMES = 64  # in contact that are kept of a stream, evenly spread


def in_contact(stream: Stream, rest: Rest) -> npt.NDArray[np.bool_]:
    """Whether each frame is in contact, shape (T,); without a resting image all are.

    A frame is averaged to at most 60 × 80 cells; in contact, 1 % of them or more differ from the rest by 2 % of the
    range or more in some colour.
    """
    frames = stream.readings
    if rest is None:
        return np.ones(len(frames), dtype=bool)
    still = frames[0] if isinstance(rest, str) else rest
    gap = np.abs(scaled_down(frames, *_CELLS) - scaled_down(still[None], *_CELLS)).max(axis=3)
    low, high = stream.sensor.limits
    differing = np.count_nonzero(gap >= np.float32(DIFFERENCE) * (high - low), axis=(1, 2))
    return np.asarray(differing >= max(1.0, AREA * gap[0].size))


def pressed(stream: Stream, rest: Rest) -> Stream:
    """The stream of the frames in contact, at most 64, behind the first frame where that is the resting image.

    It changes nothing in a stream that it returned.

    Raises NoContactError where there are none.
    """
    if rest is None or not stream.sensor.camera:
        return stream
    touching = np.flatnonzero(in_contact(stream, rest))
    if not len(touching):
        still = "the first of them" if isinstance(rest, str) else "the one given"
        raise NoContactError(
            f"expected frames of sensor {stream.sensor.name!r} in contact; of {len(stream)} none differs from the "
            f"resting image, {still}, by {DIFFERENCE:.0%} of the range on {AREA:.0%} of its area. Press the gel, begin "
            "the stream before it is pressed, or take Frames(rest=None), to which every frame counts"
        )
    if len(touching) > MOST_FRAMES:
        touching = touching[np.linspace(0, len(touching) - 1, MOST_FRAMES).round().astype(np.intp)]
    kept = np.concatenate([[0], touching]) if isinstance(rest, str) else touching
    if len(kept) == len(stream):
        return stream
    readings = stream.readings[kept]
    readings.setflags(write=False)
    mask = None if stream.mask is None else stream.mask[kept]
    return Stream(stream.sensor, readings, min(stream.clipped, readings.size), mask)


def image_of(stream: Stream, rest: Rest) -> npt.NDArray[np.float32]:
    """The tactile image of a `pressed` stream: of its frames' difference from the resting image, where there is one."""
    if rest is None or not stream.sensor.camera:
        return tactile_image(stream)
    if isinstance(rest, str):
        return tactile_image(Stream(stream.sensor, stream.readings[1:]), stream.readings[0])
    return tactile_image(stream, rest)
