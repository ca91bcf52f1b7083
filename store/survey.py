"""What of a store verifies and what does not: found by reading all of it, for `check_store` and `repair_store`."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from store.errors import DamageError
from store.generations import folder_name, numbers
from store.reading import generation_damage, read_known
from store.records import JSON, from_json, to_json
from store.remains import WINDOW, Remains
from store.rows import GenerationRow, Spans, lost_heads, read_head, uncovered
from store.schema import GENERATIONS, payload_digest

__all__ = ["Fault", "Found", "Progress", "Rows", "Survey", "survey", "survey_rows", "walk"]

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


@dataclass(frozen=True)
class Found:
    """A generation as it was found.

    `row` is the journal's, or, where that is gone, made of what the group says of itself; None where neither
    verifies. `named` tells which. `damage` is what keeps it from being used; `own`, what is wrong with what the
    group says of itself alone.
    """

    number: int
    folder: Path
    row: GenerationRow | None
    named: bool
    damage: list[DamageError]
    own: DamageError | None

    @property
    def sound(self) -> bool:
        """Whether it can be gone on from."""
        return self.row is not None and not self.damage

    @property
    def upto(self) -> int:
        """The last row that it contains, -1 where nobody knows."""
        return -1 if self.row is None else self.row.upto

    @property
    def is_base(self) -> bool:
        """Whether it stands for rows that have no arrays."""
        return self.row is not None and bool(self.row.base)


@dataclass
class Survey:
    """All that was found. `trusted`: the journal can be believed about which generations there are.

    `identity` is None where it is lost, `compacted` the last row whose arrays a base stands for, whether that
    base is sound or not, and `unnamed` are the folders of generations that the journal does not know.
    """

    journal: Path
    meta: dict[str, str]
    damaged_meta: int
    damaged_generation_rows: list[int]
    trusted: bool
    identity: dict[str, JSON] | None = None
    generations: list[Found] = field(default_factory=list)
    unnamed: list[Path] = field(default_factory=list)
    compacted: int = 0
    rows: Rows = field(default_factory=Rows)

    @property
    def sound(self) -> list[Found]:
        """The generations that can be gone on from, the newest first."""
        found = [one for one in self.generations if one.sound]
        return sorted(found, key=lambda one: (one.upto, one.number), reverse=True)

    @property
    def has_base(self) -> bool:
        """Whether a sound generation stands for the compacted rows, or none were compacted."""
        return not self.compacted or any(one.upto == self.compacted and one.is_base for one in self.sound)


def survey(folder: Path, remains: Remains, told: Progress) -> Survey:
    """Read all that there is of the store in `folder`, whose journal is `remains`, and verify it.

    A writer may be at work meanwhile. Raises VersionError for a newer format, and StoreError for a file that
    cannot be read for a reason that says nothing against it.
    """
    # The folders before the rows: one that is committed between is then known, not a leftover.
    there = numbers(folder / GENERATIONS)
    meta, damaged_meta = remains.meta()
    rows, whole = remains.generations()
    damaged_rows = [row.number for row in rows if not row.sound]
    trusted = whole and not damaged_rows and not remains.damage
    found = Survey(remains.path, meta, damaged_meta, damaged_rows, trusted)
    named = {row.number: row for row in rows if row.sound}
    found.identity = _identity(folder, meta, there)
    chosen = [*named, *(number for number in there if number not in named and not trusted)]
    for done, number in enumerate(chosen):
        told("generations", done, len(chosen))
        one = _examined(folder / GENERATIONS / folder_name(number), number, named.get(number), found.identity, remains)
        # A writer may have replaced it while it was read: no damage.
        if one.sound or number not in named or number in {row.number for row in remains.generations()[0]}:
            found.generations.append(one)
    found.unnamed = [folder / GENERATIONS / folder_name(number) for number in there if number not in chosen]
    found.compacted = max((one.upto for one in found.generations if one.is_base), default=0)
    upto = max((one.upto for one in found.generations), default=0)
    found.rows = survey_rows(remains, found.compacted, max(upto, 0), lost_heads(meta), told)
    return found


def _identity(folder: Path, meta: dict[str, str], there: list[int]) -> dict[str, JSON] | None:
    """The journal's, or that of the newest generation that says what it is."""
    try:
        return from_json(meta["identity"])
    except (KeyError, ValueError):
        pass
    for number in reversed(there):
        try:
            return dict(read_known(folder / GENERATIONS / folder_name(number))["identity"])
        except DamageError:
            continue
    return None


def _examined(
    folder: Path, number: int, row: GenerationRow | None, identity: dict[str, JSON] | None, remains: Remains
) -> Found:
    known, own = None, None
    try:
        known = read_known(folder)
        own = _disagreement(folder, known, number, row, identity)
    except DamageError as wrong:
        own = wrong
    named = row is not None
    if row is None and known is not None and own is None:
        row = _row_of(folder, known, remains)
    if row is None:
        return Found(number, folder, None, False, [], own)
    damage = list(generation_damage(folder, number, row.verified(remains.path)[1]))
    if own is not None and known is not None:
        # It verifies, and says that it is another: then it is.
        damage.append(own)
    return Found(number, folder, row, named, damage, own)


def _disagreement(
    folder: Path, known: dict[str, Any], number: int, row: GenerationRow | None, identity: dict[str, JSON] | None
) -> DamageError | None:
    expected: dict[str, Any] = {"number": number}
    if identity is not None:
        expected["identity"] = identity
    if row is not None:
        attributes, content = from_json(row.attributes.decode()), from_json(row.content.decode())
        expected |= {"upto": row.upto, "attributes": attributes, **content}
    for name, value in expected.items():
        if known.get(name) != value:
            told = "" if name in ("arrays", "attributes") else f": {known.get(name)!r}, not {value!r}"
            return DamageError(
                f"{folder / 'zarr.json'} is of another generation, or of another store, than expected: it says "
                f"another {name}{told}",
                path=folder / "zarr.json",
            )
    return None


def _row_of(folder: Path, known: dict[str, Any], remains: Remains) -> GenerationRow:
    """The journal's row as it must have been; a base is one where no row up to it has its arrays."""
    base = known["upto"] > 0 and not remains.has_payloads(known["upto"])
    content = {"format": known["format"], "arrays": known["arrays"]}
    attributes = to_json("attributes", known["attributes"])
    time = (folder / "zarr.json").stat().st_mtime
    return GenerationRow.of(known["number"], known["upto"], int(base), time, attributes, content)


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
        if readable and not rows:
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
