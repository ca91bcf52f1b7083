"""What is done to the files of a memory before somebody receives it."""

from __future__ import annotations

import os
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Scene:
    """Where an attack takes place. others: further memories; codes: the rows of codes of a touch, by scale."""

    watched: Path
    others: tuple[Path, ...] = ()
    codes: Any = None


Attack = Callable[[random.Random, Path, Scene], str]


STRANGE_FILES = ("LOG", "LOG", "CURRENT", "CURRENT", "CURRENT.new", "log-00000009", "log-00000009.new", "lock")
STRANGE_FILES += ("LOG.damaged", "log-x", "holder.json", "holder.json.new", "checkpoints", "GROUP", "GROUP/zarr.json")
STRANGE_FILES += ("ARRAY", "ARRAY/zarr.json", "ARRAY/c", "ARRAY/c/0", "checkpoints/99999999", "GROUP.damaged")
STRANGE_FILES += ("checkpoints/00000099.partial", "derived", "derived/x")
KINDS = ("link", "link", "link", "loop", "nowhere", "pipe", "device", "folder", "sparse", "hard", "socket")
INSIDE = ("12345", "file", "memory", "memory/CURRENT", "12345/data", ".", "memory/checkpoints")
DEVICES = tuple(map(Path, ("/dev/zero", "/dev/full", "/proc/self/mem")))


def strange_file(rng: random.Random, path: Path, scene: Scene) -> str:
    """A link, a pipe, a device, a folder or a file of a terabyte in the place of a file or folder, or beside them."""
    name = rng.choice(STRANGE_FILES)
    target = path / name.replace("LOG", min(log.name for log in path.glob("log-*")))
    if name.startswith(("GROUP", "ARRAY")):
        groups = sorted((path / "checkpoints").glob("[0-9]*"))
        if not groups:
            return "no checkpoint"
        first = groups[0]
        array = rng.choice(sorted(folder.parent for folder in first.glob("*/zarr.json")))
        target = path / name.replace("GROUP", str(first)).replace("ARRAY", str(array))
    kind = rng.choice(KINDS)
    moved = path.parent / "moved"
    if os.path.lexists(target):
        target.rename(moved)
    target.parent.mkdir(parents=True, exist_ok=True)
    if kind == "link":
        to = rng.choice((*(scene.watched / name for name in INSIDE), moved, *DEVICES))
        target.symlink_to(to)
        kind = f"link to {to.name}"
    elif kind in ("loop", "nowhere"):
        target.symlink_to(target if kind == "loop" else scene.watched / "new")
    elif kind in ("pipe", "device", "socket"):
        kinds = {"pipe": 0o010600, "device": 0o020600, "socket": 0o140600}
        os.mknod(target, kinds[kind], os.makedev(1, 5))
    elif kind == "folder":
        target.mkdir()
        (target / "12345").mkdir()
        (target / "file").write_text("x")
    elif kind == "sparse":
        with target.open("wb") as file:
            if moved.is_file():
                file.write(moved.read_bytes())
            file.truncate(rng.choice((2**31, 2**40)))
    else:
        os.link(scene.watched / "file", target)
    if moved.is_symlink() or moved.is_file():
        moved.unlink()
    elif moved.exists() and "moved" not in kind:
        shutil.rmtree(moved)
    return f"{name}: {kind}"
