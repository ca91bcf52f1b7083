"""A packed store: its folder in one zip, stored as it is, unpacked into a temporary folder to be read."""

from __future__ import annotations

import atexit
import os
import re
import shutil
import stat
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkdtemp
from uuid import uuid4

from scroll_tactile_store.encoding import NAME
from scroll_tactile_store.exceptions import DamageError, NotAStoreError, StoreError, reported
from scroll_tactile_store.files import dense_size, regular_file, replacing
from scroll_tactile_store.layout import CHECKPOINTS, CURRENT_FILE, LOG, checkpoint_path, log_path, read_current

NAMES = re.compile(
    rf"{CURRENT_FILE}|{LOG}\d{{8,18}}|{CHECKPOINTS}/\d{{8,18}}/(zarr\.json|{NAME}/(zarr\.json|c(/\d{{1,18}}){{0,64}}))",
    re.ASCII,
)
BEFORE_NAME = 30  # bytes of the header before each file, which its name follows
ARCHIVE_BYTES = BEFORE_NAME + len(CURRENT_FILE)
LARGEST = 2**46  # bytes of a packed store
AGAIN = "fetch it again from where it was packed"
NO_ZIP = (zipfile.BadZipFile, struct.error, EOFError, NotImplementedError, OverflowError, RuntimeError, ValueError)


def is_archive(begin: bytes) -> bool:
    """Return whether a file that begins with these ARCHIVE_BYTES is a packed store, as `write_archive` writes it."""
    return begin[:4] == b"PK\3\4" and begin[BEFORE_NAME:].startswith(CURRENT_FILE.encode())


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """In the block the packed store at `path` lies in a temporary folder, which it gives.

    Raises NotAStoreError for what is no zip of a store, and DamageError for one that is damaged, or holds anything but
    the files of a store, each once and as long as it is listed.
    """
    maker = os.getpid()
    with reported(path, "making a temporary folder to unpack a store into"):
        folder = Path(mkdtemp(prefix="scroll-tactile."))

    def remove() -> None:
        if os.getpid() == maker:  # a fork that ends does not take it from its parent
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    try:
        with reported(path, "unpacking a store"), regular_file(path, LARGEST) as (file, _):
            size = dense_size(file.fileno(), path)
            if not is_archive(file.read(ARCHIVE_BYTES)):
                raise NotAStoreError(f"{path} is a file, and no packed store: {AGAIN}")
            try:
                _unpack(zipfile.ZipFile(file), folder, path, size)
            except NO_ZIP as error:
                raise _damage(path, f"does not unpack ({error})") from error
        try:
            yield folder
        except StoreError as error:
            error.args = (str(error).replace(str(folder), str(path)),)
            raise
    finally:
        remove()
        atexit.unregister(remove)


def _damage(path: Path, what: str) -> DamageError:
    return DamageError(f"{path} {what}: it is damaged or was made to harm; {AGAIN}", path=path)


def _unpack(packed: zipfile.ZipFile, folder: Path, path: Path, size: int) -> None:
    entries = packed.infolist()
    if sum(entry.file_size for entry in entries) > size:
        raise _damage(path, "lists more bytes than it has")
    for entry in entries:
        is_plain = entry.compress_type == zipfile.ZIP_STORED and not entry.flag_bits & 1
        is_link, is_there = stat.S_ISLNK(entry.external_attr >> 16), os.path.lexists(folder / entry.filename)
        if not is_plain or is_link or is_there or not NAMES.fullmatch(entry.filename):
            what = "which is no file of a store, or twice, a link, compressed or encrypted"
            raise _damage(path, f"lists {entry.filename[:100]!r}, {what}")
        target = folder / entry.filename
        target.parent.mkdir(parents=True, exist_ok=True)
        with packed.open(entry) as source, target.open("xb") as copy:
            shutil.copyfileobj(source, copy, 2**20)


def write_archive(folder: Path, path: Path) -> None:
    """Write what `CURRENT` in a store's folder names as a zip, whole and durable or not at all.

    Nobody may write to the folder meanwhile. What is at `path` is replaced. Raises StoreFullError, ReadOnlyError or
    another StoreError.
    """
    draft = path.with_name(f"{path.name}.{uuid4().hex}.partial")
    with reported(path, "packing a store"):
        current = read_current(folder / CURRENT_FILE)
        named = [checkpoint_path(folder, each.number) for each in current.checkpoints]
        files = [folder / CURRENT_FILE, log_path(folder, current.log)]
        files += sorted(file for group in named for file in group.rglob("*") if file.is_file())
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path, draft), zipfile.ZipFile(draft, "x", zipfile.ZIP_STORED) as packed:
            for each in files:
                entry = zipfile.ZipInfo(each.relative_to(folder).as_posix())  # of 1980, whenever it is written
                with each.open("rb") as source, packed.open(entry, "w", force_zip64=True) as target:
                    shutil.copyfileobj(source, target, 2**20)
