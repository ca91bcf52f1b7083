"""Several embeddings side by side, as one."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.protocol import (
    Capabilities,
    Embedding,
    capabilities_of,
    embed_competing,
    embed_windows,
    is_embedding,
)
from scroll_tactile.embeddings.registry import configuration_of
from scroll_tactile.errors import InputError

__all__ = ["Joined"]


class Joined:
    """Features of several embeddings, one after another: what one of them misses another may see.

    Each one's features are divided by its bound, so that all lie in [-1, 1]. Windows are those that every part can
    read, and they are judged as the most demanding part asks for.

    Raises InputError for fewer than two embeddings, or two that have other resting images of a camera.

    >>> from scroll_tactile.embeddings.kernels import Kernels
    >>> Joined(Kernels(dimension=64), Kernels(seed=2, dimension=128))
    Joined(Kernels(seed=1, dimension=64), Kernels(seed=2, dimension=128))
    """

    bound = 1.0

    def __init__(self, *embeddings: Embedding) -> None:
        if len(embeddings) < 2:
            raise InputError(f"expected at least two embeddings to join; came {len(embeddings)}")
        strange = [part for part in embeddings if not is_embedding(part)]
        if strange:
            raise InputError(f"expected embeddings, such as Joined(Kernels(), Vision()); came {strange[0]!r:.100}")
        self.parts: tuple[Embedding, ...] = embeddings
        self.name = "+".join(part.name for part in embeddings)
        self.dimension = sum(part.dimension for part in embeddings)
        declared = [capabilities_of(part) for part in embeddings]
        framed = [part for part in declared if part.reads_frames]
        rest = framed[0].rest if framed else None
        if not all(np.array_equal(part.rest, rest) for part in framed):  # type: ignore[arg-type]
            raise InputError(f"expected embeddings of frames with one resting image; came {embeddings}")
        # Judged by all scales, kernels with vision are not better (BioTac 99.4 against 99.5 %, RoboSkin 98.4 to 98.6),
        # at the price of a pass for each narrow window.
        widest = any(part.judged_scales == "widest" for part in declared)
        self.capabilities = Capabilities(
            partial_windows=all(part.partial_windows for part in declared),
            judged_scales="widest" if widest else "all",
            reads_whole_touches=all(part.reads_whole_touches for part in declared),
            reads_frames=bool(framed),
            rest=rest,
            embeds_windows=True,
            competes=all(part.competes for part in declared),
            composite=True,
            exact=all(part.exact for part in declared),
        )

    def __repr__(self) -> str:
        return f"Joined({', '.join(map(repr, self.parts))})"

    def configuration(self) -> dict[str, Any] | None:
        """What makes an equal one, in JSON's types; None with a part that does not ship with scroll-tactile."""
        parts = [configuration_of(part) for part in self.parts]
        return None if None in parts else {"kind": "joined", "parts": parts}

    @cached_property
    def fingerprint(self) -> str:
        """A hash of the parts' fingerprints, bounds and dimensions, in their order."""
        digest = hashlib.sha256(b"joined 1")
        for part in self.parts:
            digest.update(f"\n{part.name} {part.dimension} {part.bound!r} {part.fingerprint}".encode())
        return digest.hexdigest()

    def embed(self, image: npt.NDArray[np.float32]) -> npt.NDArray[np.floating]:
        """Features in [-1, 1], shape (d,), of a tactile image of shape (C, T) in [-1, 1]."""
        return np.concatenate([np.divide(part.embed(image), part.bound) for part in self.parts])

    def embed_windows(
        self, image: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]]
    ) -> dict[int, npt.NDArray[np.floating]]:
        """Embed windows of an image: width → first steps, to width → features (windows, d)."""
        embedded = [embed_windows(part, image, windows) for part in self.parts]
        return {width: self._beside([rows[width] for rows in embedded]) for width in windows}

    def embed_competing(
        self, image: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]], width: int
    ) -> tuple[dict[int, npt.NDArray[np.floating]], npt.NDArray[np.floating]]:
        """Embed windows of an image, and all of it by the competing kernels of each part: features (d,)."""
        embedded = [embed_competing(part, image, windows, width) for part in self.parts]
        features = {width: self._beside([rows[width] for rows, _ in embedded]) for width in windows}
        return features, self._beside([competing for _, competing in embedded])

    def _beside(self, features: Sequence[npt.NDArray[np.floating]]) -> npt.NDArray[np.floating]:
        """The features of the parts, (…, d of a part) each, one after another."""
        return np.concatenate(
            [np.divide(own, part.bound) for own, part in zip(features, self.parts, strict=True)], axis=-1
        )
