"""A run's notes beside its memories: its plan and what is finished, so that an interrupted run resumes."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scroll_tactile_store.files import new_file

from scroll_tactile.errors import InputError

__all__ = ["RunFile"]

_FORMAT = 1


class RunFile:
    """Notes of one run by name, in a JSON file that is replaced as a whole.

    path: the file; None keeps the notes in memory only. plan: what the run does, in JSON's types.

    Raises InputError for a file of another plan, or one that cannot be read.
    """

    def __init__(self, path: Path | None, plan: Mapping[str, Any]) -> None:
        self.path = path
        self.plan = json.loads(json.dumps(plan))
        self.notes: dict[str, Any] = {}
        if path is None:
            return
        if path.parent.is_file():
            raise InputError(f"expected a folder for the memory; {path.parent} is a file")
        if path.exists():
            self.notes = self._read(path)
        elif path.parent.is_dir() and {entry.name for entry in path.parent.iterdir()} - {_draft(path).name}:
            raise InputError(
                f"{path.parent} holds other things, and no {path.name}: no run to resume. Take an empty folder, or "
                "move this one away"
            )
        else:
            self._write(path)

    def _read(self, path: Path) -> dict[str, Any]:
        try:
            kept = json.loads(path.read_text(encoding="utf-8"))
            version, plan, notes = kept["format"], dict(kept["plan"]), dict(kept["notes"])
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(
                f"expected the notes of a run in {path}; they cannot be read: {error!r:.200}. Move its folder away "
                "to begin anew"
            ) from error
        if version != _FORMAT:
            raise InputError(f"{path} was written in format {version}; this version reads {_FORMAT}")
        differing = [
            f"{name} {plan.get(name)!r} there, {self.plan.get(name)!r} here"
            for name in sorted({*plan, *self.plan})
            if plan.get(name) != self.plan.get(name)
        ]
        if differing:
            raise InputError(
                f"{path.parent} belongs to another run ({'; '.join(differing)}). Ask for the same, take another "
                "folder, or move this one away to begin anew"
            )
        return notes

    def note(self, name: str, value: Any) -> None:
        """Keep a value, in JSON's types, under a name; it is on disk when this returns."""
        self.notes[name] = value
        if self.path is not None:
            self._write(self.path)

    def _write(self, path: Path) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            draft = _draft(path)
            with new_file(draft, "w") as file:  # a link that came with a folder of others leads to any file
                json.dump({"format": _FORMAT, "plan": self.plan, "notes": self.notes}, file, indent=1)
                file.flush()
                os.fsync(file.fileno())
            draft.replace(path)
        except OSError as error:
            raise InputError(
                f"{path} cannot be written: {error.strerror}. What was noted before is kept: make room, or take "
                "another folder, and start again"
            ) from error


def _draft(path: Path) -> Path:
    return path.with_name(path.name + ".new")
