"""A disk that is full, may only be read, or fails: `python tests/faults/disk.py` (mounts need root).

Full: a small file system in memory is filled up, but for so little that each operation in turn does not fit. It must
say StoreFullError and change nothing, whenever it comes, and work when there is room again. Read-only: the file system
is mounted anew to be read; opening to write must say ReadOnlyError, and opening to read must show all. Turned
read-only, or failing, under an open memory, as a kernel does to a disk it no longer trusts: through the shim, all calls
that write fail from one instant on, with EROFS or EIO.
"""

from __future__ import annotations

import argparse
import errno
import itertools
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from forging import log_of

from faults import shim as watch
from faults.common import folder, parser, quiet_coroutines, run, warnings_told
from faults.learners import opened, warm
from faults.model import Operation, State, after
from faults.plans import prepare
from faults.shim import Shim
from faults.trials import SUCCESS, Attempt, Trials

SIZE = 12 * 2**20
PAGE = 4096
SMALLEST = 200  # bytes of a row and its commit, at least

GROUND: Operation = ("batch", tuple(("observe", name, (i, 90)) for i in range(4) for name in "abü"))

# Each begins from the same memory, and has something to write.
OPERATIONS: dict[str, Operation] = {
    "observe": ("observe", "c", (1, 90)),
    "batch": ("batch", tuple(("observe", "c", (i, 90)) for i in range(5))),
    "retract": ("retract", 2),
    "forget": ("forget", "ü"),
    "describe": ("describe", "a", (("silk", 1.0),)),
    "merge": ("merge", "plain"),
    "merge of one compacted": ("merge", "compacted"),
    "fine_tune": ("fine_tune",),
    "backup": ("backup",),
    "compact": ("compact", 0),
    "close": ("close",),
    "open": ("open",),
}


@contextmanager
def mounted(where: Path, size: int) -> Iterator[Path]:
    """A file system in memory, of so many bytes, in folder `where`."""
    where.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "faults", where], check=True, capture_output=True)
    try:
        yield where
    finally:
        subprocess.run(["umount", where], check=False, capture_output=True)


def may_mount(home: Path) -> bool:
    """Whether this process may."""
    try:
        with mounted(home / "try", 2**20):
            return True
    except (OSError, subprocess.CalledProcessError):
        return False


def fill(where: Path, left: int) -> None:
    """Take all room of a file system but for so many bytes."""
    found = os.statvfs(where)
    room = found.f_bavail * found.f_frsize - left
    with (where / "filler").open("ab", buffering=0) as file:
        while room > 0:
            room -= file.write(bytes(min(room, 2**20)))


class Bench(Trials):
    """One memory, brought back to the same state before each operation."""

    def __init__(self, home: Path) -> None:
        super().__init__(home, prepare(home))
        self.ground = State()
        self._fill(home, GROUND)
        # A row of some bytes must not fit into the last page of the log.
        for length in itertools.count(1):
            if -log_of(home / "ground").stat().st_size % PAGE < SMALLEST:
                break
            self._fill(home, ("describe", "b", (("x" * (length % 100), 1.0),)))

    def _fill(self, home: Path, operation: Operation) -> None:
        filling = Attempt(operation, home / "ground", home)
        filling.learner = opened(filling.path)
        filling.do()
        filling.learner.close()
        self.ground, _ = after(self.ground, operation, self.others)

    def ready(self, path: Path, operation: Operation) -> Attempt:
        """An operation to be done with a fresh copy."""
        return Attempt(operation, path, self.home, self.home / "ground")

    def then(self, attempt: Attempt, outcome: str) -> State:
        """The state after an operation."""
        return after(self.ground, attempt.operation, self.others)[0] if outcome == SUCCESS else self.ground

    def afterwards(self, where: str, attempt: Attempt, outcome: str) -> None:
        """With the fault over: nothing was changed by what was refused, and it can be done."""
        if attempt.changes_nothing and not (outcome == SUCCESS and attempt.operation[0] == "open"):
            attempt.learner = opened(attempt.path)
        self.require_copies(where, attempt.path, [self.ground])
        self.require(f"{where}: after {outcome}", attempt.learner, [self.then(attempt, outcome)])
        if outcome != SUCCESS and not attempt.changes_nothing:
            if (again := self.outcome(where, attempt.do)) != SUCCESS:
                self.failures.append(f"{where}: when there was room again it said {again}")
            self.require(f"{where}: done again", attempt.learner, [self.then(attempt, SUCCESS)])
        attempt.learner.close()
        with opened(attempt.path) as learner:
            self.require(f"{where}: opened at last", learner, [self.then(attempt, SUCCESS)])


