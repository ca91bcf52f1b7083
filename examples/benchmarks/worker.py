"""A process that runs one checkout's learner, call by call; `checkouts` starts them, with the checkout's path.

It imports nothing of the checkout but the public names, so any version can stand beside any other. Argument: a folder
of touches that `checkouts.write_touches` made. Each line on the standard input is a call in JSON: its name and what it
takes; the answer says how long it took, by the clock on the wall and of the processor, in seconds.
"""

from __future__ import annotations

import inspect
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

__all__: list[str] = []

KEPT = {"VmRSS": "resident", "VmHWM": "peak"}  # Linux's names for what it holds in memory, and has held
NAME_BYTES = 32  # of a material in the file of their names


def _resident() -> dict[str, float]:
    """What the process holds in memory, and the most that it held, in MB; nothing where the system does not say."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    found = {name: int(rest.split()[0]) / 1024 for name, rest in (line.split(":", 1) for line in lines) if name in KEPT}
    return {KEPT[name]: value for name, value in found.items()}


class _Calls:
    """The calls by name; `learner` is that of the memory opened last."""

    def __init__(self, folder: Path, package: Any) -> None:
        self._package = package
        self._folder = folder
        self._described = json.loads((folder / "touches.json").read_text())
        self.learner: Any = None
        # Touches come round again, and each is to be learned: versions before 0.7 do so untold.
        told = "again" in inspect.signature(package.TactileLearner.observe).parameters
        self._again = {"again": True} if told else {}

    def touch(self, number: int) -> tuple[str, Any]:
        """A touch's material and its readings, read from the file: they are not to count as memory of the learner."""
        import numpy as np

        count, length, channels = NAME_BYTES, self._described["readings"], self._described["sensor"]["channels"]
        name = np.fromfile(self._folder / "materials", np.uint8, count, offset=count * number).tobytes()
        values = length * channels
        readings = np.fromfile(self._folder / "readings", np.float32, values, offset=4 * values * number)
        return name.rstrip(b"\0").decode(), readings.reshape(length, channels)

    def make(self, name: str, take: dict[str, Any]) -> Callable[[], Any]:
        """What is timed of a call; what has to be made ready for it is made first."""
        learner = self.learner
        match name:
            case "open":
                return lambda: self._open(**take)
            case "observe":
                material, readings = self.touch(take["touch"])
                return lambda: learner.observe(material, readings, **self._again)
            case "predict":
                _, readings = self.touch(take["touch"])
                return lambda: learner.predict(readings, scene=take.get("scene")).material
            case "fill":
                return lambda: self._fill(take["first"], take["last"])
            case "learned":
                return lambda: str(sum(learner.materials.values()))
            case "refresh" | "settle" | "close":
                plain: Callable[[], Any] = getattr(learner, name)
                return plain
            case _:
                raise ValueError(f"there is no call {name!r}")

    def _open(self, path: str, mode: str = "write") -> None:
        sensor = self._package.Sensor(**self._described["sensor"])
        self.learner = self._package.TactileLearner.open(path, sensor=sensor, mode=mode)

    def _fill(self, first: int, last: int) -> None:
        with self.learner.batch():
            for number in range(first, last):
                self.learner.observe(*self.touch(number), **self._again)


def _main(folder: Path) -> None:
    began = time.perf_counter()
    import torch  # noqa: F401  # before the package, of whose import it is the greatest part

    took, beside = time.perf_counter() - began, _resident()
    import scroll_tactile

    calls = _Calls(folder, scroll_tactile)
    _answer(torch=took, resident=beside.get("resident"))
    for line in sys.stdin:
        take = json.loads(line)
        name = take.pop("call")
        if name == "memory":
            _answer(**_resident())
            continue
        call = calls.make(name, take)
        begun, spent = time.perf_counter(), time.process_time()
        said = call()
        wall, processor = time.perf_counter() - begun, time.process_time() - spent
        _answer(wall=wall, processor=processor, said=said if isinstance(said, str | bool) else None)
    os._exit(0)  # what was not closed stays as a process that was killed leaves it


def _answer(**values: Any) -> None:
    print(json.dumps(values), flush=True)


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
