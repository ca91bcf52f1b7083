"""Embeddings: frozen maps from a tactile image of any size to a feature vector."""

import importlib
import typing

from scroll_tactile.embeddings.protocol import Capabilities, Embedding, embed_windows

if typing.TYPE_CHECKING:
    from scroll_tactile.embeddings.frames import Frames
    from scroll_tactile.embeddings.joined import Joined
    from scroll_tactile.embeddings.kernels import Kernels
    from scroll_tactile.embeddings.maps import Maps
    from scroll_tactile.embeddings.modules import ModuleEmbedding
    from scroll_tactile.embeddings.robust import Robust
    from scroll_tactile.embeddings.vision import Vision

__all__ = [
    "Capabilities",
    "Embedding",
    "Frames",
    "Joined",
    "Kernels",
    "Maps",
    "ModuleEmbedding",
    "Robust",
    "Vision",
    "embed_windows",
]

# Imported when asked for: modules of networks need torch, which takes seconds.
_MODULES = {
    "Frames": "frames",
    "Joined": "joined",
    "Kernels": "kernels",
    "Maps": "maps",
    "ModuleEmbedding": "modules",
    "Robust": "robust",
    "Vision": "vision",
}


def __getattr__(name: str) -> typing.Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
