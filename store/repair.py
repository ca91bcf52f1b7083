"""Making a damaged store whole again, at the price of what is lost: the one entry to salvage and repair."""

from __future__ import annotations

import os
import re
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import cast

from store.exceptions import DamageError, reported
from store.files import store_folder, sync_folder
from store.generations import highest_number, remove_others
from store.groups import Draft, GroupReader, folder_name, write_group
from store.header import require_unshared, strangers
from store.lock import WriterLock
from store.records import (
    GENERATION_COLUMNS,
    HEAD_COLUMNS,
    JSON,
    GenerationRow,
    Spans,
    from_json,
    payload_digest,
    read_head,
    to_json,
    united,
)
from store.salvage import Fault, Salvage, require_salvageable
from store.schema import (
    DAMAGED_FILE,
    DRAFT_FILE,
    GENERATIONS,
    JOURNAL_FILE,
    REPAIRED_FILE,
    ROLLBACK,
    SIDES,
    build_journal,
    new_meta,
    remove_drafts,
)
from store.survey import FoundGeneration, Progress, Survey

__all__ = ["Repair", "repair_store"]

# Only such names: with another a forged note could have a file anywhere replaced.
ASIDE = re.compile(re.escape(DAMAGED_FILE) + r"(-[0-9]{1,9})?", re.ASCII)
DISTRUST = "its disk cannot be trusted; copy the folder to another one and repair it there"


@dataclass(frozen=True)
class Repair:
    """What a repair did.

    `kept` is the last sequence that is kept. `lost` are sentences that name what is lost or can no longer be
    retracted. `aside` is the damaged journal, None where nothing was damaged or there was none.
    """

    kept: int
    lost: list[str]
    aside: Path | None


def repair_store(path: str | PathLike[str], *, progress: Progress | None = None) -> Repair:
    """Keep of a damaged store the longest part from its beginning that verifies, and name what is lost.

    Recovery resumes from the newest generation whose checksums verify, whatever is wrong with the rows that it
    contains. Behind it rows are kept up to the first that is damaged or missing. Those behind that one are
    dropped even where they verify: nobody knows what it did; it may have retracted one of them, or they one
    that is gone. If rows that the generation contains are damaged, it becomes the base: all of them give up
    their arrays, so none can be retracted any more, and rows that cannot be read are left out.

    Where nothing is damaged nothing is written. Otherwise the damaged journal and damaged generations stay
    beside the new ones, under names with "damaged" in them. Killed at any instant it can be started again.
    Readers that have the store open continue with the damaged one until they open it anew.
    `progress` is called with what is being done, how many of it are done, and how many there will be.

    Raises NotAStoreError, LockedError while a writer has it, VersionError for a newer format, DamageError
    where not even its identity is left or a link is where a file should be, StoreFullError,
    ReadOnlyError and other StoreErrors.
    """
    folder = store_folder(path)
    require_salvageable(folder)
    with reported(folder, "looking at the store"):
        for error in strangers(folder):
            raise error
    require_unshared(folder)
    lock = WriterLock(folder)
    try:
        with reported(folder, "repairing the store"):
            noted = _finish_interrupted(folder)
            if noted is None:
                with closing(Salvage(folder / JOURNAL_FILE)) as salvage:
                    survey = Survey(folder, salvage, progress or (lambda *_: None))
                    if not survey.problems():
                        return Repair(survey.last, [], None)
                    noted = _write_repaired(survey)
                _put_generations_aside(survey)
                _put_in_place(folder, str(noted["aside"]))
            with closing(Salvage(folder / JOURNAL_FILE)) as salvage:
                remove_others(folder / GENERATIONS, [row.number for row in salvage.generations()[0]])
            aside = folder / str(noted["aside"])
            lost = cast("list[str]", noted["lost"])
            return Repair(cast(int, noted["kept"]), list(lost), aside if aside.exists() else None)
    finally:
        lock.release()


