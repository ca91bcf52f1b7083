"""What files from somebody else may not do: run code, reach outside of their folder, have a size believed.

A row of `MEMORIES` is done to a sound memory, with right checksums, and looked at as a folder and packed; a row of
`ZIPS` is a packed memory; a row of `RECORDINGS` makes a recording. Whoever received it reads, checks, merges and
repairs it. That ends as the row says, well or with an error of ours; nothing runs, nothing elsewhere is opened or
changed, and it takes less than ROOM, though bombs claim more. Names are text: on a terminal, a page, in a table, in C.
"""

import csv
import json
import os
import pickle
import shutil
import sqlite3
import struct
import subprocess
import tempfile
import zipfile
import zlib
from contextlib import closing
from functools import partial
from pathlib import Path

import forging
import h5py
import numpy as np
import pytest
import zarr
from commands import run
from confined import CALLS, HARMLESS, REFUSED, confined, ending
from faults.common import fingerprint
from forging import change_array, largest_array, pack, put_row, put_touch, say_in_current, set_configuration
from made import SKIN, TIP, lerobot, ros
from numcodecs import zstd
from scroll_tactile_store import check_store, repair_store
from touches import SETTINGS, stream

from scroll_tactile import TactileLearner
from scroll_tactile.clients.firmware.c_files import write_firmware
from scroll_tactile.clients.learning.plain_export import export_plain
from scroll_tactile.clients.report import memory_page
from scroll_tactile.recordings import describe, read


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A folder with one for what is received, one with a file that is none of its business, and one to extract to."""
    for name in ("in", "outside", "scratch"):
        (tmp_path / name).mkdir()
    (tmp_path / "outside" / "secret").write_bytes(b"secret" * 1000)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "scratch"))
    return tmp_path


def outside_of(path):
    return next(parent for parent in path.parents if parent.name == "in").with_name("outside")


class Evil:
    """What shows where it is unpickled."""

    def __reduce__(self):
        return CALLS.seen.append, ("unpickled",)


class Plugin(zarr.codecs.BytesCodec):
    """A codec that somebody has installed, and that no memory is written with."""

    @classmethod
    def from_dict(cls, data):
        CALLS.seen.append("a plugin")
        return cls()


zarr.registry.register_codec("evil", Plugin)
PICKLE = pickle.dumps(Evil())
DEEP = "[" * 100_000 + "]" * 100_000
ZEROS, GIGABYTE = (zstd.compress(bytes(size), 1) for size in (2**28, 2**30))
BLOCK = (deflater := zlib.compressobj(1, wbits=-15)).compress(bytes(2**24)) + deflater.flush(zlib.Z_FULL_FLUSH)
DEFLATED = b"\x78\x01" + BLOCK * 64  # a gigabyte

# Memories.


def in_place(path, name, put):
    """Something else in the place of a file or folder, which is moved outside."""
    number, largest = largest_array(path)
    put(moved_out(path / name.replace("CHUNK", f"checkpoints/{number:08d}/{largest}/c")))


def moved_out(place):
    return place.rename(outside_of(place) / "moved") and place


def link(place):
    place.symlink_to(outside_of(place) / "moved")


def touched(*arrays, **changes):
    """A touch with these arrays."""
    return partial(put_touch, payload=pack(arrays), **changes)


def set_weights(path):
    weights = {"name": str(outside_of(path) / "secret"), "sha256": "0" * 64}
    set_configuration(path, kind="frames", weights=weights, rest=None, cosines=0, seed=0)


MEMORIES = {
    "objects in a row": (touched(("x", "|O", [1], PICKLE, len(PICKLE))), REFUSED),
    "a codec of a plugin": (partial(change_array, codec="evil"), HARMLESS),
    "an embedding that names code": (partial(set_configuration, kind="module", name="os:system"), REFUSED),
    "an embedding by a path": (set_weights, REFUSED),
    "a log elsewhere": (partial(say_in_current, log="../../outside/secret"), REFUSED),
    "an array of a checkpoint by a path": (partial(change_array, named="../../../../outside/x"), HARMLESS),
    **{
        f"a link for {name}": (partial(in_place, name=name, put=link), REFUSED)
        for name in ("CURRENT", "log-00000001", "checkpoints")
    },
    "a link for a chunk": (partial(in_place, name="CHUNK", put=link), HARMLESS),
    "a hard link for the log": (
        partial(in_place, name="log-00000001", put=lambda at: os.link(outside_of(at) / "moved", at)),
        HARMLESS,
    ),
    "a device for CURRENT": (partial(in_place, name="CURRENT", put=lambda at: at.symlink_to("/dev/zero")), REFUSED),
    "a tebibyte in a row": (touched(("x", "|u1", [2**40], b"", 2**40)), REFUSED),
    "16 GiB of zeros in a row": (touched(*((f"x{i}", "|u1", [2**28], ZEROS, len(ZEROS)) for i in range(64))), REFUSED),
    "a frame of 4 GiB": (forging.lengthen_frame, HARMLESS),
    "a log with a hole": (lambda path: os.truncate(path / "log-00000001", 2**40), REFUSED),
    "a touch of 10^9 readings": (partial(put_touch, attributes={"columns": 10**9, "nbytes": 240}), REFUSED),
    "a retraction of 10^12": (
        partial(put_row, kind="retract", label="", attributes={"sequences": [[1, 10**12]]}),
        REFUSED,
    ),
    "a chunk of 1 GiB": (partial(change_array, codec="zstd", data=GIGABYTE), HARMLESS),
    "deep attributes": (partial(put_touch, attributes=DEEP), REFUSED),
    "a deep identity": (partial(forging.set_identity, identity=DEEP), REFUSED),
    "a deep checkpoint": (partial(forging.describe_again, text=DEEP), HARMLESS),
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A memory with a checkpoint, and an empty one."""
    folder = tmp_path_factory.mktemp("sound")
    with TactileLearner.open(folder / "m", **SETTINGS, kept_touches=0) as learner:
        for i in range(6):
            learner.observe("ab"[i % 2], stream((i, 60)))
    TactileLearner.open(folder / "other", **SETTINGS, kept_touches=0).close()
    return folder


