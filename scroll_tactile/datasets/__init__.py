"""Readers of published data sets in their publishers' layouts, and a minimal simulator; no data."""

from scroll_tactile.datasets.labelled import Recordings

__all__ = ["Recordings"]
