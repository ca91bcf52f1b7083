"""One hostile case in a process that may die of it: what came of it, within bounds of time, room and place."""

from __future__ import annotations

import faulthandler
import os
import resource
import shutil
import signal
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

from faults.common import fingerprint

SECONDS = 10  # of work in one case
ADDRESSES = 3 * 2**30  # of which no case can take more, so that the machine lives

Finding = tuple[str, str]  # what it is, and where


class Wrong(Exception):
    """Something is not as it has to be."""


@dataclass
class Told:
    """What came of a case: outcomes by reader, and what was wrong."""

    number: int
    about: str
    kind: str
    outcomes: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    peak: int = 0


class Cases:
    """What a process needs for cases: folders of its own, of which `watched` is nobody's to change.

    A case that takes longer than `options.seconds` ends the process, and the log says where it was.
    """

    def __init__(self, home: Path, options: Any, log: TextIO) -> None:
        self.home, self.log, self.seconds = home, log, options.seconds
        self.seed, self.verbose, self.quick = options.seed, options.case >= 0, options.quick
        self.own = home / f"bench-{os.getpid()}"
        self.watched = self.own / "watched"
        shutil.copytree(home / "watched", self.watched)
        self.watching = fingerprint(self.watched)

    def bounded(
        self, told: Told, name: str, spare: int, do: Callable[[], str], typed: tuple[type[Exception], ...]
    ) -> str:
        """Do what may only end in a word or in a typed error, soon, and in so many more bytes; what came of it."""
        start, worked = begin_peak(), time.process_time()
        signal.setitimer(signal.ITIMER_REAL, self.seconds)
        faulthandler.dump_traceback_later(self.seconds - 1, file=self.log)
        try:
            came = do()
        except typed as error:
            came = type(error).__name__
            if _is_memory(error):
                told.findings.append(("memory ran out", _place(error)))
        except Wrong as error:
            came = "WRONG"
            told.findings.append((f"{name}: {error}"[:300], ""))
        except Exception as error:
            came = "UNTYPED"
            told.findings.append((f"{type(error).__name__}: {error}"[:160], f"{name}: {_place(error)}"))
            if self.verbose:
                traceback.print_exc()
        finally:
            faulthandler.cancel_dump_traceback_later()
            signal.setitimer(signal.ITIMER_REAL, 0)
        if (worked := time.process_time() - worked) > SECONDS:
            told.findings.append((f"worked for {worked:.0f} s", name))
        grown = peak() - start
        told.peak = max(told.peak, grown)
        if grown > spare:
            told.findings.append((f"took {grown >> 20} MB, where {spare >> 20} MB are allowed", name))
        told.outcomes.append(f"{name}: {came}")
        return came

    def require_untouched(self, told: Told, name: str) -> None:
        """What lies elsewhere is as it was."""
        if fingerprint(self.watched) != self.watching:
            told.findings.append((f"{name} changed something elsewhere", ""))
            remove(self.watched)
            shutil.copytree(self.home / "watched", self.watched)
            self.watching = fingerprint(self.watched)

    def close(self) -> list[Finding]:
        """Remove what is this process's own; what is found at last."""
        remove(self.own)
        return []


def limit_addresses() -> None:
    """From here on, this process can take ADDRESSES bytes of addresses more than it has now."""
    now = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    most = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (now + ADDRESSES, most))


def remove(path: Path) -> None:
    """A folder, a file or anything else."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def size(path: Path) -> int:
    """The bytes that a folder takes on the disk."""
    return sum(file.lstat().st_blocks * 512 for file in path.rglob("*"))


def begin_peak() -> int:
    """Forget the most memory that this process had, and return what it has."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    return peak()


def peak() -> int:
    """The most memory that this process had, in bytes."""
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    return int(status.split("VmHWM:")[1].split()[0]) * 1024


def _is_memory(error: BaseException | None) -> bool:
    seen = 0
    while error is not None and seen < 10:
        if isinstance(error, MemoryError):
            return True
        error, seen = error.__cause__ or error.__context__, seen + 1
    return False


def _place(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "/store/" in frame.filename or "/scroll_tactile/" in frame.filename]
    last = (own or frames)[-1]
    return f"{last.filename.rsplit('/', 1)[-1]}:{last.lineno} {last.name}"
