"""Checking a store: all that is wrong is named, and nothing is changed."""

import json
import os
import shutil
import sqlite3
import threading
from contextlib import closing

import pytest
import store.schema
from store_builds import LAST, add, change, commit, contents, damage, flip, folders, state, values

from store import DamageError, NotAStoreError, Problem, Store, StoreError, VersionError, check_store, repair_store


@pytest.fixture
def path(either):
    return either


def newest(path):
    return path / "generations" / "00000002"


def older(path):
    (name,) = [name for name in folders(path) if name != newest(path).name]
    return path / "generations" / name


def texts(problems):
    return " | ".join(f"{problem.kind}: {problem.what}" for problem in problems)


def found(path):
    return texts(check_store(path))


def test_a_sound_store_has_no_problems_and_stays_as_it_is(path):
    before = contents(path)
    assert check_store(path) == []
    assert check_store(str(path)) == []
    assert contents(path) == before


def test_a_store_without_rows_or_generations_is_sound(tmp_path):
    Store.open(tmp_path, identity={}).close()
    assert check_store(tmp_path) == []


def test_what_is_being_done_is_told(path):
    told = []
    check_store(path, progress=lambda *step: told.append(step))
    assert {what for what, _, _ in told} >= {"generations"}
    assert all(0 <= done <= of for _, done, of in told)


def test_a_problem_is_plain_data(path):
    (newest(path) / "sum" / "zarr.json").unlink()
    (problem,) = check_store(path)
    assert isinstance(problem, Problem)
    assert (problem.path, problem.kind) == (newest(path) / "sum", "spare")
    with pytest.raises(AttributeError):
        problem.kind = "lost"


@pytest.mark.parametrize(
    ("statement", "said"),
    [
        ("DELETE FROM record WHERE sequence = 20", "row 20 is missing"),
        ("UPDATE record SET key = x'' WHERE sequence = 2", "row 2 fails its checksum"),
    ],
)
def test_a_lost_last_or_compacted_row_is_named_once(path, statement, said):
    change(path, statement)
    assert [said in problem.what for problem in check_store(path) if problem.kind == "lost"] == [True]


def test_exchanged_arrays_are_found(path):
    change(
        path,
        "UPDATE payload SET sequence = 99 WHERE sequence = 16",
        "UPDATE payload SET sequence = 16 WHERE sequence = 17",
        "UPDATE payload SET sequence = 17 WHERE sequence = 99",
    )
    (problem,) = check_store(path)
    assert "rows 16 to 17 have arrays that fail their checksums" in problem.what


def test_arrays_too_many_are_found(path):
    change(path, "INSERT INTO payload VALUES (25, x'00')")
    assert "rows 21 to 25 are missing" in found(path)
    assert "holds arrays of row 25 that no row has" in found(path)


def test_arrays_that_were_given_up_and_are_there_are_found(path):
    with Store.open(path, mode="read") as opened:
        compacted = opened.compacted
    change(path, "INSERT OR REPLACE INTO payload SELECT 3, bytes FROM payload WHERE sequence = 16")
    (problem,) = check_store(path)
    if compacted:
        assert problem.kind == "spare"
        assert "arrays of row 3 that no row has, or a base stands for" in problem.what
    else:
        assert problem.kind == "lost"
        assert "row 3 has arrays that fail their checksum" in problem.what


def rows_of(folder):
    return folder / "rows" / "c" / "0" / "0"


GENERATIONS = {
    "a file": (lambda folder: flip(rows_of(folder), 30), "array 'rows' of generation"),
    "an array": (lambda folder: flip(folder / "names" / "c" / "0" / "0", 20), "array 'names' of generation"),
    "an array's description": (lambda folder: (folder / "sum" / "zarr.json").write_text("{}"), "array 'sum'"),
    "an array's folder": (lambda folder: shutil.rmtree(folder / "sum"), "array 'sum' of generation"),
    "the group": (lambda folder: (folder / "zarr.json").unlink(), "zarr.json cannot be read"),
    "the folder": (shutil.rmtree, "zarr.json cannot be read"),
}


@pytest.mark.parametrize("choose", [newest, older])
@pytest.mark.parametrize(("spoil", "said"), GENERATIONS.values(), ids=GENERATIONS)
def test_damaged_generations_are_named_by_file_and_array(path, spoil, said, choose):
    folder = choose(path)
    spoil(folder)
    problems = check_store(path)
    assert said in texts(problems)
    assert all(problem.path.is_relative_to(folder) and str(problem.path) in problem.what for problem in problems)
    base = folder.name == "00000003"
    assert {problem.kind for problem in problems} == {"lost" if base else "spare"}


