"""From a touch to what is learned of it and asked about it: codes, and mean features."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import cast

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.protocol import (
    Embedding,
    NoiseEmbedding,
    capabilities_of,
    embed_windows,
    require_rest,
)
from scroll_tactile.errors import EmbeddingError
from scroll_tactile.memory.rows import Codes
from scroll_tactile.prediction.filling import sampled_readings
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.contact import Rest, image_of, pressed
from scroll_tactile.signals.copies import Augmented
from scroll_tactile.signals.stream import Stream, validate
from scroll_tactile.signals.windows import BEGINNING, CHANNELS, NOISE, Scale, WindowPlan
from scroll_tactile.statistics.grid import in_units, to_codes

__all__ = ["Perception", "Readings"]

Readings = npt.ArrayLike | Iterable[npt.ArrayLike] | Stream
Image = npt.NDArray[np.float32]


class Perception:
    """What a learner's sensor, embedding, windows and augmentation make of touches; it learns nothing.

    Raises InputError for an embedding of frames with a sensor that is no camera, or a resting image that is not its.
    """

    def __init__(
        self, sensor: Sensor, embedding: Embedding, reading: WindowPlan, augmentation: Augmented | None
    ) -> None:
        self._sensor = sensor
        self._embedding = embedding
        self._reading = reading
        self._augmentation = augmentation
        require_rest(embedding, sensor)
        self._rest: Rest = capabilities_of(embedding).rest

    def felt(self, readings: Readings) -> Stream:
        """What is read of readings: a sound stream; of a camera's, the frames in contact.

        Raises StreamError: see `validate` and `pressed`.
        """
        return pressed(validate(readings, self._sensor), self._rest)

    def image(self, felt: Stream) -> Image:
        """The tactile image of what was `felt`."""
        return image_of(felt, self._rest)

    def codes(self, image: Image, key: bytes) -> Codes:
        """The codes of a touch's windows by scale, behind them those of its copies; and those of its noisy copies.

        The touch's own come first: the pool finds them by their place. Copies are no longer than the touch, and so
        have no scale that it has not.
        """
        copies, noisy = self._augmentation.copies_of(image, key) if self._augmentation is not None else ([], [])
        own, *others = [self.features(one) for one in (image, *copies, *noisy * (not self._reading.noisy))]
        read = {scale: [rows, *(one[scale] for one in others if scale in one)] for scale, rows in own.items()}
        if self._reading.noisy and noisy:
            read |= {scale: [rows] for scale, rows in zip(NOISE, self._noisy_features(noisy), strict=True)}
        if self._reading.filled:
            read[CHANNELS] = [sampled_readings(image, self._embedding.dimension)]
        return {scale: to_codes(np.concatenate(rows), self._embedding.bound) for scale, rows in sorted(read.items())}

    def means(self, image: Image, scales: Sequence[Scale]) -> dict[Scale, npt.NDArray[np.float64]]:
        """A touch's mean features in the codes' unit, (d,) by scale."""
        places = self._reading.places(image.shape[1])
        # Not rounded: the grid is for sums, and would only add its error to what is asked about.
        return {
            scale: in_units(rows[places[scale]], self._embedding.bound).mean(axis=0)
            for scale, rows in self.features(image, scales).items()
        }

    def features(self, image: Image, scales: Sequence[Scale] | None = None) -> dict[Scale, npt.NDArray[np.floating]]:
        """The features of a tactile image's windows, (windows, d) by scale: all, or those of some scales."""
        windows = self._reading.extent(image.shape[1])
        narrowest = self._reading.widths[0]
        if scales is not None:
            wanted = {scale.width for scale in scales}
            windows = {width: windows[width] for width in windows if width in wanted}
        embedded = embed_windows(self._embedding, image, windows)
        for width, features in embedded.items():
            expected = (len(windows[width]), self._embedding.dimension)
            if features.shape != expected:
                raise EmbeddingError(
                    f"expected features of shape {expected} from {self._embedding.name!r}; came {features.shape}"
                )
        read = {Scale("window", width): features for width, features in embedded.items()}
        if self._reading.beginning and narrowest in embedded:
            read = {BEGINNING: embedded[narrowest][:1], **read}
        return read

    def as_far_as(self, felt: Stream, longest: int) -> Stream:
        """The part of a touch that lies within the longest one learned, of so many columns.

        What comes later was never felt of any material, and the later part of a slide differs: learned from 2 s of
        BioTac, touches of 4 s are told apart in 93.5 % when all of them is read.
        """
        frame = self._reading.widths[0] if self._sensor.camera else 1
        before = 1 if isinstance(self._rest, str) else 0  # the resting image is no column
        return felt.first((longest // frame + before) / self._sensor.rate)

    def is_noisy(self, image: Image) -> bool:
        """Whether a touch was felt through noise, by an embedding that tells; a function of the touch alone."""
        return self._reading.noisy and cast(NoiseEmbedding, self._embedding).is_noisy(image)

    def noisy_means(self, image: Image) -> dict[Scale, npt.NDArray[np.float64]]:
        """The features of a touch felt through noise, in the codes' unit, (d,) by scale."""
        sets = self._noisy_features([image])
        return {scale: in_units(rows[0], self._embedding.bound) for scale, rows in zip(NOISE, sets, strict=True)}

    def _noisy_features(self, images: Sequence[Image]) -> npt.NDArray[np.floating]:
        return cast(NoiseEmbedding, self._embedding).embed_noisy(images)
