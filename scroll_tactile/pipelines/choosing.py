"""Which touches of a fleet's sources come into its memory: those that one process would take, source after source.

A worker may be first with a touch that another source, of an earlier place, has under another name. So what is taken is
chosen when all are there, by the order of the sources alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate

from scroll_tactile.memory.contents import Contents, refusal
from scroll_tactile.memory.partial import Partial
from scroll_tactile.memory.rows import SOURCE
from scroll_tactile.pipelines.partials import Contained

__all__ = ["Chosen", "Part", "choose"]

Touch = tuple[str, bytes]
"""A material and a key."""


@dataclass(frozen=True)
class Part:
    """A partial with rows. out: the numbers of its touches that the sums leave out: they came before, in any order."""

    held: Contained
    out: frozenset[int]

    @property
    def summed(self) -> tuple[str, tuple[int, ...]]:
        """As `SumJob` takes it."""
        return self.held.path, tuple(sorted(self.out))


@dataclass
class Chosen:
    """What is taken of partials.

    rows: the place of a partial and the numbers of its touches that are not next, one stretch after another: of all
    touches the first under each name. repeated: how many came before under their names. refused: of those that came
    before under another the address, where it came from, and why. not_taken: these touches.
    """

    rows: list[tuple[int, frozenset[int]]] = field(default_factory=list)
    repeated: int = 0
    refused: list[tuple[str, str, str]] = field(default_factory=list)
    not_taken: set[Touch] = field(default_factory=set)


def choose(parts: Sequence[tuple[Contained, Partial]], order: Mapping[str, int], there: Contents) -> Chosen:
    """Which touches of some partials are taken.

    order: of the sources. there: what the memory has; what is taken is added.
    """
    chosen, came = Chosen(), set[Touch]()
    for address, place, first, last in _stretches(parts, order):
        held, partial = parts[place]
        taken = set()
        for number, touch, said in _touches(held, partial, address, first, last):
            why = refusal(there.names(touch[1]), touch[0], number in held.clipped)
            if why is not None:
                chosen.refused.append((address, said, why))
                chosen.not_taken.add(touch)
            elif touch in came:
                chosen.repeated += 1
            elif not there.names(touch[1]):
                there.add(*touch, 0)
            if touch not in came:
                came.add(touch)
                taken.add(number)
        if taken:
            chosen.rows.append((place, frozenset(range(1, len(held.touches) + 1)) - taken))
    return chosen


def _stretches(parts: Sequence[tuple[Contained, Partial]], order: Mapping[str, int]) -> list[tuple[str, int, int, int]]:
    """Address, place of the partial, and first and last + 1 of its touches from there, by the order of the sources."""
    found = []
    for place, (held, _) in enumerate(parts):
        ends = list(accumulate((count for _, count in held.read), initial=0))
        for (address, _), first, last in zip(held.read, ends, ends[1:], strict=False):
            found.append((address, place, first, last))
    return sorted(found, key=lambda stretch: order[stretch[0]])


def _touches(
    held: Contained, partial: Partial, address: str, first: int, last: int
) -> Iterator[tuple[int, Touch, str]]:
    """Number in the partial, touch, and where it came from; then those that came again, whose row is the first's."""
    for number in range(first, last):
        said = partial.named[number].attributes.get(SOURCE, address)
        yield number + 1, held.touches[number], str(said)
    for each in held.again:
        if each.address == address:
            touch = each.material, each.key
            yield held.numbers[touch], touch, each.said
