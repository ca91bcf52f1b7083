"""This checkout beside an older one in one run: each learner in a process of its own, which is called in turns.

Milliseconds that were taken on different days, or machines, say nothing of a change; ratios of one run do.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.sensors import Sensor

__all__ = ["HERE", "Worker", "checkouts", "disk_bytes", "in_turns", "write_touches"]

HERE = Path(__file__).resolve().parent
NAME_BYTES = 32  # as `worker` has it


def checkouts(before: Path | None) -> dict[str, Path]:
    """ "now" and, if any, "before" → a checkout of the project. Raises InputError for a folder that is none."""
    found = {"now": HERE.parents[1]}
    if before is not None:
        if not (before / "scroll_tactile" / "__init__.py").is_file():
            raise InputError(f"expected a checkout of the project in {before}; it has no scroll_tactile/__init__.py")
        found["before"] = before.resolve()
    return found


def write_touches(
    folder: Path,
    sensor: Sensor,
    touches: Iterable[tuple[str, npt.NDArray[np.float32]]],
    readings: int,
    **made: int,
) -> Path:
    """Touches, of so many readings each, into a folder from which a worker reads them one by one.

    What an earlier run wrote there is taken as it is: it is described last. made: by what they differ from others of
    this sensor, such as the seed. Raises InputError where an earlier run made others.
    """
    folder.mkdir(parents=True, exist_ok=True)
    described = {"sensor": sensor.model_dump(exclude_defaults=True), "readings": readings, "made": made}
    if (folder / "touches.json").exists():
        before = json.loads((folder / "touches.json").read_text())
        if before != json.loads(json.dumps(described)):
            raise InputError(
                f"expected touches in {folder} made with {made}; came those of another run, {before.get('made')}: go "
                "on with its options, or give another folder"
            )
        return folder
    with (folder / "readings").open("wb") as values, (folder / "materials").open("wb") as names:
        for name, touch in touches:
            assert touch.shape == (readings, sensor.channels)
            values.write(np.ascontiguousarray(touch, np.float32).tobytes())
            names.write(name.encode().ljust(NAME_BYTES, b"\0"))
    (folder / "touches.json").write_text(json.dumps(described))
    return folder


def disk_bytes(path: Path, pattern: str = "**/*") -> int:
    """The sizes of the files below a path, together."""
    return sum(file.stat().st_size for file in path.glob(pattern) if file.is_file())


class Worker:
    """A process of `worker` with a checkout's path, ready for calls. Ended, it leaves memories as if it was killed.

    started: the seconds that importing torch took, and what it holds in memory by itself.
    """

    def __init__(self, checkout: Path, touches: Path) -> None:
        # -P: beside the checkout's own path nothing of this folder's is to be imported.
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(HERE / "worker.py"), str(touches)],
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(checkout), str(checkout / "store")])},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.started: dict[str, float] = self._answer()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def call(self, name: str, **take: Any) -> dict[str, Any]:
        """The worker's answer to a call: how long it took, `wall` and `processor`, in seconds, and what it `said`."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"call": name, **take}) + "\n")
        self._process.stdin.flush()
        return self._answer()

    def wall(self, name: str, **take: Any) -> float:
        """The seconds of a call by the clock on the wall."""
        return float(self.call(name, **take)["wall"])

    def memory(self, what: str = "resident") -> float:
        """MB that the process holds beyond what it held with torch alone; what: or "peak", the most it ever held.

        NaN where the system does not say.
        """
        held, beside = self.call("memory").get(what), self.started["resident"]
        return float("nan") if held is None else held - beside

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise InputError(f"expected an answer of {self._process.args!r}; it ended with {self._process.wait()}")
        answer: dict[str, Any] = json.loads(line)
        return answer


def in_turns(stack: ExitStack, sides: dict[str, Path], touches: Path) -> dict[str, Worker]:
    """A worker of each checkout, which end with the stack."""
    return {name: stack.enter_context(Worker(checkout, touches)) for name, checkout in sides.items()}
