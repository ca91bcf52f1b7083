"""What every system of the comparison is: it is fitted to streams once, and names the materials of others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from examples.paper.runs.cells import silent
from scroll_tactile.clients.learning.metrics import Labelled
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.signals.stream import Stream

__all__ = ["System", "Watch", "require_touches", "silent", "unwatched"]

Watch = Callable[[], object]
"""Called after every epoch of a system that has epochs; `predict` answers then with the weights of that moment."""


def unwatched() -> None:
    """Epochs that nobody looks at."""


@runtime_checkable
class System(Protocol):
    """A classifier of streams. `name` is what tables call it."""

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    def fit(
        self,
        streams: Sequence[Stream],
        materials: Sequence[str],
        validation: Sequence[Labelled],
        seed: int,
        progress: Progress = silent,
        watch: Watch = unwatched,
    ) -> None:
        """Learn N streams of N materials, forgetting what was learned before; the same arguments give the same answers.

        validation: touches of the same materials that a system may choose settings on. One that has nothing to
        choose, or has chosen, learns them too: all systems are given the same touches in all.
        seed: of all that is drawn; 0 or more. progress: receives what is being done.

        Raises InputError for fewer than two materials, or other numbers of streams than of materials.
        """
        ...

    def predict(self, streams: Sequence[Stream]) -> list[str]:
        """The material of each stream, of any length. Raises InputError before `fit`."""
        ...


def require_touches(streams: Sequence[Stream], materials: Sequence[str], validation: Sequence[Labelled]) -> list[str]:
    """The names of the materials, sorted.

    Raises InputError where a fit cannot be: too few materials, unequal numbers, or a validation of materials that
    are not learned.
    """
    if len(streams) != len(materials):
        raise InputError(f"expected as many streams as materials; came {len(streams)} and {len(materials)}")
    names = sorted(set(materials))
    if len(names) < 2:
        raise InputError(f"expected streams of two materials or more, to be classified; came {names}")
    strange = {name for name, _ in validation} - set(names)
    if strange:
        raise InputError(f"expected a validation of the materials that are learned; it also has {sorted(strange)}")
    return names
