"""A packed store: its folder in one zip, nothing in it compressed again, and read where it lies."""

from __future__ import annotations

import os
import re
import shutil
import struct
import zipfile
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from uuid import uuid4

from scroll_tactile_store.exceptions import DamageError, NotAStoreError, reported
from scroll_tactile_store.files import is_file, open_regular, read_regular, replacing
from scroll_tactile_store.layout import CHECKPOINTS, CURRENT_FILE, LOG, Current, checkpoint_path, log_path, read_current
from scroll_tactile_store.log import LogPlace, LogReader
from scroll_tactile_store.log_file import LogFile

__all__ = ["ARCHIVE_BYTES", "Archive", "Files", "files_of", "is_archive", "write_archive"]

NAMES = re.compile(
    rf"{CURRENT_FILE}|{LOG}\d{{8,18}}|{CHECKPOINTS}/\d{{8,18}}/(zarr\.json|[\w.-]{{1,100}}/(zarr\.json|c(/\d{{1,18}}){{0,64}}))",
    re.ASCII,
)
LOCAL = struct.Struct("<4s22xHH")  # of the header before each file: its mark, and the bytes of its name and of more
ARCHIVE_BYTES = LOCAL.size + len(CURRENT_FILE)
END = struct.Struct("<4s8xI4xH")  # what a zip ends with: its mark, the bytes of its list of files, and of a comment
LOCATOR, END_64 = struct.Struct("<4s4xQ4x"), struct.Struct("<4s36xQ8x")  # before it, where that is too large for it
UNSAID = 2**32 - 1
ENTRY_BYTES = 128  # of a file in the list, on average, at most
AGAIN = "fetch it again from where it was packed"
LINK = 0o120000  # of a file's mode
MOST_FILES = 2**16
DATE = (1980, 1, 1, 0, 0, 0)  # zip's earliest: the same bytes whenever it is written


class Files:
    """The files of a store in a folder, read: regular ones alone."""

    is_packed = False

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def read(self, path: Path, limit: int) -> bytes:
        """Return the bytes of a file of the store, of at most `limit`. Raises DamageError, OSError."""
        return read_regular(path, limit, within=self.folder)

    def open_log(self, path: Path) -> LogFile:
        """Open a log to read. Raises DamageError, OSError."""
        return LogFile(path, write=False)

    def read_log(self, path: Path, *, place: LogPlace | None = None, identity: bytes | None = None) -> LogReader:
        """Open a log as `LogReader` does, whatever holds it; it is closed again where that fails."""
        file = self.open_log(path)
        try:
            return LogReader(path, place=place, identity=identity, file=file)
        except BaseException:
            file.close()
            raise

    def sizes(self, folder: Path) -> Iterator[int]:
        """Yield the bytes of each file below a folder."""
        for where, _, names in os.walk(folder):
            yield from (found.st_size for found in (Path(where, name).lstat() for name in names))

    def current(self) -> Current:
        """Return what `CURRENT` says. Raises DamageError, VersionError, and OSError where it is not there."""
        return read_current(self.folder / CURRENT_FILE, self.read)

    def close(self) -> None:
        """Release what is open."""


