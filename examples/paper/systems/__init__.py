"""The systems that the paper compares, and ours, behind one protocol: see `catalogue`."""

from examples.paper.systems.catalogue import SYSTEMS, Catalogue
from examples.paper.systems.system_protocol import System

__all__ = ["SYSTEMS", "Catalogue", "System"]