def test_the_only_copy_of_a_state_is_lost(path):
    """Where a row that it contains is damaged it cannot be made anew."""
    shutil.rmtree(older(path))
    shutil.rmtree(newest(path))
    change(path, "UPDATE record SET label = 'z' WHERE sequence = 9")
    kinds = {problem.path.parent.name: problem.kind for problem in check_store(path)}
    assert kinds[newest(path).name] == "lost"


def test_what_a_group_says_of_itself_is_checked(path):
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


def test_a_generation_in_anothers_place_is_found(path):
    shutil.rmtree(newest(path))
    shutil.copytree(older(path), newest(path))
    assert "is of another generation, or of another store" in found(path)


def test_a_generation_of_another_store_is_found(path, tmp_path):
    with Store.open(tmp_path / "other", identity={"for": "other checks"}) as other:
        other.append("a", "b", b"")
        for upto in (0, 1):
            other.commit(state(upto), upto=upto)
    shutil.rmtree(newest(path))
    shutil.copytree(newest(tmp_path / "other"), newest(path))
    assert "it says another identity: {'for': 'other checks'}" in found(path)


@pytest.mark.parametrize("assignment", ["upto = 99", "content = '{}'", "checksum = x''", "base = 1 - base", "time = 0"])
def test_a_damaged_row_of_a_generation_is_spare_where_the_group_knows_better(path, assignment):
    change(path, f"UPDATE generation SET {assignment} WHERE number = 2")
    (problem,) = check_store(path)
    assert (problem.kind, problem.path) == ("spare", path / "journal.sqlite")
    assert "the row of generation 2" in problem.what
    shutil.rmtree(newest(path))
    assert "the row of generation 2" in found(path)


TYPES = [
    *(
        f"UPDATE record SET {column} = 7 WHERE sequence = 3"
        for column in ("kind", "label", "key", "attributes", "digest")
    ),
    *(f"UPDATE record SET {column} = 'x' WHERE sequence = 3" for column in ("time", "size", "checksum")),
    "UPDATE payload SET bytes = 10000000000000 WHERE sequence = 3",
    "UPDATE payload SET bytes = 'x' WHERE sequence = 3",
    "UPDATE payload SET bytes = 1.5 WHERE sequence = 3",
    *(f"UPDATE generation SET {column} = 'x'" for column in ("upto", "base", "time", "checksum")),
    *(f"UPDATE generation SET {column} = 7" for column in ("attributes", "content")),
    "UPDATE meta SET value = 7 WHERE key = 'identity'",
    "UPDATE meta SET checksum = 7 WHERE key = 'identity'",
]


@pytest.mark.parametrize("statement", TYPES)
def test_a_value_of_another_type_is_damage_and_no_surprise(tmp_path, monkeypatch, statement):
    """As a flipped bit can make it; SQLite forbids it in a table that is STRICT, so here they are not."""
    monkeypatch.setattr(store.schema, "STRICT", "")
    with Store.open(tmp_path, identity={}) as opened:
        for number in range(1, 6):
            opened.append("a", "b", b"", arrays={"x": values(number)})
            opened.commit(state(number), upto=number)
    change(tmp_path, statement)
    assert check_store(tmp_path) != []
    for mode in ("read", "write"):
        try:
            with Store.open(tmp_path, mode=mode) as opened:
                assert opened.last == 5
                assert opened.latest() is None or opened.latest().upto == 5
                list(opened.records())
                list(opened.heads())
        except DamageError:
            pass
    assert repair_store(tmp_path).kept == 5
    assert damage(tmp_path) == []


META = {
    "the identity": ("UPDATE meta SET value = '{}' WHERE key = 'identity'", "without a row that verifies: identity"),
    "no identity": ("DELETE FROM meta WHERE key = 'identity'", "without a row that verifies: identity"),
    "the format": ("UPDATE meta SET value = '2' WHERE key = 'format'", "without a row that verifies: format"),
    "more": ("INSERT INTO meta VALUES ('more', 'x', x'00')", "1 rows of table meta"),
}


@pytest.mark.parametrize(("statement", "said"), META.values(), ids=META)
def test_table_meta_is_checked(path, statement, said):
    change(path, statement)
    (problem,) = check_store(path)
    assert said in problem.what
    # A generation knows the identity, too.
    assert problem.kind == "spare"


def test_an_identity_that_nothing_knows_is_lost(path):
    shutil.rmtree(path / "generations")
    (path / "generations").mkdir()
    change(path, "DELETE FROM meta WHERE key = 'identity'", "DELETE FROM generation")
    (problem, *_) = check_store(path)
    assert problem.kind == "lost"


