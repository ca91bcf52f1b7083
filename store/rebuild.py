"""A journal made anew of what verifies, beside a damaged one, and put in its place."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from store.errors import DamageError
from store.faults import Fault, Progress, survey_rows, walk
from store.files import sync_folder
from store.records import JSON, from_json
from store.remains import Remains
from store.rows import GENERATION_COLUMNS, HEAD_COLUMNS, GenerationRow, Spans, read_head
from store.schema import (
    DAMAGED_FILE,
    DRAFT_FILE,
    JOURNAL_FILE,
    REPAIRED_FILE,
    SIDES,
    build_journal,
    payload_digest,
    remove_drafts,
)

__all__ = ["Contents", "finish_repair", "free_name", "put_in_place", "write_repaired"]


@dataclass(frozen=True)
class Contents:
    """What goes into a repaired journal: rows 1 to `kept`, with the arrays of those behind `base`.

    `lost`: the rows up to `base` that are not there. `generations`: their rows. `meta`: what table meta holds.
    """

    kept: int
    base: int
    lost: Spans
    generations: Sequence[GenerationRow]
    meta: Mapping[str, str]


def write_repaired(folder: Path, remains: Remains, contents: Contents, told: Progress) -> None:
    """Write a journal with these contents, out of what remains of the damaged one, and verify it.

    It is then in `folder`, complete and durable, under a name of its own. Raises DamageError where it does
    not read back as it should.
    """

    def fill(connection: sqlite3.Connection) -> None:
        _copy_rows(remains, connection, contents, told)
        values = [row.values() for row in contents.generations]
        connection.executemany(f"INSERT INTO generation ({GENERATION_COLUMNS}) VALUES (?,?,?,?,?,?,?)", values)

    draft = folder / DRAFT_FILE
    try:
        build_journal(draft, contents.meta, fill)
        _verify(draft, contents, told)
        draft.rename(folder / REPAIRED_FILE)
        sync_folder(folder)
    except BaseException:
        # It may be the disk that is full, and a half of it is worth nothing.
        remove_drafts(folder)
        raise


def _copy_rows(remains: Remains, connection: sqlite3.Connection, contents: Contents, told: Progress) -> None:
    marks = ",".join("?" * len(HEAD_COLUMNS.split(",")))
    for sequence, _, row in walk(remains, contents.kept, whole=True):
        if isinstance(row, Fault) or sequence > contents.kept:
            continue
        head = read_head(row)
        if head is None:
            continue
        told("rows written", sequence, contents.kept)
        values = [value.decode() if at in (1, 2, 5) else value for at, value in enumerate(row)]
        connection.execute(f"INSERT INTO record ({HEAD_COLUMNS}) VALUES ({marks})", values)
        if sequence > contents.base:
            payload, _ = remains.payload(sequence)
            if payload is None or payload_digest(payload) != head[1]:
                raise DamageError(
                    f"row {sequence} of {remains.path} verified, and a moment later did not: its disk cannot be "
                    "trusted; copy the folder to another one and repair it there",
                    path=remains.path,
                    sequence=sequence,
                )
            connection.execute("INSERT INTO payload (sequence, bytes) VALUES (?, ?)", (sequence, payload))


def _verify(draft: Path, contents: Contents, told: Progress) -> None:
    with closing(Remains(draft)) as written:
        upto = max((row.upto for row in contents.generations), default=0)
        rows = survey_rows(written, contents.base, upto, contents.lost, told)
        found, whole = written.generations()
        same = sorted(found, key=lambda row: row.number) == sorted(contents.generations, key=lambda row: row.number)
        if written.damage or rows.faults or rows.strays or rows.last != contents.kept or not whole or not same:
            raise DamageError(
                f"{draft} does not read back as it was just written: its disk cannot be trusted; copy the folder to "
                "another one and repair it there",
                path=draft,
            )


def free_name(folder: Path, wanted: str, suffixes: Sequence[str] = ("",)) -> str:
    """Return `wanted`, or the first of wanted-2, wanted-3 … of which nothing is there yet, with any of the suffixes."""
    name, count = wanted, 1
    while any((folder / (name + suffix)).exists() for suffix in suffixes):
        count += 1
        name = f"{wanted}-{count}"
    return name


def put_in_place(folder: Path, aside: str) -> None:
    """Give the damaged journal, with all that SQLite has beside it, the name `aside`, and the repaired one its own.

    It may be called again when it did not come to its end: between any two steps there is either the
    damaged journal as it was, or none and the repaired one complete.
    """
    # The journal first: without its log it could be opened, and rows would be missing; the log without it
    # cannot. And each move is durable before the next, or the repaired one could meet a log that is not its own.
    for suffix in ("", *SIDES):
        old = folder / (JOURNAL_FILE + suffix)
        if old.exists():
            old.rename(folder / (aside + suffix))
            sync_folder(folder)
    (folder / REPAIRED_FILE).rename(folder / JOURNAL_FILE)
    sync_folder(folder)


def finish_repair(folder: Path) -> dict[str, JSON] | None:
    """Bring a repair to its end that had moved the damaged journal away; return what it noted of itself.

    None where there is no such repair. Raises DamageError where what it had made is damaged itself.
    """
    repaired = folder / REPAIRED_FILE
    if (folder / JOURNAL_FILE).exists() or not repaired.exists():
        return None
    with closing(Remains(repaired)) as remains:
        meta, damaged = remains.meta()
        if remains.damage or damaged or "repaired" not in meta:
            raise DamageError(
                f"{repaired}, left by a repair that did not end, is damaged: remove it, give {DAMAGED_FILE} (the one "
                f"with the highest number) the name {JOURNAL_FILE} again, and what is beside it likewise, and repair "
                "the store once more",
                path=repaired,
            )
    noted = from_json(meta["repaired"])
    put_in_place(folder, str(noted["aside"]))
    return noted
