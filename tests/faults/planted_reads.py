"""Bugs in what is read, which is not looked at, and believed; and in what is counted: one too many, or lost."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from scroll_tactile_store import backup, checkpoint_files, layout, log, rows, survey
from scroll_tactile_store.records import Checkpoint
from scroll_tactile_store.store import Store

from faults.planting import BUGS, Replacement, bug, nothing
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import Kind
from scroll_tactile.persistence import ledger, merge, replaying


@bug("a frame's payload is not verified", log.Log, "_payload")
def _payload_as_it_is(_: Any, self: Any, frame: Any, begin: bytes) -> Any:
    return self.at(frame.offset + log.FRAME_BYTES, frame.size)


@bug("CURRENT is not verified", layout.Current, "from_bytes")
def _current_resealed(read: Any, cls: Any, data: bytes, path: Path) -> Any:
    try:
        known = json.loads(data)
        known.pop("sha256")
        data = json.dumps(known | {"sha256": layout.json_digest(known)}).encode()
    except (ValueError, KeyError, AttributeError, TypeError):
        pass  # it is no CURRENT at all
    return read(cls, data, path)


# What a checkpoint says of itself is compared with what CURRENT says of it. That alone lets one bit in 3900 pass.
@bug("CURRENT is not verified", Store, "_load")
def _checkpoint_as_it_is(_: Any, self: Any, named: Any) -> Any:
    reader = checkpoint_files.CheckpointReader(layout.checkpoint_path(self._folder, named.number))
    return Checkpoint(named.number, named.last_sequence, reader.attributes, reader.arrays())


class Same(str):
    """A text that is the same as any other."""

    __slots__ = ()
    __hash__ = str.__hash__

    def __eq__(self, _: object) -> bool:
        return True

    def __ne__(self, _: object) -> bool:
        return False


def _sum_of_anything(data: bytes) -> Any:
    return SimpleNamespace(hexdigest=lambda: Same(hashlib.sha256(data).hexdigest()))


BUGS["a chunk is not verified"] = [
    Replacement(checkpoint_files, "hashlib", lambda _: SimpleNamespace(sha256=_sum_of_anything))
]


@bug("what a checkpoint says of itself is not verified", checkpoint_files, "json_digest")
def _digest_of_anything(digest: Any, known: Any) -> str:
    return Same(digest(known))


@bug("a torn batch is taken", log.Log, "_batch")
def _torn_taken_for_committed(scan: Any, self: Any) -> Any:
    batch, torn = scan(self)
    return ([*batch, batch[-1]], None) if torn is not None and batch else (batch, torn)


@bug("a reader does not notice another log", Store, "_look")
def _other_log_not_noticed(_: Any, self: Any) -> None:
    self._rows.catch_up(self._log)


@bug("an index of another log is believed", checkpoint_files.CheckpointReader, "arrays")
def _any_index_is_of_this_log(arrays: Any, self: Any, names: Any = None) -> Any:
    found = arrays(self, names)
    if not found and names and next(iter(names)).startswith(checkpoint_files.INDEX):
        own = [name for name in self.names if name.startswith(checkpoint_files.INDEX)]
        found = dict.fromkeys(names, *arrays(self, own).values()) if own else {}
    return found


@bug("a backup does not look at CURRENT again", backup, "_copy")
def _copied_once(_: Any, source: Path, draft: Path) -> None:
    current = layout.read_current(source / "CURRENT")
    with suppress(FileNotFoundError):
        backup._copy_named(source, draft, current)
    layout.write_current(draft, layout.read_current(source / "CURRENT"))


bug("a backup does not look at CURRENT again", backup, "_verify")(nothing)

# What is counted.


@bug("rows of a failed batch stay known", rows.Rows, "cut")
def _undone_in_the_log_alone(_: Any, self: Any, place: Any) -> None:
    """The rows of what was rolled back stay."""


@bug("a place is one batch too late", rows.Rows, "place")
def _place_too_late(place: Any, self: Any, log: Any, last_sequence: int) -> Any:
    found = place(self, log, last_sequence)
    later = next((sequence for sequence in self.sequences if sequence > last_sequence), last_sequence)
    while later <= self.last and place(self, log, later) == found and found != log.place:
        later += 1
    return place(self, log, later)


@bug("a checkpoint says one row too many", Store, "_commit")
def _one_row_too_many(commit: Any, self: Any, draft: Any) -> Any:
    more = min(draft.last_sequence + 1, self._rows.last)
    return commit(self, dataclasses.replace(draft, last_sequence=more))


@bug("numbers of rows are given out again", rows.Rows, "last")
def _last_of_those_that_are_there(_: Any, self: Any) -> Any:
    return self.sequences[-1] if self.sequences else 0


@bug("compaction drops the last row", Store, "_payloads")
def _all_but_the_last(payloads: Any, self: Any, last_sequence: int) -> Iterator[bytes]:
    return iter(list(payloads(self, last_sequence))[:-1])


@bug("a compaction checkpoint has a retracted touch", ledger, "until")
def _with_a_retracted_touch(until: Any, memory: Any, given: Any, last_sequence: int) -> Any:
    made = until(memory, given, last_sequence)
    for sequence in sorted(memory.retracted):
        if memory.compacted < sequence <= last_sequence:
            record = given.record(sequence)
            columns, codes = memory.codes(record)
            made.statistics.add(record.label, codes, columns)
            break
    return made


@bug("excluded rows are forgotten", Memory, "to_arrays")
def _excluded_forgotten(to_arrays: Any, self: Any, *given: Any, **named: Any) -> Any:
    arrays, attributes = to_arrays(self, *given, **named)
    return arrays | {"excluded": arrays["excluded"][:0]}, attributes


@bug("kept touches are not retracted", replaying, "_chosen")
def _kept_not_retracted(chosen: Any, memory: Any, given: Any, last_sequence: int) -> Any:
    fresh = chosen(memory, given, last_sequence)
    fresh.kept = memory.kept
    return fresh


@bug("a retraction is lost in a merge or in packing", merge, "active_rows")
def _retracted_rows_too(_: Any, heads: Any) -> Any:
    return [head for head in heads if head.kind in (Kind.OBSERVE, Kind.MERGE, Kind.MEMBER)]


@bug("a shared touch is counted twice", merge.Merge, "_there")
def _nothing_there(*_: Any) -> Any:
    return set(), []


@bug("a packed memory is counted twice", merge.Merge, "_summed")
def _nothing_left_out(_: Any, self: Any, whole: Any) -> Any:
    return whole


@bug("a description is lost in a merge", merge.Merge, "_chosen_descriptions")
def _all_but_the_first(described: Any, *given: Any) -> Any:
    return dict(list(described(*given).items())[1:])


@bug("a repair keeps rows behind damage", survey.Survey, "faulty")
def _nothing_behind(faulty: Any, self: Any, first: int, last: int) -> Any:
    return faulty(self, first, last) if first == 1 or last < self.last else []
