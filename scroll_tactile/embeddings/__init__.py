"""Embeddings: frozen maps from a tactile image of any size to a feature vector."""

from scroll_tactile.embeddings.check import check_embedding
from scroll_tactile.embeddings.frames import Frames
from scroll_tactile.embeddings.joined import Joined
from scroll_tactile.embeddings.kernels import Kernels
from scroll_tactile.embeddings.maps import Maps
from scroll_tactile.embeddings.modules import ModuleEmbedding
from scroll_tactile.embeddings.protocol import Capabilities, Embedding, embed_windows
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
    "check_embedding",
    "embed_windows",
]