class Archive(Files):
    """The files of a store in a zip, which is at `folder`; each is a range of the zip's bytes.

    Raises NotAStoreError for what is no zip of a store, DamageError where its lists of files disagree.
    """

    is_packed = True

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with reported(path, "opening a packed store"):
            self._file = LogFile(path, write=False)
            try:
                self._size = self._file.size()
                self._ranges = self._listed()
            except BaseException:
                self._file.close()
                raise

    def _listed(self) -> dict[str, tuple[int, int]]:
        self._require_bounded()
        try:
            with os.fdopen(open_regular(self.folder, os.O_RDONLY), "rb") as file, zipfile.ZipFile(file) as listed:
                entries = listed.infolist()
        except (zipfile.BadZipFile, ValueError, struct.error, NotImplementedError, OverflowError) as error:
            raise NotAStoreError(f"{self.folder} is a file, and no packed store ({error}): {AGAIN}") from error
        if not any(entry.filename == CURRENT_FILE for entry in entries):
            raise NotAStoreError(
                f"{self.folder} is a zip, and no packed store: it holds no {CURRENT_FILE}. Give another path"
            )
        ranges: dict[str, tuple[int, int]] = {}
        for entry in entries:
            plain = entry.compress_type == zipfile.ZIP_STORED and not entry.flag_bits & 1
            if not plain or entry.compress_size != entry.file_size or entry.external_attr >> 16 & LINK == LINK:
                raise self._damage(f"lists {entry.filename[:100]!r} as a link, or as compressed or encrypted")
            if not NAMES.fullmatch(entry.filename) or entry.filename in ranges or len(ranges) >= MOST_FILES:
                raise self._damage(f"lists {entry.filename[:100]!r}, which is no file of a store, or twice")
            ranges[entry.filename] = self._begin(entry), entry.file_size
        ordered = sorted((begin, begin + size) for begin, size in ranges.values())
        if any(end > begin for (_, end), (begin, _) in pairwise(ordered)) or ordered[-1][1] > self._size:
            raise self._damage("lists files that overlap, or end behind its own end")
        return ranges

    def _require_bounded(self) -> None:
        """Refuse what does not begin and end as it was written, and a list of files that would fill the memory."""
        end = self._file.read(max(0, self._size - END.size), END.size)
        mark, size, comment = END.unpack(end) if len(end) == END.size else (b"", 0, 0)
        if not is_archive(self._file.read(0, ARCHIVE_BYTES)) or mark != b"PK\5\6" or comment:
            raise NotAStoreError(f"{self.folder} is a file, and no packed store, or was cut off or added to: {AGAIN}")
        before = max(0, self._size - END.size - LOCATOR.size)
        locator = self._file.read(before, LOCATOR.size)
        if locator[:4] == b"PK\6\7":
            place = LOCATOR.unpack(locator)[1]
            record = self._file.read(place, END_64.size) if place < before else b""
            if len(record) < END_64.size:
                raise self._damage("says nowhere where its list of files lies")
            size = END_64.unpack(record)[1] if size == UNSAID else max(size, END_64.unpack(record)[1])
        if size > MOST_FILES * ENTRY_BYTES:
            raise self._damage(f"says that its list of files takes {size} bytes")

    def _begin(self, entry: zipfile.ZipInfo) -> int:
        head = self._file.read(entry.header_offset, LOCAL.size) if 0 <= entry.header_offset < self._size else b""
        if len(head) == LOCAL.size:
            mark, name, more = LOCAL.unpack(head)
            begin: int = entry.header_offset + LOCAL.size
            if mark == b"PK\3\4" and self._file.read(begin, name) == entry.filename.encode("ascii"):
                return begin + int(name) + int(more)
        raise self._damage(f"lists {entry.filename!r} where another file begins, or none")

    def _damage(self, what: str) -> DamageError:
        return DamageError(
            f"{self.folder} {what}: it is damaged or was made to harm. {AGAIN.capitalize()}",
            path=self.folder,
        )

    def _range(self, path: Path) -> tuple[int, int]:
        name = path.relative_to(self.folder).as_posix()
        if name not in self._ranges:
            raise FileNotFoundError(2, "no such file in the packed store", str(path))
        return self._ranges[name]

    def read(self, path: Path, limit: int) -> bytes:
        """As `Files.read`."""
        begin, size = self._range(path)
        if size > limit:
            raise DamageError(f"{path} has {size} bytes; at most {limit} are read there", path=path)
        return self._file.read(begin, size)

    def open_log(self, path: Path) -> LogFile:
        """As `Files.open_log`."""
        return LogFile(self.folder, write=False, window=self._range(path))

    def sizes(self, folder: Path) -> Iterator[int]:
        """As `Files.sizes`."""
        inside = folder.relative_to(self.folder).as_posix() + "/"
        yield from (size for name, (_, size) in self._ranges.items() if name.startswith(inside))

    def close(self) -> None:
        """As `Files.close`."""
        self._file.close()


def is_archive(begin: bytes) -> bool:
    """Return whether a file that begins with these ARCHIVE_BYTES is a packed store, as `write_archive` writes it."""
    return begin[:4] == b"PK\3\4" and begin[LOCAL.size :].startswith(CURRENT_FILE.encode())


def files_of(path: Path) -> Files:
    """Return the files of the store at `path`, a folder or a zip."""
    return Archive(path) if is_file(path) else Files(path)


def write_archive(folder: Path, path: Path) -> None:
    """Write what `CURRENT` in a store's folder names as a zip, whole and durable or not at all.

    Nobody may write to the folder meanwhile. What is at `path` is replaced. Raises StoreFullError, ReadOnlyError or
    another StoreError.
    """
    draft = path.with_name(f"{path.name}.{uuid4().hex}.partial")
    with reported(path, "packing a store"):
        current = Files(folder).current()
        named = [checkpoint_path(folder, each.number) for each in current.checkpoints]
        files = [folder / CURRENT_FILE, log_path(folder, current.log)]
        files += sorted(file for group in named for file in group.rglob("*") if file.is_file())
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path, draft), zipfile.ZipFile(draft, "x", zipfile.ZIP_STORED) as packed:
            for each in files:
                entry = zipfile.ZipInfo(each.relative_to(folder).as_posix(), DATE)
                with each.open("rb") as source, packed.open(entry, "w", force_zip64=True) as target:
                    shutil.copyfileobj(source, target, 2**20)
