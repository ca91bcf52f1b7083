"""A whole store read and verified without changing it: what `check_store` reports, and `repair_store` starts from."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Literal

from scroll_tactile_store.archive import unpacked
from scroll_tactile_store.checkpoint_files import INDEX, CheckpointReader, index_name
from scroll_tactile_store.encoding import decode_payload
from scroll_tactile_store.exceptions import DamageError, NotAStoreError, reported
from scroll_tactile_store.files import store_folder
from scroll_tactile_store.framing import FRAME_BYTES, Frame
from scroll_tactile_store.layout import (
    CHECKPOINT,
    CHECKPOINTS,
    CURRENT_FILE,
    DAMAGED,
    LOG,
    Current,
    NamedCheckpoint,
    checkpoint_path,
    holds_store,
    log_path,
    numbers,
    read_current,
    unnamed,
)
from scroll_tactile_store.log import BEGIN, Log
from scroll_tactile_store.records import JSON, from_json
from scroll_tactile_store.rows import ROW, decode_row, read_head, row_sequence

# Called with what is being done, how many of it are done, and how many there are.
Progress = Callable[[str, int, int], object]
REPORT_EVERY = 256  # batches
ATTEMPTS = 16  # while a writer is at work


@dataclass(frozen=True)
class Problem:
    """Something that is not as it was written. `path` is the file, or the array's folder; `what` says it in words.

    `kind`: "lost" for rows and for what stands for them; "spare" for what is made anew from rows, as other checkpoints
    are; "leftover" for files too many: no damage, and only space.
    """

    path: Path
    what: str
    kind: Literal["lost", "spare", "leftover"]


def check_store(path: str | PathLike[str], *, progress: Progress | None = None) -> list[Problem]:
    """Return all that is wrong with the store at `path`, in a folder or packed; nothing for a sound one.

    It verifies every checksum: `CURRENT`, each frame of the log, each row and its arrays, each array of each
    checkpoint, and what these say of themselves. It changes nothing, and a writer may be at work.
    Where something is a link, a pipe or a device it reads nothing and names that.
    `progress` is called with what is being verified, how many of it are done, and how many there are.

    Raises NotAStoreError where there is no store, VersionError for another format, and another StoreError
    where a file cannot be read for a reason that says nothing against it.
    """
    folder = store_folder(path)
    if os.path.isfile(folder):
        try:
            with unpacked(folder) as inside:
                return [replace(problem, path=folder) for problem in check_store(inside, progress=progress)]
        except DamageError as error:
            return [Problem(folder, str(error), "lost")]
    with reported(folder, "checking the store"):
        try:
            if not holds_store(folder):
                raise NotAStoreError(f"{folder} holds no store")
        except DamageError as error:
            return [Problem(error.path, str(error), "lost")]
        for _ in range(ATTEMPTS):
            survey = Survey(folder, progress or (lambda *_: None))
            survey.close()
            found = survey.problems
            if not found or survey.current == current_of(folder):
                break
        return found + survey.leftovers()


def current_of(folder: Path) -> Current | None:
    """Return what `CURRENT` says; None where it is lost. Raises VersionError."""
    try:
        return read_current(folder / CURRENT_FILE)
    except (DamageError, FileNotFoundError):
        return None


class Survey:
    """All that is found of a store in one pass, and whether it verifies.

    `current` is None where `CURRENT` is lost, or names a log that is gone: then the log of the highest number and all
    checkpoints count. `path` is the log's, and `log` it, None where nothing of it can be read. `rows` are the offsets
    and sizes of its rows' frames by sequence, ascending; `last` is the last sequence of which there is any sign;
    `compacted` the last row whose arrays compaction gave up. `sound` are the checkpoints that recovery can resume from,
    the newest first, `spoilt` the others; `problems` what is damaged. `identity` is None where it is lost. A writer may
    be at work.

    Raises VersionError for another format, and StoreError for a file that cannot be read for a reason that says
    nothing against it.
    """

    def __init__(self, folder: Path, progress: Progress) -> None:
        self.folder, self.progress = folder, progress
        self.problems: list[Problem] = []
        self._faults: list[tuple[int, int, str]] = []  # first row, last row, what is wrong
        self.rows: dict[int, tuple[int, int]] = {}
        self.log: Log | None = None
        self.identity: Mapping[str, JSON] | None = None
        self.current = current = self._found_current()
        self._end, self._is_torn = 0, False  # the last row so far; whether something behind it cannot be read
        self.compacted = 0 if current is None else current.compacted
        self.path = log_path(folder, max(numbers(folder, LOG), default=1) if current is None else current.log)
        try:
            self._read_log()
            self.spoilt: dict[Path, str] = {}
            self.sound: list[NamedCheckpoint] = []
            self._read_checkpoints()
        except BaseException:
            self.close()
            raise
        checkpoints = self.sound if current is None else current.checkpoints
        self.last = max(self._known, self._end + self._is_torn, *(each.last_sequence for each in checkpoints))
        self._note_gap(self.last)
        for _, what in self.faulty(1, self.last):
            self._note(self.path, f"{what} in {self.path}", "lost")
        if self.identity is None:
            self._note(folder, f"nothing in {folder} tells what the store is for", "lost")

    def _note(self, path: Path, what: object, kind: Literal["lost", "spare"]) -> None:
        self.problems.append(Problem(path, str(what), kind))

    def close(self) -> None:
        """Close the log."""
        if self.log is not None:
            self.log.close()

    def _found_current(self) -> Current | None:
        path, self._known = self.folder / CURRENT_FILE, 0
        try:
            current = read_current(path)
            self._known = current.last
            if (log := log_path(self.folder, current.log)).exists():
                return current
            self._note(log, f"{log} is gone, which {path} names", "lost")
        except FileNotFoundError:
            self._note(path, f"{path} is gone", "spare")
        except DamageError as error:
            self._note(path, error, "spare")
        return None

    # The log.

    def _read_log(self) -> None:
        current = self.current
        try:
            log = self.log = Log(self.path, identity=None if current is None else current.log_identity)
        except (DamageError, FileNotFoundError) as error:  # nothing of it is read
            self._note(self.path, error, "lost")
            return
        try:
            if log.header_damage is not None:
                raise log.header_damage
            self.identity = from_json(log.header.decode())
        except (DamageError, ValueError) as error:
            what = f"what {self.path} says that the store is for was never written so: {error}"
            self._note(self.path, what, "spare")
        named = None if current is None else current.newest
        for done, frames in enumerate(log.scan(self._note_damage, None if named is None else named.place)):
            if done % REPORT_EVERY == 0:
                self.progress("batches", done, done)
            self._note_rows(frames)
        if named is not None and not log.has_place(named.place):
            what = f"{self.path} holds no batch that ends where checkpoint {named.number} says"
            self._note(self.path, what, "spare")

    def _note_rows(self, frames: list[Frame]) -> None:
        assert self.log is not None
        for frame in frames:
            if frame.kind != ROW:
                continue
            data = self.log.read(frame.offset, frame.size)
            try:
                if (sequence := row_sequence(data)) <= self._end:
                    raise ValueError(f"row {sequence} follows row {self._end}")
            except ValueError as error:
                self._note(self.path, f"{self.path} has a frame that is no row (byte {frame.offset}): {error}", "lost")
                self._is_torn = True
                continue
            what = None
            try:
                if (payload := decode_row(data)[1]) is not None:
                    decode_payload(payload)
                elif self.current is None:
                    self.compacted = sequence
                elif sequence > self.compacted:
                    raise ValueError("its arrays are missing")
            except ValueError as error:
                what = f"is not as it was written ({error})"
            self._note_row(sequence, frame, what)

    def _note_row(self, sequence: int, frame: Frame, what: str | None) -> None:
        self._note_gap(sequence - 1)
        self.rows[sequence] = frame.offset, frame.size
        self._end, self._is_torn = sequence, False
        if what is not None:
            self._faults.append((sequence, sequence, what))

    def _note_gap(self, last: int) -> None:
        """Note rows that are missing; of compacted ones a repair may have left some out, where nothing is damaged."""
        first = 1 + (self._end if self._is_torn else max(self._end, self.compacted))
        if first <= last:
            self._faults.append((first, last, "is missing"))

    def _note_damage(self, damage: DamageError, before: list[Frame]) -> None:
        """Note a damaged frame: as a row whose arrays are damaged where its head verifies by itself."""
        assert self.log is not None
        self._note_rows(before)
        at = damage.offset or 0
        try:
            found = self.log.frame_at(at)
            if found is not None and found.kind == ROW:
                sequence = read_head(self.log, at, found.size).sequence
                if sequence > self._end:
                    self._note_row(sequence, found, "has arrays that fail their checksum")
                    return
        except (DamageError, ValueError):
            pass
        self._note(self.path, damage, "spare")
        # A frame that ends where the newest checkpoint says is that of a commit, and no row's.
        named = None if self.current is None else self.current.newest
        self._is_torn |= named is None or named.place[:2] != (at + FRAME_BYTES, (damage.frame or 0) + 1)

    def faulty(self, first: int, last: int) -> list[tuple[int, str]]:
        """Return what is wrong with rows `first` to `last`: of each fault the first row, and the words."""
        found = []
        for begin, end, what in self._faults:
            begin, end = max(begin, first), min(end, last)  # noqa: PLW2901
            if begin <= end:
                found.append((begin, f"row {begin} {what}" if begin == end else f"rows {begin} to {end} are missing"))
        return found

    # Checkpoints.

    def _read_checkpoints(self) -> None:
        named: dict[int, NamedCheckpoint | None] = dict.fromkeys(numbers(self.folder, CHECKPOINT))
        if self.current is not None:
            named = {each.number: each for each in self.current.checkpoints}
        for done, (number, expected) in enumerate(sorted(named.items(), reverse=True)):
            self.progress("checkpoints", done, len(named))
            path = checkpoint_path(self.folder, number)
            try:
                self.sound.append(self._sound_checkpoint(path, number, expected))
            except DamageError as damage:
                self.spoilt[path] = str(damage)
                is_compaction = self.current is not None and self.current.compaction == expected
                self._note(damage.path, damage, "lost" if is_compaction else "spare")
        self.sound.sort(key=lambda found: found.last_sequence, reverse=True)

    def _sound_checkpoint(self, path: Path, number: int, expected: NamedCheckpoint | None) -> NamedCheckpoint:
        """Return a checkpoint whose caller's arrays all verify, as it describes itself. Raises DamageError."""
        reader = CheckpointReader(path)
        found = NamedCheckpoint(reader.number, reader.last_sequence, reader.sha256, BEGIN)
        self.identity = reader.identity if self.identity is None else self.identity
        if number != found.number or found != replace(expected or found, place=BEGIN):
            what = f"says that it is checkpoint {found.number}, up to row {found.last_sequence}, and another than was"
            raise DamageError(f"{path} {what} written there", path=path / "zarr.json")
        if reader.identity != self.identity:
            raise DamageError(f"{path} is a checkpoint of another store", path=path)
        index = None if self.log is None else index_name(self.log.identity)
        for name in reader.names:
            if name.startswith(INDEX) and name != index:  # of another log it says nothing
                continue
            try:
                reader.arrays([name])
            except DamageError as damage:
                if name != index:
                    raise
                self._note(damage.path, damage, "spare")  # the log itself has what an index says
        return found

    def leftovers(self) -> list[Problem]:
        """Return the files that are there too many, and who removes them."""
        found = [] if self.current is None else unnamed(self.folder, self.current)
        what = dict.fromkeys(found, "is named by nothing, or is being written: the next writer removes it")
        for parent in (self.folder, self.folder / CHECKPOINTS):
            aside = parent.glob(f"*{DAMAGED}*")
            what |= dict.fromkeys(aside, "was put aside by a repair: remove it when you need it no more")
        return [Problem(path, f"{path} {what[path]}", "leftover") for path in sorted(what)]
