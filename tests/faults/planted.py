"""Bugs to be put in, by name, so that it shows that the simulation finds such ones.

Each is a function that patches what it spoils, for as long as `PLANTS[name]()` lasts.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from faults.planted_counts import COUNTS
from faults.planted_looks import LOOKS
from faults.planted_writes import WRITES
from faults.planting import Patches

BUGS = WRITES | LOOKS | COUNTS


@contextmanager
def _planted(name: str) -> Iterator[None]:
    patches = Patches()
    BUGS[name](patches)
    try:
        yield
    finally:
        patches.undo()


PLANTS = {name: partial(_planted, name) for name in BUGS}
