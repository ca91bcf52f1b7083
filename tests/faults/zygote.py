"""Processes that begin at once: a warm process that never opened a memory, has one thread, and forks when asked to."""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import socket
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Self

from faults.common import progress


@dataclass
class Child:
    """A process that runs a function; what it is told and tells goes through `channel`."""

    pid: int
    channel: Connection
    zygote: Zygote

    def kill(self) -> None:
        """SIGKILL."""
        os.kill(self.pid, signal.SIGKILL)

    def wait(self, hear: Callable[[Any], object] = lambda told: None) -> int:
        """Return its exit status once the system has let go of all that it held: negative for a signal.

        hear: gets what it told that was not received yet.
        """
        status: int = self.zygote.ask("wait", self.pid)
        with self.channel, contextlib.suppress(EOFError, ConnectionResetError):
            while self.channel.poll(0):
                hear(self.channel.recv())
        return status


class Zygote:
    """Made by a process that is warm and has not opened a memory yet: the threads of zarr do not survive a fork."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        pid = os.fork()
        if pid == 0:
            ours.close()
            try:
                _serve(theirs)
            finally:
                os._exit(0)
        theirs.close()
        self._line, self._pid = ours, pid

    def spawn(self, function: Callable[..., None], *arguments: Any) -> Child:
        """Run a function of a module, with a connection as its first argument, in a new process."""
        ours, theirs = socket.socketpair()
        pid = self.ask("spawn", (function, arguments), theirs.fileno())
        theirs.close()
        return Child(pid, Connection(ours.detach()), self)

    def ask(self, what: str, argument: Any, *descriptors: int) -> Any:
        """Send the zygote a request, and return its answer."""
        request = pickle.dumps((what, argument))
        self._line.sendall(len(request).to_bytes(4, "little") + request)
        if descriptors:
            socket.send_fds(self._line, [b"f"], list(descriptors))
        return pickle.loads(_received(self._line))

    def close(self) -> None:
        """End the zygote."""
        self._line.close()
        os.waitpid(self._pid, 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _received(line: socket.socket) -> bytes:
    length = int.from_bytes(_exactly(line, 4), "little")
    return _exactly(line, length)


def _exactly(line: socket.socket, length: int) -> bytes:
    parts = b""
    while len(parts) < length:
        part = line.recv(length - len(parts))
        if not part:
            raise EOFError
        parts += part
    return parts


def _serve(line: socket.socket) -> None:
    while True:
        try:
            what, argument = pickle.loads(_received(line))
        except EOFError:
            return
        answer = os.waitstatus_to_exitcode(os.waitpid(argument, 0)[1]) if what == "wait" else _fork(line, *argument)
        packed = pickle.dumps(answer)
        line.sendall(len(packed).to_bytes(4, "little") + packed)


def _fork(line: socket.socket, function: Callable[..., None], arguments: tuple[Any, ...]) -> int:
    _, (descriptor, *_), _, _ = socket.recv_fds(line, 1, 1)
    pid = os.fork()
    if pid:
        os.close(descriptor)
        return pid
    status = 1
    try:
        line.close()
        function(Connection(descriptor), *arguments)
        status = 0
    except BaseException as error:
        import traceback

        traceback.print_exc()
        progress(f"process {os.getpid()}: {error!r}")
    finally:
        os._exit(status)
