"""Bugs to be put in, by name, so that it shows that the simulation finds such ones."""
from __future__ import annotations
from typing import Any
PLANTS: dict[str, Any] = {}
