"""A whole store read and verified without changing it: what `check_store` reports, and `repair_store` starts from."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Literal

from store.archive import Files, files_of
from store.checkpoint_files import CheckpointReader
from store.encoding import decode_payload
from store.exceptions import DamageError, NotAStoreError, VersionError, reported
from store.files import store_folder
from store.framing import FRAME_BYTES, NO_CHECKSUM, read_frame
from store.layout import (
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
    strangers,
)
from store.log import LogReader, Place, find_identity
from store.records import JSON, from_json
from store.row_encoding import ROW, decode_head, decode_row, row_sequence
from store.rows import Rows, head_bytes

__all__ = ["Fault", "FoundCheckpoint", "FoundLog", "Problem", "Progress", "Survey", "check_store", "require_store"]

# Called with what is being done, how many of it are done, and how many there are.
Progress = Callable[[str, int, int], object]
REPORT_EVERY = 256  # rows
ATTEMPTS = 4
NOWHERE = Place(0, 0, 0, NO_CHECKSUM)  # in the log, of a checkpoint that `CURRENT` does not name


class Fault(enum.Enum):
    """What can be wrong with a row, said of one and of several."""

    MISSING = ("is missing", "are missing")
    DAMAGED = ("fails its checksum", "fail their checksums")
    NO_ARRAYS = ("has lost its arrays", "have lost their arrays")
    DAMAGED_ARRAYS = ("has arrays that fail their checksum", "have arrays that fail their checksums")
    FOREIGN_ARRAYS = ("has arrays that were never written so", "have arrays that were never written so")

    def describe(self, first: int, last: int) -> str:
        """Return in words that rows `first` to `last` have this fault."""
        return f"row {first} {self.value[0]}" if first == last else f"rows {first} to {last} {self.value[1]}"


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

    Raises NotAStoreError where there is no store, VersionError for a newer format, and another StoreError
    where a file cannot be read for a reason that says nothing against it.
    """
    folder = store_folder(path)
    with reported(folder, "checking the store"):
        files = files_of(folder)
        if not files.is_packed:
            require_store(folder)
            if strange := [Problem(error.path, str(error), "lost") for error in strangers(folder)]:
                return strange
        with closing(files):
            for _ in range(ATTEMPTS):
                survey = Survey(files, progress or (lambda *_: None))
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
class FoundCheckpoint:
    """A checkpoint as it was found. `named` is as `CURRENT` has it, or, where that is lost, as it describes itself.

    `named` is None where neither is readable. `damage` is what keeps it from being used.
    """

    number: int
    folder: Path
    named: NamedCheckpoint | None
    is_base: bool
    damage: list[DamageError]
    identity: dict[str, JSON] | None

    @property
    def sound(self) -> bool:
        """Whether recovery can resume from it."""
        return not self.damage

    @property
    def upto(self) -> int:
        """The last row that it contains, -1 where nobody knows."""
        return -1 if self.named is None else self.named.upto


