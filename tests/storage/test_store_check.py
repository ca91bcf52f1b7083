"""Checking a store: all that is wrong is named, and nothing is changed."""

import shutil
import threading
from pathlib import Path

import pytest
from forging import log_of, read_log, write_log
from scroll_tactile_store import DamageError, NotAStoreError, Store, check_store, repair_store
from scroll_tactile_store.framing import FRAME_BYTES
from store_builds import IDENTITY, LAST, add, commit, compaction, contents, damage, flip, newest


@pytest.fixture
def path(either):
    return either


def texts(problems):
    return " | ".join(f"{problem.kind}: {problem.what}" for problem in problems)


def found(path):
    return texts(check_store(path))


def test_a_sound_store_has_no_problems_and_stays_as_it_is(path):
    before, files = contents(path), len(list(Path("/proc/self/fd").iterdir()))
    assert check_store(path) == []
    assert check_store(str(path)) == []
    assert contents(path) == before
    assert len(list(Path("/proc/self/fd").iterdir())) == files


def test_a_checkpoint_that_is_gone_is_made_anew_from_rows(plain):
    shutil.rmtree(newest(plain))
    assert [problem.kind for problem in check_store(plain)] == ["spare"]


def test_a_checkpoint_in_anothers_place_is_found(compacted):
    shutil.rmtree(newest(compacted))
    shutil.copytree(compaction(compacted), newest(compacted))
    assert "another than was written there" in found(compacted)


def test_an_identity_that_nothing_knows_is_lost(path):
    shutil.rmtree(path / "checkpoints")
    flip(log_of(path), FRAME_BYTES + 2)
    assert "nothing in" in found(path) and "lost" in {problem.kind for problem in check_store(path)}
    before = log_of(path).read_bytes()
    with pytest.raises(DamageError, match="what the store in"):
        repair_store(path)
    assert log_of(path).read_bytes() == before


def test_a_forged_identity_is_damage(path):
    rows = read_log(path)[1]
    for text in (b"[" * 9000 + b"]" * 9000, b"null", b"x", b"\xff"):
        write_log(path, rows, header=text)
        for mode in ("read", "write"):
            with pytest.raises(DamageError, match="identity"):
                Store.open(path, mode=mode)
        assert "was never written so" in found(path)
    repair_store(path)
    with Store.open(path) as opened:
        assert (opened.identity, opened.last) == (IDENTITY, LAST)


def test_what_is_there_too_much_is_left_over_and_no_damage(path):
    checkpoints = path / "checkpoints"
    shutil.copytree(newest(path), checkpoints / "00000009")
    (checkpoints / "00000010.partial").mkdir()
    (checkpoints / "00000001.damaged").mkdir()
    (checkpoints / "notes").mkdir()
    (path / "log-00000001.damaged").write_bytes(b"old")
    (path / "log-00000009").write_bytes(b"whole")
    (path / "log-00000010.new").write_bytes(b"half")
    (path / "CURRENT.new").write_bytes(b"half")
    (path / "thesis.txt").write_text("mine")
    problems = check_store(path)
    assert {problem.kind for problem in problems} == {"leftover"}
    assert sorted(problem.path.name for problem in problems) == [
        "00000001.damaged",
        "00000009",
        "00000010.partial",
        "CURRENT.new",
        "log-00000001.damaged",
        "log-00000009",
        "log-00000010.new",
    ]
    Store.open(path).close()
    left = {problem.path.name for problem in check_store(path)}
    assert left == {"00000001.damaged", "log-00000001.damaged"}
    assert (path / "thesis.txt").exists() and (checkpoints / "notes").exists()


def test_where_there_is_no_store_none_is_checked_or_repaired(tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.txt").write_text("mine")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "empty").mkdir()
    before = contents(tmp_path)
    for name in ("file", "folder", "loop", "empty", "nothing"):
        for call in (check_store, repair_store):
            with pytest.raises(NotAStoreError, match=name):
                call(tmp_path / name)
    assert contents(tmp_path) == before


def test_a_store_that_is_being_written_is_checked_beside_the_writer(compacted):
    path = compacted
    stop, wrong = threading.Event(), []

    def look():
        while not stop.is_set():
            wrong.extend(damage(path))

    with Store.open(path) as opened:
        thread = threading.Thread(target=look)
        thread.start()
        for number in range(LAST + 1, LAST + 9):
            add(opened, number)
            commit(opened.commit, number)
            if number % 4 == 0:
                commit(opened.compact, number - 2)
        stop.set()
        thread.join()
    assert wrong == []
    assert check_store(path) == []
