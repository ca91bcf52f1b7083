"""Making a damaged store whole again, at the price of what is lost."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

from scroll_tactile_store.exceptions import DamageError, reported
from scroll_tactile_store.files import store_folder, sync_folder
from scroll_tactile_store.layout import (
    DAMAGED,
    LOG,
    Current,
    is_number,
    log_numbers,
    log_path,
    remove_unnamed,
    require_safe,
    write_current,
)
from scroll_tactile_store.lock import WriterLock
from scroll_tactile_store.log import Log, create_log
from scroll_tactile_store.records import to_json
from scroll_tactile_store.rows import ROW, head_without_arrays, read_back
from scroll_tactile_store.survey import HEADLESS, FoundCheckpoint, Progress, Survey, require_store


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
    require_store(folder)
    require_safe(folder, written=True)
    lock = WriterLock(folder)
    try:
        with reported(folder, "repairing the store"):
            survey = Survey(folder, progress or (lambda *_: None))
            try:
                return _repair(survey) if survey.problems() else Repair(survey.last, [], None)
            finally:
                survey.log.close()
    finally:
        lock.release()


@dataclass(frozen=True)
class _Plan:
    """Rows 1 to `kept` stay, those up to `compacted` without arrays.

    `start` is the checkpoint to begin with, `stand_in` the one that stands for the rows up to `compacted`; `fresh`
    tells whether that is another than before.
    """

    kept: int
    compacted: int
    fresh: bool
    start: FoundCheckpoint | None
    stand_in: FoundCheckpoint | None

    @classmethod
    def of(cls, survey: Survey) -> _Plan:
        start = survey.sound[0] if survey.sound else None
        newest = 0 if start is None else start.last_sequence
        is_known = not survey.compacted or survey.compaction is not None
        standing = survey.compacted if is_known else 0
        # Up to `compacted` no row has arrays; without the checkpoint that stood for them they are as good as damaged.
        fresh = bool(survey.faulty(standing + 1, newest)) or (standing < survey.compacted and newest > 0)
        behind = survey.faulty(newest + 1, survey.last)
        kept = behind[0][0] - 1 if behind else survey.last
        if survey.compacted > newest:
            kept = newest
        return cls(kept, newest if fresh else standing, fresh, start, start if fresh else survey.compaction)


def _lost(survey: Survey, plan: _Plan) -> Iterator[str]:
    """Say what a repair gives up."""
    newest = 0 if plan.start is None else plan.start.last_sequence
    which = "" if plan.start is None else f"checkpoint {int(plan.start.folder.name)}"
    for _, what in survey.faulty(1, newest):
        yield f"{what}; what they did is in {which}, but can no longer be retracted"
    if plan.fresh:
        what = f"rows 1 to {plan.compacted} give up their arrays, {which} stands for them"
        yield f"{what}: none of them can be retracted any more{_counts_again(survey, plan)}"
    if plan.kept < survey.last:
        behind = survey.faulty(newest + 1, survey.last)
        why = behind[0][1] if behind else "the compaction checkpoint that they continue is lost"
        what = f"rows {plan.kept + 1} to {survey.last} are dropped, also those that verify: {why}"
        yield f"{what}, and nobody knows what that did to the others"
    if survey.log.damage and not survey.log.rows:
        yield f"{'; '.join(survey.log.damage)}: the rows behind {newest}, if there were any, are lost"
    for found in survey.checkpoints:
        if found.damage and (survey.current is not None or found.named is not None):
            yield f"checkpoint {int(found.folder.name)}: {'; '.join(map(str, found.damage))}"


def _counts_again(survey: Survey, plan: _Plan) -> str:
    """Return in words which rows behind a new compaction checkpoint can have taken back one that it contains."""
    behind = [sequence for sequence in survey.log.rows if plan.compacted < sequence <= plan.kept]
    if not behind:
        return ""
    kinds = Counter(survey.log.head(sequence).kind for sequence in behind)
    which = f"row {behind[0]}" if len(behind) == 1 else f"rows {behind[0]} to {behind[-1]}"
    named = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    return f"; what {which} ({named}) took back of them counts again"


def _repair(survey: Survey) -> Repair:
    if survey.identity is None:
        raise DamageError(
            f"neither {survey.log.path} nor a checkpoint beside it tells what the store in {survey.folder} is for: put "
            "the folder back from a copy",
            path=survey.log.path,
        )
    folder, plan = survey.folder, _Plan.of(survey)
    lost = list(_lost(survey, plan))
    number = 1 + max(_taken(survey), default=0)
    path = log_path(folder, number)
    identity = create_log(path, to_json("identity", survey.identity).encode(), _rows(survey, plan))
    with Log(path) as log:
        rows = read_back(log)
        newest, compaction = (
            None
            if each is None or each.named is None
            else replace(each.named, place=rows.place(log, each.last_sequence))
            for each in (plan.start, plan.stand_in)
        )
    current = Current(number, identity, newest, compaction, plan.kept)
    aside = _move_aside(survey, path)
    write_current(folder, current)
    remove_unnamed(folder, current)
    return Repair(plan.kept, lost, aside)


def _taken(survey: Survey) -> Iterator[int]:
    """Yield the numbers of logs, of those that were put aside, too, and of one that is gone."""
    yield from log_numbers(survey.folder, unfinished=True)
    for name in (survey.log.path.name, *(entry.name for entry in survey.folder.iterdir())):
        stem = name.removeprefix(LOG).partition(DAMAGED)[0]
        if is_number(stem):
            yield int(stem)


def _rows(survey: Survey, plan: _Plan) -> Iterator[tuple[int, bytes]]:
    for sequence, row in survey.log.rows.items():
        if sequence > plan.kept:
            return
        survey.progress("rows written", sequence, plan.kept)
        if sequence > plan.compacted:
            yield ROW, survey.log.data(sequence)
        elif row.fault is not HEADLESS:
            with suppress(DamageError, ValueError):
                yield ROW, head_without_arrays(survey.log.head(sequence))


def _move_aside(survey: Survey, new: Path) -> Path | None:
    """Rename what is damaged; return the log's new name, or the one that it had already, None where it is gone.

    new: the log that takes its place. Without `CURRENT` nobody knows which of others was the damaged one.
    """
    others = log_numbers(survey.folder) if survey.current is None else []
    for other in (log_path(survey.folder, number) for number in others):
        if other not in (new, survey.log.path):
            _put_aside(other)
    for found in survey.checkpoints:
        if found.damage and found.folder.exists():
            _put_aside(found.folder)
    path = survey.log.path
    if not path.exists() or DAMAGED in path.name:
        return path if path.exists() else None
    return _put_aside(path)


def _put_aside(path: Path) -> Path:
    """Rename to, and return, the path with "damaged" behind its name, and a number where something is there already."""
    aside, count = path.with_name(path.name + DAMAGED), 1
    while os.path.lexists(aside):
        count += 1
        aside = path.with_name(f"{path.name}{DAMAGED}-{count}")
    path.rename(aside)
    sync_folder(path.parent)
    return aside
