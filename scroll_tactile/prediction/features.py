"""From a touch to its features: quantised where it is observed, averaged where it is predicted."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings import protocol
from scroll_tactile.memory.touch_rows import Codes
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.contact import Rest, image_of, pressed
from scroll_tactile.signals.image import shape_image, stretched, tactile_image
from scroll_tactile.signals.levels import LevelArray, levels_of
from scroll_tactile.signals.stream import Stream, validate
from scroll_tactile.signals.windows import COMPETING, SHAPE, WHOLE, Extent, Scale, WindowPlan
from scroll_tactile.statistics.grid import in_units, to_codes
from scroll_tactile.statistics.sample import stage_rows

__all__ = ["Encoded", "FeatureExtractor", "Readings", "WindowCache"]

Readings = npt.ArrayLike | Iterable[npt.ArrayLike] | Stream
Image = npt.NDArray[np.float32]
Rows = dict[Scale, npt.NDArray[np.floating]]
Features = dict[int, npt.NDArray[np.floating]]  # width of windows → rows of features


@dataclass(frozen=True)
class Encoded:
    """A touch as it is evaluated.

    stream: the whole touch. image: (C, T) in [-1, 1], of as much of it as is judged. means: scale → mean features in
    grid units, (d,). seconds: how much touch is judged. logits: those of f*, by material, where it answers.
    """

    stream: Stream
    image: Image
    means: dict[Scale, npt.NDArray[np.float64]]
    seconds: float
    logits: Mapping[str, float] | None = None

    @property
    def steps(self) -> int:
        """T, the steps of time in the image."""
        return int(self.image.shape[1])

    @cached_property
    def levels(self) -> LevelArray:
        """The levels of the whole touch, (C, T'); MISSING marks each value that was not read (`Stream.mask`)."""
        read, mask = self.stream.readings, self.stream.mask
        return levels_of(read if mask is None else np.where(mask, np.nan, read), self.stream.sensor)


class WindowCache:
    """Features of the windows of a touch in progress, by what they read, so that no window is embedded twice."""

    def __init__(self) -> None:
        self._rows: dict[tuple[int, bytes], npt.NDArray[np.floating]] = {}

    def embedded(self, image: Image, windows: Extent, embed: Callable[[Image, Extent], Features]) -> Features:
        """Width → features (windows, d) of an image (C, T). embed: makes those that are not here."""
        read = {
            width: [(width, image[:, at : at + width].tobytes()) for at in starts] for width, starts in windows.items()
        }
        absent = {
            width: new
            for width, starts in windows.items()
            if (new := [at for at, key in zip(starts, read[width], strict=True) if key not in self._rows])
        }
        if absent:  # of the image, only the steps that these need
            first = min(map(min, absent.values()))
            shifted = {width: [at - first for at in starts] for width, starts in absent.items()}
            for width, rows in embed(np.ascontiguousarray(image[:, first:]), shifted).items():
                self._rows |= zip([key for key in read[width] if key not in self._rows], rows, strict=True)
        return {width: np.stack([self._rows[key] for key in keys]) for width, keys in read.items()}


class FeatureExtractor:
    """Makes features of touches, by a sensor, an embedding and a plan of windows; it learns nothing.

    check: raises EmbeddingMismatchError where an embedding is not the one that made the memory; it is called once.

    Raises InputError for an embedding of frames with a sensor that is no camera, or a resting image of another shape.
    """

    def __init__(
        self, sensor: Sensor, embedding: protocol.Embedding, plan: WindowPlan, check: Callable[..., None] | None = None
    ) -> None:
        self.sensor, self.embedding, self._plan, self.check = sensor, embedding, plan, check
        protocol.require_rest(embedding, sensor)
        self._rest: Rest = protocol.capabilities_of(embedding).rest

    def verified(self) -> FeatureExtractor:
        """This extractor, whose embedding is the memory's. Raises EmbeddingMismatchError."""
        if self.check is not None:
            self.check(self.embedding)
            self.check = None
        return self

    def stream(self, readings: Readings) -> Stream:
        """The validated stream of some readings; of a camera's, the frames in contact.

        Raises StreamError: see `validate` and `pressed`.
        """
        stream = validate(readings, self.sensor)
        return pressed(stream, self._rest) if self.sensor.camera else stream

    def image(self, stream: Stream) -> Image:
        """The tactile image of a `stream`."""
        return image_of(stream, self._rest) if self.sensor.camera else tactile_image(stream)

    def learned(self, stream: Stream) -> tuple[int, Codes]:
        """What a memory learns of a `stream`: its steps, and the `codes` that it adds. Raises as `verified`."""
        image = self.verified().image(stream)
        return image.shape[1], self.codes(image)

    def codes(self, image: Image) -> Codes:
        """The quantised features that a touch adds to the statistics, rows by scale."""
        stages, places = self._plan.scored_stages(image.shape[1]), self._plan.places(image.shape[1])
        features = self.features(image, places=places)
        codes = {scale: to_codes(rows, self.embedding.bound) for scale, rows in features.items()}
        among = {scale: {place: i for i, place in enumerate(chosen)} for scale, chosen in places.items()}
        groups = [
            {scale: [[among[scale][place] for place in group] for group in stage[scale]] for scale in stage}
            for stage in stages
        ]
        return stage_rows(groups, codes)

    def encode(
        self,
        stream: Stream,
        longest: int,
        scales_for: Callable[[int], Sequence[Scale]],
        cache: WindowCache | None = None,
    ) -> Encoded:
        """The features to predict a `stream` by: windows within the longest learned touch, and views of all of it.

        longest: its length in steps. scales_for: steps → the scales to be read. cache: of the touch when shorter.
        """
        within = self._within(stream, longest)
        image = self.image(within)
        whole = image if len(within) == len(stream) else self.image(stream)
        return Encoded(stream, image, self.means(image, scales_for(image.shape[1]), whole, cache), within.seconds)

    def means(
        self, image: Image, scales: Sequence[Scale], whole: Image | None = None, cache: WindowCache | None = None
    ) -> dict[Scale, npt.NDArray[np.float64]]:
        """A touch's mean features in grid units, (d,) by scale. whole: what is viewed, `image` unless given."""
        places = self._plan.places(image.shape[1])
        # Not rounded: the grid is for sums, and would only add its error here.
        return {
            scale: in_units(rows, self.embedding.bound).mean(axis=0)
            for scale, rows in self.features(image, scales, whole, places, cache).items()
        }

    def features(
        self,
        image: Image,
        scales: Sequence[Scale] | None = None,
        whole: Image | None = None,
        places: Mapping[Scale, Sequence[int]] | None = None,
        cache: WindowCache | None = None,
    ) -> Rows:
        """The features of a tactile image, (windows, d) by scale, one row of a view: all, or those of some scales.

        places: the windows of each scale that are embedded; all unless given, though half of the dense ones at the
        beginning are never scored. cache: of the image when it had fewer steps.
        """
        plan, wanted = self._plan, self._plan.scales if scales is None else scales
        extent = plan.extent(image.shape[1])
        windows = {scale.width: extent[scale.width] for scale in wanted if scale.width in extent}
        if places is not None:
            windows = {width: [own[at] for at in places[Scale("window", width)]] for width, own in windows.items()}
        embedded, views, viewed = Features(), Rows(), image if whole is None else whole
        if plan.views and WHOLE in wanted:
            viewed = viewed if viewed.shape[1] == plan.whole else stretched(viewed, plan.whole)
            # A touch of the default length is convolved once for its windows and for itself.
            once = viewed is image and cache is None and plan.whole not in windows
            embedded, views = self._whole(viewed, windows if once else {})
            views[SHAPE] = self._embedded(shape_image(viewed), {plan.whole: [0]})[plan.whole]
            windows = {} if once else windows
        if windows:
            embed = self._embedded if cache is None else partial(cache.embedded, embed=self._embedded)
            embedded = embed(image, windows)
        return {Scale("window", width): rows for width, rows in embedded.items()} | dict(sorted(views.items()))

    def _whole(self, image: Image, windows: Extent) -> tuple[Features, Rows]:
        """The features of windows of a whole touch, and of its views but SHAPE, (1, d) each."""
        width, every = self._plan.whole, {**windows, self._plan.whole: [0]}
        if not self._plan.competes:
            embedded = self._embedded(image, every)
            return embedded, {WHOLE: embedded.pop(width)}
        features, competing = protocol.embed_competing(self.embedding, image, every, width)
        embedded = self._sound(image, features, every)
        self._require(image, competing, (), "all, by competing kernels,")
        return embedded, {WHOLE: embedded.pop(width), COMPETING: competing[None]}

    def _embedded(self, image: Image, windows: Extent) -> Features:
        return self._sound(image, protocol.embed_windows(self.embedding, image, windows), windows)

    def _sound(self, image: Image, embedded: Features, windows: Extent) -> Features:
        """The features of windows. All features that are learned or judged by pass here, and are checked here."""
        for width, features in embedded.items():
            self._require(image, features, (len(windows[width]),), f"windows of {width} steps")
        return embedded

    def _require(self, image: Image, features: npt.NDArray[np.floating], rows: tuple[int, ...], what: str) -> None:
        channels, steps = image.shape
        touch = f"{what} of a touch of {channels} × {steps}"
        protocol.require_features(self.embedding, features, (*rows, self.embedding.dimension), touch)

    def _within(self, stream: Stream, longest: int) -> Stream:
        """The part of a touch that lies within the longest one learned.

        Nothing was learned of what comes later, and the later part of a slide differs: learned from 2 s of BioTac,
        touches of 4 s are right in 93.5 % when they are read to their end.
        """
        frame = self._plan.widths[0] if self.sensor.camera else 1
        before = 1 if isinstance(self._rest, str) else 0  # the resting image is not in the tactile image
        return stream.first((longest // frame + before) / self.sensor.rate)
