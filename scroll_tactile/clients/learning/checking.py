"""The check of a memory that comes from elsewhere, in a process of its own, which may die of it.

The process has a bound on its memory and on its time, by the size of the folder. So a file that crashes a library,
takes all memory or never ends is reported as damage, and takes nobody with it.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from threading import Event, Timer
from typing import Any

from scroll_tactile_store import (
    LockedError,
    NotAStoreError,
    Problem,
    ReadOnlyError,
    StoreError,
    StoreFullError,
    VersionError,
)
from scroll_tactile_store import check_store as check_checksums
from scroll_tactile_store.exceptions import reported
from scroll_tactile_store.files import store_folder, tree_size

__all__ = ["check_in_process"]

# Address space beyond what the process has when it begins: arrays are stored compressed, some a hundredfold.
SPARE_BYTES = 2**30
BYTES_A_BYTE = 16
# A sound memory of 267 MB is checked in 10 s on an idle machine.
SPARE_SECONDS = 60.0
BYTES_A_SECOND = 2**20

REFUSALS = {
    error.__name__: error for error in (LockedError, NotAStoreError, ReadOnlyError, StoreFullError, VersionError)
}


def check_in_process(
    path: str | os.PathLike[str], *, progress: Callable[[str, int, int], object] = lambda what, done, of: None
) -> list[Problem]:
    """All that is wrong with the memory in folder `path`, as `store.check_store`; nothing for a sound one.

    A check that crashes, takes more than 1 GB over what the folder's size explains, or does not end is a problem of
    kind "lost". It changes nothing.
    progress: called with (what is being verified, how many are done, how many there are).

    Raises NotAStoreError, VersionError and other StoreErrors as `check_store`.
    """
    folder = store_folder(path)
    with reported(folder, "measuring the memory"):
        seconds = SPARE_SECONDS + tree_size(folder) / BYTES_A_SECOND
    problems: list[Problem] = []
    doing, ended, expired = "begun", False, Event()

    def end() -> None:
        expired.set()
        process.kill()

    with _begun(folder) as process:
        timer = Timer(seconds, end)
        timer.start()
        try:
            for kind, content in _reports(process):
                if kind == "progress":
                    doing = "verified {1} of {2} {0}".format(*content)
                    progress(*content)
                elif kind == "problem":
                    problems.append(Problem(Path(content[0]), content[1], content[2]))
                elif kind == "refused":
                    raise REFUSALS.get(content[0], StoreError)(content[1])
                ended = kind == "end"
            process.wait()
        except BaseException:
            process.kill()
            raise
        finally:
            timer.cancel()
    if not ended:
        code = process.returncode
        died = f"died by signal {-code} ({signal.strsignal(-code)})" if code < 0 else f"ended with code {code}"
        how = f"did not end within {seconds:.0f} s" if expired.is_set() else died
        what = f"the check itself {how}, when it had {doing} of {folder}: what it was reading is not as it was written"
        problems.append(Problem(folder, what, "lost"))
    return problems


def _begun(folder: Path) -> subprocess.Popen[str]:
    """The process that checks a folder, and prints what it finds."""
    # Not from the working directory: it may be the folder that came from elsewhere.
    imports = os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path if entry)
    environment = os.environ | {"PYTHONPATH": imports, "OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}
    return subprocess.Popen(
        [sys.executable, "-P", "-m", __name__, str(folder)],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def _reports(process: subprocess.Popen[str]) -> Iterator[tuple[str, Any]]:
    for line in process.stdout or ():
        with suppress(ValueError):  # the last line of a process that died may be a half of one
            kind, content = json.loads(line)
            yield kind, content


def _report(kind: str, content: object) -> None:
    print(json.dumps([kind, content]), flush=True)


def _limit(folder: Path) -> None:
    """Bound what this process may take; systems that know no such bound have none."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        most = taken + SPARE_BYTES + BYTES_A_BYTE * tree_size(folder)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


def _check(folder: Path) -> None:
    # Before the bound: what is imported is no part of the memory.
    import zarr  # noqa: F401

    from scroll_tactile.memory.gate import check_memory

    _limit(folder)
    try:
        problems = check_checksums(folder, progress=lambda *step: _report("progress", step))
        for problem in problems:
            _report("problem", (str(problem.path), problem.what, problem.kind))
        # Of rows that are not as they were written there is nothing more to say.
        if all(problem.kind == "leftover" for problem in problems):
            for what in check_memory(folder):
                _report("problem", (str(folder), what, "lost"))
    except StoreError as error:
        _report("refused", (type(error).__name__, str(error)))
    except Exception as error:
        what = f"the check itself failed in {folder} ({type(error).__name__}: {error})"
        if isinstance(error, MemoryError):
            what = f"to check {folder} takes more memory than its size explains: it is not as it was written"
        _report("problem", (str(folder), what, "lost"))
    _report("end", None)


if __name__ == "__main__":
    _check(Path(sys.argv[1]))
