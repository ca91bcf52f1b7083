"""Boards that QEMU plays: how the exported judge is compiled for each, run there, and its instructions counted."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["BOARDS", "Board", "missing_tools"]

HERE = Path(__file__).parent
SOURCES = ("touch_memory.c", "judge.c", "kernels.c")
BARE = ("--specs=rdimon.specs", f"-Wl,-T,{HERE / 'mps2.ld'}", str(HERE / "startup.c"))


@dataclass(frozen=True)
class Board:
    """A machine that QEMU plays.

    machine: of qemu-system-arm; empty for a program of the user's, which qemu-aarch64 runs. megahertz: of such chips.
    """

    name: str
    compiler: str
    flags: tuple[str, ...]
    emulator: str
    machine: str = ""
    megahertz: int = 0

    def build(self, folder: Path) -> Path:
        """Compile what was exported into a folder. Raises subprocess.CalledProcessError."""
        program = folder / f"measure-{self.emulator}-{self.machine}"
        own = BARE if self.machine else ("-static",)
        command = [self.compiler, "-std=c99", "-O2", *self.flags, f"-I{folder}", "-o", str(program)]
        _run([*command, str(HERE / "measure.c"), *own, *(str(folder / name) for name in SOURCES)])
        return program

    def sizes(self, folder: Path) -> dict[str, int]:
        """Bytes of flash and RAM of the exported code and tables alone."""
        objects = []
        for name in SOURCES:
            objects.append(str(folder / f"{name}-{self.machine}.o"))
            _run([self.compiler, "-std=c99", "-O2", *self.flags, "-c", str(folder / name), "-o", objects[-1]])
        lines = _run([self.compiler.replace("gcc", "size"), *objects]).splitlines()[1:]
        text, data, zeros = (sum(int(line.split()[i]) for line in lines) for i in range(3))
        return {"flash": text + data, "ram": data + zeros}

    def judge(self, program: Path, touches: Path, counted: int = 0) -> dict[str, Any]:
        """Judge the touches of a file: how many, how many answers differ; and the instructions of the first ones.

        counted: so many touches; all are judged, and none counted, where it is 0.
        """
        words = [touches.name, *([str(counted)] if counted else [])]
        if self.machine:
            arguments = ",".join(f"arg={word}" for word in ("measure", *words))
            command = [self.emulator, "-M", self.machine, "-nographic", "-kernel", str(program)]
            command += ["-semihosting-config", f"enable=on,target=native,{arguments}"]
            command += ["-icount", "shift=0"] if counted else []
        else:
            command = [self.emulator, str(program), *words]
        *lines, last = _run(command, touches.parent, unsound=1).strip().splitlines()
        judged, _, differ, _ = last.split()
        found: dict[str, Any] = {"touches": int(judged), "differ": int(differ)}
        if counted and self.machine:
            found["instructions"] = [[int(word) for word in line.split()] for line in lines]
        return found


def _run(command: list[str], folder: Path | None = None, unsound: int = 0) -> str:
    """What a command says. unsound: an exit status that is no error beside 0."""
    done = subprocess.run(command, cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if done.returncode not in (0, unsound):
        raise subprocess.CalledProcessError(done.returncode, command, done.stdout, done.stderr)
    return done.stdout


_THUMB = ("-mthumb", "-mfloat-abi=hard")
BOARDS = (
    Board(
        "Cortex-M4F (mps2-an386)",
        "arm-none-eabi-gcc",
        ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", *_THUMB),
        "qemu-system-arm",
        "mps2-an386",
        80,
    ),
    Board(
        "Cortex-M7 (mps2-an500)",
        "arm-none-eabi-gcc",
        ("-mcpu=cortex-m7", "-mfpu=fpv5-d16", *_THUMB),
        "qemu-system-arm",
        "mps2-an500",
        480,
    ),
    Board("aarch64", "aarch64-linux-gnu-gcc", (), "qemu-aarch64"),
)


def missing_tools(board: Board) -> list[str]:
    """The programs that a board needs and this machine has not; Debian has them."""
    return [tool for tool in (board.compiler, board.emulator) if shutil.which(tool) is None]
