"""The files of a Zarr group, in a folder or a zip: nothing but files and folders, under names that were listed here."""

from __future__ import annotations

import json
import os
import stat
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from scroll_tactile.errors import RecordingError
from scroll_tactile.recordings.bounds import Budget, on_disk, stored_bytes

__all__ = ["DEEPEST", "DESCRIPTION", "GroupFiles", "opened"]

DESCRIPTION = 1 << 24
"""Bytes of a description at most; that of a group may hold all others' once more."""

DEEPEST = 8
"""Groups within each other."""


def opened(path: Path, budget: Budget) -> GroupFiles:
    """The files of a group, whose bytes on the disk the budget counts."""
    return _Folder(path, budget) if path.is_dir() else _Zip(path, budget)


class GroupFiles(ABC):
    """The files of a group by their keys, which are made of names that were listed here and of numbers."""

    def __init__(self, path: Path, budget: Budget) -> None:
        self.path, self.address, self.budget = path, budget.address, budget

    @abstractmethod
    def inside(self, key: str) -> Iterator[str]:
        """The names of the folders in a folder, in order."""

    @abstractmethod
    def find(self, key: str) -> bool:
        """Whether a file is there, whose bytes are then counted; raises RecordingError for a link, FIFO or device."""

    @abstractmethod
    def read(self, key: str, most: int) -> bytes:
        """The bytes of a file that is there; raises RecordingError where there are more than `most`."""

    def is_array(self, key: str) -> bool:
        """Whether a folder is an array."""
        at = f"{key}/" if key else ""
        if not self.find(f"{at}zarr.json"):
            return self.find(f"{at}.zarray")
        about = json.loads(self.read(f"{at}zarr.json", DESCRIPTION))
        return isinstance(about, dict) and about.get("node_type") == "array"

    def _too_long(self, key: str, size: int, most: int) -> None:
        if size > most:
            raise RecordingError(f"{key} of {self.address} has {size} bytes, where at most {most} can be: is it whole?")


class _Folder(GroupFiles):
    def __init__(self, path: Path, budget: Budget) -> None:
        super().__init__(path, budget)
        self._folders = {""}

    def inside(self, key: str) -> Iterator[str]:
        with os.scandir(self.path / key) as entries:
            yield from sorted(entry.name for entry in entries if entry.is_dir(follow_symlinks=False))

    def find(self, key: str) -> bool:
        parts = key.split("/")
        for i in range(1, len(parts)):
            folder = "/".join(parts[:i])
            if folder not in self._folders:
                if not self._is(folder, stat.S_ISDIR):
                    return False
                self._folders.add(folder)
        return self._is(key, stat.S_ISREG)

    def _is(self, key: str, kind: Any) -> bool:
        try:
            about = (self.path / key).lstat()
        except (FileNotFoundError, NotADirectoryError):
            return False
        if not kind(about.st_mode):
            what = "link" if stat.S_ISLNK(about.st_mode) else "FIFO, a device or another kind of entry than expected"
            raise RecordingError(f"{key} of {self.address} is a {what}; a Zarr group is made of files and folders")
        if stat.S_ISREG(about.st_mode):
            self.budget.add(on_disk(about))
        return True

    def read(self, key: str, most: int) -> bytes:
        with (self.path / key).open("rb") as file:
            self._too_long(key, os.fstat(file.fileno()).st_size, most)
            return file.read(most)


class _Zip(GroupFiles):
    def __init__(self, path: Path, budget: Budget) -> None:
        super().__init__(path, budget)
        budget.add(stored_bytes(path))
        self._zip = zipfile.ZipFile(path)
        self._there = {info.filename: info for info in self._zip.infolist()}
        budget.work(len(self._there))
        self._inside: dict[str, set[str]] = {}
        for name in self._there:
            parts = name.split("/")[: DEEPEST + 2]
            for i in range(len(parts) - 1):
                self._inside.setdefault("/".join(parts[:i]), set()).add(parts[i])

    def inside(self, key: str) -> Iterator[str]:
        yield from sorted(self._inside.get(key, ()))

    def find(self, key: str) -> bool:
        return key in self._there

    def read(self, key: str, most: int) -> bytes:
        info = self._there[key]
        self._too_long(key, info.file_size, most)
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise RecordingError(f"{key} of {self.address} is compressed in the zip; expected stored or deflated")
        with self._zip.open(info) as file:
            return file.read(most)
