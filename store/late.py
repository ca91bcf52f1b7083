"""An array of a checkpoint that is read when it is needed."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from store.exceptions import DamageError
from store.log_file import LogFile

__all__ = ["HeldFiles", "LateArray"]


class HeldFiles:
    """Files that stay open, so that they can be read where somebody has removed them since."""

    def __init__(self) -> None:
        self._open: dict[Path, LogFile] = {}
        weakref.finalize(self, _close, self._open)

    def hold(self, path: Path, file: LogFile) -> None:
        """Keep a file, until nobody has these any more."""
        self._open[path] = file

    def read(self, path: Path, limit: int) -> bytes:
        """Return the bytes of a file of at most `limit` bytes. Raises DamageError, OSError."""
        file = self._open[path]
        size = file.size()
        if size > limit:
            raise DamageError(f"{path} has {size} bytes; at most {limit} are read there", path=path)
        return file.read(0, size)


def _close(files: Mapping[Path, LogFile]) -> None:
    for file in files.values():
        file.close()


class LateArray:
    """An array whose files were verified; they are read, verified again and decompressed when it is needed.

    read: returns the array, or raises DamageError. check: is called with it, and raises what is wrong with its values.
    """

    def __init__(self, dtype: np.dtype, shape: tuple[int, ...], read: Callable[[], np.ndarray]) -> None:
        self.dtype, self.shape, self._read = dtype, shape, read
        self.check: Callable[[np.ndarray], None] | None = None

    def __deepcopy__(self, memo: object) -> LateArray:
        return self  # it never changes, and its files are open once

    def read(self) -> np.ndarray:
        """Return the array, the caller's own. Raises DamageError."""
        array = self._read()
        if self.check is not None:
            self.check(array)
        return array
