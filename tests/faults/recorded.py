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
import sqlite3
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from made import FORMATS, SKIN, ros

from faults.cases import Cases, Told, limit_addresses, remove, size
from faults.common import fingerprint
from faults.mutants import NUMBERS, TEXTS, VALUES, mutated_bytes, mutated_json
from faults.recording_attacks import ATTACKS, FLOATS, SECRET, mcap, mcap_chunk, message, special
from scroll_tactile.errors import InputError
from scroll_tactile.recordings import describe, find, iterate, read
from scroll_tactile.recordings.bounds import RATIO, SPARE

WORDS = ("|O", "<M8[s]", "<U9", "|V4", "float16", "<c16", "vlen-utf8", "pickle", "blosc", "sharding_indexed", "crc32c")
JSON = (*VALUES, *WORDS, *({"id": name} for name in WORDS[6:]), *({"name": name} for name in WORDS[6:]), [10**12, 19])


def spiced(rng: random.Random, value: Any) -> Any:
    """A JSON value in which, often, one place holds something of the formats' own."""
    if not isinstance(value, dict) or not value or rng.random() < 0.5:
        return value
    at, key = value, rng.choice(sorted(value))
    while isinstance(at[key], dict) and at[key] and rng.random() < 0.7:
        at = at[key]
        key = rng.choice(sorted(at))
    at[key] = [rng.choice(JSON)] if isinstance(at[key], list) and rng.random() < 0.5 else rng.choice(JSON)
    return value


def mutated_lines(rng: random.Random, text: str) -> tuple[str, str]:
    """Lines of text of which one is another, and what was done."""
    lines = text.split("\n")
    i, how = rng.randrange(len(lines)), rng.choice(("word", "drop", "twice", "swap", "alias", "long"))
    if how == "drop":
        del lines[i]
    elif how == "twice":
        lines[i:i] = [lines[i]] * rng.choice((1, 100, 10_000))
    elif how == "swap":
        j = rng.randrange(len(lines))
        lines[i], lines[j] = lines[j], lines[i]
    elif how == "long":
        lines[i] += rng.choice((" ", ",", "[", '"', "1,")) * rng.choice((100, 10_000, 100_000))
    else:
        word = rng.choice(
            ("&a [x]", "*a", "!!python/object/apply:os.system [ls]", "../x", "[]", "{}", *map(str, NUMBERS))
        )
        words = lines[i].split(",")
        words[rng.randrange(len(words))] = rng.choice((word, rng.choice(TEXTS)))
        lines[i] = ",".join(words) if how == "word" else f"{lines[i].partition(':')[0]}: {word}"
    return f"{how} in line {i}", "\n".join(lines)


def made(rng: random.Random, folder: Path) -> tuple[Path, dict[str, Any], str]:
    """A recording that its own library would write, or that is right byte by byte, of what nobody would put in it."""
    maker = rng.choice((_made_mcap, _made_definition, _made_db3))
    path, options, about = maker(rng, folder)
    return path, options, f"{maker.__name__[6:]}: {about}"[:300]


def _body(rng: random.Random) -> bytes:
    """A message of floats whose count or bytes may be others."""
    count = rng.choice((0, 1, 19, 19, 19, *NUMBERS[:16])) % 2**32
    head = rng.choice((b"\0\1\0\0", b"\0\1\0\0", b"\0\0\0\0", b"\0\3\0\0", b""))
    return head + count.to_bytes(4, "little") + rng.randbytes(rng.choice((0, 4, 76, 76, 76, 77, 1000)))


def _made_mcap(rng: random.Random, folder: Path) -> tuple[Path, dict[str, Any], str]:
    form = rng.choice(("zstd", ""))
    inside = b""
    for _ in range(rng.choice((1, 3, 30))):
        kind, data = rng.choice(
            ((5, message(_body(rng))[9:]), (4, rng.randbytes(20)), (3, rng.randbytes(30)), (9, b""))
        )
        length = len(data) if rng.random() < 0.9 else rng.choice(NUMBERS) % 2**64
        inside += bytes([kind]) + length.to_bytes(8, "little") + data
    inside *= rng.choice((1, 1, 1, 100, 30_000))
    chunk = mcap_chunk(inside, form)
    if rng.random() < 0.3:
        _, chunk = mutated_bytes(rng, chunk, ())
    path, options = mcap(lambda: [chunk] * rng.choice((1, 1, 20)))(folder, folder)
    return path, options, f"{len(inside)} bytes by {form!r}"


