"""A run's notes beside its memories: its plan and what is finished, so that an interrupted run resumes."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from scroll_tactile_store import LockedError
from scroll_tactile_store.files import new_file

from scroll_tactile.errors import InputError

try:
    import fcntl
except ImportError:  # Windows has none
    flock = None
else:
    flock = fcntl.flock

__all__ = ["RunFile", "alone_in"]

_FORMAT = 1
BEGIN = "Move its folder away to begin anew"
TRIES = 100  # to lock a folder that others remove as they end


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
        if path.parent.exists() and not path.parent.is_dir():
            raise InputError(f"expected a folder for the memory; {path.parent} is a file")
        if path.exists():
            self.notes = self._read(path)
        elif path.parent.is_dir() and {entry.name for entry in path.parent.iterdir()} - {_draft(path).name}:
            raise InputError(
                f"{path.parent} holds other things, and no {path.name}: no run to resume. Take an empty folder, or "
                "move this one away"
            )
        else:
            self._write()

    def _read(self, path: Path) -> dict[str, Any]:
        if not path.is_file():  # a pipe would be waited for
            raise InputError(f"expected the notes of a run in {path}; it is no file: move it away")
        try:
            kept = json.loads(path.read_text(encoding="utf-8"))
            plan, notes = kept["plan"], kept["notes"]
            version = kept["format"]
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(
                f"expected the notes of a run in {path}; they cannot be read: {error!r:.200}. {BEGIN}"
            ) from error
        if not isinstance(plan, dict):
            raise InputError(f"expected the notes of a run in {path}; its plan is a {type(plan).__name__}. {BEGIN}")
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
        if not isinstance(notes, dict):
            raise InputError(f"expected the notes of a run in {path}; they are a {type(notes).__name__}. {BEGIN}")
        return notes

    def note(self, name: str, value: Any) -> None:
        """Keep a value, in JSON's types, under a name; it is on disk when this returns."""
        self.notes[name] = value
        if self.path is not None:
            self._write()

    def _write(self) -> None:
        assert self.path is not None
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            draft = _draft(self.path)
            with new_file(draft, "w") as file:  # a link that came with a folder of others leads to any file
                json.dump({"format": _FORMAT, "plan": self.plan, "notes": self.notes}, file, indent=1)
                file.flush()
                os.fsync(file.fileno())
            draft.replace(self.path)
        except OSError as error:
            raise InputError(
                f"{self.path} cannot be written: {error.strerror}. What was noted before is kept: make room, or take "
                "another folder, and start again"
            ) from error


@contextmanager
def alone_in(folder: Path, destination: Path) -> Iterator[None]:
    """Keep other runs out of the folder of one, which is made; where the system has no locks nothing does.

    An empty folder is removed again. Raises LockedError where another run is in it, for this destination.
    """
    descriptor = _locked(folder, destination)
    try:
        yield
    finally:
        if descriptor is not None:
            with suppress(OSError):
                folder.rmdir()
            os.close(descriptor)


def _locked(folder: Path, destination: Path) -> int | None:
    """The folder, made and locked; None where that cannot be. Raises LockedError."""
    descriptor = None
    for _ in range(TRIES):
        with suppress(OSError):  # what is wrong with it is raised where notes are written
            folder.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(folder, os.O_RDONLY)
        if descriptor is None or flock is None:
            break
        try:
            flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(descriptor)
            raise LockedError(
                f"another run is at work for {destination}, in {folder}: wait until it has ended, or take another "
                "destination"
            ) from error
        except OSError:
            break
        with suppress(OSError):  # where it is not there, another run ended meanwhile, and removed it
            if os.path.samestat(os.fstat(descriptor), folder.stat()):
                break
        os.close(descriptor)
        descriptor = None
    return descriptor


def _draft(path: Path) -> Path:
    return path.with_name(path.name + ".new")
