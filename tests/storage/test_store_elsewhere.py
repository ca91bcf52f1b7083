"""A store that comes from elsewhere: nothing outside is touched, nothing in it runs, and reading it changes nothing."""

import errno
import fcntl
import hashlib
import json
import os
import shutil
import socket
import sqlite3
import stat
import struct
import threading
import time
from contextlib import closing
from pathlib import Path

import pytest
from store_builds import LAST, add, as_after_a_crash, build, change, commit, contents, damage, query

from store import (
    DamageError,
    LockedError,
    NotAStoreError,
    RecordError,
    Store,
    StoreError,
    StoreFullError,
    check_store,
    repair_store,
)
from store.files import read_regular, same_folder
from store.lock import is_held
from store.records import checksum

JOURNAL = "journal.sqlite"


def everything(folder):
    """All that can be told of a folder: names, bytes, sizes, times, and what each is."""
    told = {}
    for path in [folder, *sorted(folder.rglob("*"))]:
        entry = path.lstat()
        data = path.read_bytes() if stat.S_ISREG(entry.st_mode) else None
        told[str(path.relative_to(folder))] = (entry.st_mode, entry.st_size, entry.st_mtime_ns, entry.st_ino, data)
    return told


def uses(path, target):
    """Every use of a store that must not change it, one after another."""
    return {
        "read": lambda: read_all(path),
        "check": lambda: check_store(path),
        "backup": lambda: backed_up(path, target),
    }


def read_all(path):
    with Store.open(path, mode="read") as reader:
        reader.latest()
        return [row.label for row in reader.records(reader.compacted)]


def backed_up(path, target):
    with Store.open(path, mode="read") as reader:
        reader.backup(target)
    return read_all(target)


# A read leaves everything as it is.


@pytest.fixture(params=["closed", "crashed", "crashed with its shared memory", "closed beside a reader"])
def left(request, tmp_path):
    """A store in each state in which a writer can leave it."""
    path = build(tmp_path / "s")
    if request.param == "closed beside a reader":
        writer = Store.open(path)
        with Store.open(path, mode="read") as reader:
            add(writer, LAST + 1)
            assert reader.last == LAST + 1
            writer.close()
    elif request.param.startswith("crashed"):
        writer = Store.open(path)
        add(writer, LAST + 1)
        hidden = () if "shared" in request.param else ("*-shm",)
        shutil.copytree(path, tmp_path / "c", ignore=shutil.ignore_patterns("holder.json", *hidden))
        writer.close()
        path = tmp_path / "c"
    return path


@pytest.mark.parametrize("use", ["read", "check", "backup"])
def test_a_read_a_check_and_a_backup_leave_the_folder_as_it_is(left, tmp_path, use):
    before = everything(left)
    first = uses(left, tmp_path / "copy")[use]()
    again = uses(left, tmp_path / "copy 2")[use]()
    assert everything(left) == before
    assert first == again
    if use != "check":
        assert len(first) >= LAST


def test_a_row_that_is_only_in_the_log_is_read(tmp_path):
    with Store.open(tmp_path / "s", identity={}) as writer:
        add(writer, 1)
        crashed = as_after_a_crash(writer, tmp_path / "c")
    assert (crashed / f"{JOURNAL}-wal").stat().st_size
    assert read_all(crashed) == ["row 1"]


def test_beside_a_writer_no_file_is_new(tmp_path):
    with Store.open(build(tmp_path / "s")) as writer:
        add(writer, LAST + 1)
        before = set(everything(writer.path))
        assert read_all(writer.path)[-1] == f"row {LAST + 1}"
        assert check_store(writer.path) == []
        assert set(everything(writer.path)) == before


def test_a_reader_that_was_there_first_sees_each_row_of_writers_that_come_and_go(tmp_path):
    path, last = build(tmp_path / "s"), LAST
    with Store.open(path, mode="read") as reader:
        for _ in range(4):
            assert reader.last == last
            with Store.open(path) as writer:
                for _ in range(3):
                    last = add(writer, last + 1).sequence
                    assert reader.last == last
                assert commit(writer.commit, last) == reader.newest
            assert reader.last == last
            assert [row.sequence for row in reader.records()] == list(range(1, last + 1))
        with Store.open(path) as writer:
            commit(writer.compact, last)
        assert reader.compacted == last
        assert reader.base().upto == last


