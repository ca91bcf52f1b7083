"""Checking a store: all that is wrong is named, and nothing is changed."""

import json
import os
import shutil
import threading
from pathlib import Path

import pytest
from store_builds import (
    IDENTITY,
    LAST,
    add,
    base,
    change_rows,
    commit,
    contents,
    damage,
    flip,
    flip_row,
    frames,
    log_of,
    lose_rows,
    newest,
    put_row,
    rows,
    state,
    write_log,
)

from store import DamageError, NotAStoreError, Problem, Store, StoreError, check_store, repair_store
from store.framing import FRAME_BYTES
from store.row_encoding import decode_row, head_without_arrays


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


def test_a_store_without_rows_or_checkpoints_is_sound(tmp_path):
    Store.open(tmp_path, identity={}).close()
    assert check_store(tmp_path) == []


def test_what_is_being_done_is_told(path):
    told = []
    check_store(path, progress=lambda *step: told.append(step))
    assert {what for what, _, _ in told} >= {"checkpoints", "rows"}
    assert all(0 <= done <= of for _, done, of in told)


def test_a_problem_is_plain_data(path):
    (newest(path) / "sum" / "zarr.json").unlink()
    (problem,) = check_store(path)
    assert isinstance(problem, Problem)
    assert (problem.path, problem.kind) == (newest(path) / "sum", "spare")
    with pytest.raises(AttributeError):
        problem.kind = "lost"


def forge_arrays(found, number):
    found[number] = found[number][:-3] + b"xyz"


ROWS = {
    "a damaged row": (lambda path: flip_row(path, 9), "row 9 is missing"),
    "damaged arrays": (lambda path: flip_row(path, 9, arrays=True), "row 9 has arrays that fail their checksum"),
    "a compacted or early row": (lambda path: flip_row(path, 2), "row 2 is missing"),
    "a row without a frame": (lambda path: lose_rows(path, 9), "row 9 is missing"),
    "the last row": (lambda path: (flip_row(path, 20), put_row(path, sequence=21)), "row 20 is missing"),
    "arrays of nobody": (
        lambda path: change_rows(path, lambda found: forge_arrays(found, 9)),
        "row 9 has arrays that were never written so",
    ),
    "arrays that were given up": (
        lambda path: change_rows(path, lambda found: found.update({9: without_arrays(path, 9)})),
        "row 9 has lost its arrays",
    ),
}


def without_arrays(path, number):
    return head_without_arrays(decode_row(rows(path)[number]).head)


@pytest.mark.parametrize(("harm", "said"), ROWS.values(), ids=ROWS)
def test_a_lost_row_is_named_once(path, harm, said):
    harm(path)
    assert [said in problem.what for problem in check_store(path) if problem.kind == "lost"] == [True]


def rows_of(folder):
    return folder / "rows" / "c" / "0" / "0"


CHECKPOINTS = {
    "a file": (lambda folder: flip(rows_of(folder), 30), "array 'rows' of checkpoint"),
    "an array": (lambda folder: flip(folder / "names" / "c" / "0" / "0", 20), "array 'names' of checkpoint"),
    "an array's description": (lambda folder: (folder / "sum" / "zarr.json").write_text("{}"), "array 'sum'"),
    "an array's folder": (lambda folder: shutil.rmtree(folder / "sum"), "array 'sum' of checkpoint"),
    "the group": (lambda folder: (folder / "zarr.json").unlink(), "zarr.json cannot be read"),
    "the folder": (shutil.rmtree, "zarr.json cannot be read"),
}


@pytest.mark.parametrize("choose", [newest, base])
@pytest.mark.parametrize(("spoil", "said"), CHECKPOINTS.values(), ids=CHECKPOINTS)
def test_damaged_checkpoints_are_named_by_file_and_array(compacted, spoil, said, choose):
    folder = choose(compacted)
    spoil(folder)
    problems = check_store(compacted)
    assert said in texts(problems)
    assert all(problem.path.is_relative_to(folder) and str(problem.path) in problem.what for problem in problems)
    assert {problem.kind for problem in problems} == {"lost" if choose is base else "spare"}


def test_the_only_copy_of_a_state_is_lost(plain):
    """Where a row that it contains is damaged it cannot be made anew."""
    shutil.rmtree(newest(plain))
    assert [problem.kind for problem in check_store(plain)] == ["spare"]
    flip_row(plain, 9)
    kinds = {problem.path.parent.name: problem.kind for problem in check_store(plain)}
    assert kinds[newest(plain).name] == "lost"


def test_what_a_checkpoint_says_of_itself_is_checked(path):
    for name, value in {"upto": 99, "number": 7, "identity": {"for": "another"}, "attributes": {"a": 1}}.items():
        header = newest(path) / "zarr.json"
        text = header.read_text()
        known = json.loads(text)
        known["attributes"][name] = value
        header.write_text(json.dumps(known))
        (problem,) = check_store(path)
        assert (problem.kind, problem.path) == ("spare", header)
        assert "its sha256 differs" in problem.what
        header.write_text(text)