def _made_definition(rng: random.Random, folder: Path) -> tuple[Path, dict[str, Any], str]:
    types = ("float32", "string", "a/C", "bool", "Header", "uint8", "string<=5", "a/B", "time", "wstring", "float128")
    sizes = ("", "[]", "[3]", "[<=4]", *(f"[{number}]" for number in NUMBERS))
    names = ("data", "data", "x", "__class__", "a b", "import", "1x", "x\n\n", "é", "x=1", "self", "Exception")
    lines = [f"{rng.choice(types)}{rng.choice(sizes)} {rng.choice(names)}" for _ in range(rng.choice((1, 2, 5)))]
    text = "\n".join([*lines, "=" * 80, "MSG: a/C", f"{rng.choice(types)}{rng.choice(sizes)} y"])
    if rng.random() < 0.2:
        _, data = mutated_bytes(rng, text.encode(), ())
        text = data.decode(errors="replace")
    text = text if rng.random() < 0.8 else FLOATS + "\n" + text
    path, options = mcap(lambda: [message(_body(rng), 3)], text, rng.choice(("a/msg/B", "a/B", "a/msg/../B")))(
        folder, folder
    )
    return path, options, text


def _made_db3(rng: random.Random, folder: Path) -> tuple[Path, dict[str, Any], str]:
    path = next(ros(folder, "db3").glob("*.db3"))
    table, columns = rng.choice(
        (
            ("messages", ("id", "topic_id", "timestamp", "data")),
            ("topics", ("id", "name", "type", "serialization_format")),
            ("message_definitions", ("topic_type", "encoding", "encoded_message_definition")),
        )
    )
    column = rng.choice(columns)
    value = rng.choice((*(v for v in VALUES if isinstance(v, int | float | str) or v is None), rng.randbytes(40)))
    statement, values = rng.choice(
        (
            (f"UPDATE {table} SET {column} = ? WHERE rowid = {rng.choice((1, 2, 9))}", (value,)),
            (f"UPDATE {table} SET {column} = ?", (value,)),
            (f"UPDATE {table} SET {column} = zeroblob({rng.choice((100, 10**6))})", ()),
            (f"ALTER TABLE {table} RENAME COLUMN {column} TO x", ()),
            (f"ALTER TABLE {table} ADD COLUMN y BLOB AS (zeroblob(900000000))", ()),
            (f"DROP TABLE {table}", ()),
            (f"UPDATE sqlite_master SET sql = ? WHERE name = '{table}'", (rng.choice(SQL).format(table),)),
            (f"UPDATE sqlite_master SET rootpage = {rng.randrange(8)} WHERE name = '{table}'", ()),
            (f"INSERT INTO {table} SELECT * FROM {table}", ()),
        )
    )
    base = sqlite3.connect(path, isolation_level=None)
    try:
        base.execute("PRAGMA writable_schema = ON")
        base.execute(statement, values)
    finally:
        base.close()
    return path, SKIN, f"{statement} {str(values)[:60]}"


SQL = (
    "CREATE VIEW {0} AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) SELECT * FROM n",
    "CREATE TABLE {0}(id INTEGER PRIMARY KEY, topic_id, timestamp, data AS (randomblob(1000000)), name, type)",
    "CREATE VIRTUAL TABLE {0} USING fts5(id)",
    "CREATE TABLE {0}(id INT, topic_id INT DEFAULT (load_extension('x')), timestamp INT, data BLOB)",
    "CREATE TABLE {0}(id, name, type, serialization_format) WITHOUT ROWID",
    "garbage",
)


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