class FoundLog:
    """A log as it was found: the sequences of its rows, each with what is wrong with it, and other damage.

    path: the log, or what an interrupted repair left of it. identity: the store's, None where that is lost.
    compacted: the last row without arrays. damage: what is wrong with it but for rows. durable: as of `LogReader`.
    """

    def __init__(
        self, files: Files, path: Path, identity: bytes | None, progress: Progress, durable: Place | None = None
    ) -> None:
        self.path, self.damage = path, list[str]()
        self.identity: dict[str, JSON] | None = None
        self.rows: list[tuple[int, Fault | None]] = []
        self.torn, self.without_arrays = set[int](), set[int]()
        self.compacted = 0
        self._offsets: dict[int, tuple[int, int]] = {}
        self._reader: LogReader | None = None
        try:
            known = find_identity(files.open_log(path)) if identity is None else identity
            self._reader = files.read_log(path, identity=known)
            self._reader.durable = durable
        except FileNotFoundError:
            self.damage.append(f"{path} is gone")
            return
        except DamageError as error:
            self.damage.append(str(error))
            return
        if identity is not None and self._reader.identity != identity:
            self.damage.append(f"{path} is the log of another store, or of another time: nothing of it was read")
            self._reader.close()
            self._reader = None
            return
        try:
            self._read(self._reader, progress)
        except DamageError as error:  # nothing more of the file can be read
            self.damage.append(str(error))
        except BaseException:
            self.close()
            raise

    def _read(self, log: LogReader, progress: Progress) -> None:
        if log.header_damage is not None:
            self.damage.append(str(log.header_damage))
        else:
            try:
                self.identity = from_json(log.header.decode())
            except ValueError as error:
                self.damage.append(f"the identity in {self.path} was never written so: {error}")
        rows = Rows()
        for done, _ in enumerate(rows.take(log)):
            if done % REPORT_EVERY == 0:
                progress("batches", done, done)
        for index in range(len(rows) + 1):
            for damage in rows.damage.get(index, ()):
                self._note_damage(log, damage)
            if index < len(rows):
                if index % REPORT_EVERY == 0:
                    progress("rows", index, len(rows))
                self._note_row(log, rows.sequences[index], rows.offsets[index], rows.sizes[index])

    def _note_damage(self, log: LogReader, damage: DamageError) -> None:
        """Note a damaged frame: as a row with a fault where its first bytes still say which."""
        before = self.rows[-1][0] if self.rows else 0
        try:
            offset = -1 if damage.offset is None else damage.offset
            frame = read_frame(log.bytes_at(offset, FRAME_BYTES), offset) if offset >= 0 else None
            if frame is not None and frame.identity == log.identity and frame.kind == ROW:
                data = head_bytes(log, offset, frame.size)
                sequence = row_sequence(data)
                if sequence > before:
                    decode_head(data, frame.size)
                    self._offsets[sequence] = offset, frame.size
                    self.rows.append((sequence, Fault.DAMAGED_ARRAYS))
                    return
        except ValueError:
            pass
        self.damage.append(str(damage))
        is_commit = log.durable is not None and log.durable[:2] == (offset + FRAME_BYTES, (damage.frame or 0) + 1)
        if not is_commit:  # which is no row
            self.torn.add(before)

    def _note_row(self, log: LogReader, sequence: int, offset: int, size: int) -> None:
        if self.rows and sequence <= self.rows[-1][0]:
            self.damage.append(f"row {sequence} follows row {self.rows[-1][0]} in {self.path}")
            return
        fault = None
        try:
            row = decode_row(log.read(offset, size)[1])
            if row.head.sequence != sequence:
                fault = Fault.DAMAGED
            elif row.payload is None:
                self.without_arrays.add(sequence)
                self.compacted = sequence
            elif not _is_readable(row.payload):
                fault = Fault.FOREIGN_ARRAYS
        except (DamageError, ValueError):
            fault = Fault.DAMAGED
        self._offsets[sequence] = offset, size
        self.rows.append((sequence, fault))

    @property
    def last(self) -> int:
        """The sequence of its last row, 0 without any."""
        return self.rows[-1][0] if self.rows else 0

    @property
    def is_read(self) -> bool:
        """Whether anything of it was read."""
        return self._reader is not None

    def has_place(self, named: NamedCheckpoint) -> bool:
        """Whether a checkpoint's place is in the log, and no row that it does not contain is before it."""
        assert self._reader is not None
        if any(at < named.place.offset for row, (at, _) in self._offsets.items() if row > named.upto):
            return False
        return self._reader.has_place(named.place)

    def data(self, sequence: int) -> bytes:
        """Return the bytes of a row, verified once more. Raises DamageError."""
        assert self._reader is not None
        return self._reader.read(*self._offsets[sequence])[1]

    def head_data(self, sequence: int) -> bytes:
        """Return the bytes of a row's head, not verified."""
        assert self._reader is not None
        return head_bytes(self._reader, *self._offsets[sequence])

    def row_size(self, sequence: int) -> int:
        """Return the bytes of a row."""
        return self._offsets[sequence][1]

    def close(self) -> None:
        """Close the file."""
        if self._reader is not None:
            self._reader.close()