def test_a_checkpoint_in_anothers_place_is_found(compacted):
    shutil.rmtree(newest(compacted))
    shutil.copytree(base(compacted), newest(compacted))
    assert "another than was written there" in found(compacted)


def test_a_checkpoint_of_another_store_is_found(path, tmp_path):
    with Store.open(tmp_path / "other", identity={"for": "other checks"}) as other:
        other.append("a", "b", b"")
        for upto in range(2):
            other.commit(state(upto), upto=upto)
    shutil.rmtree(newest(path))
    shutil.copytree(newest(tmp_path / "other"), newest(path))
    assert "another than was written there" in found(path)


def test_an_identity_that_nothing_knows_is_lost(path):
    shutil.rmtree(path / "checkpoints")
    flip(log_of(path), FRAME_BYTES + 2)
    assert "nothing in" in found(path) and "lost" in {problem.kind for problem in check_store(path)}
    before = log_of(path).read_bytes()
    with pytest.raises(DamageError, match="what the store in"):
        repair_store(path)
    assert log_of(path).read_bytes() == before


def test_a_forged_identity_is_damage(path):
    for text in (b"[" * 9000 + b"]" * 9000, b"null", b"x", b"\xff"):
        write_log(path, rows(path).values(), header=text)
        for mode in ("read", "write"):
            with pytest.raises(DamageError, match="identity"):
                Store.open(path, mode=mode)
        assert "was never written so" in found(path)
    repair_store(path)
    with Store.open(path) as opened:
        assert (opened.identity, opened.last) == (IDENTITY, LAST)


LOGS = {
    "missing": (lambda file: file.unlink(), "is gone"),
    "empty": (lambda file: file.write_bytes(b""), "does not begin as a log"),
    "a stub": (lambda file: file.write_bytes(file.read_bytes()[:80]), "does not begin as a log"),
    "cut": (lambda file: file.write_bytes(file.read_bytes()[: file.stat().st_size // 3]), "are missing"),
    "text": (lambda file: file.write_text("dear diary " * 900), "does not begin as a log"),
    "another mark": (lambda file: flip(file, 3, 1), "does not begin as a log"),
    "another version": (lambda file: flip(file, 6, 1), "does not begin as a log"),
    "another identity": (lambda file: flip(file, 9, 1), "does not begin as a log"),
    "another header": (lambda file: flip(file, FRAME_BYTES + 4, 1), "payload of frame 0"),
}


@pytest.mark.parametrize(("spoil", "said"), LOGS.values(), ids=LOGS)
def test_all_the_rest_is_checked_where_the_log_is_none(path, spoil, said):
    spoil(log_of(path))
    flip(newest(path) / "names" / "c" / "0" / "0", 20)
    before = contents(path)
    told = found(path)
    assert said in told
    assert "array 'names' of checkpoint" in told
    assert contents(path).items() >= before.items()
    with pytest.raises(StoreError):
        Store.open(path)


def test_damage_that_takes_no_row_is_named_too(path):
    frame = frames(path)[17]
    flip(log_of(path), frame.end + 20)  # of the commit frame behind it
    (problem,) = check_store(path)
    assert problem.kind == "spare"
    assert "proves that it was durable" in problem.what


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


def test_everything_that_is_wrong_is_told_at_once(compacted):
    for number in (8, 18):
        flip_row(compacted, number)
    flip_row(compacted, 12, arrays=True)
    flip(rows_of(newest(compacted)))
    flip(base(compacted) / "names" / "c" / "0" / "0", 20)
    told = found(compacted)
    for said in ("row 8 is", "row 12 has arrays", "row 18 is", "array 'rows'", "array 'names'"):
        assert said in told


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


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="this user may read everything")
def test_a_folder_without_permission_is_no_damage(path):
    path.chmod(0)
    try:
        with pytest.raises(StoreError) as caught:
            check_store(path)
        assert not isinstance(caught.value, DamageError)
    finally:
        path.chmod(0o700)


def test_a_store_that_is_being_written_is_checked_beside_the_writer(compacted):
    path = compacted
    stop, wrong = threading.Event(), []

    def look():
        while not stop.is_set():
            wrong.extend(damage(path))

    with Store.open(path) as opened:
        thread = threading.Thread(target=look)
        thread.start()
        for number in range(LAST + 1, LAST + 25):
            add(opened, number)
            commit(opened.commit, number)
            if number % 4 == 0:
                commit(opened.compact, number - 2)
        stop.set()
        thread.join()
    assert wrong == []
    assert check_store(path) == []
