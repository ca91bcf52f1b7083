"""Making a damaged store whole again, at the price of what is lost."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, cast

from store.check import problems
from store.errors import DamageError
from store.faults import Progress, rows_text
from store.files import sync_folder
from store.generations import folder_name, highest_number, remove_others, write_generation
from store.lock import WriterLock
from store.reading import read_generation
from store.rebuild import Contents, finish_repair, free_name, put_in_place, write_repaired
from store.records import JSON, to_json
from store.remains import Remains, require_remains
from store.reporting import reported
from store.rows import GenerationRow, Spans, lost_heads
from store.schema import DAMAGED_FILE, GENERATIONS, JOURNAL_FILE, SIDES, new_meta
from store.survey import Found, Survey, survey

__all__ = ["Repair", "repair_store"]


@dataclass(frozen=True)
class _Plan:
    """Rows 1 to `kept` stay, those up to `base` without arrays, and of these not those in `heads`.

    `generations` stay, too, the newest first; `fresh` is whether the base is another than before.
    """

    kept: int
    base: int
    fresh: bool
    heads: Spans
    generations: list[Found]


@dataclass(frozen=True)
class Repair:
    """What a repair did.

    `kept` is the last sequence that is kept. `lost` are sentences that name what is lost or can no longer be
    taken back. `aside` is the damaged journal, None where nothing was damaged or there was none.
    """

    kept: int
    lost: list[str]
    aside: Path | None


def repair_store(path: str | PathLike[str], *, progress: Progress | None = None) -> Repair:
    """Keep of a damaged store the longest part from its beginning that verifies, and name what is lost.

    The newest generation that verifies is gone on from, whatever is wrong with the rows that it contains.
    Behind it rows are kept up to the first that is damaged or missing. Those behind that one are dropped even
    where they verify: what it did cannot be known, and it may have taken one of them back, or they one that
    is not there. If rows that the generation contains are damaged, it becomes the base: the arrays of all of
    them are given up, so none can be taken back any more, and rows that cannot be read are left out.

    Where nothing is damaged nothing is written. Otherwise the damaged journal and damaged generations are
    kept beside the new ones, under names with "damaged" in them. Killed at any instant it can be begun again.
    Who has the store open to read goes on with the damaged one until it is opened anew.
    `progress` is told what is being done, how many of it are, and how many there will be.

    Raises NotAStoreError, LockedError while a writer has it, VersionError for a newer format, DamageError
    where not even its identity is left, StoreFullError, ReadOnlyError and other StoreErrors.
    """
    folder = Path(path).absolute()
    require_remains(folder)
    lock = WriterLock(folder)
    try:
        with reported(folder, "repairing the store"):
            if (noted := finish_repair(folder)) is not None:
                _remove_dropped(folder)
                return _done(folder, noted)
            return _repair(folder, progress or (lambda *_: None))
    finally:
        lock.release()


def _done(folder: Path, noted: Mapping[str, Any]) -> Repair:
    aside = folder / noted["aside"]
    return Repair(noted["kept"], list(noted["lost"]), aside if aside.exists() else None)


def _repair(folder: Path, told: Progress) -> Repair:
    with closing(Remains(folder / JOURNAL_FILE)) as remains:
        found = survey(folder, remains, told)
        if not problems(remains, found):
            return Repair(found.rows.last, [], None)
        if found.identity is None:
            raise DamageError(
                f"neither {found.journal} nor a generation beside it tells what the store in {folder} is for: put the "
                "folder back from a copy",
                path=found.journal,
            )
        plan = _plan(found)
        noted: dict[str, JSON] = {
            "aside": free_name(folder, DAMAGED_FILE, ("", *SIDES)),
            "heads": [list(span) for span in plan.heads],
            "kept": plan.kept,
            "lost": [*_lost_rows(remains, found, plan), *_lost_generations(found)],
        }
        meta = new_meta(to_json("identity", found.identity)) | {
            key: found.meta[key] for key in ("created", "identity") if key in found.meta
        }
        meta["repaired"] = to_json("what was repaired", noted)
        rows = [_row_of(folder, found, plan, one) for one in plan.generations]
        write_repaired(folder, remains, Contents(plan.kept, plan.base, plan.heads, rows, meta), told)
    _put_generations_aside(found)
    put_in_place(folder, cast(str, noted["aside"]))
    _remove_dropped(folder)
    return _done(folder, noted)


def _plan(found: Survey) -> _Plan:
    sound, rows = found.sound, found.rows
    newest = sound[0].upto if sound else 0
    standing = found.compacted if found.has_base else 0
    # Up to `compacted` no row has arrays, and without the base that stood for them they are as good as damaged.
    fresh = bool(rows.faulty(standing + 1, newest)) or (standing < found.compacted and newest > 0)
    base = newest if fresh else standing
    behind = rows.faulty(newest + 1, rows.last)
    kept = behind[0][0] - 1 if behind else rows.last
    if found.compacted > newest:
        kept = newest
    lost = [(first, last) for first, last, fault in rows.faulty(1, base) if fault.takes_head]
    heads = _united([*lost, *((first, last) for first, last in lost_heads(found.meta) if last <= base)])
    bases = [one for one in sound if one.is_base and one.upto == base]
    # One that must be written again, because it does not tell what it is, is worth it only where it is needed.
    needed = [one for one in sound if one is sound[0] or one in bases[:1] or (one.upto >= base and one.own is None)]
    return _Plan(kept, base, fresh, heads, needed)


def _united(spans: Spans) -> Spans:
    united: Spans = []
    for first, last in sorted(spans):
        if united and first <= united[-1][1] + 1:
            united[-1] = (united[-1][0], max(last, united[-1][1]))
        else:
            united.append((first, last))
    return united


def _lost_rows(remains: Remains, found: Survey, plan: _Plan) -> list[str]:
    rows, newest = found.rows, found.sound[0].upto if found.sound else 0
    which = f"generation {found.sound[0].number}" if found.sound else ""
    lost = [
        f"{rows_text(first, last, fault)}; what they did is in {which}, but can no longer be taken back"
        for first, last, fault in rows.faulty(1, newest)
    ]
    if plan.fresh:
        lost.append(
            f"the arrays of rows 1 to {plan.base} are given up, {which} stands for them: none of them can be taken "
            "back any more"
        )
    if plan.kept < rows.last:
        behind = rows.faulty(newest + 1, rows.last)
        why = rows_text(*behind[0]) if behind else "the base that they go on from is lost"
        lost.append(
            f"rows {plan.kept + 1} to {rows.last} are dropped, also those that verify: {why}, and what that did to the "
            "others cannot be known"
        )
    if remains.is_gone:
        lost.append(f"{'; '.join(remains.damage)}: the rows behind {newest}, if there were any, are lost")
    return lost


def _lost_generations(found: Survey) -> list[str]:
    lost = []
    for one in found.generations:
        if not one.sound:
            why = one.damage or ([one.own] if one.own is not None else [])
            lost.append(f"generation {one.number}: {'; '.join(map(str, why))}")
    return lost


def _row_of(folder: Path, found: Survey, plan: _Plan, one: Found) -> GenerationRow:
    """The row of a generation that stays; one that does not tell what it is is written again."""
    assert one.row is not None
    attributes, content = one.row.verified(found.journal)
    number = one.number
    if one.own is not None:
        parent = folder / GENERATIONS
        arrays = read_generation(one.folder, number, content)
        chunks = {name: described["rows"] for name, described in content["arrays"].items() if "rows" in described}
        number = 1 + highest_number(parent)
        content = write_generation(parent, number, one.upto, arrays, attributes, chunks, found.identity or {})
    base = one.upto == plan.base and (one.is_base or (plan.fresh and one is plan.generations[0]))
    return GenerationRow.of(number, one.upto, int(base), one.row.time, one.row.attributes.decode(), content)


def _put_generations_aside(found: Survey) -> None:
    for one in found.generations:
        if not one.sound and one.folder.exists():
            parent = one.folder.parent
            one.folder.rename(parent / free_name(parent, f"{folder_name(one.number)}.damaged"))
            sync_folder(parent)


def _remove_dropped(folder: Path) -> None:
    with closing(Remains(folder / JOURNAL_FILE)) as remains:
        kept = [row.number for row in remains.generations()[0]]
    remove_others(folder / GENERATIONS, kept)
