"""Rows of a journal, one by one: which of them do not verify, and why."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from store.remains import WINDOW, Remains
from store.rows import Spans, read_head, uncovered
from store.schema import payload_digest

__all__ = ["Fault", "Progress", "Rows", "rows_text", "survey_rows", "walk"]

# Told what is being looked at, how many of it were, and how many there are.
Progress = Callable[[str, int, int], object]

# Sequences in a row of which none can be read, behind which no more are tried.
GIVE_UP = 64 * WINDOW


class Fault(enum.Enum):
    """What can be wrong with a row, said of one and of several."""

    MISSING = ("is missing", "are missing")
    DAMAGED = ("fails its checksum", "fail their checksums")
    UNREADABLE = ("cannot be read", "cannot be read")
    NO_ARRAYS = ("has lost its arrays", "have lost their arrays")
    DAMAGED_ARRAYS = ("has arrays that fail their checksum", "have arrays that fail their checksums")
    UNREADABLE_ARRAYS = ("has arrays that cannot be read", "have arrays that cannot be read")

    @property
    def takes_head(self) -> bool:
        """Whether not even the row without its arrays is left."""
        return self in (Fault.MISSING, Fault.DAMAGED, Fault.UNREADABLE)


@dataclass
class Rows:
    """Which rows do not verify: (first, last, fault), ascending, consecutive ones with the same fault as one.

    `last` is the last sequence that there ever was a sign of. `strays` are payloads that ought not to be there.
    """

    last: int = 0
    faults: list[tuple[int, int, Fault]] = field(default_factory=list)
    strays: Spans = field(default_factory=list)

    def add(self, first: int, last: int, fault: Fault) -> None:
        """Note a fault of rows behind all those that were noted before."""
        if self.faults and self.faults[-1][1] == first - 1 and self.faults[-1][2] is fault:
            first = self.faults.pop()[0]
        self.faults.append((first, last, fault))

    def faulty(self, first: int, last: int) -> list[tuple[int, int, Fault]]:
        """Return the faults of rows `first` to `last`, cut off at these."""
        return [
            (max(begin, first), min(end, last), fault)
            for begin, end, fault in self.faults
            if max(begin, first) <= min(end, last)
        ]


def rows_text(first: int, last: int, fault: Fault) -> str:
    """Return that rows `first` to `last` have a fault, in words."""
    return f"row {first} {fault.value[0]}" if first == last else f"rows {first} to {last} {fault.value[1]}"


def survey_rows(remains: Remains, compacted: int, upto: int, lost: Spans, told: Progress) -> Rows:
    """Verify every row, and the arrays of those behind `compacted`.

    upto: the last row that a generation contains. lost: those that an earlier repair named as lost.
    """
    last, whole = remains.last()
    found = Rows(last=max(last, upto))
    for first, through, what in walk(remains, found.last, whole=whole):
        if isinstance(what, Fault):
            for begin, end in uncovered(first, through, lost):
                found.add(begin, end, what)
            continue
        found.last = max(found.last, through)
        if first % WINDOW == 0:
            told("rows", first, found.last)
        fault = _fault(remains, what, arrays=first > compacted)
        if fault is Fault.NO_ARRAYS and not found.faulty(first - 1, first - 1):
            # A writer may have compacted it while this went on.
            compacted = max([compacted, *(row.upto for row in remains.generations()[0] if row.sound and row.base)])
            fault = fault if first > compacted else None
        if fault is not None:
            found.add(first, first, fault)
    found.faults = found.faulty(1, found.last)
    found.strays = remains.strays(compacted)
    return found


def walk(remains: Remains, last: int, *, whole: bool) -> Iterator[tuple[int, int, tuple[Any, ...] | Fault]]:
    """Yield every sequence once, ascending: (s, s, its row), or (first, last, why there are no rows).

    whole: `last` is to be believed; otherwise it goes on behind it as long as there is anything.
    """
    after = quiet = 0
    while not remains.is_gone and (after < last or not whole):
        rows, readable = remains.heads(after)
        if readable and not rows and not remains.damage:
            break
        if rows and _are_in_order(rows, after, gaps=not remains.damage):
            for row in rows:
                if row[0] > after + 1:
                    yield after + 1, row[0] - 1, Fault.MISSING
                yield row[0], row[0], row
                after = row[0]
            continue
        ahead = min((row[0] for row in rows if row[0] > after), default=None)
        if quiet >= GIVE_UP:
            if ahead is None:
                break
            if ahead > after + 1:
                yield after + 1, ahead - 1, Fault.MISSING
            after, quiet = ahead - 1, 0
        end = min(after + WINDOW, last) if whole else after + WINDOW
        for sequence, found in _one_by_one(remains, after + 1, end, rows + remains.heads_before(end)):
            yield sequence, sequence, found
            quiet = quiet + 1 if isinstance(found, Fault) else 0
        after = end
    if after < last:
        yield after + 1, last, Fault.MISSING


def _are_in_order(rows: list[tuple[Any, ...]], after: int, *, gaps: bool) -> bool:
    """Whether the sequences ascend, from behind `after`, and where no gaps may be, by one."""
    steps = [later - earlier for earlier, later in pairwise([after, *(row[0] for row in rows)])]
    return min(steps) > 0 and (gaps or max(steps) == 1)


def _one_by_one(
    remains: Remains, first: int, last: int, seen: list[tuple[Any, ...]]
) -> Iterator[tuple[int, tuple[Any, ...] | Fault]]:
    # In a damaged tree the way that leads to a row may be lost, and it is still passed by, from one side.
    passed = {row[0]: row for row in seen} | {row[0]: row for row in seen if read_head(row) is not None}
    for sequence in range(first, last + 1):
        row, readable = remains.head(sequence)
        if row is None or read_head(row) is None:
            row = passed.get(sequence, row)
        yield sequence, row or (Fault.MISSING if readable else Fault.UNREADABLE)


def _fault(remains: Remains, row: tuple[Any, ...], *, arrays: bool) -> Fault | None:
    head = read_head(row)
    if head is None:
        return Fault.DAMAGED
    if not arrays:
        return None
    payload, readable = remains.payload(row[0])
    if payload is None:
        return Fault.NO_ARRAYS if readable else Fault.UNREADABLE_ARRAYS
    return None if payload_digest(payload) == head[1] else Fault.DAMAGED_ARRAYS
