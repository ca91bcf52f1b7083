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
import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import scroll_tactile.memory.ledger
from faults import shim as watch
from faults.common import folder, parser, progress, quiet_coroutines, run, warnings_told
from faults.model import Operation, State, after, opened, perform, seen, settle, warm
from faults.plans import prepare
from faults.shim import Shim
from store import ReadOnlyError, StoreError, StoreFullError

NEVER = 2**40
SIZE = 12 * 2**20

GROUND: Operation = ("batch", tuple(("observe", name, (i, 90)) for i in range(4) for name in "abü"))

# Each begins from the same memory, and has something to write.
OPERATIONS: dict[str, Operation] = {
    "observe": ("observe", "c", (1, 90)),
    "batch": ("batch", tuple(("observe", "c", (i, 90)) for i in range(5))),
    "retract": ("retract", 2),
    "forget": ("forget", "ü"),
    "describe": ("describe", "a", (("silk", 1.0),)),
    "merge": ("merge", "plain", "twice"),
    "merge of one compacted": ("merge", "compacted", "twice"),
    "fine_tune": ("fine_tune",),
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


class Bench:
    """One memory, brought back to the same state before each operation."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.others = prepare(home)
        self.failures: list[str] = []
        self.outcomes: dict[str, Counter[str]] = {}
        scroll_tactile.memory.ledger.SNAPSHOT_EVERY = NEVER
        self.ground, _ = after(State(), GROUND, self.others)
        with opened(home / "ground") as learner:
            perform(learner, GROUND, home)
        self.tried = 0

    def ready(self, path: Path, operation: Operation) -> Any:
        """A learner of a copy, None where it is to be opened."""
        shutil.rmtree(path, ignore_errors=True)
        shutil.copytree(self.home / "ground", path)
        learner = None if operation[0] == "open" else opened(path)
        if operation[0] == "close":
            learner._ledger._saved = -1  # so that there is a generation to write
        return learner

    def attempt(self, path: Path, learner: Any, operation: Operation) -> tuple[str, Any]:
        """Do it: the name of the error, or "done", and the learner."""
        try:
            if operation[0] == "open":
                return "done", opened(path)
            if operation[0] == "close":
                learner.close()
                return "done", learner
            perform(learner, operation, self.home)
        except StoreError as error:
            return type(error).__name__, learner
        except Exception as error:
            self.failures.append(f"{operation[0]} in {path.name}: not a StoreError: {error!r}")
            return "not a StoreError", learner
        return "done", learner

    def require(self, where: str, learner: Any, state: State) -> None:
        """What is seen of a learner is what is expected."""
        found, differ = settle(seen(learner), [state])
        if found is None:
            self.failures.append(f"{where}: differs in {differ}")

    def then(self, operation: Operation) -> State:
        """The state after an operation."""
        return self.ground if operation[0] in ("open", "close") else after(self.ground, operation, self.others)[0]

    def note(self, name: str, outcome: str) -> None:
        """Count."""
        self.tried += 1
        self.outcomes.setdefault(name, Counter())[outcome] += 1

    def examined(self, where: str, *rest: Any) -> None:
        """As `afterwards`; what it raises is a failure, and not the end."""
        try:
            self.afterwards(where, *rest)
        except Exception as error:
            self.failures.append(f"{where}: afterwards {error!r}")

    def afterwards(self, where: str, path: Path, learner: Any, operation: Operation, outcome: str) -> None:
        """With the fault over: nothing was changed by what was refused, and it can be done."""
        done = outcome == "done"
        if operation[0] in ("open", "close"):
            learner = learner if outcome == "done" and operation[0] == "open" else opened(path)
            done = True
        self.require(f"{where}: after {outcome}", learner, self.then(operation) if done else self.ground)
        if not done:
            again, _ = self.attempt(path, learner, operation)
            if again != "done":
                self.failures.append(f"{where}: when there was room again it said {again}")
            self.require(f"{where}: done again", learner, self.then(operation))
        learner.close()
        with opened(path) as learner:
            self.require(f"{where}: opened at last", learner, self.then(operation))


def full(bench: Bench, where: Path, rooms: list[int]) -> None:
    """Each operation with ever more room, until it fits."""
    for name, operation in OPERATIONS.items():
        for room in rooms:
            path = where / "memory"
            learner = bench.ready(path, operation)
            fill(where, room)
            told = f"{name}, {room} bytes left"
            with warnings_told(lambda text: None):
                outcome, learner = bench.attempt(path, learner, operation)
                if outcome not in ("done", "StoreFullError"):
                    bench.failures.append(f"{told}: {outcome}")
                if learner is not None and operation[0] not in ("open", "close"):
                    bench.require(told, learner, bench.then(operation) if outcome == "done" else bench.ground)
                    with opened(path, "read") as reader:
                        bench.require(
                            f"{told}, a reader", reader, bench.then(operation) if outcome == "done" else bench.ground
                        )
                (where / "filler").unlink()
                bench.examined(told, path, learner, operation, outcome)
            bench.note(f"full: {name}", outcome)
            if outcome == "done" and room:
                break
        if bench.outcomes[f"full: {name}"][StoreFullError.__name__] == 0 and name != "open":
            bench.failures.append(f"{name}: was never refused by a full disk")


def read_only(bench: Bench, where: Path) -> None:
    """A disk mounted to be read."""
    path = where / "memory"
    bench.ready(path, ("open",))
    subprocess.run(["mount", "-o", "remount,ro", where], check=True)
    try:
        outcome, _ = bench.attempt(path, None, ("open",))
        bench.note("read-only: open to write", outcome)
        if outcome != ReadOnlyError.__name__:
            bench.failures.append(f"opening to write on a read-only disk: {outcome}")
        with opened(path, "read") as reader:
            bench.require("opened to read on a read-only disk", reader, bench.ground)
            bench.note("read-only: open to read", "done")
    finally:
        subprocess.run(["mount", "-o", "remount,rw", where], check=True)


def from_now_on(bench: Bench, path: Path, name: str, error: int, allowed: tuple[str, ...]) -> None:
    """All writing calls fail from one instant on, and then no more."""
    shim = Shim()
    for operation_name, operation in OPERATIONS.items():
        learner = bench.ready(path, operation)
        with warnings_told(lambda text: None):
            shim.arm(path, watch.FAIL, watch.WRITES, first=1, last=watch.FOREVER, error=error)
            outcome, learner = bench.attempt(path, learner, operation)
            shim.disarm()
            if outcome not in allowed:
                bench.failures.append(f"{name}: {operation_name}: {outcome}")
            bench.examined(f"{name}: {operation_name}", path, learner, operation, outcome)
        bench.note(f"{name}: {operation_name}", outcome)


def main(options: argparse.Namespace) -> dict[str, Any]:
    """All of it; what needs a mount is left out where there may be none."""
    quiet_coroutines()
    warm()
    skipped = []
    with folder(options, in_memory=True) as home:
        bench = Bench(home)
        if may_mount(home):
            with mounted(home / "disk", SIZE) as disk:
                pages = [0, 40, 160] if options.quick else [0, 1, 3, *range(8, 240, 8)]
                full(bench, disk, [4096 * page for page in pages])
                progress(f"full: {bench.tried} operations, {len(bench.failures)} failures")
                read_only(bench, disk)
        else:
            skipped.append("full and read-only file systems: this process may not mount")
        # SQLite tells of a failed write only that it failed: the more exact error comes where the store itself writes.
        refused = ("StoreError", "ReadOnlyError", "StoreFullError")
        if not options.quick:
            from_now_on(bench, home / "quota", "over quota (EDQUOT)", errno.EDQUOT, refused)
            from_now_on(bench, home / "failing", "failing (EIO)", errno.EIO, refused)
        from_now_on(bench, home / "turned", "turned read-only (EROFS)", errno.EROFS, refused)
    return {
        "operations": bench.tried,
        "skipped": skipped,
        "outcomes": {name: dict(counted) for name, counted in bench.outcomes.items()},
        "failures": bench.failures,
    }


if __name__ == "__main__":
    watch.begin_again_watched()
    run("disk", parser(__doc__).parse_args(), main)