def received(home, path):
    """How a memory ends that is opened, asked and listed, is checked, and is merged into another."""

    def use():
        with TactileLearner.open(path, mode="read") as learner:
            learner.observations()
            learner.predict(stream((9, 60)))
            if path.is_dir():
                learner.backup(home / "copy")

    def merge():
        with TactileLearner.open(home / "other") as learner:
            learner.merge(path)

    before = fingerprint(path.parent)
    ends = [ending(do, home / "outside") for do in (use, merge, lambda: check_store(path))]
    assert fingerprint(path.parent) == before
    return REFUSED if ends[:2] == [REFUSED, REFUSED] else HARMLESS


def test_a_sound_memory_is_taken_in(sound, home):
    for part in ("in/m", "other"):
        shutil.copytree(sound / Path(part).name, home / part)
    assert received(home, home / "in" / "m") == received(home, forging.zipped(home / "in" / "m")) == HARMLESS


@pytest.mark.parametrize("name", MEMORIES)
def test_a_strangers_memory_runs_nothing_reaches_nothing_and_takes_little(sound, home, name):
    forge, expected = MEMORIES[name]
    path = Path(shutil.copytree(sound / "m", home / "in" / "m"))
    shutil.copytree(sound / "other", home / "other")
    forge(path)
    assert received(home, path) == expected or expected == HARMLESS
    entries = [entry.lstat() for entry in path.rglob("*")]
    if all(entry.st_mode >> 12 in (4, 8) and entry.st_size < 2**30 and entry.st_nlink < 2 for entry in entries):
        assert received(home, forging.zipped(path)) == expected or expected == HARMLESS

    def write():
        with TactileLearner.open(path) as learner:
            learner.observe("a", stream((8, 60)))

    for use in (write, lambda: repair_store(path)):
        ending(use, home / "outside")


def linked(made):
    entry = zipfile.ZipInfo("checkpoints/00000009")
    entry.external_attr = 0o120777 << 16
    made.writestr(entry, b"../../../outside")


def claims(made):
    made.filelist[1].file_size = made.filelist[1].compress_size = 2**32 - 2


OUTSIDE = ("../../outside/evil", "/tmp/evil", "checkpoints/../../../outside/evil", "..\\evil", "C:\\evil")
ZIPS = {f"a file {name}": lambda made, name=name: made.writestr(name, b"evil") for name in OUTSIDE}
ZIPS |= {"a link": linked, "a log of 4 GiB": claims}
ZIPS["zeros, deflated"] = lambda made: made.writestr("log-00000009", bytes(2**26), zipfile.ZIP_DEFLATED)


@pytest.mark.parametrize("name", ZIPS)
def test_a_packed_memory_that_no_pack_writes_is_refused(sound, home, name):
    for part in ("m", "other"):
        shutil.copytree(sound / part, home / part)
    forging.zipped(home / "m", ZIPS[name]).rename(home / "in" / "m.zip")
    assert received(home, home / "in" / "m.zip") == REFUSED


# Recordings.