@dataclass(frozen=True)
class _Plan:
    """Rows 1 to `kept` stay, those up to `base` without arrays, and of these not those in `heads`.

    `generations` stay, too, the newest first; `fresh` is whether the base is another than before.
    """

    kept: int
    base: int
    fresh: bool
    heads: Spans
    generations: list[FoundGeneration]

    @classmethod
    def of(cls, survey: Survey) -> _Plan:
        sound = survey.sound
        newest = sound[0].upto if sound else 0
        standing = survey.compacted if survey.has_base else 0
        # Up to `compacted` no row has arrays; without the base that stood for them they are as good as damaged.
        fresh = bool(survey.faulty(standing + 1, newest)) or (standing < survey.compacted and newest > 0)
        base = newest if fresh else standing
        behind = survey.faulty(newest + 1, survey.last)
        kept = behind[0][0] - 1 if behind else survey.last
        if survey.compacted > newest:
            kept = newest
        lost = [(first, last) for first, last, fault in survey.faulty(1, base) if fault.takes_head]
        heads = united([*lost, *((first, last) for first, last in survey.lost_heads if last <= base)])
        bases = [found for found in sound if found.is_base and found.upto == base]
        # A generation that does not describe itself has to be written again: only where it is needed.
        needed = [
            found
            for found in sound
            if found is sound[0] or found in bases[:1] or (found.upto >= base and found.own is None)
        ]
        return cls(kept, base, fresh, heads, needed)


def _lost_rows(survey: Survey, plan: _Plan) -> list[str]:
    newest = survey.sound[0].upto if survey.sound else 0
    which = f"generation {survey.sound[0].number}" if survey.sound else ""
    lost = [
        f"{fault.describe(first, last)}; what they did is in {which}, but can no longer be retracted"
        for first, last, fault in survey.faulty(1, newest)
    ]
    if plan.fresh:
        lost.append(
            f"rows 1 to {plan.base} give up their arrays, {which} stands for them: none of them can be retracted any "
            "more"
        )
    if plan.kept < survey.last:
        behind = survey.faulty(newest + 1, survey.last)
        first, last, fault = behind[0] if behind else (0, 0, None)
        why = fault.describe(first, last) if fault else "the base that they continue is lost"
        lost.append(
            f"rows {plan.kept + 1} to {survey.last} are dropped, also those that verify: {why}, and nobody knows what "
            "that did to the others"
        )
    if survey.salvage.is_gone:
        lost.append(f"{'; '.join(survey.salvage.damage)}: the rows behind {newest}, if there were any, are lost")
    return lost


def _lost_generations(survey: Survey) -> list[str]:
    lost = []
    for found in survey.generations:
        if not found.sound:
            why = found.damage or ([found.own] if found.own is not None else [])
            lost.append(f"generation {found.number}: {'; '.join(map(str, why))}")
    return lost


def _row_to_keep(survey: Survey, plan: _Plan, found: FoundGeneration) -> GenerationRow:
    """Return the row of a generation that stays; write one again that does not describe itself."""
    assert found.row is not None
    _, content = found.row.verified(survey.journal)
    number = found.number
    if found.own is not None:
        parent = found.folder.parent
        arrays = GroupReader(found.folder, number, content).arrays()
        number = 1 + highest_number(parent)
        draft = Draft(arrays, found.upto, found.row.attributes.decode())
        content = write_group(parent, number, draft, survey.identity or {})
    base = found.upto == plan.base and (found.is_base or (plan.fresh and found is plan.generations[0]))
    return GenerationRow.of(number, found.upto, int(base), found.row.time, found.row.attributes.decode(), content)


def _write_repaired(survey: Survey) -> dict[str, JSON]:
    """Write the repaired journal, verify it, and return what it notes of this repair.

    It is then complete and durable under a name of its own. Raises DamageError where it does not read back
    as it was written.
    """
    if survey.identity is None:
        raise DamageError(
            f"neither {survey.journal} nor a generation beside it tells what the store in {survey.folder} is for: put "
            "the folder back from a copy",
            path=survey.journal,
        )
    folder, plan = survey.folder, _Plan.of(survey)
    noted: dict[str, JSON] = {
        "aside": _free_name(folder, DAMAGED_FILE, ("", ROLLBACK, *SIDES)),
        "heads": [list(span) for span in plan.heads],
        "kept": plan.kept,
        "lost": [*_lost_rows(survey, plan), *_lost_generations(survey)],
    }
    known = {key: survey.meta[key] for key in ("created", "identity") if key in survey.meta}
    meta = new_meta(to_json("identity", survey.identity)) | known
    meta["repaired"] = to_json("what was repaired", noted)
    rows = [_row_to_keep(survey, plan, found) for found in plan.generations]

    def fill(connection: sqlite3.Connection) -> None:
        _copy_rows(survey, plan, connection)
        values = [row.values() for row in rows]
        connection.executemany(f"INSERT INTO generation ({GENERATION_COLUMNS}) VALUES (?,?,?,?,?,?,?)", values)

    draft = folder / DRAFT_FILE
    try:
        build_journal(draft, meta, fill)
        _verify(survey, draft, plan, rows)
        draft.rename(folder / REPAIRED_FILE)
        sync_folder(folder)
    except BaseException:
        # The disk may be full, and a half of it is worth nothing.
        remove_drafts(folder)
        raise
    return noted


