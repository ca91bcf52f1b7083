"""From a stream to its tactile image: channels × time, in [-1, 1], what every embedding reads."""

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.streams import Stream

__all__ = ["tactile_image", "three_planes"]

# A frame is averaged down to this: finer than the contacts that tell materials apart by their relief, and of
# a width comparable with a touch of the other sensors.
_FRAME_ROWS, _FRAME_COLUMNS = 60, 80


def tactile_image(stream: Stream) -> npt.NDArray[np.float32]:
    """Lay a stream out as an image of shape (C, T): float32, C-contiguous, without unit.

    The sensor's range [low, high] is mapped to [-1, 1]. A sensor's n channels are the rows, its T readings
    the columns.

    A camera's frames are scanned as if they slid past: each is reduced by area averaging to at most 60 × 80,
    its columns follow one another on the time axis, frame after frame, and its rows × 3 colours are the
    channels. So C = 180 and T = 80 a frame for a GelSight, and an embedding that reads along time reads
    texture across the frame.
    """
    readings = _scan(stream.readings) if stream.sensor.camera else stream.readings
    low, high = np.float32(stream.sensor.low), np.float32(stream.sensor.high)
    # Low goes first, so that a narrow range far from zero keeps its digits.
    image = np.subtract(readings.T, low, order="C")
    image /= (high - low) / np.float32(2)
    image -= np.float32(1)
    # Rounding may pass 1 by a unit in the last place.
    return np.clip(image, np.float32(-1), np.float32(1), out=image)


def three_planes(image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Repeat a tactile image of shape (C, T) as three equal colour planes, shape (3, C, T), for `vision`.

    Raises InputError if the image has not two axes.
    """
    if image.ndim != 2:
        raise InputError(f"expected a tactile image of shape (C, T); came {image.shape}")
    return np.stack([image, image, image])


def _scan(frames: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Frames of shape (T, height, width, 3) as readings of shape (T · columns, rows · 3)."""
    height, width = frames.shape[1:3]
    rows, columns = min(height, _FRAME_ROWS), min(width, _FRAME_COLUMNS)
    scanned = np.empty((len(frames), columns, rows, 3), dtype=np.float32)
    for at, frame in enumerate(frames):  # one by one: a second of frames in double precision is 180 MB
        scanned[at] = _average(_average(frame, rows).swapaxes(0, 1), columns)
    return scanned.reshape(len(frames) * columns, rows * 3)


def _average(pixels: npt.NDArray[np.floating], size: int) -> npt.NDArray[np.floating]:
    """Average the first axis down to `size` equal areas; a pixel that an edge divides counts in part.

    Plain sums in a fixed order: the result depends on no thread count.
    """
    length = len(pixels)
    if length == size:
        return pixels
    whole, rest = np.divmod(np.arange(size + 1) * length, size)
    share = (rest / size).reshape(-1, *[1] * (pixels.ndim - 1))
    divided = share * pixels[np.minimum(whole, length - 1)]  # of each edge's pixel, the part before the edge
    sums = np.add.reduceat(pixels, whole[:-1], axis=0, dtype=np.float64)
    return (sums - divided[:-1] + divided[1:]) * (size / length)