def record(kind, data):
    return struct.pack("<BQ", kind, len(data)) + data


def text(value):
    return struct.pack("<I", len(value)) + value


MAGIC = b"\x89MCAP0\r\n"
MESSAGE = struct.pack("<BBHI19f", 0, 1, 0, 19, *range(19))
ATTACHMENT = bytes(16) + text(b"../outside/evil") + text(b"") + struct.pack("<Q", 4) + b"evil" + bytes(4)
CHUNK = struct.pack("<QQQI", 0, 0, 2**30, 0) + text(b"zstd") + struct.pack("<Q", len(GIGABYTE)) + GIGABYTE


def mcap(*parts, form="ros2msg", message=MESSAGE, records=()):
    """An MCAP of one topic with one message, of a definition in these parts, and more records."""

    def make(folder):
        definition = ("\n" + "=" * 80 + "\n").join(parts or ["float32[] data"]).encode()
        about = struct.pack("<H", 1) + text(b"sensor_msgs/msg/CompressedImage") + text(form.encode()) + text(definition)
        data = record(3, about) + record(4, struct.pack("<HH", 1, 1) + text(b"/skin") + text(b"cdr") + text(b""))
        data += record(5, struct.pack("<HIQQ", 1, 0, 10**9, 10**9) + message)
        (folder / "x.mcap").write_bytes(MAGIC + data + b"".join(records) + record(15, bytes(4)))

    return make


def bag(written):
    """A ROS 2 bag whose metadata say this below their title."""
    return lambda folder: (ros(folder, "mcap") / "metadata.yaml").write_text(f"rosbag2_bagfile_information:{written}")


def view(folder):
    """A table that never ends."""
    said = (
        "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS id, 1 AS topic_id, i AS timestamp"
    )
    with closing(sqlite3.connect(next(ros(folder, "db3").glob("*.db3")))) as base:
        base.executescript(f"DROP TABLE messages; CREATE VIEW messages AS {said}, x'00' AS data FROM n")


def sparse(name, begin):
    """A file of a gigabyte, of which only this is there."""
    return lambda folder: ((folder / name).write_bytes(begin), os.truncate(folder / name, 2**30 + 17))


ALIASES = "".join(f"\n  a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10) if i else 'x'}]" for i in range(10))


def hdf5(fill):
    def make(folder):
        with h5py.File(outside_of(folder / "x") / "other.h5", "w") as other:
            other["secret"] = TIP
        with h5py.File(folder / "x.h5", "w") as file:
            fill(file, str(outside_of(folder / "x") / "other.h5"))

    return make


def virtual(file, other):
    layout = h5py.VirtualLayout(TIP.shape, TIP.dtype)
    layout[:] = h5py.VirtualSource(other, "secret", TIP.shape)
    file.create_virtual_dataset("tactile", layout)


def deflated(file, other):
    made = file.create_dataset("tactile", (2**16, 19), "u1", chunks=(2**16, 19), compression="gzip")
    made.id.write_direct_chunk((0, 0), DEFLATED)


ARRAY = {"zarr_format": 2, "shape": [64, 64], "chunks": [64, 64], "dtype": "|u1", "filters": None}
ARRAY |= {"order": "C", "compressor": None, "fill_value": 0}


def zarr2(put=None, **about):
    """A Zarr group, version 2, with an array that is described so; put: the bytes of its first chunk, or what does."""

    def make(folder):
        (place := folder / "x.zarr" / "tactile").mkdir(parents=True)
        (place.parent / ".zgroup").write_text('{"zarr_format": 2}')
        (place / ".zarray").write_text(json.dumps(ARRAY | about))
        file = place / ("0" if about.get("shape") == [1] else "0.0")
        put(file) if callable(put) else put and file.write_bytes(put)

    return make


def robot_set(folder, change=None, **told):
    about = lerobot(folder / "set") / "meta/info.json"
    known = json.loads(about.read_text()) | told
    if change is not None:
        change(folder / "set" / "data/chunk-000/file-000.parquet")
    about.write_text(json.dumps(known))