def _copy_rows(survey: Survey, plan: _Plan, connection: sqlite3.Connection) -> None:
    marks = ",".join("?" * len(HEAD_COLUMNS.split(",")))
    for sequence, _, row in survey.salvage.rows(plan.kept, survey.lost_heads, whole=True):
        if sequence > plan.kept:
            break
        head = None if isinstance(row, Fault) else read_head(row)
        if head is None or isinstance(row, Fault):
            continue
        survey.progress("rows written", sequence, plan.kept)
        values = [value.decode() if i in (1, 2, 5) else value for i, value in enumerate(row)]
        connection.execute(f"INSERT INTO record ({HEAD_COLUMNS}) VALUES ({marks})", values)
        if sequence > plan.base:
            payload, _ = survey.salvage.payload(sequence)
            if payload is None or payload_digest(payload) != head[1]:
                raise DamageError(
                    f"row {sequence} of {survey.journal} verified, and a moment later did not: {DISTRUST}",
                    path=survey.journal,
                    sequence=sequence,
                )
            connection.execute("INSERT INTO payload (sequence, bytes) VALUES (?, ?)", (sequence, payload))


def _verify(survey: Survey, draft: Path, plan: _Plan, generations: Sequence[GenerationRow]) -> None:
    with closing(Salvage(draft)) as salvage:
        again = Survey(survey.folder, salvage, survey.progress)
        found = set(salvage.generations()[0])
        if again.problems() or again.last != plan.kept or found != set(generations):
            raise DamageError(f"{draft} does not read back as it was just written: {DISTRUST}", path=draft)


def _free_name(folder: Path, wanted: str, suffixes: Sequence[str] = ("",)) -> str:
    """Return `wanted`, or the first of wanted-2, wanted-3 … of which nothing is there yet, with any of the suffixes."""
    name, count = wanted, 1
    while any(os.path.lexists(folder / (name + suffix)) for suffix in suffixes):
        count += 1
        name = f"{wanted}-{count}"
    return name


def _put_generations_aside(survey: Survey) -> None:
    for found in survey.generations:
        if not found.sound and found.folder.exists():
            parent = found.folder.parent
            found.folder.rename(parent / _free_name(parent, f"{folder_name(found.number)}.damaged"))
            sync_folder(parent)


def _put_in_place(folder: Path, aside: str) -> None:
    """Rename the damaged journal, with all that SQLite has beside it, to `aside`, and the repaired one to its name.

    A call that was cut short can be repeated: between any two steps there is either the damaged journal as it
    was, or none and the repaired one complete.
    """
    # The journal first: without its log it could be opened, and rows would be missing; the log without it
    # cannot. And each move is durable before the next, or the repaired one could meet a log that is not its own.
    for suffix in ("", ROLLBACK, *SIDES):
        old = folder / (JOURNAL_FILE + suffix)
        if old.exists():
            old.rename(folder / (aside + suffix))
            sync_folder(folder)
    (folder / REPAIRED_FILE).rename(folder / JOURNAL_FILE)
    sync_folder(folder)


def _noted(meta: dict[str, str]) -> dict[str, JSON] | None:
    """Return what a repair noted of itself; None where it did not, or names as aside what a repair would not."""
    try:
        noted = from_json(meta["repaired"])
        aside, kept, lost = noted["aside"], noted["kept"], noted["lost"]
    except (KeyError, ValueError):
        return None
    is_ours = isinstance(aside, str) and ASIDE.fullmatch(aside) is not None
    return noted if is_ours and isinstance(kept, int) and isinstance(lost, list) else None


def _finish_interrupted(folder: Path) -> dict[str, JSON] | None:
    """Finish a repair that was killed after it had moved the damaged journal away; return what it noted of itself.

    None where there is no such repair. Raises DamageError where what it had made is damaged itself.
    """
    repaired = folder / REPAIRED_FILE
    if (folder / JOURNAL_FILE).exists() or not repaired.exists():
        return None
    with closing(Salvage(repaired)) as salvage:
        meta, damaged = salvage.meta()
        noted = _noted(meta)
        if salvage.damage or damaged or noted is None:
            raise DamageError(
                f"{repaired}, left by a repair that did not end, is damaged: remove it, give {DAMAGED_FILE} (the one "
                f"with the highest number) the name {JOURNAL_FILE} again, and what is beside it likewise, and repair "
                "the store once more",
                path=repaired,
            )
    _put_in_place(folder, str(noted["aside"]))
    return noted