class Survey:
    """All that is found of a store, and whether it verifies.

    `current` is None where `CURRENT` is lost; `identity` where that is. `compacted` is the last row whose arrays a base
    stands for, whether that base is sound or not. `last` is the last sequence of which there is any sign; `faults` are
    the rows that do not verify, as (first, last, fault), ascending. A writer may be at work meanwhile. Raises
    VersionError for a newer format, and StoreError for a file that cannot be read for a reason that says nothing
    against it.
    """

    def __init__(self, files: Files, progress: Progress) -> None:
        self.files, self.folder, self.progress = files, files.folder, progress
        self.current: Current | None = None
        self.damage: list[Problem] = []
        try:
            self.current = files.current()
        except FileNotFoundError:
            path = self.folder / CURRENT_FILE
            self.damage.append(Problem(path, f"{path} is gone", "spare"))
        except DamageError as error:
            self.damage.append(Problem(error.path, str(error), "spare"))
        self.checkpoints = list(self._found())
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
        base = None if self.current is None else self.current.base
        is_base = base is not None and base.number == number
        try:
            reader = CheckpointReader(path, self.files)
            found = NamedCheckpoint(reader.number, reader.upto, reader.sha256, NOWHERE)
            expected = found if named is None else named
            if (found.number, found.upto, found.sha256) != (number, expected.upto, expected.sha256):
                raise DamageError(
                    f"{path} says that it is checkpoint {found.number}, up to row {found.upto}, and another than was "
                    "written there",
                    path=path / "zarr.json",
                )
            return FoundCheckpoint(number, path, expected, is_base, list(reader.damage()), dict(reader.identity))
        except DamageError as wrong:
            return FoundCheckpoint(number, path, named, is_base, [wrong], None)

    def _found_log(self) -> FoundLog:
        """Return the log that counts; where that is gone, or nobody knows which it was, the one that tells most.

        Of logs whose compacted rows no checkpoint stands for there is none to go on from.
        """
        named, aside = log_path(self.folder, 1), list[Path]()
        if self.current is None:
            aside = sorted(self.folder.glob(f"{LOG}*{DAMAGED}*"))
        else:
            named = _or_aside(log_path(self.folder, self.current.log))
            if self.files.is_packed or named.exists():
                durable = None if self.current.newest is None else self.current.newest.place
                return FoundLog(self.files, named, self.current.log_identity, self.progress, durable)
        there = [log_path(self.folder, number) for number in log_numbers(self.folder)]
        newest = self.sound[0].upto if self.sound else 0
        found = [FoundLog(self.files, path, None, self.progress) for path in there or aside[-1:]]
        # Of two that tell as much the newer: the other may be what a compaction replaced.
        best = max(reversed(found), key=lambda log: (log.compacted <= newest, log.last), default=None)
        for log in found:
            if log is not best:
                log.close()
        if self.current is not None and best is not None:
            self.damage.append(Problem(named, f"{named} is gone: {best.path} is what was before it", "lost"))
        return best or FoundLog(self.files, named, None, self.progress)

    def _drop_foreign(self) -> None:
        """Where a checkpoint is another store's it does not count."""
        for i, found in enumerate(self.checkpoints):
            if found.sound and found.identity != self.identity:
                wrong = DamageError(f"{found.folder} is a checkpoint of another store", path=found.folder)
                self.checkpoints[i] = replace(found, damage=[wrong], identity=None)

    def _find_faults(self) -> None:
        upto = max((found.upto for found in self.checkpoints), default=0)
        self.faults: list[tuple[int, int, Fault]] = []
        before = 0
        for sequence, fault in self.log.rows:
            self._note_gap(before, sequence - 1)
            if fault is not None and not (fault is not Fault.DAMAGED and sequence <= self.compacted):
                self._note(sequence, sequence, fault)
            elif sequence > self.compacted and sequence in self.log.without_arrays:
                self._note(sequence, sequence, Fault.NO_ARRAYS)
            before = sequence
        self.last = max(before, upto)
        if before in self.log.torn:
            self.last = max(self.last, before + 1)
        self._note_gap(before, self.last)

    def _note_gap(self, before: int, last: int) -> None:
        """Note rows that are missing; before the base a repair may have left some out, where nothing is damaged."""
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

    @property
    def sound(self) -> list[FoundCheckpoint]:
        """The checkpoints that recovery can resume from, the newest first."""
        found = [found for found in self.checkpoints if found.sound]
        return sorted(found, key=lambda found: (found.upto, found.number), reverse=True)

    @property
    def base(self) -> FoundCheckpoint | None:
        """The sound checkpoint that stands for the compacted rows."""
        return next((found for found in self.sound if found.upto == self.compacted), None) if self.compacted else None

    def moved(self) -> bool:
        """Whether a writer has committed something since."""
        try:
            return self.files.current() != self.current
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
        for named in () if self.current is None or not self.log.is_read else self.current.checkpoints:
            if not self.log.has_place(named):
                what = f"{self.log.path} has no place behind which are all rows behind checkpoint {named.number}, as "
                found.append(Problem(self.log.path, f"{what}{self.folder / CURRENT_FILE} says", "spare"))
        if self.identity is None:
            found.append(Problem(self.folder, f"nothing in {self.folder} tells what the store is for", "lost"))
        return found

    def _is_spare(self, checkpoint: FoundCheckpoint) -> bool:
        """Return whether the state that a checkpoint holds can be had without it."""
        upto = self.last if checkpoint.named is None else checkpoint.upto
        uptos = [other.upto for other in self.sound if other is not checkpoint]
        if checkpoint.is_base and upto == self.compacted:
            return upto in uptos
        starts = [start for start in [*uptos, *([0] if not self.compacted else [])] if start >= self.compacted]
        return any(start >= upto or not self.faulty(start + 1, upto) for start in starts)

    def leftovers(self) -> Iterator[Problem]:
        """Yield the files that are there too many, and who removes them."""
        if self.files.is_packed:
            return
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


def _or_aside(path: Path) -> Path:
    """Return a log's path, or where an interrupted repair put it."""
    aside = path.with_name(path.name + DAMAGED)
    return aside if not path.exists() and aside.exists() else path


def _is_readable(payload: bytes) -> bool:
    """Whether a payload is what `encode_payload` makes: anyone can make its digest; one of a newer release counts."""
    try:
        decode_payload(payload)
    except VersionError:
        return True
    except ValueError:
        return False
    return True
