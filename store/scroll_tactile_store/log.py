"""The log read: whole batches of frames in order, and single frames by where they are; nothing is ever written.

A batch is written once the one before it is durable. So behind a frame that does not verify there may be, after a power
cut, others of its own batch and nothing else; any other frame of the log there proves that a durable one was damaged.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Self

from scroll_tactile_store.exceptions import DamageError, StoreError, VersionError, reported
from scroll_tactile_store.framing import (
    COMMIT,
    FRAME_BYTES,
    HEADER,
    LARGEST_PAYLOAD,
    MARK,
    NO_CHECKSUM,
    VERSION,
    Frame,
    pack_frame,
    read_frame,
)
from scroll_tactile_store.log_file import LogFile, Window, frames_behind
from scroll_tactile_store.records import LARGEST_NUMBER, payload_digest

__all__ = ["LogPlace", "LogReader"]

# A window older than the file, what a writer is just writing, and damage look alike the first time, and not the third.
ATTEMPTS = 3


class LogPlace(NamedTuple):
    """Where a log's next frame belongs: its offset and number, its batch's first number, the checksum before it."""

    offset: int
    number: int
    batch: int
    previous: bytes

    @classmethod
    def behind(cls, frame: Frame) -> LogPlace:
        """Return the place of the frame behind this one, in a batch of its own where this one ends a batch."""
        number = frame.number + 1
        batch = number if frame.kind in (HEADER, COMMIT) else frame.batch
        return cls(frame.end, number, batch, frame.checksum)

    def holds(self, frame: Frame) -> bool:
        """Return whether the frame is the one that belongs here."""
        belongs = (frame.offset, frame.number, frame.batch, frame.previous) == self
        largest = 0 if frame.kind == COMMIT else LARGEST_PAYLOAD
        return belongs and frame.kind != HEADER and frame.size <= largest

    def is_before(self, frame: Frame) -> bool:
        """Return whether reading can go on with the frame, where none belongs here."""
        return frame.number > self.number or (frame.number == self.number and frame.offset > self.offset)

    def can_be_torn_before(self, frame: Frame) -> bool:
        """Return whether a power cut while the batch of this place was written can have left the frame."""
        if frame.number <= self.number:
            return (frame.offset, frame.number, frame.batch, frame.previous) == self
        return frame.batch == self.batch and frame.offset - self.offset >= FRAME_BYTES * (frame.number - self.number)


class LogReader:
    """An open log. It needs no lock and leaves every byte as it is; a writer may be at work.

    `header` is the payload of the log's first frame, the caller's. `place` is behind the last batch that was read:
    kept elsewhere, and given again, it saves reading what is before it. A batch can be read an instant before it is
    durable. One thread at a time may refresh; any may read.

    payloads: whether `refresh` verifies these, too; where it does not, `read` still does. identity: of a log whose
    first frame may be damaged, which is then named in `header_damage`, and `refresh` begins with the first that is not.
    file: the log, where it is open already.

    durable: a place that its writer noted elsewhere. Where it is in the log, what is before it is no torn batch.

    Raises VersionError for a newer format, DamageError for what is no log, or not the one of `place`, and StoreError.
    """

    WRITES = False
    durable: LogPlace | None = None

    def __init__(
        self,
        path: Path,
        *,
        place: LogPlace | None = None,
        payloads: bool = True,
        identity: bytes | None = None,
        file: LogFile | None = None,
    ) -> None:
        self.path = path
        self.payloads = payloads
        self.header_damage: DamageError | None = None
        with reported(path, "opening the log"):
            self._file = LogFile(path, write=self.WRITES) if file is None else file
            try:
                self._window = Window(self._file)
                self._torn: LogPlace | None = None
                self._proved: Frame | None = None
                self._first: Frame | None = None
                try:
                    self._first = self._read_header()
                    self.place = LogPlace.behind(self._first)
                except DamageError as damage:
                    if identity is None:
                        raise
                    self._begin_without_header(identity, damage)
                self._last = self._first
                if place is not None and place != self.place:
                    self._last = self._commit_before(place)
                    self.place = place
            except BaseException:
                if file is None:
                    self._file.close()
                raise

    def _read_header(self) -> Frame:
        self._file.size()
        frame = read_frame(self._window.read(0, FRAME_BYTES), 0)
        if frame is None:
            raise self._damage("does not begin as a log, or its first frame is not as it was written", 0, 0)
        if frame.version > VERSION:
            raise VersionError(
                f"{self.path} is written in format {frame.version}; this release reads format {VERSION}: upgrade it; "
                "nothing was changed"
            )
        expected = (VERSION, 0, 0, HEADER, NO_CHECKSUM)
        if (frame.version, frame.number, frame.batch, frame.kind, frame.previous) != expected:
            raise self._damage("does not begin with the first frame of a log", 0, 0)
        self.identity = frame.identity
        self._mark = MARK + frame.identity
        self.header = self._payload(frame)
        return frame

    def _begin_without_header(self, identity: bytes, damage: DamageError) -> None:
        self.header, self.identity, self._mark, self.header_damage = b"", identity, MARK + identity, damage
        self._torn = self.place = LogPlace(0, 0, 0, NO_CHECKSUM)
        with suppress(DamageError):
            self.resume()

    def has_place(self, place: LogPlace) -> bool:
        """Return whether a place is behind the first frame or a batch of this log."""
        if self._first is not None and place == LogPlace.behind(self._first):
            return True
        try:
            with reported(self.path, "looking for a place"):
                self._commit_before(place)
        except DamageError:
            return False
        return True

    def _commit_before(self, place: LogPlace) -> Frame:
        offset = place.offset - FRAME_BYTES
        is_inside = 0 < offset < self._file.size()
        frame = read_frame(self._file.read(offset, FRAME_BYTES), offset) if is_inside else None
        ours = frame is not None and self._is_ours(frame) and frame.kind == COMMIT and frame.number < LARGEST_NUMBER
        if frame is None or not ours or LogPlace.behind(frame) != place:
            raise self._damage(f"holds no batch that ends with frame {place.number - 1} there", offset, place.number)
        return frame

    def _is_ours(self, frame: Frame) -> bool:
        return frame.version == VERSION and frame.identity == self.identity

    def _damage(self, what: str, offset: int, number: int) -> DamageError:
        return DamageError(f"{self.path} {what} (byte {offset})", path=self.path, offset=offset, frame=number)

    def refresh(self) -> Iterator[list[Frame]]:
        """Yield what was committed since the last call: the frames of each batch, verified and in order.

        A batch without its commit frame is not there yet. Raises DamageError at the first damaged frame: those before
        it were yielded, its batch's too, and `resume` continues behind it. Raises StoreError where the writer took back
        what was read here, because it could not be made durable: open the log anew.
        """
        with reported(self.path, "reading the log"):
            last = self._last
            if last is not None and read_frame(self._file.read(last.offset, FRAME_BYTES), last.offset) != last:
                raise StoreError(f"{self.path} no longer ends as it did, its writer took a batch back: open it anew")
            damage = None
            while damage is None:
                batch, damage = self._next_batch()
                if damage is not None and self._torn is not None:
                    self._last, self.place = self._first, self._torn
                elif batch:
                    self._last = batch.pop()
                    self.place = LogPlace.behind(self._last)
                else:
                    return
                if batch:
                    yield batch
            raise damage

    def _next_batch(self) -> tuple[list[Frame], DamageError | None]:
        """Return the next batch with its commit frame, nothing where the log ends; or what is before damage, and it."""
        damage: DamageError | None = None
        for attempt in range(ATTEMPTS):
            batch, torn = self._scan()
            if torn is None:
                return batch, None
            self._window.drop()
            if attempt:
                if (proof := self._proof(torn)) is None:
                    return [], None
                self._torn = torn
                damage = self._damage(
                    f"is damaged: frame {torn.number} is not as it was written, and frame {proof.number} at byte "
                    f"{proof.offset} proves that it was durable. What is before it verifies and can be kept",
                    torn.offset,
                    torn.number,
                )
        return batch, damage

    def _scan(self) -> tuple[list[Frame], LogPlace | None]:
        """Return the frames from the place on that verify, up to a commit frame, or the place where one does not."""
        place, size = self.place, self._file.size()
        batch: list[Frame] = []
        while True:
            frame = read_frame(self._window.read(place.offset, FRAME_BYTES), place.offset)
            if frame is None or not self._is_ours(frame) or not place.holds(frame) or frame.end > size:
                return batch, place
            if self.payloads and self._window.digest(frame.payload_offset, frame.size) != frame.digest:
                return batch, place
            batch.append(frame)
            if frame.kind == COMMIT:
                return batch, None
            place = LogPlace.behind(frame)

    def _proof(self, torn: LogPlace) -> Frame | None:
        """Return a frame of this log that no power cut can have left behind a torn one; None where there is none."""
        known = self._proved
        if known is not None and known.offset > torn.offset and not torn.can_be_torn_before(known):
            # Or each of many damaged frames would be a search of all that is behind it.
            found = read_frame(self._file.read(known.offset, FRAME_BYTES), known.offset)
            if found == known:
                return known
        if self.durable is not None and torn.offset < self.durable.offset:
            commit = pack_frame(self.identity, torn.offset, torn.number, torn.batch, COMMIT, b"", torn.previous)[1]
            if LogPlace.behind(commit) == self.durable:
                return commit  # as it was: all of its batch is there but for this frame
            with suppress(DamageError):
                return self._commit_before(self.durable)
        behind = frames_behind(self._file, torn.offset, self._mark)
        self._proved = next((frame for frame in behind if not torn.can_be_torn_before(frame)), None)
        return self._proved

    def resume(self) -> None:
        """Go on behind the damaged frame that `refresh` named, at the next that can be found; the rest is lost."""
        if (torn := self._torn) is None:
            return
        with reported(self.path, "looking for a frame behind damage"):
            behind = frames_behind(self._file, torn.offset, self._mark)
            if (frame := next(filter(torn.is_before, behind), None)) is None:
                raise self._damage("holds no frame behind the damage", torn.offset, torn.number)
            self.place = LogPlace(frame.offset, frame.number, frame.batch, frame.previous)
            self._last, self._torn = self._first, None

    def read(self, offset: int, size: int) -> tuple[Frame, bytes]:
        """Return the frame at an offset, whose payload has `size` bytes, and that payload, both verified.

        Raises DamageError where there is none.
        """
        frame = self.frame(offset, size)
        with reported(self.path, "reading a frame"):
            return frame, self._payload(frame)

    def frame(self, offset: int, size: int) -> Frame:
        """Return the frame at an offset, verified but for its payload of `size` bytes. Raises DamageError."""
        with reported(self.path, "reading a frame"):
            if not 0 <= offset <= offset + FRAME_BYTES + size <= self._file.size():
                raise self._damage(f"ends before a frame of {size} bytes could", offset, 0)
            frame = read_frame(self._file.read(offset, FRAME_BYTES), offset)
            if frame is None or not self._is_ours(frame) or frame.size != size:
                raise self._damage(f"holds no frame with a payload of {size} bytes there", offset, 0)
            return frame

    def peek(self, offset: int, size: int) -> bytes:
        """Return `size` bytes of the payload of the frame at an offset, not verified, fewer where the file ends."""
        with reported(self.path, "reading the beginning of a frame"):
            return self._file.read(offset + FRAME_BYTES, size)

    def bytes_at(self, offset: int, size: int) -> bytes:
        """Return bytes of the file as they are, fewer where it ends."""
        with reported(self.path, "copying the log"):
            return self._file.read(offset, size)

    def _payload(self, frame: Frame) -> bytes:
        payload = b""
        if frame.size <= LARGEST_PAYLOAD and frame.end <= self._file.size():
            payload = self._file.read(frame.payload_offset, frame.size)
        if payload_digest(payload) != frame.digest or len(payload) != frame.size:
            raise self._damage(
                f"is damaged: the payload of frame {frame.number} is not as it was written", frame.offset, frame.number
            )
        return payload

    @property
    def size(self) -> int:
        """The bytes of the file."""
        with reported(self.path, "measuring the log"):
            return self._file.size()

    def reader_of_heads(self) -> LogReader:
        """Return another reader of the same open file, of heads alone, from its beginning; it is not to be closed."""
        return LogReader(self.path, payloads=False, file=self._file)

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
