"""A whole store read and verified without changing it: what `check_store` reports, and `repair_store` starts from."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Literal

from scroll_tactile_store.archive import unpacked
from scroll_tactile_store.checkpoint_files import CheckpointReader
from scroll_tactile_store.encoding import decode_payload
from scroll_tactile_store.exceptions import DamageError, NotAStoreError, reported
from scroll_tactile_store.files import is_file, store_folder
from scroll_tactile_store.framing import FRAME_BYTES, Frame, LogPlace
from scroll_tactile_store.layout import (
    CHECKPOINTS,
    CURRENT_FILE,
    DAMAGED,
    LOG,
    NEW,
    PARTIAL,
    Current,
    NamedCheckpoint,
    checkpoint_path,
    holds_store,
    log_numbers,
    log_path,
    numbers,
    read_current,
    unsafe_entries,
)
from scroll_tactile_store.log import BEGIN, Log
from scroll_tactile_store.records import JSON, Head, from_json
from scroll_tactile_store.rows import ROW, decode_row, read_head, row_sequence

# Called with what is being done, how many of it are done, and how many there are.
Progress = Callable[[str, int, int], object]
REPORT_EVERY = 256  # batches
ATTEMPTS = 4  # while a writer is at work

# What can be wrong with a row, as it is said of one and of several.
MISSING = ("is missing", "are missing")
HEADLESS = ("fails its checksum", "fail their checksums")
NO_ARRAYS = ("has lost its arrays", "have lost their arrays")
DAMAGED_ARRAYS = ("has arrays that fail their checksum", "have arrays that fail their checksums")
FOREIGN_ARRAYS = ("has arrays that were never written so", "have arrays that were never written so")
Words = tuple[str, str]


@dataclass(frozen=True)
class Problem:
    """Something that is not as it was written. `path` is the file, or the array's folder; `what` says it in words.

    `kind`: "lost" where nothing else in the store holds what was there; "spare" where something does, or
    where no content is concerned; "leftover" for files too many: no damage, and only space.
    """

    path: Path
    what: str
    kind: Literal["lost", "spare", "leftover"]


def check_store(path: str | PathLike[str], *, progress: Progress | None = None) -> list[Problem]:
    """Return all that is wrong with the store at `path`, in a folder or packed; nothing for a sound one.

    It verifies every checksum: `CURRENT`, each frame of the log, each row and its arrays, each array of each
    checkpoint, and what these say of themselves. It changes nothing, and a writer may be at work.
    Where something is a link, a pipe or a device it reads nothing and names these.
    `progress` is called with what is being verified, how many of it are done, and how many there are.

    Raises NotAStoreError where there is no store, VersionError for another format, and another StoreError
    where a file cannot be read for a reason that says nothing against it.
    """
    folder = store_folder(path)
    if is_file(folder):
        try:
            with unpacked(folder) as inside:
                return [replace(problem, path=folder) for problem in check_store(inside, progress=progress)]
        except DamageError as error:
            return [Problem(folder, str(error), "lost")]
    with reported(folder, "checking the store"):
        require_store(folder)
        if strange := [Problem(error.path, str(error), "lost") for error in unsafe_entries(folder)]:
            return strange
        for _ in range(ATTEMPTS):
            survey = Survey(folder, progress or (lambda *_: None))
            try:
                found = survey.problems() + list(survey.leftovers())
            finally:
                survey.log.close()
            if not any(problem.kind != "leftover" for problem in found) or not survey.moved():
                break
        return found


def require_store(folder: Path) -> None:
    """Return where `folder` holds a store, or what is left of one. Raises NotAStoreError and VersionError."""
    try:
        if not holds_store(folder):
            raise NotAStoreError(f"{folder} holds no store")
    except DamageError:
        return


@dataclass(frozen=True)
class FoundRow:
    """A row as it was found; fault: what is wrong with it. offset, size: of its frame."""

    offset: int
    size: int
    has_arrays: bool
    fault: Words | None = None


class FoundLog:
    """A log as it was found: its rows by sequence, ascending, and what is wrong with it beside these.

    path: the log, or what an interrupted repair left of it. identity: the store's, None where that is lost. compacted:
    the last row without arrays. torn: rows behind which there was something that cannot be read. durable: as of
    `Log.scan`.
    """

    def __init__(self, path: Path, identity: bytes | None, progress: Progress, durable: LogPlace | None = None) -> None:
        self.path, self.damage, self._durable = path, list[str](), durable
        self.identity: dict[str, JSON] | None = None
        self.rows, self.torn = dict[int, FoundRow](), set[int]()
        self.last = self.compacted = 0
        self.log: Log | None = None
        try:
            self.log = Log(path, identity=identity or b"")
            if identity not in (None, self.log.identity):
                self.close()
                what = f"{path} is the log of another store, or of another time: nothing of it was read"
                raise DamageError(what, path=path)
            self._read(self.log, progress)
        except FileNotFoundError:
            self.damage.append(f"{path} is gone")
        except DamageError as error:  # nothing more of the file can be read
            self.damage.append(str(error))
        except BaseException:
            self.close()
            raise

    def _read(self, log: Log, progress: Progress) -> None:
        try:
            if log.header_damage is not None:
                raise log.header_damage
            self.identity = from_json(log.header.decode())
        except (DamageError, ValueError) as error:
            self.damage.append(f"what {self.path} says that the store is for was never written so: {error}")
        for done, frames in enumerate(log.scan(lambda *damage: self._note_damage(log, *damage), self._durable)):
            if done % REPORT_EVERY == 0:
                progress("batches", done, done)
            for frame in frames:
                self._note_row(log, frame)

    def _note_damage(self, log: Log, damage: DamageError, before: list[Frame]) -> None:
        """Note a damaged frame: as a row with a fault where its first bytes still say which."""
        for frame in before:
            self._note_row(log, frame)
        at, number = damage.offset or 0, damage.frame or 0
        try:
            found = log.frame_at(at)
            if found is not None and found.kind == ROW:
                head = read_head(log, at, found.size)
                if head.sequence > self.last:
                    self._note(head.sequence, FoundRow(at, found.size, True, DAMAGED_ARRAYS))
                    return
        except (DamageError, ValueError):
            pass
        self.damage.append(str(damage))
        if self._durable is None or self._durable[:2] != (at + FRAME_BYTES, number + 1):  # that is no row's frame
            self.torn.add(self.last)

    def _note_row(self, log: Log, frame: Frame) -> None:
        if frame.kind != ROW:
            return
        data, row = log.read(frame.offset, frame.size), FoundRow(frame.offset, frame.size, True)
        try:
            if (sequence := row_sequence(data)) <= self.last:
                raise ValueError(f"row {sequence} follows row {self.last}")
        except ValueError as error:
            self.damage.append(f"{self.path} has a frame that is no row (byte {frame.offset}): {error}")
            self.torn.add(self.last)
            return
        fault = HEADLESS
        try:
            payload, fault = decode_row(data).payload, FOREIGN_ARRAYS
            if payload is None:
                self.compacted, row = sequence, replace(row, has_arrays=False)
            else:
                decode_payload(payload)
        except ValueError:
            row = replace(row, fault=fault)
        self._note(sequence, row)

    def _note(self, sequence: int, row: FoundRow) -> None:
        self.rows[sequence], self.last = row, sequence

    def data(self, sequence: int) -> bytes:
        """Return the bytes of a row, verified once more. Raises DamageError."""
        assert self.log is not None
        return self.log.read(self.rows[sequence].offset, self.rows[sequence].size)

    def head(self, sequence: int) -> Head:
        """Return the head of a row. Raises DamageError, and ValueError where it does not verify."""
        assert self.log is not None
        return read_head(self.log, self.rows[sequence].offset, self.rows[sequence].size)

    def close(self) -> None:
        """Close the file."""
        if self.log is not None:
            self.log.close()
            self.log = None


@dataclass
class FoundCheckpoint:
    """A checkpoint as it was found, as `CURRENT` names it, or, where that is lost, as it describes itself.

    named: None where neither is readable. damage: what keeps it from being used. identity: of the store.
    """

    folder: Path
    named: NamedCheckpoint | None
    damage: list[DamageError]
    identity: Mapping[str, JSON] | None = None

    @property
    def last_sequence(self) -> int:
        """The last row that it contains, -1 where nobody knows."""
        return -1 if self.named is None else self.named.last_sequence


class Survey:
    """All that is found of a store, and whether it verifies.

    `current` is None where `CURRENT` is lost; `identity` where that is. `compacted` is the last row whose arrays
    compaction gave up, whether its checkpoint is sound or not. `sound` are the checkpoints that recovery can resume
    from, the newest first. `last` is the last sequence of which there is any sign; `faults` are
    the rows that do not verify, as (first, last, words), ascending. A writer may be at work meanwhile. Raises
    VersionError for another format, and StoreError for a file that cannot be read for a reason that says nothing
    against it.
    """

    def __init__(self, folder: Path, progress: Progress) -> None:
        self.folder, self.progress = folder, progress
        self.current: Current | None = None
        self.damage: list[Problem] = []
        try:
            self.current = read_current(folder / CURRENT_FILE)
        except FileNotFoundError:
            self._note_spare(folder / CURRENT_FILE, f"{folder / CURRENT_FILE} is gone")
        except DamageError as error:
            self._note_spare(error.path, str(error))
        self.checkpoints = list(self._found_checkpoints())
        self._sort_sound()
        self.log = self._found_log()
        self.identity: Mapping[str, JSON] | None = self.log.identity
        if self.identity is None and self.sound:
            self.identity = self.sound[0].identity
        for found in self.sound:
            if found.identity != self.identity:
                found.damage.append(DamageError(f"{found.folder} is a checkpoint of another store", path=found.folder))
        self._sort_sound()
        self.compacted = self.log.compacted if self.current is None else self.current.compacted
        self._find_faults()

    def _note_spare(self, path: Path, what: str) -> None:
        self.damage.append(Problem(path, what, "spare"))

    def _sort_sound(self) -> None:
        found = [found for found in self.checkpoints if not found.damage]
        self.sound = sorted(found, key=lambda found: (found.last_sequence, found.folder), reverse=True)

    def _found_checkpoints(self) -> Iterator[FoundCheckpoint]:
        named: dict[int, NamedCheckpoint | None] = dict.fromkeys(numbers(self.folder))
        if self.current is not None:
            named = {named.number: named for named in self.current.checkpoints}
        for done, (number, expected) in enumerate(named.items()):
            self.progress("checkpoints", done, len(named))
            path = checkpoint_path(self.folder, number)
            try:
                reader = CheckpointReader(path)
                own = NamedCheckpoint(reader.number, reader.last_sequence, reader.sha256, BEGIN)
                if own.number != number or own != replace(expected or own, place=BEGIN):
                    what = f"{path} says that it is checkpoint {own.number}, up to row {own.last_sequence}, and another"
                    raise DamageError(f"{what} than was written there", path=path / "zarr.json")
                for each in () if self.current is None else reader.damage(self.current.log_identity):
                    self._note_spare(each.path, str(each))  # the log itself has what an index says
                yield FoundCheckpoint(path, expected or own, list(reader.damage()), reader.identity)
            except DamageError as wrong:
                yield FoundCheckpoint(path, expected, [wrong])

    def _found_log(self) -> FoundLog:
        """Return the log that counts; where that is gone, or nobody knows which it was, the one that tells most.

        Of logs whose compacted rows no checkpoint stands for there is none to go on from.
        """
        named = log_path(self.folder, 1 if self.current is None else self.current.log)
        there = [log_path(self.folder, number) for number in log_numbers(self.folder)]
        if self.current is not None:
            put_aside = named.with_name(named.name + DAMAGED)  # by an interrupted repair
            for path in (named, put_aside):
                if path.exists():
                    durable = None if self.current.newest is None else self.current.newest.place
                    return FoundLog(path, self.current.log_identity, self.progress, durable)
        else:
            there = there or sorted(self.folder.glob(f"{LOG}*{DAMAGED}*"))[-1:]
        newest = self.sound[0].last_sequence if self.sound else 0
        found = [FoundLog(path, None, self.progress) for path in there]
        # Of two that tell as much the newer: the other may be what a compaction replaced.
        best = max(reversed(found), key=lambda log: (log.compacted <= newest, log.last), default=None)
        for log in found:
            if log is not best:
                log.close()
        if self.current is not None and best is not None:
            self.damage.append(Problem(named, f"{named} is gone: {best.path} is what was before it", "lost"))
        return best or FoundLog(named, None, self.progress)

    def _find_faults(self) -> None:
        self.faults: list[tuple[int, int, Words]] = []
        before = 0
        for sequence, row in self.log.rows.items():
            self._note_gap(before, sequence - 1)
            if row.fault is HEADLESS or (row.fault is not None and sequence > self.compacted):
                self._note_fault(sequence, sequence, row.fault)
            elif sequence > self.compacted and not row.has_arrays:
                self._note_fault(sequence, sequence, NO_ARRAYS)
            before = sequence
        known = 0 if self.current is None else self.current.last
        self.last = max(before, known, *(found.last_sequence for found in self.checkpoints), 0)
        if before in self.log.torn:
            self.last = max(self.last, before + 1)
        self._note_gap(before, self.last)

    def _note_gap(self, before: int, last: int) -> None:
        """Note rows that are missing; of compacted ones a repair may have left some out, where nothing is damaged."""
        first = before + 1 if before in self.log.torn else max(before, self.compacted) + 1
        if first <= last:
            self._note_fault(first, last, MISSING)

    def _note_fault(self, first: int, last: int, words: Words) -> None:
        if self.faults and self.faults[-1][1:] == (first - 1, words):
            first = self.faults.pop()[0]
        self.faults.append((first, last, words))

    def faulty(self, first: int, last: int) -> list[tuple[int, str]]:
        """Return the faults of rows `first` to `last`, cut off at these: the first row of each, and what is wrong."""
        found = []
        for since, until, words in self.faults:
            begin, end = max(since, first), min(until, last)
            if begin <= end:
                which = f"row {begin} {words[0]}" if begin == end else f"rows {begin} to {end} {words[1]}"
                found.append((begin, which))
        return found

    @property
    def compaction(self) -> FoundCheckpoint | None:
        """The sound checkpoint that stands for the compacted rows."""
        stands = (found for found in self.sound if found.last_sequence == self.compacted)
        return next(stands, None) if self.compacted else None

    def moved(self) -> bool:
        """Whether a writer has committed something since."""
        try:
            return read_current(self.folder / CURRENT_FILE) != self.current
        except (DamageError, FileNotFoundError):
            return False

    def problems(self) -> list[Problem]:
        """Return what is damaged."""
        log, found = self.log, list(self.damage)
        is_lost = log.identity is None and not log.rows
        found += [Problem(log.path, what, "lost" if is_lost else "spare") for what in log.damage]
        found += [Problem(log.path, f"{what} in {log.path}", "lost") for _, what in self.faulty(1, self.last)]
        for checkpoint in self.checkpoints:
            if self.current is not None or checkpoint.named is not None:
                kind: Literal["lost", "spare"] = "spare" if self._is_spare(checkpoint) else "lost"
                found += [Problem(damage.path, str(damage), kind) for damage in checkpoint.damage]
        for named in () if self.current is None else self.current.checkpoints:
            if log.log is not None and not log.log.has_place(named.place):
                what = f"{log.path} holds no batch that ends where checkpoint {named.number} says"
                found.append(Problem(log.path, what, "spare"))
        if self.identity is None:
            found.append(Problem(self.folder, f"nothing in {self.folder} tells what the store is for", "lost"))
        return found

    def _is_spare(self, checkpoint: FoundCheckpoint) -> bool:
        """Return whether the state that a checkpoint holds can be had without it."""
        last_sequence = self.last if checkpoint.named is None else checkpoint.last_sequence
        starts = {other.last_sequence for other in self.sound if other is not checkpoint}
        compaction = None if self.current is None else self.current.compaction
        if compaction is not None and last_sequence == self.compacted and checkpoint.named == compaction:
            return last_sequence in starts
        starts |= set() if self.compacted else {0}
        return any(not self.faulty(start + 1, last_sequence) for start in starts if start >= self.compacted)

    def leftovers(self) -> Iterator[Problem]:
        """Yield the files that are there too many, and who removes them."""
        known = {found.folder for found in self.checkpoints} | {self.log.path}
        ours = {log_path(self.folder, number) for number in log_numbers(self.folder)}
        ours |= {checkpoint_path(self.folder, number) for number in numbers(self.folder)}
        parent = self.folder / CHECKPOINTS
        for path in sorted([*self.folder.iterdir(), *(parent.iterdir() if parent.is_dir() else ())]):
            if DAMAGED in path.name:
                what = "was put aside by a repair: remove it when you need it no more"
            elif path.name.endswith((NEW, PARTIAL)):
                what = "was, or is being, written: the next writer removes it"
            elif path in ours - known:
                what = "is named by nothing: the next writer removes it"
            else:
                continue
            yield Problem(path, f"{path} {what}", "leftover")
