"""The systems that the paper compares, and ours, behind one protocol: see `catalogue`."""

from scroll_tactile.pipelines.systems.catalogue import SYSTEMS, Catalogue
from scroll_tactile.pipelines.systems.protocol import System

__all__ = ["SYSTEMS", "Catalogue", "System"]
