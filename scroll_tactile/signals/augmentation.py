"""The paper's four augmentations of a tactile image, each a change in how the touch was made.

The paper (Zandonati et al. 2023) flips tactile images along the data axis, resizes and crops them along time, and
jitters them. Here all four act along time: the slide went the other way, faster or slower, for less long, over a
noisier, drifting sensor. The channels keep their places: a sensor's electrodes do not move.

Each takes an image (C, T) or a batch of images of one width, (…, C, T), and does the same to all of it; noise and drift
are drawn for each image of a batch apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["Augmentation", "Change", "crop", "fit", "flip", "jitter", "resize"]

Image = npt.NDArray[np.float32]

KNOTS = 4  # of the drift: over a touch it turns once or twice, as warming and pressure do


def flip(image: Image) -> Image:
    """The touch made the other way: time reversed, same shape (…, C, T)."""
    return np.ascontiguousarray(image[..., ::-1])


def resize(image: Image, factor: float) -> Image:
    """The touch made slower (factor > 1) or faster: T · factor steps, at least one, by linear interpolation.

    The first and the last step stay.
    """
    steps = image.shape[-1]
    places = np.linspace(0, steps - 1, max(1, round(steps * factor)))
    before = np.minimum(places.astype(np.int64), max(steps - 2, 0))
    part = (places - before).astype(np.float32)
    after = np.minimum(before + 1, steps - 1)
    return np.asarray(image[..., before] * (1 - part) + image[..., after] * part)


def crop(image: Image, start: int, steps: int) -> Image:
    """The touch cut off: `steps` steps from `start` on, shape (…, C, steps)."""
    return np.ascontiguousarray(image[..., start : start + steps])


def jitter(image: Image, noise: npt.NDArray[np.float32], drift: npt.NDArray[np.float32]) -> Image:
    """The touch observed by a noisier, slowly drifting sensor: image + noise + drift, clipped to [-1, 1].

    noise: shape (…, C, T). drift: shape (…, C, K), K values that are spread evenly over the touch with straight lines
    between them. Both in units of the image, half the sensor's range.
    """
    slow = resize(drift.astype(np.float32), image.shape[-1] / drift.shape[-1])
    return np.asarray(np.clip(image + noise.astype(np.float32) + slow, np.float32(-1), np.float32(1)))


def fit(image: Image, steps: int) -> Image:
    """The image's first `steps` steps, 1 or more; a shorter image goes on as its mirror image, back and forth."""
    length = image.shape[-1]
    places = np.arange(steps) % (2 * length)
    return np.ascontiguousarray(image[..., np.minimum(places, 2 * length - 1 - places)])


@dataclass(frozen=True)
class Change:
    """What one augmentation does; `apply` is a function of it and the image.

    flip: whether time is reversed. speed: the factor of `resize`. keep: part of the steps that stays, in (0, 1].
    place: where the rest is cut off, from 0 (all behind) to 1 (all in front). noise: standard deviation of the white
    noise. drift: of the slow offset. seed: of the noise's and the drift's values.
    """

    flip: bool = False
    speed: float = 1.0
    keep: float = 1.0
    place: float = 0.0
    noise: float = 0.0
    drift: float = 0.0
    seed: int = 0

    def apply(self, image: Image, steps: int | None = None) -> Image:
        """The changed image, float32 of shape (…, C, T'), in [-1, 1]; T' = `steps` where that is given.

        `fit` cuts or continues it to that length.
        """
        made = resize(flip(image) if self.flip else image, self.speed)
        kept = max(1, round(made.shape[-1] * self.keep))
        made = crop(made, round((made.shape[-1] - kept) * self.place), kept)
        if steps is not None:
            made = fit(made, steps)
        rng = np.random.default_rng(self.seed)
        slow = rng.standard_normal((*made.shape[:-1], KNOTS), dtype=np.float32) * np.float32(self.drift)
        noise = rng.standard_normal(made.shape, dtype=np.float32) * np.float32(self.noise)
        return jitter(made, noise, slow)


@dataclass(frozen=True)
class Augmentation:
    """How strongly touches are changed.

    flip: the probability of the other direction. speed: (least, most) factor, drawn evenly on a logarithmic scale.
    keep: the least part of the touch that stays. noise, drift: the most, as standard deviations in units of the
    image, half the sensor's range.
    """

    flip: float = 0.5
    speed: tuple[float, float] = (0.8, 1.25)
    keep: float = 0.8
    noise: float = 0.01
    drift: float = 0.02

    def draw(self, rng: np.random.Generator) -> Change:
        """One change of at most these strengths; it takes the same numbers from `rng` whatever they are."""
        turned, speed, kept, place, noise, drift = rng.random(6)
        least, most = self.speed
        return Change(
            flip=bool(turned < self.flip),
            speed=float(least * (most / least) ** speed),
            keep=float(1 - kept * (1 - self.keep)),
            place=float(place),
            noise=float(noise * self.noise),
            drift=float(drift * self.drift),
            seed=int(rng.integers(2**63)),
        )

    def augment(self, image: Image, rng: np.random.Generator, *, steps: int | None = None) -> Image:
        """The image with all four changes, drawn from `rng`; see `Change.apply`."""
        return self.draw(rng).apply(image, steps)