def test_a_reader_never_sees_half_of_what_writers_in_another_thread_do(tmp_path):
    path, stop, failures = build(tmp_path / "s"), threading.Event(), []

    def write():
        number = LAST
        while not stop.is_set():
            with Store.open(path) as writer:
                for _ in range(5):
                    number = add(writer, number + 1).sequence
                commit(writer.commit, number)

    thread = threading.Thread(target=write)
    thread.start()
    try:
        end = time.monotonic() + 2
        while time.monotonic() < end:
            with Store.open(path, mode="read") as reader:
                for _ in range(20):
                    last = reader.last
                    found = [head.sequence for head in reader.heads()]
                    if found[:last] != list(range(1, last + 1)):
                        failures.append((last, found))
    finally:
        stop.set()
        thread.join()
    assert not failures
    assert damage(path) == []


def test_a_reader_of_a_journal_that_a_repair_replaced_goes_on_with_the_one_it_opened(tmp_path):
    path = build(tmp_path / "s")
    change(path, "UPDATE record SET label = 'z' WHERE sequence = 18")
    with Store.open(path, mode="read") as reader:
        assert reader.last == LAST
        repair_store(path)
        assert reader.last == LAST
    with Store.open(path, mode="read") as reader:
        assert reader.last == 17


# Links, pipes and other things that are no files.


def victim(tmp_path):
    folder = tmp_path / "victim"
    (folder / "12345").mkdir(parents=True)
    (folder / "12345" / "precious").write_text("precious")
    (folder / "file").write_text("precious")
    return folder


def as_link(path, target):
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    path.symlink_to(target)


LINKS = {
    "generations": "",
    "generations/00000077": "12345",
    "generations/00000077.partial": "12345",
    "holder.json": "file",
    "holder.json.new": "file",
    "lock": "file",
    JOURNAL: "journal",
    f"{JOURNAL}-wal": "file",
    f"{JOURNAL}-shm": "file",
    f"{JOURNAL}-journal": "file",
    f"{JOURNAL}.new": "file",
    f"{JOURNAL}.repaired": "file",
    f"{JOURNAL}.damaged": "file",
}


def all_refuse(path, tmp_path):
    for mode in ("write", "read"):
        with pytest.raises(DamageError) as caught:
            Store.open(path, mode=mode)
        assert caught.value.path.is_relative_to(path)
    with pytest.raises(DamageError):
        repair_store(path)
    assert [problem.kind for problem in check_store(path)] == ["lost"]


@pytest.mark.parametrize("name", LINKS)
def test_a_link_in_a_store_is_refused_and_nothing_that_it_leads_to_changes(tmp_path, name):
    path, outside = build(tmp_path / "s"), victim(tmp_path)
    shutil.copy(path / JOURNAL, outside / "journal")
    as_link(path / name, outside / LINKS[name])
    before, inside = everything(outside), everything(path)
    all_refuse(path, tmp_path)
    assert everything(outside) == before
    assert everything(path) == inside


def test_a_link_that_comes_while_a_store_is_read_is_not_followed(tmp_path):
    path, outside = build(tmp_path / "s"), victim(tmp_path)
    with Store.open(path, mode="read") as reader:
        assert reader.last
        as_link(path / f"{JOURNAL}-wal", outside / "file")
        with pytest.raises(DamageError, match="symbolic link"):
            list(reader.heads())


def test_a_link_among_the_files_of_a_generation_is_not_copied(tmp_path):
    path, outside = build(tmp_path / "s"), victim(tmp_path)
    as_link(path / "generations" / "00000002" / "rows" / "c" / "0" / "0", outside / "file")
    with Store.open(path, mode="read") as reader, pytest.raises(DamageError):
        reader.backup(tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


def test_a_store_is_reached_through_a_link(tmp_path):
    (tmp_path / "link").symlink_to(build(tmp_path / "s"))
    with Store.open(tmp_path / "link") as writer:
        assert add(writer, LAST + 1).sequence == LAST + 1
        with pytest.raises(LockedError):
            Store.open(tmp_path / "s")
    assert check_store(tmp_path / "link") == []


@pytest.mark.parametrize("name", [JOURNAL, f"{JOURNAL}-wal", f"{JOURNAL}-shm", "lock"])
def test_nothing_is_written_to_a_file_that_has_another_name(tmp_path, name):
    path, outside = build(tmp_path / "s"), tmp_path / "outside"
    (path / name).touch()
    os.link(path / name, outside)
    before = everything(tmp_path)
    for write in (Store.open, repair_store):
        with pytest.raises(DamageError, match="another name") as caught:
            write(path)
        assert caught.value.path == path / name
    assert len(read_all(path)) == LAST
    assert everything(tmp_path) == before


def no_file(path, kind):
    path.unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "device":
        try:
            os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 5))  # as /dev/zero
        except PermissionError:
            pytest.skip("this user may make no devices")
    else:
        here = Path.cwd()
        os.chdir(path.parent)  # the name of a socket may have no more than 107 bytes
        try:
            with socket.socket(socket.AF_UNIX) as made:
                made.bind(path.name)
        finally:
            os.chdir(here)


