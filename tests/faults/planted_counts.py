"""Bugs in what is counted: rows, numbers and touches that are one too many, or lost."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

from faults.planting import Patches, nothing
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import MEMBER, MERGE, OBSERVE
from scroll_tactile.persistence import ledger, merge, packing, replaying
from store import checkpoints, journal, repair


def _place_too_late(patch: Patches) -> None:
    def make(_: Any) -> Any:
        def place(self: Any, last_sequence: int) -> Any:
            with self._using("looking for a place") as at:
                found = [place for row, place in at.places if row > last_sequence]
                return found[0] if found else at.places[-1][1]

        return place

    patch(journal.Journal, "place", make)


def _one_row_too_many(patch: Patches) -> None:
    def make(commit: Any) -> Any:
        def committed(self: Any, draft: Any) -> Any:
            return commit(
                self, dataclasses.replace(draft, last_sequence=min(draft.last_sequence + 1, self._journal.last()))
            )

        return committed

    patch(checkpoints.Checkpoints, "commit", make)


def _numbers_given_out_again(patch: Patches) -> None:
    patch(journal.OpenLog, "last", lambda _: lambda self: self.last_row)


def _compaction_drops_a_row(patch: Patches) -> None:
    def make(payloads: Any) -> Any:
        def fewer(self: Any, last_sequence: int) -> Iterator[bytes]:
            found = list(payloads(self, last_sequence))
            return iter(found[:-1])

        return fewer

    patch(journal.Journal, "payloads", make)


def _compaction_with_a_retracted_touch(patch: Patches) -> None:
    def make(until: Any) -> Any:
        def spoilt(memory: Any, given: Any, last_sequence: int) -> Any:
            made = until(memory, given, last_sequence)
            for sequence in sorted(memory.retracted):
                if memory.compacted < sequence <= last_sequence:
                    record = given.record(sequence)
                    columns, codes = memory.codes(record)
                    made.statistics.add(record.label, codes, columns)
                    break
            return made

        return spoilt

    patch(ledger, "until", make)


def _excluded_forgotten(patch: Patches) -> None:
    def make(to_arrays: Any) -> Any:
        def spoilt(self: Any, *given: Any, **named: Any) -> Any:
            arrays, attributes = to_arrays(self, *given, **named)
            return arrays | {"excluded": arrays["excluded"][:0]}, attributes

        return spoilt

    patch(Memory, "to_arrays", make)


def _kept_not_retracted(patch: Patches) -> None:
    def make(chosen: Any) -> Any:
        def spoilt(memory: Any, given: Any, last_sequence: int) -> Any:
            fresh = chosen(memory, given, last_sequence)
            fresh.kept = memory.kept
            return fresh

        return spoilt

    patch(replaying, "_chosen", make)


def _all(heads: Any) -> Any:
    return [head for head in heads if head.kind in (OBSERVE, MERGE, MEMBER)]


def _retraction_lost_in_a_merge(patch: Patches) -> None:
    patch(merge, "active_rows", lambda _: _all)


def _retraction_lost_in_packing(patch: Patches) -> None:
    patch(packing, "active_rows", lambda _: _all)


def _shared_twice(patch: Patches) -> None:
    patch(merge, "_row", nothing)


def _packed_twice(patch: Patches) -> None:
    def make(sums: Any) -> Any:
        return lambda source, newest, memory, left_out: sums(source, newest, memory, set())

    patch(merge, "sums_without", make)


def _description_lost(patch: Patches) -> None:
    def make(described: Any) -> Any:
        return lambda *given: dict(list(described(*given).items())[1:])

    patch(merge, "_descriptions", make)


def _repair_keeps_too_much(patch: Patches) -> None:
    def make(of: Any) -> Any:
        return lambda cls, survey: dataclasses.replace(of(cls, survey), kept=survey.last)

    patch(repair._Plan, "of", make)


def _rows_of_a_failed_batch(patch: Patches) -> None:
    def make(_: Any) -> Any:
        def undo(at: Any, writer: Any) -> None:
            writer.rollback()

        return undo

    patch(journal.Journal, "_undo", make)


COUNTS: dict[str, Callable[[Patches], None]] = {
    "rows of a failed batch stay known": _rows_of_a_failed_batch,
    "a place is one batch too late": _place_too_late,
    "a checkpoint says one row too many": _one_row_too_many,
    "numbers of rows are given out again": _numbers_given_out_again,
    "compaction drops the last row": _compaction_drops_a_row,
    "a compaction checkpoint has a retracted touch": _compaction_with_a_retracted_touch,
    "excluded rows are forgotten": _excluded_forgotten,
    "kept touches are not retracted": _kept_not_retracted,
    "a retraction is lost in a merge": _retraction_lost_in_a_merge,
    "a retraction is lost in packing": _retraction_lost_in_packing,
    "a shared touch is counted twice": _shared_twice,
    "a packed memory is counted twice": _packed_twice,
    "a description is lost in a merge": _description_lost,
    "a repair keeps rows behind damage": _repair_keeps_too_much,
}
