"""What is done in a block that comes from somebody else: confined to its folder, in time and in memory."""

import os
import resource
import signal
import sys
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

from faults.common import fingerprint
from scroll_tactile_store import StoreError

from scroll_tactile.errors import ScrollTactileError

OURS = (StoreError, ScrollTactileError)
ROOM = 400 * 2**20  # bytes of memory; recordings are allowed 256 MiB and a multiple of their own
SECONDS = 60
REFUSED, HARMLESS = "refused", "harmless"
CALLS = SimpleNamespace(outside=None, seen=[])


class Late(BaseException):
    """Nobody catches it, as code does that reads files and is told of an OSError."""


def audit(event, given):
    """Note what is opened outside, and each program and each pickle that is begun."""
    if CALLS.outside is None:
        return
    opens = event == "open" and isinstance(given[0], str | bytes)
    if opens and os.path.realpath(os.fsdecode(given[0])).startswith(CALLS.outside):
        CALLS.seen.append(f"opened {given[0]}")
    if event in ("os.system", "os.posix_spawn", "os.exec", "subprocess.Popen", "pickle.find_class"):
        CALLS.seen.append(f"{event} {given}")


sys.addaudithook(audit)


def most_memory():
    """The most that this process had at once since that was last reset."""
    return int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) * 1024


def ran_out(error):
    """Whether somebody asked for more memory than there may be."""
    return error is not None and (isinstance(error, MemoryError) or ran_out(error.__cause__ or error.__context__))


@contextmanager
def confined(outside):
    """In the block nothing runs, nothing outside is opened or changed, and less than ROOM is taken."""

    def late(*_):
        raise Late(f"it took more than {SECONDS} s")

    before, CALLS.seen[:] = fingerprint(outside), []
    own = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limit, handler = resource.getrlimit(resource.RLIMIT_AS), signal.signal(signal.SIGALRM, late)
    Path("/proc/self/clear_refs").write_text("5")
    start = most_memory()
    resource.setrlimit(resource.RLIMIT_AS, (own + 4 * ROOM, limit[1]))  # the machine is to live
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    CALLS.outside = str(outside.resolve())
    try:
        yield
    finally:
        CALLS.outside = None
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)
        resource.setrlimit(resource.RLIMIT_AS, limit)
    assert most_memory() - start < ROOM
    assert CALLS.seen == []
    assert fingerprint(outside) == before


def ending(do, outside):
    """How something ends that is done confined."""
    with confined(outside):
        try:
            do()
        except OURS as error:
            assert not ran_out(error)
            return REFUSED
    return HARMLESS
