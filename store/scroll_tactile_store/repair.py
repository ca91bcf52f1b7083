"""Making a damaged store whole again, at the price of what is lost."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

from scroll_tactile_store.exceptions import DamageError, NotAStoreError, reported
from scroll_tactile_store.files import store_folder, sync_folder
from scroll_tactile_store.layout import (
    DAMAGED,
    LOG,
    NEW,
    Current,
    holds_store,
    log_path,
    numbers,
    remove_unnamed,
    require_safe,
    write_current,
)
from scroll_tactile_store.lock import WriterLock
from scroll_tactile_store.log import Log, create_log
from scroll_tactile_store.records import to_json
from scroll_tactile_store.rows import ROW, head_without_arrays, read_back, read_head
from scroll_tactile_store.survey import Progress, Survey


@dataclass(frozen=True)
class Repair:
    """What a repair did.

    `kept` is the last sequence that is kept. `lost` are sentences that name what is lost or can no longer be
    retracted. `aside` is the damaged log, None where nothing was damaged or there was none.
    """

    kept: int
    lost: list[str]
    aside: Path | None


def repair_store(path: str | PathLike[str], *, progress: Progress | None = None) -> Repair:
    """Keep of a damaged store the longest part from its beginning that verifies, and name what is lost.

    Recovery resumes from the newest checkpoint whose checksums verify, whatever is wrong with the rows that it
    contains. Behind it rows are kept up to the first that is damaged or missing. Those behind that one are
    dropped even where they verify: nobody knows what it did; it may have retracted one of them, or they one
    that is gone. If rows that the checkpoint contains are damaged, it becomes the compaction checkpoint: all of them
    give up their arrays, so none can be retracted any more, and rows that cannot be read are left out.

    Where nothing is damaged nothing is written. Otherwise the damaged log and damaged checkpoints stay
    beside the new ones, under names with "damaged" in them. Killed at any instant it can be started again.
    Readers that have the store open continue with the damaged one until they look again.
    `progress` is called with what is being done, how many of it are done, and how many there will be.

    Raises NotAStoreError, LockedError while a writer has it, VersionError for another format, DamageError
    where not even its identity is left or a link is where a file should be, StoreFullError,
    ReadOnlyError and other StoreErrors.
    """
    folder = store_folder(path)
    if not holds_store(folder):
        raise NotAStoreError(f"{folder} holds no store")
    require_safe(folder, written=True)
    lock = WriterLock(folder)
    try:
        with reported(folder, "repairing the store"):
            survey = Survey(folder, progress or (lambda *_: None))
            try:
                return _repair(survey) if survey.problems else Repair(survey.last, [], None)
            finally:
                survey.close()
    finally:
        lock.release()


def _repair(survey: Survey) -> Repair:
    folder, last = survey.folder, survey.last
    if survey.identity is None:
        raise DamageError(
            f"neither {survey.path} nor a checkpoint beside it tells what the store in {folder} is for: put the "
            "folder back from a copy",
            path=survey.path,
        )
    start = survey.sound[0] if survey.sound else None
    newest = 0 if start is None else start.last_sequence
    stand_in = next((each for each in survey.sound if each.last_sequence == survey.compacted > 0), None)
    # Up to `compacted` no row has arrays; without the checkpoint that stood for them they are as good as damaged.
    is_orphan = stand_in is None and survey.compacted > 0
    behind = survey.faulty(newest + 1, last)
    kept = behind[0][0] - 1 if behind else last
    if survey.compacted > newest:
        kept, behind = newest, [(newest + 1, "the compaction checkpoint that they continue is lost")]
    lost = [
        f"{what}; what they did is in checkpoint {start.number}, but can no longer be retracted"
        for _, what in survey.faulty(1, newest)
        if start is not None
    ]
    if start is not None and (is_orphan or survey.faulty(survey.compacted + 1, newest)):
        stand_in, back = start, f"; what rows behind {newest} took back of them counts again"
        what = f"rows 1 to {newest} give up their arrays, checkpoint {start.number} stands for them: none of them can"
        lost.append(f"{what} be retracted any more{back if kept > newest else ''}")
    if kept < last:
        what = f"rows {kept + 1} to {last} are dropped, also those that verify: {behind[0][1]}"
        lost.append(f"{what}, and nobody knows what that did to the others")
    if not survey.rows and any(problem.path == survey.path for problem in survey.problems):
        lost.append(f"nothing of {survey.path} can be read: the rows behind {newest}, if there were any, are lost")
    lost += [f"checkpoint {int(path.name)}: {damage}" for path, damage in survey.spoilt.items()]

    number = 1 + max(numbers(folder, LOG, NEW), default=0)
    compacted = 0 if stand_in is None else stand_in.last_sequence
    path = log_path(folder, number)
    identity = create_log(path, to_json("identity", survey.identity).encode(), _rows(survey, kept, compacted))
    with Log(path) as log:
        rows = read_back(log)
        start, stand_in = (
            None if each is None else replace(each, place=rows.place(log, each.last_sequence))
            for each in (start, stand_in)
        )
    current = Current(number, identity, start, stand_in, kept)
    damaged = [*survey.spoilt, *(log_path(folder, other) for other in numbers(folder, LOG) if other != number)]
    aside = {each: _put_aside(each) for each in damaged if each.exists()}
    write_current(folder, current)
    remove_unnamed(folder, current)
    return Repair(kept, lost, aside.get(survey.path))


def _rows(survey: Survey, kept: int, compacted: int) -> Iterator[tuple[int, bytes]]:
    """Yield the rows up to `kept`, those up to `compacted` without arrays, and of these the ones that verify."""
    assert survey.log is not None or not survey.rows
    for sequence, (offset, size) in survey.rows.items():
        if sequence > kept or survey.log is None:
            return
        survey.progress("rows written", sequence, kept)
        if sequence > compacted:
            yield ROW, survey.log.read(offset, size)
            continue
        with suppress(DamageError, ValueError):
            yield ROW, head_without_arrays(read_head(survey.log, offset, size))


def _put_aside(path: Path) -> Path:
    """Rename to, and return, the path with "damaged" behind its name, and a number where something is there already."""
    aside, count = path.with_name(path.name + DAMAGED), 1
    while os.path.lexists(aside):
        count += 1
        aside = path.with_name(f"{path.name}{DAMAGED}-{count}")
    path.rename(aside)
    sync_folder(path.parent)
    return aside
