"""Embeddings: frozen maps from a tactile image of any size to a feature vector."""

from scroll_tactile.embeddings.kernels import Kernels
from scroll_tactile.embeddings.protocol import Embedding, embed_windows

__all__ = ["Embedding", "Kernels", "embed_windows"]
