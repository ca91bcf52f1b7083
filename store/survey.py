"""What of a store verifies and what does not: found by reading all of it, for `check_store` and `repair_store`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from store.errors import DamageError
from store.faults import Progress, Rows, survey_rows
from store.generations import folder_name, numbers
from store.reading import generation_damage, read_known
from store.records import JSON, from_json, to_json
from store.remains import Remains
from store.rows import GenerationRow, lost_heads
from store.schema import GENERATIONS

__all__ = ["Found", "Survey", "survey"]


@dataclass(frozen=True)
class Found:
    """A generation as it was found.

    `row` is the journal's, or, where that is gone, made of what the group says of itself; None where neither
    verifies. `damage` is what keeps it from being used; `own`, what is wrong with what the group says of itself.
    """

    number: int
    folder: Path
    row: GenerationRow | None
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
    if row is None and known is not None and own is None:
        row = _row_of(folder, known, remains)
    if row is None:
        return Found(number, folder, None, [], own)
    damage = list(generation_damage(folder, number, row.verified(remains.path)[1]))
    if own is not None and known is not None:
        # It verifies, and says that it is another: then it is.
        damage.append(own)
    return Found(number, folder, row, damage, own)


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
