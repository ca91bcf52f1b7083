"""Machines' disks in a simulation: what is written goes through disks.py, and is left as a power cut leaves it."""

from __future__ import annotations

import os
import random
import re
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import scroll_tactile_store.checkpoint_files
import scroll_tactile_store.log
import scroll_tactile_store.store
from quick_checkpoints import read_zarr, write_zarr

from faults import shim as watch
from faults.disks import STYLES, Disk, Event, File, Folder, Style, events, rebuild
from faults.shim import Shim

AHEAD = 4096  # zeros that the log is filled with, so that rebuilding a disk is quick
LAST_BYTES = 600
NUMBER = re.compile(rb"(?<=[ \[])\d+(?=[,\]}])")


class Disks(Disk):
    """The disks of machines, a folder each, and the shim that writes down what is done to them."""

    def __init__(self, root: Path, shim: Shim, log: Path) -> None:
        super().__init__(root)
        self._shim, self._log = shim, log

    def begin(self, fail: tuple[int, int, int] | None = None) -> None:
        """Write down from here; fail: the first and last of the writing calls that fail, and with which error."""
        os.truncate(self._log, 0)
        first, last, error = fail or (0, 0, 0)
        self._shim.arm(self.root, watch.LOG, first=first, last=last, error=error)

    def end(self) -> list[Event]:
        """What was done since."""
        self._shim.disarm()
        return list(events(self._log))

    def go(self, done: list[Event]) -> None:
        """Take in what was done."""
        for event in done:
            self.apply(event)

    @contextmanager
    def taken_in(self) -> Iterator[None]:
        """In the block what is done is done, without any fate."""
        self.begin()
        try:
            yield
        finally:
            self.go(self.end())

    def cut(self, name: str, rng: random.Random) -> str:
        """Pull the plug of a machine; how its disk was left."""
        style = rng.choice(STYLES)
        self._rebuilt(name, rng, style)
        self.settle(name)
        return style

    def kill(self, name: str) -> None:
        """Have a machine's files be what was written to them so far, none safer than it was."""
        for path, node in self._rebuilt(name, random.Random(0), "all"):
            self.inodes[path.stat().st_ino] = node

    def _rebuilt(self, name: str, rng: random.Random, style: Style) -> list[tuple[Path, File]]:
        shutil.rmtree(self.root / name, ignore_errors=True)
        node = self.top.now[name]
        assert isinstance(node, Folder)
        return rebuild(node, self.root / name, rng, style)

    def settle(self, name: str) -> None:
        """Take a machine's files as they are now for safe."""
        self.top.now[name] = self._scanned(self.root / name)
        self.top.sync()


class Job(Future[None]):
    """A background commit that waits for its turn."""

    def __init__(self, held: Held, do: Callable[[], None]) -> None:
        super().__init__()
        self._held, self._do = held, do

    def __call__(self) -> None:
        """Do it now, unless a later one has taken its place."""
        if not self.set_running_or_notify_cancel():
            return
        try:
            self.set_result(self._do())
        except Exception as error:
            self.set_exception(error)

    def failed(self) -> bool:
        """Whether it was done, and in vain."""
        return self.done() and self.exception() is not None

    def wait(self) -> None:
        """Do what waits."""
        self._held.run()


class Held:
    """In the place of the thread of background commits: they run when the schedule says so, or never."""

    at_once = False

    def __init__(self, *_: Any) -> None:
        self.jobs: list[Job] = []

    def submit(self, do: Any, *given: Any) -> Job:
        """Take a job."""
        job = Job(self, partial(do, *given))
        self.jobs.append(job)
        if Held.at_once:
            self.run()
        return job

    def run(self) -> None:
        """Do all that waits."""
        while self.jobs:
            self.jobs.pop(0)()

    def shutdown(self) -> None:
        """As closing does: wait."""
        self.run()


def prepare() -> None:
    """Have the store write little at once, quickly, and in the background only what the schedule lets run."""
    scroll_tactile_store.log.AHEAD = AHEAD
    scroll_tactile_store.checkpoint_files._write_zarr = partial(write_zarr, indent=None)  # numbers stand between commas
    scroll_tactile_store.checkpoint_files._read_zarr = read_zarr
    scroll_tactile_store.store.ThreadPoolExecutor = Held  # type: ignore[misc,assignment]
    scroll_tactile_store.store.wait_for = lambda jobs: [job.wait() for job in jobs]  # type: ignore[assignment,misc]


def abandon(learner: Any) -> None:
    """Let go of a memory as a process does that is killed: nothing more is written."""
    held = learner._ledger.store
    held._worker.jobs.clear()
    held._log.close()
    if held._lock is not None:
        held._lock._lock.release()
    held._closed = True


Where = Callable[[bytes, random.Random], range]


def flip(path: Path, rng: random.Random, where: Where | None = None, bits: int = 8) -> None:
    """One bit of a file becomes another; where: the bytes that it may be in; bits: the lowest that it may be."""
    data = bytearray(path.read_bytes())
    place = rng.randrange(len(data)) if where is None else rng.choice(where(bytes(data), rng))
    data[place] ^= 1 << rng.randrange(bits)
    path.write_bytes(data)


def near_the_end(data: bytes, _: random.Random) -> range:
    """The last bytes before the zeros at the end, which in a log have its last row or two."""
    end = len(data.rstrip(b"\0")) or len(data)
    return range(max(0, end - LAST_BYTES), end)


def in_a_number(data: bytes, rng: random.Random) -> range:
    """The digits of a number in JSON, long ones as often as short ones, and not those in text."""
    return range(*rng.choice([found.span() for found in NUMBER.finditer(data)]))
