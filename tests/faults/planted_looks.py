"""Bugs in what is read: what is not looked at, and believed."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from faults.planting import Patches, nothing
from store import backup, checkpoint_files, checkpoints, chunks, journal, layout, log, rows


def _payload_not_looked_at(patch: Patches) -> None:
    def make(_: Any) -> Any:
        return lambda self, frame: self._file.read(frame.payload_offset, frame.size)

    def make_init(init: Any) -> Any:
        def begun(self: Any, path: Any, **named: Any) -> None:
            init(self, path, **named)
            self.payloads = False

        return begun

    patch(log.LogReader, "_payload", make)
    patch(log.LogReader, "__init__", make_init)


def _current_not_looked_at(patch: Patches) -> None:
    def make(read: Any) -> Any:
        def found(cls: Any, data: bytes, path: Path) -> Any:
            known = None
            try:
                known = json.loads(data)
                known.pop("sha256")
                text = json.dumps(known | {"sha256": layout.json_digest(known)}).encode()
            except (ValueError, KeyError, AttributeError, TypeError):
                text = data
            return read(cls, text, path)

        return found

    # What a checkpoint says of itself is compared with what CURRENT says of it. That alone lets one bit in 3900 pass.
    def make_verified(_: Any) -> Any:
        return lambda self, named: checkpoint_files.CheckpointReader(
            layout.checkpoint_path(self._folder, named.number), self._files
        )

    patch(layout.Current, "from_bytes", make)
    patch(checkpoints.Checkpoints, "_verified", make_verified)


class _Same(str):
    """A text that is the same as any other."""

    __slots__ = ()
    __hash__ = str.__hash__

    def __eq__(self, _: object) -> bool:
        return True

    def __ne__(self, _: object) -> bool:
        return False


class _Sum:
    """A checksum that is the same as any other."""

    def __init__(self, data: bytes) -> None:
        self._text = hashlib.sha256(data).hexdigest()

    def hexdigest(self) -> str:
        return _Same(self._text)


def _chunk_not_looked_at(patch: Patches) -> None:
    patch(chunks, "hashlib", lambda _: SimpleNamespace(sha256=_Sum))


def _description_not_looked_at(patch: Patches) -> None:
    patch(checkpoint_files, "json_digest", lambda digest: lambda known: _Same(digest(known)))


def _torn_taken_for_committed(patch: Patches) -> None:
    def make(scan: Any) -> Any:
        def scanned(self: Any) -> Any:
            batch, torn = scan(self)
            return ([*batch, batch[-1]], None) if torn is not None and batch else (batch, torn)

        return scanned

    patch(log.LogReader, "_scan", make)


def _other_log_not_noticed(patch: Patches) -> None:
    def make(_: Any) -> Any:
        def renewed(self: Any, at: Any) -> Any:
            at.catch_up()
            return at

        return renewed

    patch(journal.Journal, "_renewed", make)


def _index_of_another_log(patch: Patches) -> None:
    def make(decoded: Any) -> Any:
        def believed(self: Any, path: Path, data: bytes) -> Any:
            self._identity = rows.HEADER.unpack_from(data)[1]
            segment, found = decoded(self, path, data)
            return dataclasses.replace(segment, begin=self.end), found

        return believed

    def make_read(read: Any) -> Any:
        return lambda self, log, until: read(self, SimpleNamespace(has_place=lambda _: True), until)

    patch(rows.Index, "_decoded", make)
    patch(rows.Index, "read", make_read)


def _backup_looks_once(patch: Patches) -> None:
    def make(_: Any) -> Any:
        def copy(source: Path, draft: Path) -> None:
            current = layout.read_current(source / "CURRENT")
            with suppress(FileNotFoundError):
                backup._copy_named(source, draft, current)
            layout.write_current(draft, layout.read_current(source / "CURRENT"))

        return copy

    patch(backup, "_copy", make)
    patch(backup, "_verify", nothing)


LOOKS: dict[str, Callable[[Patches], None]] = {
    "a frame's payload is not verified": _payload_not_looked_at,
    "CURRENT is not verified": _current_not_looked_at,
    "a chunk is not verified": _chunk_not_looked_at,
    "what a checkpoint says of itself is not verified": _description_not_looked_at,
    "a torn batch is taken": _torn_taken_for_committed,
    "a reader does not notice another log": _other_log_not_noticed,
    "an index of another log is believed": _index_of_another_log,
    "a backup does not look at CURRENT again": _backup_looks_once,
}