RECORDINGS = {
    "npy: a pickle": lambda folder: np.save(folder / "x.npy", np.array([Evil()], object), allow_pickle=True),
    "zarr: pickles": zarr2(PICKLE, shape=[1], chunks=[1], dtype="|O", filters=[{"id": "vlen-utf8"}, {"id": "pickle"}]),
    "hdf5: a filter outside the list": hdf5(
        lambda file, _: file.create_dataset("tactile", data=TIP.astype("i4"), chunks=(7, 19), scaleoffset=0)
    ),
    "yaml: a call": bag(" !!python/object/apply:os.system [ls]"),
    "npy: a pipe": lambda folder: os.mkfifo(folder / "x.npy"),
    "zarr: a chunk that is a link": zarr2(lambda file: file.symlink_to(outside_of(file) / "secret")),
    "hdf5: external storage": hdf5(
        lambda file, other: file.create_dataset("tactile", (50, 19), "u1", external=[(other, 0, 950)])
    ),
    "hdf5: an external link": hdf5(lambda file, other: file.update(tactile=h5py.ExternalLink(other, "secret"))),
    "hdf5: virtual": hdf5(virtual),
    "bag: a part that is a link": lambda folder: link(moved_out(next(ros(folder, "mcap").glob("*.mcap")))),
    "bag: a name that climbs": bag("\n  compression_mode: ''\n  relative_file_paths: [../../outside/secret]"),
    "lerobot: names that climb": partial(robot_set, data_path="../../outside/{chunk_index}.parquet"),
    "lerobot: a link": partial(robot_set, change=lambda file: link(moved_out(file))),
    "npy: 10^11 numbers in a hole": lambda folder: np.lib.format.open_memmap(folder / "x.npy", "w+", "f4", (10**11,)),
    "zarr: deflated": zarr2(DEFLATED, compressor={"id": "zlib", "level": 9}),
    "hdf5: deflated": hdf5(deflated),
    "mcap: zeros": mcap(records=[record(6, CHUNK)] * 3),
    "mcap: a message in a hole": sparse("x.mcap", MAGIC + struct.pack("<BQ", 5, 2**30)),
    "yaml: aliases": bag(f"{ALIASES}\n  compression_mode: ''\n  relative_file_paths: *a9"),
    "bag: a header in a hole": sparse("x.bag", b"#ROSBAG V2.0\n" + struct.pack("<I", 10**9)),
    "db3: a view without end": view,
}
FIELDS = {"npy": {}, "zarr": {"field": "tactile"}, "hdf5": {"field": "tactile"}, "lerobot": {"field": "tip"}}


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning", "ignore::UserWarning")
@pytest.mark.parametrize("name", RECORDINGS)
def test_a_strangers_recording_runs_nothing_reaches_nothing_and_takes_little(home, name):
    RECORDINGS[name](home / "in")
    (path,), before = (home / "in").iterdir(), fingerprint(home / "in")
    assert ending(lambda: read(path, **FIELDS.get(name.partition(":")[0], SKIN)), home / "outside") == REFUSED
    ending(lambda: describe(path), home / "outside")
    assert fingerprint(home / "in") == before


def test_what_is_attached_to_a_recording_is_not_written(home):
    mcap(records=[record(9, ATTACHMENT)])(home / "in")
    with confined(home / "outside"):
        assert len(read(home / "in" / "x.mcap", **SKIN)) == 1


ESCAPES = "\x1b]0;pwned\x07\x1b[2J\x9b31m\u202eevil"
NAMES = ["<script>alert(1)</script>", "a\"'&<b>", "=cmd|'calc'!A0", '";}system("id");/*\\', "../../outside/evil"]


def test_a_name_that_a_terminal_would_obey_is_shown_as_text_or_refused(sound, home):
    path = Path(shutil.copytree(sound / "m", home / "in" / ESCAPES))
    put_touch(path, label=ESCAPES, key=b"../../outside/evil")
    for words in (["inspect", path], ["inspect", path, "--json"], ["memory", "check", path]):
        assert run(*words).output.replace("\n", "").isprintable()


def test_names_are_text_on_a_page_in_a_table_and_in_c_and_never_paths(home):
    folder = home / "in"
    with TactileLearner.open(folder / "m", **SETTINGS) as learner:
        for i, name in enumerate(NAMES * 2):
            learner.observe(name, stream((i, 60)))
        with confined(home / "outside"):
            page = memory_page(learner)
            export_plain(learner, folder / "plain")
            learner.backup(folder / "copy")
            write_firmware(learner.exported(), folder / "c", [])
    assert "&lt;script&gt;" in page
    assert not any(name in page for name in NAMES[:2])
    cells = [
        cell
        for file in (folder / "plain").glob("*.csv")
        for line in csv.reader(file.read_text().splitlines())
        for cell in line
    ]
    assert "'" + NAMES[2] in cells
    assert not any(cell.startswith(("=", "+", "@")) for cell in cells)
    assert not any(name in (folder / "c" / "touch_memory.c").read_text() for name in NAMES)
    if tool := shutil.which("cc"):
        subprocess.run([tool, "-fsyntax-only", "-Wall", "-Werror", "touch_memory.c"], cwd=folder / "c", check=True)
