"""What every command of this folder has: its options, a folder to harm, and a record of what came of it."""

from __future__ import annotations

import argparse
import hashlib
import inspect
import json
import logging
import os
import platform
import shlex
import shutil
import sqlite3
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from scroll_tactile import __version__

# Folders that are harmed by the shim and not by the disk may lie in memory, where nothing is waited for.
IN_MEMORY = Path("/dev/shm")

ABOUT = ("command", "seed", "date", "versions", "machine")  # in the file alone
PACKAGES = ("numpy", "torch", "zarr", "numcodecs", "filelock")


def parser(about: str | None, *, seed: int | None = 0, **defaults: Any) -> argparse.ArgumentParser:
    """The options that every command has, and one for each default: --name VALUE, or --name where it is False."""
    made = argparse.ArgumentParser(description=(about or "").split("\n\n", maxsplit=1)[0])
    made.add_argument("--quick", action="store_true", help="a few of each, in seconds")
    made.add_argument("--seed", type=int, default=seed)
    made.add_argument("--json", type=Path, help="file for the record")
    made.add_argument("--home", type=Path, help="folder in which memories are made and harmed")
    for name, value in defaults.items():
        if value is False:
            made.add_argument(f"--{name}", action="store_true")
        else:
            made.add_argument(f"--{name}", type=type(value), default=value)
    return made


@contextmanager
def folder(options: argparse.Namespace, *, in_memory: bool = False) -> Iterator[Path]:
    """An empty folder that is removed afterwards; in_memory: where the disk's own speed and safety do not matter."""
    base = options.home or (IN_MEMORY if in_memory and os.access(IN_MEMORY, os.W_OK) else None)
    made = Path(tempfile.mkdtemp(prefix="faults-", dir=base))
    try:
        yield made
    finally:
        shutil.rmtree(made, ignore_errors=True)


def file_system(path: Path) -> str:
    """The type of the file system that holds a folder, where the machine tells."""
    try:
        lines = Path("/proc/mounts").read_text(encoding="utf-8").splitlines()
    except OSError:
        return "unknown"
    mounts = [line.split()[1:3] for line in lines]
    held = [(where, kind) for where, kind in mounts if path.resolve().is_relative_to(where)]
    return max(held, default=("", "unknown"), key=lambda one: len(one[0]))[1]


def fingerprint(path: Path) -> dict[str, Any]:
    """Everything in a folder: of each thing its type and, by that, its bytes or where it points."""
    found: dict[str, Any] = {}
    for entry in sorted(os.scandir(path), key=lambda entry: entry.name) if path.is_dir() else ():
        about = entry.stat(follow_symlinks=False)
        if entry.is_symlink():
            found[entry.name] = str(Path(entry.path).readlink())
        elif entry.is_dir():
            found[entry.name] = about.st_mode
            found |= {f"{entry.name}/{name}": what for name, what in fingerprint(Path(entry.path)).items()}
        elif entry.is_file() and about.st_size < 2**24:
            found[entry.name] = hashlib.sha256(Path(entry.path).read_bytes()).hexdigest()
        else:
            found[entry.name] = (about.st_mode, about.st_size)
    return found


class Warnings(logging.Handler):
    """Hears what the store and the library log as a warning or worse, and tells `hear`."""

    def __init__(self, hear: Callable[[str], object]) -> None:
        super().__init__(logging.WARNING)
        self._hear = hear

    def emit(self, record: logging.LogRecord) -> None:
        self._hear(f"{record.levelname}: {record.getMessage()}")


@contextmanager
def warnings_told(hear: Callable[[str], object]) -> Iterator[None]:
    """While it lasts, `hear` gets each warning, and nothing of it is printed."""
    heard = Warnings(hear)
    loggers = [logging.getLogger(name) for name in ("scroll_tactile_store", "scroll_tactile")]
    for logger in loggers:
        logger.addHandler(heard)
        logger.propagate = False
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeHandler(heard)
            logger.propagate = True


def quiet_coroutines() -> None:
    """Say nothing of the coroutines that zarr leaves behind where the one before them failed."""
    warnings.filterwarnings("ignore", message="coroutine .* was never awaited")
    told = sys.unraisablehook

    def others(about: Any) -> None:
        if not inspect.iscoroutine(about.object):
            told(about)

    sys.unraisablehook = others


def _machine() -> dict[str, Any]:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")
    except OSError:
        model = platform.processor()
    return {"system": platform.platform(), "processor": model, "cores": os.cpu_count()}


def _without_folders(words: Sequence[str]) -> list[str]:
    """The words of a command without the folders of the machine that it ran on."""
    return [Path(word).name if "/" in word else word for word in words]


def run(
    name: str, options: argparse.Namespace, work: Callable[[argparse.Namespace], Mapping[str, Any]]
) -> dict[str, Any]:
    """Do a command's work, print its figures and write its record; exits with 1 where a bar was missed.

    work: gives the figures, and a list "failures" of sentences.
    """
    begun = time.perf_counter()
    figures = dict(work(options))
    failures = figures.pop("failures", [])
    record = {
        "name": name,
        "command": shlex.join(["python", f"tests/faults/{Path(sys.argv[0]).name}", *_without_folders(sys.argv[1:])]),
        "seed": options.seed,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"python": platform.python_version(), "sqlite": sqlite3.sqlite_version}
        | {"scroll-tactile": __version__}
        | {package: version(package) for package in PACKAGES},
        "machine": _machine(),
        "seconds": round(time.perf_counter() - begun, 1),
        **figures,
        "failures": failures,
    }
    print(json.dumps({name: told for name, told in record.items() if name not in ABOUT}, indent=1, ensure_ascii=False))
    if options.json is not None:
        options.json.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    if failures:
        sys.exit(1)
    return record


def progress(text: str) -> None:
    """A line that says how far it is, on standard error."""
    print(text, file=sys.stderr, flush=True)