JOURNALS = {
    "missing": (lambda file: file.unlink(), "journal.sqlite is missing"),
    "empty": (lambda file: file.write_bytes(b""), "was cut off: it has 0 bytes"),
    "a stub": (lambda file: file.write_bytes(file.read_bytes()[:1000]), "was cut off"),
    "cut": (lambda file: file.write_bytes(file.read_bytes()[: 4096 * 9]), "bytes, and says that it has"),
    "another count": (lambda file: flip(file, 31, 1), "bytes, and says that it has"),
    "text": (lambda file: file.write_text("dear diary " * 900), "does not begin as a journal of format 1"),
    "another page size": (lambda file: flip(file, 16, 1), "does not begin as a journal of format 1"),
    "another encoding": (lambda file: flip(file, 59, 1), "does not begin as a journal of format 1"),
    "another version": (lambda file: flip(file, 63, 2), "does not begin as a journal of format 1"),
    "another program's id": (lambda file: flip(file, 70, 2), "does not begin as a journal of format 1"),
    "another schema": (lambda file: flip(file, 4000, 2), "journal.sqlite"),
}


@pytest.mark.parametrize(("spoil", "said"), JOURNALS.values(), ids=JOURNALS)
def test_all_the_rest_is_checked_where_the_journal_is_malformed(path, spoil, said):
    spoil(path / "journal.sqlite")
    flip(newest(path) / "names" / "c" / "0" / "0", 20)
    before = contents(path)
    told = found(path)
    assert said in told
    assert "array 'names' of generation 2" in told
    assert contents(path).items() >= before.items()
    with pytest.raises(StoreError):
        Store.open(path)


def test_sqlites_own_structure_is_checked(path):
    file = path / "journal.sqlite"
    data = bytearray(file.read_bytes())
    # The fourth page is the root of table record; here the number of its cells.
    data[3 * 4096 + 4] ^= 1
    file.write_bytes(data)
    assert "SQLite finds in" in found(path)


def test_what_is_there_too_much_is_left_over_and_no_damage(path):
    generations = path / "generations"
    shutil.copytree(newest(path), generations / "00000009")
    (generations / "00000010.partial").mkdir()
    (generations / "00000001.damaged").mkdir()
    (generations / "notes").mkdir()
    (path / "journal.sqlite.damaged").write_bytes(b"old")
    (path / "journal.sqlite.repaired").write_bytes(b"half")
    (path / "thesis.txt").write_text("mine")
    problems = check_store(path)
    assert {problem.kind for problem in problems} == {"leftover"}
    assert sorted(problem.path.name for problem in problems) == [
        "00000001.damaged",
        "00000009",
        "00000010.partial",
        "journal.sqlite.damaged",
        "journal.sqlite.repaired",
    ]
    Store.open(path).close()
    left = {problem.path.name for problem in check_store(path)}
    assert left == {"00000001.damaged", "journal.sqlite.damaged"}


def test_everything_that_is_wrong_is_told_at_once(path):
    change(
        path,
        "UPDATE record SET label = 'z' WHERE sequence IN (8, 18)",
        "DELETE FROM payload WHERE sequence = 12",
        "UPDATE meta SET value = '' WHERE key = 'created'",
    )
    flip(rows_of(newest(path)))
    flip(older(path) / "names" / "c" / "0" / "0", 20)
    told = found(path)
    for said in ("created", "row 8 fails", "row 12 has lost", "row 18 fails", "array 'rows'", "array 'names'"):
        assert said in told


def test_where_there_is_no_store_none_is_checked_or_repaired(tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.txt").write_text("mine")
    (tmp_path / "database").mkdir()
    with closing(sqlite3.connect(tmp_path / "database" / "journal.sqlite")) as connection:
        connection.execute("CREATE TABLE mine (x)")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "empty").mkdir()
    before = contents(tmp_path)
    for name in ("file", "folder", "database", "loop", "empty", "nothing"):
        for call in (check_store, repair_store):
            with pytest.raises(NotAStoreError, match=name):
                call(tmp_path / name)
    assert contents(tmp_path) == before


def test_a_newer_format_is_neither_judged_nor_touched(path):
    change(path, "PRAGMA user_version = 2", "DELETE FROM meta WHERE key = 'format'")
    before = contents(path)
    for call in (check_store, repair_store):
        with pytest.raises(VersionError, match="format 2"):
            call(path)
    assert contents(path) == before


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
