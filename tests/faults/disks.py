"""A disk as it may look after a power cut, from all that was written to it in order.

What the rules allow, and nothing that one file system happens to do besides: the bytes of a file are there when the
file was synced after them, and a name is there (or gone, or moved) when its folder was. Of the writes to a file since
then any may have come, in any order, each sector of 512 bytes by itself; its length may have come without the bytes,
and be filled with zeros or with what was on the disk before. Of the changes to a folder since then those up to any
one may have come. Nothing orders a file against another, nor against its folder. Bytes beside a write stay as they
are.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

SECTOR = 512

Style = Literal["nothing", "all", "prefix", "scattered", "names only", "bytes only"]
STYLES: tuple[Style, ...] = ("nothing", "all", "prefix", "prefix", "scattered", "scattered", "names only", "bytes only")


@dataclass(frozen=True)
class Event:
    """A call that was written down: see shim.c. kind "M": a mark of our own, whose text is the path."""

    kind: str
    inode: int
    offset: int
    path: str
    data: bytes


def events(log: Path) -> Iterator[Event]:
    """What a log tells, in order."""
    raw, i = log.read_bytes(), 0
    while i < len(raw):
        line = raw.index(b"\n", i)
        kind, inode, offset, length, path_length = raw[i:line].split()
        begin = line + 1
        middle = begin + int(path_length)
        i = middle + int(length)
        yield Event(kind.decode(), int(inode), int(offset), raw[begin:middle].decode(), raw[middle:i])


@dataclass
class File:
    """Bytes that are safe, and writes since: (offset, bytes), or a length to which it was cut or grown."""

    safe: bytearray = field(default_factory=bytearray)
    since: list[tuple[int, bytes] | int] = field(default_factory=list)

    def sync(self) -> None:
        """All that was written is safe."""
        for change in self.since:
            _apply(self.safe, change)
        self.since = []

    def content(self, rng: random.Random, style: Style) -> bytes:
        """Bytes that may be found."""
        data, since = bytearray(self.safe), self.since
        if style in ("all", "bytes only"):
            kept = len(since)
        elif style == "prefix":
            kept = rng.randint(0, len(since))
        else:
            kept = 0
        for change in since[:kept]:
            _apply(data, change)
        rest = since[kept:]
        if style == "prefix":
            rest = rest[:1]
        if style in ("prefix", "scattered"):
            share = rng.choice((0.1, 0.5, 0.9))
            for change in rest:
                _scatter(data, change, rng, share)
        if style in ("names only", "scattered") and rng.random() < 0.5:
            _grow(data, since, rng)
        return bytes(data)


def _apply(data: bytearray, change: tuple[int, bytes] | int) -> None:
    if isinstance(change, int):
        del data[change:]
        data.extend(bytes(change - len(data)))
        return
    offset, part = change
    data.extend(bytes(max(0, offset + len(part) - len(data))))
    data[offset : offset + len(part)] = part


def _scatter(data: bytearray, change: tuple[int, bytes] | int, rng: random.Random, share: float) -> None:
    """Apply a cut or not; of a write each sector or not."""
    if isinstance(change, int):
        if rng.random() < share:
            _apply(data, change)
        return
    offset, part = change
    begin = offset
    while begin < offset + len(part):
        end = min(offset + len(part), (begin // SECTOR + 1) * SECTOR)
        if rng.random() < share:
            _apply(data, (begin, part[begin - offset : end - offset]))
        begin = end


def _grow(data: bytearray, since: list[tuple[int, bytes] | int], rng: random.Random) -> None:
    """Give the file the length that it was to have, without the bytes."""
    ends = [change if isinstance(change, int) else change[0] + len(change[1]) for change in since]
    missing = max(ends, default=0) - len(data)
    if missing > 0:
        data.extend(rng.choice((bytes(missing), rng.randbytes(missing))))


@dataclass
class Folder:
    """Names that are safe, names as they are now, and changes since: (name, node or None), or two names of a move."""

    safe: dict[str, Node] = field(default_factory=dict)
    now: dict[str, Node] = field(default_factory=dict)
    since: list[tuple[str, Node | None] | tuple[str, str]] = field(default_factory=list)

    def change(self, change: tuple[str, Node | None] | tuple[str, str]) -> None:
        """Do it, not safe yet."""
        self.since.append(change)
        _rename(self.now, change)

    def sync(self) -> None:
        """All names are safe as they are now."""
        self.safe, self.since = dict(self.now), []

    def content(self, rng: random.Random, style: Style) -> dict[str, Node]:
        """Names that may be found."""
        names, count = dict(self.safe), len(self.since)
        kept = count if style in ("all", "names only") else 0 if style in ("nothing", "bytes only") else None
        for change in self.since[: rng.randint(0, count) if kept is None else kept]:
            _rename(names, change)
        return names


Node = File | Folder


def _rename(names: dict[str, Node], change: tuple[str, Node | None] | tuple[str, str]) -> None:
    name, other = change
    if isinstance(other, str):
        names[other] = names.pop(name)
    elif other is None:
        del names[name]
    else:
        names[name] = other


class Disk:
    """Everything below a folder, as it goes through events; what is there at the start is safe."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.inodes: dict[int, File] = {}
        self.top = self._scanned(root)

    def _scanned(self, path: Path) -> Folder:
        folder = Folder()
        for entry in path.iterdir():
            if entry.is_dir():
                folder.now[entry.name] = self._scanned(entry)
            else:
                file = File(bytearray(entry.read_bytes()))
                folder.now[entry.name] = self.inodes[entry.stat().st_ino] = file
        folder.sync()
        return folder

    def _folder(self, path: str) -> Folder:
        node: Node = self.top
        for name in Path(path).relative_to(self.root).parts:
            assert isinstance(node, Folder)
            node = node.now[name]
        assert isinstance(node, Folder)
        return node

    def apply(self, event: Event) -> None:
        """Go on by one event."""
        if event.kind == "W":
            self.inodes[event.inode].since.append((event.offset, event.data))
        elif event.kind == "T":
            self.inodes[event.inode].since.append(event.offset)
        elif event.kind == "S":
            self.inodes[event.inode].sync()
        elif event.kind == "F":
            self._folder(event.path).sync()
        elif event.kind != "M":
            self._named(event)

    def _named(self, event: Event) -> None:
        where = Path(event.path)
        folder, name = self._folder(str(where.parent)), where.name
        if event.kind == "C":
            self.inodes[event.inode] = File()
            folder.change((name, self.inodes[event.inode]))
        elif event.kind == "D":
            folder.change((name, Folder()))
        elif event.kind in ("U", "X"):
            folder.change((name, None))
        else:
            other = Path(event.data.decode())
            assert other.parent == where.parent, event
            folder.change((name, other.name) if event.kind == "R" else (other.name, folder.now[name]))

    def unsafe(self) -> int:
        """How many changes, of bytes and names, are not safe."""
        nodes, count = [self.top], 0
        while nodes:
            node = nodes.pop()
            count += len(node.since)
            nodes += list(node.now.values()) if isinstance(node, Folder) else []
        return count

    def rebuilt(self, to: Path, rng: random.Random, style: Style) -> None:
        """Make folder `to` as the disk may look after a power cut now."""
        rebuild(self.top, to, rng, style)


def rebuild(folder: Folder, to: Path, rng: random.Random, style: Style) -> list[tuple[Path, File]]:
    """Make folder `to` as this one may look after a power cut; its files."""
    to.mkdir()
    made = []
    for name, node in folder.content(rng, style).items():
        if isinstance(node, Folder):
            made += rebuild(node, to / name, rng, style)
        else:
            (to / name).write_bytes(node.content(rng, style))
            made.append((to / name, node))
    return made