@pytest.mark.parametrize("kind", ["pipe", "socket", "device", "folder"])
@pytest.mark.parametrize("name", [name for name, target in LINKS.items() if target in ("file", "journal")])
def test_what_is_no_file_is_refused_at_once(tmp_path, name, kind):
    path = build(tmp_path / "s")
    no_file(path / name, kind)
    before = everything(path)
    all_refuse(path, tmp_path)
    assert everything(path) == before


def test_only_a_regular_file_is_read_and_none_that_is_larger_than_it_may_be(tmp_path):
    (tmp_path / "file").write_bytes(b"12345")
    (tmp_path / "link").symlink_to("file")
    (tmp_path / "folder").symlink_to(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    assert read_regular(tmp_path / "file", 5) == b"12345"
    for name, limit in (("file", 4), ("link", 9), ("pipe", 9), (".", 9)):
        with pytest.raises(DamageError):
            read_regular(tmp_path / name, limit)
    with pytest.raises(FileNotFoundError):
        read_regular(tmp_path / "none", 5)
    with pytest.raises(DamageError, match="symbolic link"):
        read_regular(tmp_path / "folder" / "file", 5, within=tmp_path)


# What SQLite would run, remove or believe.

SCHEMAS = {
    "a trigger": "CREATE TRIGGER t AFTER INSERT ON payload BEGIN DELETE FROM record; END",
    "an endless trigger": (
        "CREATE TRIGGER t AFTER INSERT ON record BEGIN INSERT INTO meta WITH RECURSIVE c(n) AS "
        "(SELECT 1 UNION ALL SELECT n FROM c) SELECT n, n, n FROM c; END"
    ),
    "a view": "CREATE VIEW v AS SELECT * FROM record",
    "an index": "CREATE INDEX i ON record (length(label))",
    "a table": "CREATE TABLE other (x)",
    "a virtual table": "CREATE VIRTUAL TABLE f USING fts5(x)",
}


@pytest.mark.parametrize("what", SCHEMAS)
def test_a_schema_that_is_not_exactly_ours_is_damage(tmp_path, what):
    path = build(tmp_path / "s")
    change(path, SCHEMAS[what])
    before = contents(path)
    for mode in ("write", "read"):
        with pytest.raises(DamageError, match="the tables of"):
            Store.open(path, mode=mode)
    assert any("the tables of" in problem.what for problem in check_store(path))
    after = contents(path)
    assert {name: after[name] for name in before} == before
    repair_store(path)
    assert read_all(path) == [f"row {number}" for number in range(1, LAST + 1)]
    assert damage(path) == []
    assert len(query(path, "SELECT * FROM sqlite_master")) == 5


def rollback_journal(super_journal):
    """A rollback journal with no pages that names a super-journal: played back, SQLite removes what it names."""
    name = os.fsencode(super_journal)
    header = struct.pack(">8s5I", bytes.fromhex("d9d505f920a163d7"), 0, 1, 6, 512, 4096).ljust(512, b"\0")
    total = sum(byte - 256 if byte > 127 else byte for byte in name) & 0xFFFFFFFF
    tail = struct.pack(">I", 0x40000000 // 4096 + 1) + name + struct.pack(">II", len(name), total)
    return header + tail + bytes.fromhex("d9d505f920a163d7")


def test_what_another_program_did_not_end_is_not_played_back(tmp_path):
    path, outside = build(tmp_path / "s"), victim(tmp_path)
    (path / f"{JOURNAL}-journal").write_bytes(rollback_journal(outside / "file"))
    before, inside = everything(outside), everything(path)
    for mode in ("write", "read"):
        with pytest.raises(DamageError, match="did not end"):
            Store.open(path, mode=mode)
    assert "did not end" in check_store(path)[0].what
    assert everything(path) == inside
    repair_store(path)
    assert everything(outside) == before
    assert (path / f"{JOURNAL}.damaged-journal").exists()
    assert read_all(path) == [f"row {number}" for number in range(1, LAST + 1)]


@pytest.mark.parametrize("aside", ["../victim/file", "{victim}/file", "generations", "journal.sqlite", 5, None])
def test_a_forged_note_of_a_repair_moves_nothing_out_of_the_folder(tmp_path, aside):
    path, outside = build(tmp_path / "s"), victim(tmp_path)
    aside = aside.format(victim=outside) if isinstance(aside, str) else aside
    noted = json.dumps({"aside": aside, "heads": [], "kept": 3, "lost": []})
    with closing(sqlite3.connect(path / JOURNAL)) as connection, connection:
        values = ("repaired", noted, checksum("meta", b"repaired", noted.encode()))
        connection.execute("INSERT INTO meta VALUES (?, ?, ?)", values)
    (path / JOURNAL).rename(path / f"{JOURNAL}.repaired")
    (path / f"{JOURNAL}-wal").write_bytes(b"mine")
    before = everything(outside)
    with pytest.raises(DamageError, match="is damaged: remove it"):
        repair_store(path)
    assert everything(outside) == before


def put_row(path, *, sequence, payload=b"ARPL\x01\0\0", **changed):
    """Insert a row with right checksums, of any types."""
    digest = hashlib.blake2b(payload, digest_size=16).digest()
    row = {"sequence": sequence, "kind": "a", "label": "b", "key": b"", "time": 1.0, "attributes": "{}"}
    row |= {"size": len(payload), "digest": digest, **changed}
    plain = [value.encode() if isinstance(value, str) else value for value in row.values()]
    with closing(sqlite3.connect(path / JOURNAL)) as connection, connection:
        marks = ",".join("?" * 9)
        values = [*row.values(), checksum("record", *plain)]
        connection.execute("PRAGMA ignore_check_constraints = ON")
        connection.execute(f"INSERT INTO record VALUES ({marks})", values)
        connection.execute("INSERT INTO payload VALUES (?, ?)", (sequence, payload))


FORGED = {
    "nested JSON": {"attributes": '{"x":' + "[" * 100_000 + "]" * 100_000 + "}"},
    "no JSON": {"attributes": "x"},
    "a list": {"attributes": "[]"},
    "a NUL in the label": {"label": "a\0b"},
    "a NUL in the kind": {"kind": "a\0b"},
    "a long key": {"key": bytes(65)},
    "an endless time": {"time": float("inf")},
}


@pytest.mark.parametrize("what", FORGED)
def test_a_forged_row_with_a_right_checksum_is_damage(tmp_path, what):
    path = build(tmp_path / "s")
    put_row(path, sequence=LAST + 1, **FORGED[what])
    with Store.open(path, mode="read") as reader, pytest.raises(DamageError) as caught:
        list(reader.heads())
    assert caught.value.sequence == LAST + 1
    assert any(f"row {LAST + 1} fails" in problem.what for problem in check_store(path))


@pytest.mark.parametrize("text", ["[" * 100_000 + "]" * 100_000, "null", "x"])
def test_a_forged_identity_is_damage(tmp_path, text):
    path = build(tmp_path / "s")
    with closing(sqlite3.connect(path / JOURNAL)) as connection, connection:
        values = (text, checksum("meta", b"identity", text.encode()))
        connection.execute("UPDATE meta SET value = ?, checksum = ? WHERE key = 'identity'", values)
    with pytest.raises(DamageError, match="identity"):
        Store.open(path)
    assert check_store(path)


def pages(path):
    data = bytearray((path / JOURNAL).read_bytes())
    return data, [memoryview(data)[start : start + 4096] for start in range(0, len(data), 4096)]


def test_a_table_that_leads_through_one_page_again_and_again_is_damage_and_ends(tmp_path):
    path = tmp_path / "s"
    with Store.open(path, identity={}) as writer:
        for number in range(1, 400):
            writer.append("a", f"row {number}" + "x" * 300, b"")
    data, page = pages(path)
    # The root of table record, and eight pages that each lead four hundred times to the next, the last one to a leaf.
    leaf = next(i for i, found in enumerate(page, 1) if found[0] == 0x0D and i > 6)
    chain = [4, *[i for i in range(7, len(page)) if i != leaf][:8]]
    for number, below in zip(chain, [*chain[1:], leaf], strict=True):
        cells = [struct.pack(">I", below) + bytes([0x82, i & 0x7F]) for i in range(100)]
        place, places = 4096, []
        for cell in cells:
            place -= len(cell)
            page[number - 1][place : place + len(cell)] = cell
            places.append(place)
        header = struct.pack(">BHHHBI", 0x05, 0, len(cells), place, 0, below)
        page[number - 1][: len(header) + 2 * len(places)] = header + struct.pack(f">{len(places)}H", *places)
    (path / JOURNAL).write_bytes(data)
    with pytest.raises(DamageError), Store.open(path, mode="read") as reader:
        list(reader.heads(kind="none of these"))
    with pytest.raises(DamageError), Store.open(path, mode="read") as reader:
        list(reader.heads())
    assert check_store(path)


# Locks and paths.


@pytest.mark.parametrize("code", [errno.ENOSYS, errno.ENOLCK])
def test_where_there_are_no_locks_that_is_said_and_no_other_kind_is_taken(tmp_path, monkeypatch, code):
    Store.open(tmp_path / "s", identity={}).close()
    before = contents(tmp_path / "s")

    def missing(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", missing)
    monkeypatch.setattr("filelock._unix.fcntl.flock", missing)
    monkeypatch.setattr("store.lock.flock", missing)
    for path in (tmp_path / "s", tmp_path / "new"):
        with pytest.raises(StoreError, match="has no locks") as caught:
            Store.open(path, identity={})
        assert not isinstance(caught.value, LockedError)
        assert str(path) in str(caught.value)
    assert read_all(tmp_path / "s") == []
    assert contents(tmp_path / "s") == before


def test_whether_a_writer_is_there_can_be_asked_without_keeping_one_out(tmp_path):
    path = build(tmp_path / "s")
    assert not is_held(path)
    with Store.open(path):
        assert is_held(path)
    assert not is_held(path)
    stop = threading.Event()

    def ask():
        while not stop.is_set():
            is_held(path)

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        for _ in range(50):
            Store.open(path).close()
    finally:
        stop.set()
        thread.join()


def test_a_note_of_a_holder_is_shown_without_what_a_terminal_would_obey(tmp_path):
    with Store.open(tmp_path, identity={}):
        note = {"pid": 1, "host": "\x1b[31mevil", "since": "\x07\nx"}
        (tmp_path / "holder.json").write_text(json.dumps(note))
        with pytest.raises(LockedError) as caught:
            Store.open(tmp_path)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("path", ["a\0b", "a\ud800b", None, 5, b"bytes"])
def test_what_is_no_path_is_no_store(path):
    for call in (lambda: Store.open(path, identity={}), lambda: check_store(path), lambda: repair_store(path)):
        with pytest.raises(NotAStoreError):
            call()


def test_a_mode_that_there_is_not_is_an_error_of_the_store(tmp_path):
    with pytest.raises(RecordError, match="append"):
        Store.open(tmp_path, identity={}, mode="append")


def test_one_folder_by_two_paths_is_the_same(tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "link").symlink_to("s")
    assert same_folder(tmp_path / "s", tmp_path / "link")
    assert same_folder(tmp_path / "none", tmp_path / "s" / ".." / "none")
    assert not same_folder(tmp_path / "s", tmp_path)


def test_nobody_backs_a_store_up_into_itself(tmp_path):
    (tmp_path / "link").symlink_to(build(tmp_path / "s"))
    with Store.open(tmp_path / "s", mode="read") as reader:
        for target in (tmp_path / "s" / "copy", tmp_path / "link" / "deep" / "copy"):
            with pytest.raises(NotAStoreError, match="lies inside"):
                reader.backup(target)


def test_numbers_at_the_end_of_all_numbers_are_damage_and_not_counted_on(tmp_path):
    path = build(tmp_path / "s")
    (path / "generations" / ("9" * 40)).mkdir()
    with Store.open(path) as writer:
        commit(writer.commit, LAST)
    put_row(path, sequence=2**63 - 1)
    with Store.open(path) as writer, pytest.raises(DamageError, match="number 9223372036854775807"):
        add(writer, LAST + 1)
    assert (path / "generations" / ("9" * 40)).is_dir()


@pytest.mark.skipif(not hasattr(os, "truncate"), reason="makes a file with holes")
def test_a_file_of_holes_fills_no_disk(tmp_path):
    with Store.open(tmp_path / "s", identity={}) as writer:
        add(writer, 1)
        crashed = as_after_a_crash(writer, tmp_path / "c")
    os.truncate(crashed / JOURNAL, 2**43)
    with pytest.raises(StoreFullError, match="copy of"):
        read_all(crashed)


def test_a_file_of_holes_is_not_copied(tmp_path):
    path = build(tmp_path / "s")
    with (path / "generations" / "00000002" / "rows" / "zarr.json").open("r+b") as file:
        file.truncate(2**40)
    with Store.open(path, mode="read") as reader, pytest.raises(DamageError, match="at most"):
        reader.backup(tmp_path / "copy")
    assert [entry.name for entry in tmp_path.iterdir()] == ["s"]
