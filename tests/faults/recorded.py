"""Recordings from elsewhere, one hostile case after another in a process that may die of it; see `hostile`.

A case mutates a small recording of any format, or what it was made of, or is one of `recording_attacks`, and has it
read, read block by block, described, or found in its folder. It may only be read or be refused with an InputError. A
failure is: a crash; another error; more than ten seconds of work; more memory than the bound of recordings allows; a
file that is made or changed elsewhere; a file elsewhere that is opened; a program or an unpickling that is begun.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from made import FORMATS

from faults.cases import Cases, Told, limit_addresses, remove, size
from faults.common import fingerprint
from faults.mutants import mutated_bytes, mutated_json
from faults.odd_recordings import made, mutated_lines, spiced
from faults.recording_attacks import ATTACKS, SECRET, special
from scroll_tactile.errors import InputError
from scroll_tactile.recordings import describe, find, iterate, read
from scroll_tactile.recordings.bounds import RATIO, SPARE

# Of what is read once as it was written, as floats, and joined: four times what a recording may hold.
TIMES = 4
LONGEST = 20_000  # letters of a message
KINDS = ("bytes", "json", "entries", "made")
SHARES = (60, 15, 5, 20)
TEXT = (".json", ".zarray", ".zgroup", ".zattrs", ".yaml", ".csv")
BEGUN = {"pickle.find_class", "subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "socket.connect"}


@dataclass
class Form:
    """A recording of the corpus: the folder that it lies in, its path in there, and what `read` takes."""

    name: str
    folder: Path
    path: Path
    options: dict[str, Any]


def prepared(home: Path) -> list[Form]:
    """A recording of each format, and a folder that is watched."""
    forms = []
    for i, (name, (make, options)) in enumerate(FORMATS.items()):
        folder = home / "corpus" / str(i)
        folder.mkdir(parents=True)
        forms.append(Form(name, folder, make(folder).relative_to(folder), options))
    (home / "watched").mkdir()
    (home / "watched" / "secret").write_bytes(bytes([SECRET]) * 4096)
    (home / "watched" / "12345").mkdir()
    (home / "watched" / "12345" / "data").write_bytes(bytes([SECRET]) * 4096)
    return forms


def warm() -> None:
    """Have everything imported, with no thread running."""
    import h5py
    import lz4.frame
    import numcodecs
    import PIL.Image
    import pyarrow.parquet
    import rosbags.typesys
    import ruamel.yaml
    from backports import zstd

    PIL.Image.init()
    assert all((h5py, lz4, numcodecs, pyarrow, rosbags, ruamel, zstd))


class RecordingBench(Cases):
    """Cases of recordings, and an ear for what is opened and begun."""

    def __init__(self, home: Path, forms: list[Form], options: Any, log: TextIO) -> None:
        super().__init__(home, options, log)
        self.forms, self.case = forms, self.own / "case"
        for name in ("case", "tmp"):
            (self.own / name).mkdir()
        tempfile.tempdir = str(self.own / "tmp")
        self.heard: set[str] = set()
        self.listening = False
        sys.addaudithook(self._hear)
        warnings.simplefilter("ignore")

    def _hear(self, event: str, about: tuple[Any, ...]) -> None:
        if not self.listening:
            return
        if event in BEGUN:
            self.heard.add(f"began {event}")
        elif event == "open" and isinstance(about[0], str | bytes) and str(self.watched) in os.fsdecode(about[0]):
            self.heard.add("opened a file elsewhere")

    def named(self, name: str, number: int = -1) -> Told:
        """Do an attack that has a name, before every reader."""
        told = Told(number, name, name.partition(" ")[0])
        self._clear()
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.getrlimit(resource.RLIMIT_AS)[1]))
        path, options = ATTACKS[name](self.case, self.watched / "secret")  # which may need more than its readers get
        limit_addresses()
        self.watching = fingerprint(self.watched)  # some need files of others
        for reader in READERS:
            self._read(reader, path, options, told)
        if any(outcome == "read: accepted" for outcome in told.outcomes):
            told.findings.append(("accepted what nobody may take in", name))
        return told

    def once(self, number: int) -> Told:
        """Do a case."""
        rng = random.Random(f"{self.seed}:{number}")
        kind = rng.choices(KINDS, SHARES)[0]
        told = Told(number, "", kind)
        self._clear()
        try:
            if kind == "made":
                path, options, told.about = made(rng, self.case)
            else:
                form = rng.choice(self.forms)
                shutil.copytree(form.folder, self.case, dirs_exist_ok=True)
                path, options = self.case / form.path, form.options
                told.about = f"{form.name}: {self._mutated(rng, kind, form)}"[:300]
        except Exception as error:  # a library does not write it
            told.outcomes.append(f"no attack: {type(error).__name__}")
            return told
        first = rng.choice(READERS[:2])
        for reader in (first, *rng.sample(READERS, 1 if rng.random() < 0.3 else 0)):
            self._read(reader, path, options, told)
        return told

    def _mutated(self, rng: random.Random, kind: str, form: Form) -> str:
        files = sorted(file for file in self.case.rglob("*") if file.is_file())
        told = []
        if kind == "json":
            files = [file for file in files if file.name.endswith(TEXT)] or files
        for _ in range(rng.choice((1, 1, 1, 2, 4))):
            file = rng.choice(files)
            if not file.is_file() or file.is_symlink():
                continue
            name = file.relative_to(self.case).as_posix()
            if kind == "entries":
                told.append(f"{name}, {self._other(rng, file)}")
                continue
            whole = file.read_bytes()
            if kind == "json" and file.suffix != ".yaml" and whole[:1] == b"{":
                how, text = mutated_json(rng, spiced(rng, json.loads(whole)))
                file.write_text(text, encoding="utf-8", errors="surrogatepass")
            elif kind == "json" and file.suffix in (".yaml", ".csv"):
                how, text = mutated_lines(rng, whole.decode())
                file.write_text(text, encoding="utf-8", errors="surrogatepass")
            else:
                others = [other.folder / other.path for other in rng.sample(self.forms, 3)]
                how, data = mutated_bytes(rng, whole, [other.read_bytes() for other in others if other.is_file()])
                file.write_bytes(data)
            told.append(f"{name}, {how}")
        return "; ".join(told)

    def _other(self, rng: random.Random, file: Path) -> str:
        kinds = ["fifo", "socket", "folder", "device", "empty", "sparse", "form", "gone"]
        if file.parent != self.case:  # a recording that is a link itself is read: people lay their own out so
            kinds.append("link")
        kind = rng.choice(kinds)
        if kind == "form":
            other = rng.choice(self.forms)
            source = other.folder / other.path
            inside = [source] if source.is_file() else [path for path in source.rglob("*") if path.is_file()]
            shutil.copyfile(rng.choice(inside), file)
        elif kind == "sparse":
            with file.open("r+b") as there:
                there.truncate(rng.choice((2**31, 2**40)))
        else:
            file.unlink()
            if kind == "empty":
                file.write_bytes(b"")
            elif kind != "gone":
                special(file, kind, self.watched / "secret", rng.choice(("/dev/zero", "/dev/null", "/proc/self/mem")))
        return kind

    def _clear(self) -> None:
        if self.case.exists():
            remove(self.case)
        self.case.mkdir()

    def _read(self, reader: Reader, path: Path, options: dict[str, Any], told: Told) -> None:
        """Have one reader at it, and look at what it did."""
        name = reader.__name__
        before = fingerprint_of(self.case)
        for file in self.watched.rglob("*"):
            os.utime(file, ns=(0, file.stat().st_mtime_ns))

        def listened() -> str:
            self.listening = True
            try:
                return reader(path, options)
            except InputError as error:
                if not 0 < len(str(error)) <= LONGEST:
                    told.findings.append((f"a message of {len(str(error))} letters", name))
                raise
            finally:
                self.listening = False

        self.bounded(told, name, SPARE * TIMES + (TIMES * RATIO) * size(self.case), listened, (InputError,))
        told.findings += [(what, name) for what in sorted(self.heard)]
        self.heard.clear()
        if any(file.is_file() and file.stat().st_atime_ns for file in self.watched.rglob("*")):
            told.findings.append(("read a file elsewhere", name))
        if fingerprint_of(self.case) != before:
            told.findings.append((f"{name} changed the recording", ""))
        self.require_untouched(told, name)
        for file in (self.own / "tmp").iterdir():
            told.findings.append((f"{name} left {file.name} in the temporary folder", ""))
            remove(file)


def fingerprint_of(folder: Path) -> dict[str, Any]:
    """Of each thing in a folder its type, size and time of change: what is sparse is not read."""
    about = {path: path.lstat() for path in folder.rglob("*")}
    return {str(path): (stat.st_mode, stat.st_size, stat.st_mtime_ns) for path, stat in about.items()}


def _secret(readings: Any) -> None:
    """Raises where readings are what only a file elsewhere holds."""
    flat = np.asarray(readings).reshape(-1)[:100_000].astype(np.float64)
    for kind in ("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<f4", "<u8", "<i8", "<f8"):
        value = np.frombuffer(bytes([SECRET]) * 8, kind)[0]
        if len(flat) >= 64 and np.count_nonzero(flat == float(value)) > len(flat) // 2:
            raise AssertionError("the readings are of a file elsewhere")


def whole(path: Path, options: dict[str, Any]) -> str:
    """As `learn` reads it."""
    recording = read(path, **options)
    str(recording.report)
    _secret(recording.readings)
    return "accepted"


def in_blocks(path: Path, options: dict[str, Any]) -> str:
    """As a stream."""
    for block in iterate(path, **options):
        _secret(block.readings)
    return "accepted"


def described(path: Path, options: dict[str, Any]) -> str:
    """As `describe` tells what there is."""
    str(describe(path))
    return "described"


def found(path: Path, options: dict[str, Any]) -> str:
    """As `learn` finds it in a folder, and reads it without knowing what it is."""
    for recording in find(path.parent):
        _secret(read(recording).readings)
    return "accepted"


whole.__name__ = "read"
Reader = Callable[[Path, dict[str, Any]], str]
READERS: tuple[Reader, ...] = (whole, in_blocks, described, found)
