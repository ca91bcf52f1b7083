"""The C library's file calls, watched: the Python side of shim.c, which is compiled when a command needs it."""

from __future__ import annotations

import atexit
import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

SOURCE = Path(__file__).with_name("shim.c")
MARK = "FAULTS_SHIM"

OFF, COUNT, FAIL, CRASH, TEAR, LOG = range(6)
WRITES, LOOKS, READS = 1, 2, 4
FOREVER = 2**62


def compiler() -> str | None:
    """A C compiler, where there is one."""
    return next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)


def begin_again_watched() -> None:
    """Compile the shim and run this command again with it; returns in the process that has it.

    Exits with 2 where there is no compiler.
    """
    if (made := os.environ.get(MARK)) is not None:
        # The folder is this process's to remove, and not that of its children.
        owner = os.getpid()
        atexit.register(lambda: shutil.rmtree(made, ignore_errors=True) if os.getpid() == owner else None)
        return
    if sys.platform != "linux" or (tool := compiler()) is None:
        print("this needs Linux and a C compiler", file=sys.stderr)
        sys.exit(2)
    library = Path(tempfile.mkdtemp(prefix="faults-shim-"), "shim.so")
    subprocess.run([tool, "-shared", "-fPIC", "-O1", "-Wall", SOURCE, "-o", library, "-ldl", "-lpthread"], check=True)
    before = [os.environ["LD_PRELOAD"]] if os.environ.get("LD_PRELOAD") else []
    environment = os.environ | {"LD_PRELOAD": ":".join([str(library), *before]), MARK: str(library.parent)}
    os.execve(sys.executable, [sys.executable, *sys.argv], environment)


class Shim:
    """The shim in this process, inherited by its forks as it is at the fork."""

    def __init__(self) -> None:
        self._library = ctypes.CDLL(str(Path(os.environ[MARK], "shim.so")))
        self._library.shim_hit.restype = ctypes.c_char_p
        self._library.shim_count.restype = ctypes.c_long
        kinds = [ctypes.c_char_p, ctypes.c_int, ctypes.c_int, ctypes.c_long, ctypes.c_long, ctypes.c_int]
        self._library.shim_arm.argtypes = kinds

    def arm(
        self, folder: Path, mode: int, what: int = WRITES, *, first: int = 0, last: int | None = None, error: int = 0
    ) -> None:
        """Watch what lies below a folder; calls `first` to `last` of the classes `what` fail, crash or are torn."""
        self._library.shim_arm(os.fsencode(folder), mode, what, first, first if last is None else last, error)

    def disarm(self) -> tuple[int, str]:
        """Let all pass again; how many calls there were, and the last that was hit: its name and path."""
        count, hit = self._library.shim_count(), self._library.shim_hit().decode()
        self._library.shim_arm(b"/nowhere", OFF, 0, 0, 0, 0)
        return count, hit

    def slow(self, milliseconds: float) -> None:
        """Let each sync take so much longer, as on a card or a turning disk."""
        self._library.shim_slow(round(1e3 * milliseconds))

    def log(self, file: Path) -> None:
        """Append what is done while the mode is LOG to a file."""
        if self._library.shim_log(os.fsencode(file)) < 0:
            raise OSError(f"cannot write {file}")

    def mark(self, text: str) -> None:
        """Put a line of our own into the log."""
        self._library.shim_mark(text.encode())
