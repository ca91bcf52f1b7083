"""A whole store read and verified without changing it: what `check_store` reports, and `repair_store` starts from."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Literal

from scroll_tactile_store.archive import unpacked
from scroll_tactile_store.checkpoint_files import CheckpointReader
from scroll_tactile_store.encoding import decode_payload
from scroll_tactile_store.exceptions import DamageError, NotAStoreError, VersionError, reported
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

__all__ = ["Fault", "FoundCheckpoint", "Problem", "Progress", "Survey", "check_store", "require_store"]

# Called with what is being done, how many of it are done, and how many there are.
Progress = Callable[[str, int, int], object]
REPORT_EVERY = 256  # batches
ATTEMPTS = 4


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


class Fault(enum.Enum):
    """A fault of a row; its value: the words for one row, and for several."""

    MISSING = ("is missing", "are missing")
    DAMAGED = ("fails its checksum", "fail their checksums")
    NO_ARRAYS = ("has lost its arrays", "have lost their arrays")
    DAMAGED_ARRAYS = ("has arrays that fail their checksum", "have arrays that fail their checksums")
    FOREIGN_ARRAYS = ("has arrays that were never written so", "have arrays that were never written so")

    def describe(self, first: int, last: int) -> str:
        """Return in words that rows `first` to `last` have this fault."""
        return f"row {first} {self.value[0]}" if first == last else f"rows {first} to {last} {self.value[1]}"


class FoundLog:
    """A log as it was found: the sequences of its rows, each with what is wrong with it, and other damage.

    path: the log, or what an interrupted repair left of it. identity: the store's, None where that is lost. rows: by
    sequence, ascending. compacted: the last row without arrays. torn: rows behind which there was something that cannot
    be read. damage: what is wrong with it but for rows. durable: as of `Log.scan`.
    """

    def __init__(self, path: Path, identity: bytes | None, progress: Progress, durable: LogPlace | None = None) -> None:
        self.path, self.damage, self._durable = path, list[str](), durable
        self.identity: dict[str, JSON] | None = None
        self.rows: dict[int, Fault | None] = {}
        self.torn, self.without_arrays = set[int](), set[int]()
        self.last = self.compacted = 0
        self._frames: dict[int, tuple[int, int]] = {}
        self.log: Log | None = None
        try:
            log = Log(path, identity=identity or b"")
        except FileNotFoundError:
            self.damage.append(f"{path} is gone")
            return
        except DamageError as error:
            self.damage.append(str(error))
            return
        if identity is not None and log.identity != identity:
            self.damage.append(f"{path} is the log of another store, or of another time: nothing of it was read")
            log.close()
            return
        self.log = log
        try:
            self._read(log, progress)
        except DamageError as error:  # nothing more of the file can be read
            self.damage.append(str(error))
        except BaseException:
            self.close()
            raise

    def _read(self, log: Log, progress: Progress) -> None:
        if log.header_damage is not None:
            self.damage.append(str(log.header_damage))
        else:
            try:
                self.identity = from_json(log.header.decode())
            except ValueError as error:
                self.damage.append(f"the identity in {self.path} was never written so: {error}")
        for done, frames in enumerate(log.scan(self._note_damage, self._durable)):
            if done % REPORT_EVERY == 0:
                progress("batches", done, done)
            for frame in frames:
                self._note_row(frame)

    def _note_damage(self, damage: DamageError, before: list[Frame]) -> None:
        """Note a damaged frame: as a row with a fault where its first bytes still say which."""
        for frame in before:
            self._note_row(frame)
        assert self.log is not None and damage.offset is not None and damage.frame is not None
        try:
            found = self.log.frame_at(damage.offset)
            if found is not None and found.kind == ROW:
                head = read_head(self.log, found.offset, found.size)
                if head.sequence > self.last:
                    self._note(head.sequence, found, Fault.DAMAGED_ARRAYS)
                    return
        except (DamageError, ValueError):
            pass
        self.damage.append(str(damage))
        is_commit = self._durable is not None and self._durable[:2] == (damage.offset + FRAME_BYTES, damage.frame + 1)
        if not is_commit:  # which is no row
            self.torn.add(self.last)

    def _note_row(self, frame: Frame) -> None:
        if frame.kind != ROW:
            return
        assert self.log is not None
        try:
            data = self.log.read(frame.offset, frame.size)
            if (sequence := row_sequence(data)) <= self.last:
                raise ValueError(f"row {sequence} follows row {self.last}")
        except (DamageError, ValueError) as error:
            self.damage.append(f"{self.path} has a frame that is no row (byte {frame.offset}): {error}")
            self.torn.add(self.last)
            return
        fault = None
        try:
            payload = decode_row(data).payload
            if payload is None:
                self.without_arrays.add(sequence)
                self.compacted = sequence
            elif not _is_readable(payload):
                fault = Fault.FOREIGN_ARRAYS
        except ValueError:
            fault = Fault.DAMAGED
        self._note(sequence, frame, fault)

    def _note(self, sequence: int, frame: Frame, fault: Fault | None) -> None:
        self.rows[sequence], self._frames[sequence], self.last = fault, (frame.offset, frame.size), sequence

    def data(self, sequence: int) -> bytes:
        """Return the bytes of a row, verified once more. Raises DamageError."""
        assert self.log is not None
        return self.log.read(*self._frames[sequence])

    def head(self, sequence: int) -> Head:
        """Return the head of a row. Raises DamageError where that does not verify."""
        assert self.log is not None
        try:
            return read_head(self.log, *self._frames[sequence])
        except ValueError as error:
            what = f"the head of row {sequence} is not as it was written ({error})"
            raise DamageError(f"{what} in {self.path}", path=self.path, sequence=sequence) from error

    def close(self) -> None:
        """Close the file."""
        if self.log is not None:
            self.log.close()


def _is_readable(payload: bytes) -> bool:
    """Whether a payload is what `encode_payload` makes; one of a newer release counts."""
    try:
        decode_payload(payload)
    except VersionError:
        return True
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class FoundCheckpoint:
    """A checkpoint as it was found. `named` is as `CURRENT` has it, or, where that is lost, as it describes itself.

    `named` is None where neither is readable. `damage` is what keeps it from being used.
    """

    number: int
    folder: Path
    named: NamedCheckpoint | None
    is_compaction: bool
    damage: list[DamageError]
    identity: dict[str, JSON] | None

    @property
    def sound(self) -> bool:
        """Whether recovery can resume from it."""
        return not self.damage

    @property
    def last_sequence(self) -> int:
        """The last row that it contains, -1 where nobody knows."""
        return -1 if self.named is None else self.named.last_sequence


class Survey:
    """All that is found of a store, and whether it verifies.

    `current` is None where `CURRENT` is lost; `identity` where that is. `compacted` is the last row whose arrays
    compaction gave up, whether its checkpoint is sound or not. `sound` are the checkpoints that recovery can resume
    from, the newest first. `last` is the last sequence of which there is any sign; `faults` are
    the rows that do not verify, as (first, last, fault), ascending. A writer may be at work meanwhile. Raises
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
            path = self.folder / CURRENT_FILE
            self.damage.append(Problem(path, f"{path} is gone", "spare"))
        except DamageError as error:
            self.damage.append(Problem(error.path, str(error), "spare"))
        self.checkpoints = list(self._found())
        self._sort_sound()
        self.log = self._found_log()
        self.identity = self.log.identity
        if self.identity is None and self.sound:
            self.identity = self.sound[0].identity
        self._drop_foreign()
        self.compacted = self.log.compacted if self.current is None else self.current.compacted
        self._find_faults()

    def _found(self) -> Iterator[FoundCheckpoint]:
        named: dict[int, NamedCheckpoint | None]
        if self.current is None:
            named = dict.fromkeys(numbers(self.folder))
        else:
            named = {named.number: named for named in self.current.checkpoints}
        for done, (number, expected) in enumerate(named.items()):
            self.progress("checkpoints", done, len(named))
            yield self._examine(number, expected)

    def _examine(self, number: int, named: NamedCheckpoint | None) -> FoundCheckpoint:
        path = checkpoint_path(self.folder, number)
        compaction = None if self.current is None else self.current.compaction
        is_compaction = compaction is not None and compaction.number == number
        try:
            reader = CheckpointReader(path)
            found = NamedCheckpoint(reader.number, reader.last_sequence, reader.sha256, BEGIN)
            expected = found if named is None else named
            if (found.number, found.last_sequence, found.sha256) != (number, expected.last_sequence, expected.sha256):
                raise DamageError(
                    f"{path} says that it is checkpoint {found.number}, up to row {found.last_sequence}, and another "
                    "than was written there",
                    path=path / "zarr.json",
                )
            if self.current is not None:  # the log itself has what an index says
                index = reader.damage(self.current.log_identity)
                self.damage += [Problem(each.path, str(each), "spare") for each in index]
            return FoundCheckpoint(number, path, expected, is_compaction, list(reader.damage()), dict(reader.identity))
        except DamageError as wrong:
            return FoundCheckpoint(number, path, named, is_compaction, [wrong], None)

    def _found_log(self) -> FoundLog:
        """Return the log that counts; where that is gone, or nobody knows which it was, the one that tells most.

        Of logs whose compacted rows no checkpoint stands for there is none to go on from.
        """
        named, aside = log_path(self.folder, 1), list[Path]()
        if self.current is None:
            aside = sorted(self.folder.glob(f"{LOG}*{DAMAGED}*"))
        else:
            named = log_path(self.folder, self.current.log)
            put_aside = named.with_name(named.name + DAMAGED)  # by an interrupted repair
            if not named.exists() and put_aside.exists():
                named = put_aside
            if named.exists():
                durable = None if self.current.newest is None else self.current.newest.place
                return FoundLog(named, self.current.log_identity, self.progress, durable)
        there = [log_path(self.folder, number) for number in log_numbers(self.folder)]
        newest = self.sound[0].last_sequence if self.sound else 0
        found = [FoundLog(path, None, self.progress) for path in there or aside[-1:]]
        # Of two that tell as much the newer: the other may be what a compaction replaced.
        best = max(reversed(found), key=lambda log: (log.compacted <= newest, log.last), default=None)
        for log in found:
            if log is not best:
                log.close()
        if self.current is not None and best is not None:
            self.damage.append(Problem(named, f"{named} is gone: {best.path} is what was before it", "lost"))
        return best or FoundLog(named, None, self.progress)

    def _drop_foreign(self) -> None:
        """Where a checkpoint is another store's it does not count."""
        for i, found in enumerate(self.checkpoints):
            if found.sound and found.identity != self.identity:
                wrong = DamageError(f"{found.folder} is a checkpoint of another store", path=found.folder)
                self.checkpoints[i] = replace(found, damage=[wrong], identity=None)
        self._sort_sound()

    def _find_faults(self) -> None:
        known = 0 if self.current is None else self.current.last
        self.faults: list[tuple[int, int, Fault]] = []
        before = 0
        for sequence, fault in self.log.rows.items():
            self._note_gap(before, sequence - 1)
            if fault is not None and not (fault is not Fault.DAMAGED and sequence <= self.compacted):
                self._note(sequence, sequence, fault)
            elif sequence > self.compacted and sequence in self.log.without_arrays:
                self._note(sequence, sequence, Fault.NO_ARRAYS)
            before = sequence
        self.last = max([before, known, *(found.last_sequence for found in self.checkpoints)])
        if before in self.log.torn:
            self.last = max(self.last, before + 1)
        self._note_gap(before, self.last)

    def _note_gap(self, before: int, last: int) -> None:
        """Note rows that are missing; of compacted ones a repair may have left some out, where nothing is damaged."""
        first = before + 1 if before in self.log.torn else max(before, self.compacted) + 1
        if first <= last:
            self._note(first, last, Fault.MISSING)

    def _note(self, first: int, last: int, fault: Fault) -> None:
        if self.faults and self.faults[-1][1] == first - 1 and self.faults[-1][2] is fault:
            first = self.faults.pop()[0]
        self.faults.append((first, last, fault))

    def faulty(self, first: int, last: int) -> list[tuple[int, int, Fault]]:
        """Return the faults of rows `first` to `last`, cut off at these."""
        return [
            (max(begin, first), min(end, last), fault)
            for begin, end, fault in self.faults
            if max(begin, first) <= min(end, last)
        ]

    def _sort_sound(self) -> None:
        found = [found for found in self.checkpoints if found.sound]
        self.sound = sorted(found, key=lambda found: (found.last_sequence, found.number), reverse=True)

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
        found = list(self.damage)
        structure: Literal["lost", "spare"] = "lost" if self.log.identity is None and not self.log.rows else "spare"
        found += [Problem(self.log.path, what, structure) for what in self.log.damage]
        for first, last, fault in self.faults:
            found.append(Problem(self.log.path, f"{fault.describe(first, last)} in {self.log.path}", "lost"))
        for checkpoint in self.checkpoints:
            if self.current is not None or checkpoint.named is not None:
                kind: Literal["lost", "spare"] = "spare" if self._is_spare(checkpoint) else "lost"
                found += [Problem(damage.path, str(damage), kind) for damage in checkpoint.damage]
        for named in () if self.current is None else self.current.checkpoints:
            if self.log.log is not None and not self.log.log.has_place(named.place):
                what = f"{self.log.path} holds no batch that ends where checkpoint {named.number} says"
                found.append(Problem(self.log.path, what, "spare"))
        if self.identity is None:
            found.append(Problem(self.folder, f"nothing in {self.folder} tells what the store is for", "lost"))
        return found

    def _is_spare(self, checkpoint: FoundCheckpoint) -> bool:
        """Return whether the state that a checkpoint holds can be had without it."""
        last_sequence = self.last if checkpoint.named is None else checkpoint.last_sequence
        last_sequences = [other.last_sequence for other in self.sound if other is not checkpoint]
        if checkpoint.is_compaction and last_sequence == self.compacted:
            return last_sequence in last_sequences
        starts = [start for start in [*last_sequences, *([0] if not self.compacted else [])] if start >= self.compacted]
        return any(start >= last_sequence or not self.faulty(start + 1, last_sequence) for start in starts)

    def leftovers(self) -> Iterator[Problem]:
        """Yield the files that are there too many, and who removes them."""
        known = {found.folder for found in self.checkpoints} | {self.log.path}
        parent = self.folder / CHECKPOINTS
        entries = [*self.folder.iterdir(), *(parent.iterdir() if parent.is_dir() else ())]
        ours = {log_path(self.folder, number) for number in log_numbers(self.folder)}
        ours |= {checkpoint_path(self.folder, number) for number in numbers(self.folder)}
        for path in sorted(entries):
            if DAMAGED in path.name:
                what = f"{path} was put aside by a repair: remove it when you need it no more"
            elif path.name.endswith((NEW, PARTIAL)):
                what = f"{path} was, or is being, written: the next writer removes it"
            elif path in ours - known:
                what = f"{path} is named by nothing: the next writer removes it"
            else:
                continue
            yield Problem(path, what, "leftover")