def full(bench: Bench, where: Path, names: Sequence[str], rooms: list[int]) -> None:
    """Each operation with ever more room, until it fits."""
    for name in names:
        operation = OPERATIONS[name]
        for room in rooms:
            attempt = bench.ready(where / "memory", operation)
            fill(where, room)
            told = f"{name}, {room} bytes left"
            with warnings_told(lambda text: None):
                outcome = bench.outcome(told, attempt.do)
                if outcome not in (SUCCESS, "StoreFullError"):
                    bench.failures.append(f"{told}: {outcome}")
                if attempt.learner is not None and not attempt.changes_nothing:
                    expected = [bench.then(attempt, outcome)]
                    bench.require(told, attempt.learner, expected)
                    with opened(attempt.path, "read") as reader:
                        bench.require(f"{told}, a reader", reader, expected)
                (where / "filler").unlink()
                with bench.examined(f"{told}: afterwards"):
                    bench.afterwards(told, attempt, outcome)
            bench.note(f"full: {name}", outcome)
            if outcome == SUCCESS and room:
                break
        if bench.outcomes[f"full: {name}"]["StoreFullError"] == 0 and name != "open":
            bench.failures.append(f"{name}: was never refused by a full disk")


def read_only(bench: Bench, where: Path) -> None:
    """A disk mounted to be read."""
    attempt = bench.ready(where / "memory", ("open",))
    subprocess.run(["mount", "-o", "remount,ro", where], check=True)
    try:
        outcome = bench.outcome("opening to write on a read-only disk", attempt.do)
        bench.note("read-only: open to write", outcome)
        if outcome != "ReadOnlyError":
            bench.failures.append(f"opening to write on a read-only disk: {outcome}")
        with opened(attempt.path, "read") as reader:
            bench.require("opened to read on a read-only disk", reader, [bench.ground])
            bench.note("read-only: open to read", SUCCESS)
    finally:
        subprocess.run(["mount", "-o", "remount,rw", where], check=True)


def from_now_on(bench: Bench, path: Path, names: Sequence[str], how: str, error: int, expected: str) -> None:
    """All writing calls fail from one instant on, and then no more."""
    shim = Shim()
    for name in names:
        told = f"{how}: {name}"
        attempt = bench.ready(path, OPERATIONS[name])
        with warnings_told(lambda text: None):
            shim.arm(path.parent, watch.FAIL, watch.WRITES, first=1, last=watch.FOREVER, error=error)
            outcome = bench.outcome(told, attempt.do)
            shim.disarm()
            if outcome != expected:
                bench.failures.append(f"{told}: {outcome}")
            with bench.examined(f"{told}: afterwards"):
                bench.afterwards(told, attempt, outcome)
        bench.note(told, outcome)


def main(options: argparse.Namespace) -> dict[str, Any]:
    """All of it; what needs a mount is left out where there may be none."""
    quiet_coroutines()
    warm()
    skipped, names = [], list(OPERATIONS)
    ways = {"over quota (EDQUOT)": (errno.EDQUOT, "StoreFullError"), "failing (EIO)": (errno.EIO, "StoreError")}
    ways |= {"turned read-only (EROFS)": (errno.EROFS, "ReadOnlyError")}
    with folder(options, in_memory=True) as home:
        bench = Bench(home)
        if may_mount(home):
            with mounted(home / "disk", SIZE) as disk:
                pages = [0, 80] if options.quick else [0, 1, 3, *range(8, 240, 8)]
                full(bench, disk, names[::6] if options.quick else names, [PAGE * page for page in pages])
                bench.tell(f"full: {bench.tried} operations")
                read_only(bench, disk)
        else:
            skipped.append("full and read-only file systems: this process may not mount")
        for number, (how, (error, expected)) in enumerate(ways.items()):
            some = names[number + 1 :: 6] if options.quick else names
            from_now_on(bench, home / f"failing-{number}", some, how, error, expected)
    return {
        "operations": bench.tried,
        "skipped": skipped,
        "outcomes": {name: dict(counted) for name, counted in bench.outcomes.items()},
        "failures": bench.failures,
    }


if __name__ == "__main__":
    watch.begin_again_watched()
    run("disk", parser(__doc__).parse_args(), main)
