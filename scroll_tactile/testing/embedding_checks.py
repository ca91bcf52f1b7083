"""Whether an embedding keeps its promises."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.protocol import (
    TOGETHER,
    Embedding,
    capabilities_of,
    embed_windows,
    is_embedding,
    require_features,
)
from scroll_tactile.errors import EmbeddingError

__all__ = ["check_embedding"]

Image = npt.NDArray[np.float32]
HASHED = 16  # hex digits: of fewer than 64 bits two would be equal by chance
DECLARED = {  # by which capability
    "embed_windows": "embeds_windows",
    "parts": "composite",
    "network": "tunable",
}


def check_embedding(
    embedding: Embedding, *, channels: Sequence[int] = (19,), columns: Sequence[int] = (9, 30, 75, 400)
) -> list[str]:
    """Try an embedding on images of all these sizes; what was found to hold, in words.

    channels, columns: the sizes of images that it has to read, those of the sensor in use.

    Raises EmbeddingError that names the first promise that does not hold, and on which image.

    >>> from scroll_tactile import Kernels
    >>> check_embedding(Kernels(dimension=64), columns=(9, 30))[0]
    'it says what it is: name, dimension, bound, fingerprint'
    """
    images = [_image(rows, across) for rows in channels for across in columns]
    images += [np.full_like(images[-1], value) for value in (0.0, 1.0, -1.0, 0.3)]
    promises = [
        _describes_itself,
        _declares_what_it_has,
        _features_are_sound,
        _image_is_left_alone,
        _repeats_itself,
        _windows_are_sound,
        _windows_repeat,
        _windows_are_cuts,
        _keeps_its_fingerprint,
    ]
    held = []
    for promise in promises:
        promise(embedding, images)
        held.append(str(promise.__doc__).rstrip("."))
    return held


def _describes_itself(embedding: Embedding, images: list[Image]) -> None:
    """it says what it is: name, dimension, bound, fingerprint."""
    if not is_embedding(embedding):
        raise EmbeddingError(
            f"expected name, dimension, bound, fingerprint and embed(image); {type(embedding).__name__} lacks some"
        )
    if not isinstance(embedding.name, str) or not embedding.name:
        raise EmbeddingError(f"expected a name that messages can use; came {embedding.name!r}")
    if not isinstance(embedding.dimension, int) or embedding.dimension < 1:
        raise _broken(embedding, f"its dimension must be an integer of at least 1; it is {embedding.dimension!r}")
    if not 0 < embedding.bound < float("inf"):
        raise _broken(embedding, f"its bound must be positive and finite; it is {embedding.bound!r}")
    digits = embedding.fingerprint
    if not isinstance(digits, str) or len(digits) < HASHED or set(digits) - set("0123456789abcdef"):
        raise _broken(embedding, f"its fingerprint must be {HASHED} or more lower-case hex digits; it is {digits!r}")


def _declares_what_it_has(embedding: Embedding, images: list[Image]) -> None:
    """its capabilities are those that it has."""
    for member, capability in DECLARED.items():
        has, says = hasattr(embedding, member), vars(capabilities_of(embedding))[capability]
        if says and not has:
            raise _broken(embedding, f"its capabilities say {capability}, and it has no {member}")
        if has and not says and member.startswith("embed_"):  # another's `parts` may be anything
            raise _broken(embedding, f"it has {member}, which nothing calls: declare Capabilities({capability}=True)")


def _features_are_sound(embedding: Embedding, images: list[Image]) -> None:
    """features are real, finite, within the bound and of its dimension, on constant images too."""
    for image in images:
        _require_sound(embedding, embedding.embed(image.copy()), (embedding.dimension,), _described(image))


def _image_is_left_alone(embedding: Embedding, images: list[Image]) -> None:
    """the image is left as it is, and may be read-only."""
    for image in images:
        given = image.copy()
        embedding.embed(given)
        embed_windows(embedding, given, _windows(given, images))
        if given.tobytes() != image.tobytes():
            raise _broken(embedding, f"it wrote into the image that it was given, {_described(image)}")
        given.flags.writeable = False
        try:
            embedding.embed(given)
        except (ValueError, TypeError) as error:
            raise _broken(embedding, f"it does not read an image that is read-only ({error})") from error


def _repeats_itself(embedding: Embedding, images: list[Image]) -> None:
    """an image gives the same bytes again, whatever was embedded in between."""
    first = [embedding.embed(image.copy()).copy() for image in images]
    for image, before in zip(images[::-1], first[::-1], strict=True):
        _require_same(embedding, before, embedding.embed(image.copy()), "again", image)


def _windows_are_sound(embedding: Embedding, images: list[Image]) -> None:
    """windows are read: a sound row for each."""
    for image in images:
        windows = _windows(image, images)
        embedded = embed_windows(embedding, image.copy(), windows)
        if set(embedded) != set(windows):
            raise _broken(embedding, f"given windows of widths {sorted(windows)}, it read {sorted(embedded)}")
        for width, starts in windows.items():
            what = f"windows of {width} columns of {_described(image)}"
            _require_sound(embedding, embedded[width], (len(starts), embedding.dimension), what)


def _windows_repeat(embedding: Embedding, images: list[Image]) -> None:
    """windows give the same bytes again, whichever others are read with them."""
    for image in images:
        together = embed_windows(embedding, image.copy(), _windows(image, images))
        for width, starts in _windows(image, images).items():
            for row, start in zip(together[width], starts, strict=True):
                alone = embed_windows(embedding, image.copy(), {width: [start]})[width][0]
                what = f"as a window of {width} columns at {start}, with other windows and alone,"
                _require_same(embedding, row, alone, what, image)


def _windows_are_cuts(embedding: Embedding, images: list[Image]) -> None:
    """narrow windows, and all that no pass is shared for, are read as if cut out."""
    shares = capabilities_of(embedding).embeds_windows
    for image in images:
        windows = {width: starts for width, starts in _windows(image, images).items() if width < TOGETHER or not shares}
        for width, rows in embed_windows(embedding, image.copy(), windows).items():
            for row, start in zip(rows, windows[width], strict=True):
                cut = embedding.embed(np.ascontiguousarray(image[:, start : start + width]))
                what = f"as a window of {width} columns at {start} and cut out"
                _require_same(embedding, np.asarray(row), cut, what, image)


def _keeps_its_fingerprint(embedding: Embedding, images: list[Image]) -> None:
    """the fingerprint stays as it is."""
    before = embedding.fingerprint
    for image in images[:2]:
        embedding.embed(image.copy())
    if embedding.fingerprint != before:
        raise _broken(embedding, f"its fingerprint was {before[:12]} and is now {embedding.fingerprint[:12]}")


def _image(channels: int, columns: int) -> Image:
    """Channels of different levels that walk at random, in [-1, 1]."""
    rng = np.random.default_rng([channels, columns])
    walk = np.cumsum(rng.normal(size=(channels, columns)), axis=1)
    return np.clip(rng.uniform(-1, 1, (channels, 1)) + 0.05 * walk, -1, 1).astype(np.float32)


def _windows(image: Image, images: list[Image]) -> dict[int, list[int]]:
    """Windows of a third, of two thirds, and of all of the image; none narrower than the narrowest of all images."""
    columns, least = image.shape[1], min(other.shape[1] for other in images)
    widths = sorted({max(least, columns // 3), max(least, 2 * columns // 3), columns})
    return {width: sorted({0, (columns - width) // 2, columns - width}) for width in widths}


def _require_sound(embedding: Embedding, features: npt.NDArray[np.floating], shape: tuple[int, ...], what: str) -> None:
    if not isinstance(features, np.ndarray) or not np.issubdtype(features.dtype, np.floating):
        kind = features.dtype if isinstance(features, np.ndarray) else type(features).__name__
        raise _broken(embedding, f"expected floating-point NumPy features of {what}; came {kind}")
    require_features(embedding, features, shape, what)


def _require_same(
    embedding: Embedding,
    first: npt.NDArray[np.floating],
    second: npt.NDArray[np.floating],
    when: str,
    image: Image,
) -> None:
    if first.dtype != second.dtype or first.tobytes() != second.tobytes():
        differing = np.count_nonzero(first != second)
        raise _broken(
            embedding,
            f"{when}, {_described(image)} gave other bytes ({differing} of {first.size} features differ). Threads, "
            "batches, dropout and state that is kept between calls are the common reasons",
        )


def _described(image: Image) -> str:
    constant = f", all {image.flat[0]:g}" if np.ptp(image) == 0 else ""
    return f"an image of {image.shape[0]} × {image.shape[1]}{constant}"


def _broken(embedding: Embedding, what: str) -> EmbeddingError:
    return EmbeddingError(f"embedding {embedding.name!r} breaks a promise: {what}")
