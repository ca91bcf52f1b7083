"""Verifying a store without changing it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal

from store.faults import Progress, rows_text
from store.generations import PARTIAL
from store.remains import Remains, require_remains
from store.reporting import reported
from store.schema import DAMAGED_FILE, DRAFT_FILE, GENERATIONS, JOURNAL_FILE, REPAIRED_FILE
from store.survey import Found, Survey, survey

__all__ = ["Problem", "check_store", "problems"]


@dataclass(frozen=True)
class Problem:
    """Something that is not as it was written. `path` is the file, or the array's folder; `what` says it in words.

    `kind`: "lost" where nothing else in the store holds what was there; "spare" where something does, or
    where no content is concerned; "leftover" for what is there too much: no damage, and only space.
    """

    path: Path
    what: str
    kind: Literal["lost", "spare", "leftover"]


def check_store(path: str | PathLike[str], *, progress: Progress | None = None) -> list[Problem]:
    """Return all that is wrong with the store in folder `path`, the journal first; nothing for a sound one.

    Every checksum is verified: SQLite's structure of the journal, each row and its arrays, each array and
    chunk of each generation, and what these say of themselves. Nothing is written, no lock is taken, and a
    writer may be at work (SQLite may make its two files beside the journal, as for any reader).
    `progress` is told what is looked at, how many of it were, and how many there are.

    Raises NotAStoreError where there is no store, VersionError for a newer format, and another StoreError
    where a file cannot be read for a reason that says nothing against it.
    """
    folder = Path(path).absolute()
    require_remains(folder)
    with reported(folder, "checking the store"), closing(Remains(folder / JOURNAL_FILE)) as remains:
        found = survey(folder, remains, progress or (lambda *_: None))
        return problems(remains, found) + list(_leftovers(folder, found))


def problems(remains: Remains, found: Survey) -> list[Problem]:
    """Return what of a survey is damage."""
    return [*_in_journal(remains, found), *_in_rows(found), *_in_generations(found)]


def _in_journal(remains: Remains, found: Survey) -> Iterator[Problem]:
    for what in remains.damage:
        yield Problem(found.journal, what, "lost" if remains.is_gone else "spare")
    if found.damaged_meta or not {"format", "created", "identity"} <= set(found.meta):
        missing = sorted({"format", "created", "identity"} - set(found.meta))
        what = f"{found.damaged_meta} rows of table meta in {found.journal} fail their checksums"
        what += f"; without a row that verifies: {', '.join(missing)}" if missing else ""
        yield Problem(found.journal, what, "spare" if found.identity is not None else "lost")


def _in_rows(found: Survey) -> Iterator[Problem]:
    for first, last, fault in found.rows.faults:
        yield Problem(found.journal, f"{rows_text(first, last, fault)} in {found.journal}", "lost")
    for first, last in found.rows.strays:
        rows = f"row {first}" if first == last else f"rows {first} to {last}"
        yield Problem(
            found.journal, f"{found.journal} holds arrays of {rows} that no row has, or a base stands for", "spare"
        )


def _in_generations(found: Survey) -> Iterator[Problem]:
    known = {one.number: one for one in found.generations}
    for number in found.damaged_generation_rows:
        one = known.get(number)
        spare = (one is not None and one.sound) or _is_spare(found, one)
        what = f"the row of generation {number} in {found.journal} fails its checksum"
        yield Problem(found.journal, what, "spare" if spare else "lost")
    for one in found.generations:
        kind: Literal["lost", "spare"] = "spare" if _is_spare(found, one) else "lost"
        for damage in one.damage:
            yield Problem(damage.path, str(damage), kind)
        if one.own is not None and one.own not in one.damage:
            # Where the journal knows the generation it needs not to tell of itself.
            yield Problem(one.own.path, str(one.own), "spare" if one.sound else kind)


def _is_spare(found: Survey, one: Found | None) -> bool:
    """Whether the state that a generation holds can be had without it."""
    upto = found.rows.last if one is None or one.row is None else one.upto
    uptos = [other.upto for other in found.sound if other is not one]
    if one is not None and one.is_base and upto == found.compacted:
        return upto in uptos
    starts = [start for start in [*uptos, *([0] if not found.compacted else [])] if start >= found.compacted]
    return any(start >= upto or not found.rows.faulty(start + 1, upto) for start in starts)


def _leftovers(folder: Path, found: Survey) -> Iterator[Problem]:
    for path in found.unnamed:
        yield Problem(path, f"{path} is of no generation that counts: the next writer removes it", "leftover")
    generations = folder / GENERATIONS
    for path in sorted(generations.iterdir()) if generations.is_dir() else ():
        if path.name.endswith(PARTIAL):
            yield Problem(path, f"{path} was, or is being, written: the next writer removes it", "leftover")
        elif ".damaged" in path.name:
            yield Problem(path, f"{path} was put aside by a repair: remove it when you need it no more", "leftover")
    for path in sorted(folder.iterdir()):
        if path.name.startswith(DAMAGED_FILE):
            yield Problem(path, f"{path} was put aside by a repair: remove it when you need it no more", "leftover")
        elif path.name.startswith((DRAFT_FILE, REPAIRED_FILE)):
            yield Problem(path, f"{path} is of a repair that did not end: the next writer removes it", "leftover")
