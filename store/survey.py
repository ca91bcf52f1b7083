"""A whole store read and verified without changing it: what `check_store` reports, and `repair_store` starts from."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal

from store.encoding import decode_payload
from store.exceptions import DamageError, VersionError, reported
from store.files import store_folder
from store.generations import numbers
from store.groups import PARTIAL, GroupReader, folder_name, read_own_description
from store.header import strangers
from store.records import (
    JSON,
    GenerationRow,
    Spans,
    from_json,
    lost_heads,
    payload_digest,
    read_head,
    to_json,
    uncovered,
)
from store.salvage import Fault, Row, Salvage, require_salvageable
from store.schema import DAMAGED_FILE, DRAFT_FILE, GENERATIONS, JOURNAL_FILE, REPAIRED_FILE

__all__ = ["FoundGeneration", "Problem", "Progress", "Survey", "check_store"]

# Called with what is being done, how many of it are done, and how many there are.
Progress = Callable[[str, int, int], object]
REPORT_EVERY = 256  # rows
ATTEMPTS = 4


@dataclass(frozen=True)
class Problem:
    """Something that is not as it was written. `path` is the file, or the array's folder; `what` says it in words.

    `kind`: "lost" where nothing else in the store holds what was there; "spare" where something does, or
    where no content is concerned; "leftover" for files too many: no damage, and only space.
    """

    path: Path
    what: str
    kind: Literal["lost", "spare", "leftover"]


def check_store(path: str | PathLike[str], *, progress: Progress | None = None) -> list[Problem]:
    """Return all that is wrong with the store in folder `path`, the journal first; nothing for a sound one.

    It verifies every checksum: SQLite's structure of the journal, each row and its arrays, each array
    of each generation, and what these say of themselves. It changes nothing, and a writer may be at work.
    Where something is a link, a pipe or a device it reads nothing and names these.
    `progress` is called with what is being verified, how many of it are done, and how many there are.

    Raises NotAStoreError where there is no store, VersionError for a newer format, and another StoreError
    where a file cannot be read for a reason that says nothing against it.
    """
    folder = store_folder(path)
    require_salvageable(folder)
    with reported(folder, "checking the store"):
        if found := [Problem(error.path, str(error), "lost") for error in strangers(folder)]:
            return found
        for _ in range(ATTEMPTS):
            with closing(Salvage(folder / JOURNAL_FILE)) as salvage:
                survey = Survey(folder, salvage, progress or (lambda *_: None))
                found = survey.problems() + list(survey.leftovers())
                if not salvage.moved:
                    break
        return found


@dataclass(frozen=True)
class FoundGeneration:
    """A generation as it was found.

    `row` is the journal's, or, where that is gone, made from what the group says of itself; None where neither
    verifies. `damage` is what keeps it from being used; `own`, what is wrong with what the group says of itself.
    """

    number: int
    folder: Path
    row: GenerationRow | None
    damage: list[DamageError]
    own: DamageError | None

    @property
    def sound(self) -> bool:
        """Whether recovery can resume from it."""
        return self.row is not None and not self.damage

    @property
    def upto(self) -> int:
        """The last row that it contains, -1 where nobody knows."""
        return -1 if self.row is None else self.row.upto

    @property
    def is_base(self) -> bool:
        """Whether it stands for rows that have no arrays."""
        return self.row is not None and bool(self.row.base)


class Survey:
    """All that is found of the store in `folder`, whose journal is `salvage`, and whether it verifies.

    `identity` is None where it is lost; `compacted` is the last row whose arrays a base stands for, whether that
    base is sound or not; `unnamed` are the folders of generations that the journal does not know. `last` is the
    last sequence of which there is any sign; `faults` are the rows that do not verify, as (first, last, fault),
    ascending; `strays` are payloads that ought not to be there. A writer may be at work meanwhile. Raises
    VersionError for a newer format, and StoreError for a file that cannot be read for a reason that says nothing
    against it.
    """

    def __init__(self, folder: Path, salvage: Salvage, progress: Progress) -> None:
        self.folder, self.salvage, self.progress, self.journal = folder, salvage, progress, salvage.path
        # The folders before the rows: a generation that is committed in between is then known, not a leftover.
        parent = self.folder / GENERATIONS
        there = numbers(parent)
        self.meta, self.damaged_meta = salvage.meta()
        rows, whole = salvage.generations()
        self.damaged_generation_rows = [row.number for row in rows if not row.sound]
        trusted = whole and not self.damaged_generation_rows and not salvage.damage
        named = {row.number: row for row in rows if row.sound}
        self.lost_heads = lost_heads(self.meta)
        if _json_or_none(self.meta.get("identity", "{}")) is None:  # forged: its checksum was right
            del self.meta["identity"]
            self.damaged_meta += 1
        self.identity = _identity(parent, self.meta, there)
        self.generations: list[FoundGeneration] = []
        chosen = [*named, *(number for number in there if number not in named and not trusted)]
        for done, number in enumerate(chosen):
            progress("generations", done, len(chosen))
            found = self._examine(parent / folder_name(number), number, named.get(number))
            # A writer may have replaced it while it was read: that is no damage.
            still_named = number in {row.number for row in salvage.generations()[0]}
            if found.sound or number not in named or still_named:
                self.generations.append(found)
        self.unnamed = [parent / folder_name(number) for number in there if number not in chosen]
        self.compacted = max((found.upto for found in self.generations if found.is_base), default=0)
        self.faults: list[tuple[int, int, Fault]] = []
        self._verify_rows(max((found.upto for found in self.generations), default=0))

    def _verify_rows(self, upto: int) -> None:
        """Verify every row, and the arrays of those behind the base; `upto` is the last that a generation contains."""
        last, whole = self.salvage.last()
        self.last, compacted = max(last, upto), self.compacted
        for first, through, row in self.salvage.rows(self.last, self.lost_heads, whole=whole):
            if isinstance(row, Fault):
                for begin, end in uncovered(first, through, self.lost_heads):
                    self._note(begin, end, row)
                continue
            self.last = max(self.last, through)
            if first % REPORT_EVERY == 0:
                self.progress("rows", first, self.last)
            fault = self._fault(row, arrays=first > compacted)
            if fault is Fault.NO_ARRAYS and not self.faulty(first - 1, first - 1):
                # A writer may have compacted it since.
                compacted = max(compacted, self.salvage.compacted())
                fault = fault if first > compacted else None
            if fault is not None:
                self._note(first, first, fault)
        self.faults = self.faulty(1, self.last)
        self.strays: Spans = self.salvage.strays(compacted)

    def _fault(self, row: Row, *, arrays: bool) -> Fault | None:
        head = read_head(row)
        if head is None:
            return Fault.DAMAGED
        if not arrays:
            return None
        payload, readable = self.salvage.payload(row[0])
        if payload is None:
            return Fault.NO_ARRAYS if readable else Fault.UNREADABLE_ARRAYS
        if payload_digest(payload) != head[1]:
            return Fault.DAMAGED_ARRAYS
        return None if _is_readable(payload) else Fault.FOREIGN_ARRAYS

    def _note(self, first: int, last: int, fault: Fault) -> None:
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

    @property
    def sound(self) -> list[FoundGeneration]:
        """The generations that recovery can resume from, the newest first."""
        found = [found for found in self.generations if found.sound]
        return sorted(found, key=lambda found: (found.upto, found.number), reverse=True)

    @property
    def has_base(self) -> bool:
        """Whether a sound generation stands for the compacted rows, or none were compacted."""
        return not self.compacted or any(found.upto == self.compacted and found.is_base for found in self.sound)

    def _examine(self, folder: Path, number: int, row: GenerationRow | None) -> FoundGeneration:
        known, own = None, None
        try:
            known = read_own_description(folder)
            own = self._disagreement(folder / "zarr.json", known, number, row)
        except DamageError as wrong:
            own = wrong
        if row is None and known is not None and own is None:
            row = self._row_of(folder, known)
        if row is None:
            return FoundGeneration(number, folder, None, [], own)
        try:
            damage = list(GroupReader(folder, number, row.verified(self.journal)[1]).damage())
        except DamageError as wrong:
            damage = [wrong]
        if own is not None and known is not None:
            # It verifies, and says that it is another: then it is.
            damage.append(own)
        return FoundGeneration(number, folder, row, damage, own)

    def _disagreement(
        self, header: Path, known: dict[str, Any], number: int, row: GenerationRow | None
    ) -> DamageError | None:
        expected: dict[str, Any] = {"number": number}
        if self.identity is not None:
            expected["identity"] = self.identity
        if row is not None:
            attributes, content = row.verified(self.journal)
            expected |= {"upto": row.upto, "attributes": attributes, **content}
        for name, value in expected.items():
            if known.get(name) != value:
                detail = "" if name in ("arrays", "attributes") else f": {known.get(name)!r}, not {value!r}"
                return DamageError(
                    f"{header} is of another generation, or of another store, than expected: it says another "
                    f"{name}{detail}",
                    path=header,
                )
        return None

    def _row_of(self, folder: Path, known: dict[str, Any]) -> GenerationRow:
        """Return the journal's row as it must have been; a base is one where no row up to it has its arrays."""
        base = known["upto"] > 0 and not self.salvage.may_have_payloads(known["upto"])
        content = {"format": known["format"], "arrays": known["arrays"]}
        attributes = to_json("attributes", known["attributes"])
        time = (folder / "zarr.json").stat().st_mtime
        return GenerationRow.of(known["number"], known["upto"], int(base), time, attributes, content)

    def problems(self) -> list[Problem]:
        """Return what is damaged."""
        return [*self._in_journal(), *self._in_rows(), *self._in_generations()]

    def _in_journal(self) -> Iterator[Problem]:
        for what in self.salvage.damage:
            yield Problem(self.journal, what, "lost" if self.salvage.is_gone else "spare")
        missing = sorted({"format", "created", "identity"} - set(self.meta))
        if self.damaged_meta or missing:
            what = f"{self.damaged_meta} rows of table meta in {self.journal} fail their checksums"
            what += f"; without a row that verifies: {', '.join(missing)}" if missing else ""
            yield Problem(self.journal, what, "spare" if self.identity is not None else "lost")

    def _in_rows(self) -> Iterator[Problem]:
        for first, last, fault in self.faults:
            yield Problem(self.journal, f"{fault.describe(first, last)} in {self.journal}", "lost")
        for first, last in self.strays:
            rows = f"row {first}" if first == last else f"rows {first} to {last}"
            what = f"{self.journal} holds arrays of {rows} that no row has, or a base stands for"
            yield Problem(self.journal, what, "spare")

    def _in_generations(self) -> Iterator[Problem]:
        known = {found.number: found for found in self.generations}
        for number in self.damaged_generation_rows:
            generation = known.get(number)
            spare = (generation is not None and generation.sound) or self._is_spare(generation)
            what = f"the row of generation {number} in {self.journal} fails its checksum"
            yield Problem(self.journal, what, "spare" if spare else "lost")
        for found in self.generations:
            kind: Literal["lost", "spare"] = "spare" if self._is_spare(found) else "lost"
            for damage in found.damage:
                yield Problem(damage.path, str(damage), kind)
            if found.own is not None and found.own not in found.damage:
                # A generation that the journal knows need not describe itself.
                yield Problem(found.own.path, str(found.own), "spare" if found.sound else kind)

    def _is_spare(self, generation: FoundGeneration | None) -> bool:
        """Return whether the state that a generation holds can be had without it."""
        upto = self.last if generation is None or generation.row is None else generation.upto
        uptos = [other.upto for other in self.sound if other is not generation]
        if generation is not None and generation.is_base and upto == self.compacted:
            return upto in uptos
        starts = [start for start in [*uptos, *([0] if not self.compacted else [])] if start >= self.compacted]
        return any(start >= upto or not self.faulty(start + 1, upto) for start in starts)

    def leftovers(self) -> Iterator[Problem]:
        """Yield the files that are there too many, and who removes them."""
        aside = "was put aside by a repair: remove it when you need it no more"
        for path in self.unnamed:
            yield Problem(path, f"{path} is of no generation that counts: the next writer removes it", "leftover")
        parent = self.folder / GENERATIONS
        for path in sorted(parent.iterdir()) if parent.is_dir() else ():
            if path.name.endswith(PARTIAL):
                yield Problem(path, f"{path} was, or is being, written: the next writer removes it", "leftover")
            elif ".damaged" in path.name:
                yield Problem(path, f"{path} {aside}", "leftover")
        for path in sorted(self.folder.iterdir()):
            if path.name.startswith(DAMAGED_FILE):
                yield Problem(path, f"{path} {aside}", "leftover")
            elif path.name.startswith((DRAFT_FILE, REPAIRED_FILE)):
                what = f"{path} is of a repair that did not end: the next writer removes it"
                yield Problem(path, what, "leftover")


def _json_or_none(text: str) -> dict[str, JSON] | None:
    try:
        return from_json(text)
    except ValueError:
        return None


def _identity(parent: Path, meta: dict[str, str], there: list[int]) -> dict[str, JSON] | None:
    """Return the journal's identity, or that of the newest generation that describes itself."""
    if "identity" in meta:
        return _json_or_none(meta["identity"])
    for number in reversed(there):
        try:
            return dict(read_own_description(parent / folder_name(number))["identity"])
        except DamageError:
            continue
    return None


def _is_readable(payload: bytes) -> bool:
    """Whether a payload is what `encode_payload` makes: anyone can make its digest; one of a newer release counts."""
    with suppress(VersionError):
        try:
            decode_payload(payload)
        except ValueError:
            return False
    return True
