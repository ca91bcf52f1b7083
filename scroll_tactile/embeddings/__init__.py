"""Embeddings: frozen maps from a tactile image of any size to a feature vector."""
