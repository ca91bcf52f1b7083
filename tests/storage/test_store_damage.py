"""Bytes that changed on the disk are found, named, and gone around."""

import logging
import shutil
from itertools import islice

import numpy as np
import pytest
from store_builds import change, flip, folders, same_arrays, state, two_kept

from store import DamageError, NotAStoreError, Store

ROWS = 6


@pytest.fixture
def path(tmp_path):
    """A closed store of six rows and two generations, up to rows 2 and 4."""
    with two_kept(), Store.open(tmp_path / "s", identity={"for": "damage"}) as opened:
        for number in range(1, ROWS + 1):
            opened.append("a", f"the label of row {number}", bytes([number] * 8), arrays={"x": np.arange(number)})
            if number in (2, 4):
                opened.commit({"x": np.arange(1000) + number, "y": np.array(number)}, upto=number)
    return tmp_path / "s"


def chunk_of(folder):
    return folder / "x" / "c" / "0"


@pytest.mark.parametrize(
    ("row", "covered"), [(1, "generation 2 (up to row 4)"), (4, "generation 2"), (5, "no generation")]
)
def test_a_flipped_bit_in_a_row_is_named_and_gone_around(path, row, covered):
    journal = path / "journal.sqlite"
    flip(journal, journal.read_bytes().index(f"label of row {row}".encode()))
    with Store.open(path) as opened:
        rows = opened.records()
        for expected in range(1, row):
            assert next(rows).sequence == expected
        with pytest.raises(DamageError, match=f"row {row} fails") as caught:
            next(rows)
        assert covered in str(caught.value)
        assert (caught.value.path, caught.value.sequence) == (journal, row)
        assert [found.sequence for found in opened.records(row)] == list(range(row + 1, ROWS + 1))
        assert opened.append("a", "b", b"").sequence == ROWS + 1


@pytest.mark.parametrize(
    "assignment",
    [
        "kind = 'z'",
        "label = 'z'",
        "label = CAST(x'ff' AS TEXT)",
        "key = x'00'",
        "time = time + 1",
        "attributes = '{\"a\":1}'",
        "attributes = ''",
        "size = size + 1",
        "digest = x''",
        "checksum = x''",
    ],
)
def test_every_column_is_under_the_checksum(path, assignment):
    change(path, f"UPDATE record SET {assignment} WHERE sequence = 3")
    with Store.open(path, mode="read") as opened:
        assert [row.sequence for row in islice(opened.records(), 2)] == [1, 2]
        assert [head.sequence for head in islice(opened.heads(), 2)] == [1, 2]
        for read in (lambda: list(opened.records()), lambda: list(opened.heads()), lambda: opened.record(3)):
            with pytest.raises(DamageError, match="row 3 fails its checksum") as caught:
                read()
            assert caught.value.sequence == 3


@pytest.mark.parametrize(
    ("statement", "said"),
    [
        ("UPDATE payload SET bytes = x'' WHERE sequence = 3", "fail their checksum"),
        ("UPDATE payload SET bytes = substr(bytes, 1, 20) WHERE sequence = 3", "fail their checksum"),
        ("UPDATE payload SET bytes = (SELECT bytes FROM payload WHERE sequence = 4) WHERE sequence = 3", "fail their"),
        ("DELETE FROM payload WHERE sequence = 3", "are missing"),
    ],
)
def test_the_arrays_of_a_row_are_under_its_digest_and_its_head_is_not_lost_with_them(path, statement, said):
    change(path, statement)
    with Store.open(path, mode="read") as opened:
        for read in (lambda: list(opened.records()), lambda: opened.record(3)):
            with pytest.raises(DamageError, match=f"the arrays of row 3 {said}") as caught:
                read()
            assert caught.value.sequence == 3
        assert [row.sequence for row in opened.records(3)] == [4, 5, 6]
        assert [head.sequence for head in opened.heads()] == list(range(1, ROWS + 1))


def test_exchanged_rows_are_found(path):
    change(path, "UPDATE record SET sequence = 30 WHERE sequence = 3")
    change(path, "UPDATE record SET sequence = 3 WHERE sequence = 2")
    change(path, "UPDATE record SET sequence = 2 WHERE sequence = 30")
    with Store.open(path) as opened, pytest.raises(DamageError, match="row 2"):
        list(opened.records())


def test_missing_rows_are_named_and_their_numbers_not_given_again(path):
    change(path, "DELETE FROM record WHERE sequence IN (2, 3)")
    with Store.open(path) as opened:
        for read in (opened.records, opened.heads):
            with pytest.raises(DamageError, match="rows 2 to 3 are missing") as caught:
                list(read())
            assert [row.sequence for row in read(caught.value.sequence)] == [4, 5, 6]
    # One table betrays what the other lost at its end.
    change(path, "DELETE FROM record WHERE sequence > 5")
    with Store.open(path) as opened, pytest.raises(DamageError, match="rows 6 to 6 are missing"):
        list(opened.heads(5))
    change(path, "DELETE FROM record WHERE sequence > 1")
    change(path, "DELETE FROM payload WHERE sequence > 1")
    with Store.open(path) as opened:
        assert opened.last == 4
        with pytest.raises(DamageError, match="rows 2 to 4 are missing"):
            list(opened.records())
        assert opened.append("a", "b", b"").sequence == 5


def file_of(folder):
    return folder / "rows" / "c" / "0" / "0"


def rewrite(file, change):
    file.write_bytes(change(file.read_bytes()))


SPOIL = {
    "a bit of an array": lambda folder: flip(file_of(folder), -9),
    "a bit of its header": lambda folder: flip(file_of(folder), 4),
    "a zeroed end": lambda folder: rewrite(file_of(folder), lambda data: data[:-60] + bytes(60)),
    "a file cut short": lambda folder: rewrite(file_of(folder), lambda data: data[:-9]),
    "an empty file": lambda folder: file_of(folder).write_bytes(b""),
    "no file": lambda folder: file_of(folder).unlink(),
    "no array": lambda folder: shutil.rmtree(folder / "rows"),
    "an array's description": lambda folder: (folder / "rows" / "zarr.json").write_text("{}"),
    "an array's shape": lambda folder: rewrite(
        folder / "rows" / "zarr.json", lambda data: data.replace(b"100", b"101")
    ),
    "no group": lambda folder: (folder / "zarr.json").unlink(),
    "the group's format": lambda folder: rewrite(
        folder / "zarr.json", lambda data: data.replace(b'"format": 2', b'"format": 9')
    ),
    "nothing left": shutil.rmtree,
}


@pytest.mark.parametrize("spoil", SPOIL.values(), ids=SPOIL.keys())
@pytest.mark.parametrize("mode", ["read", "write"])
def test_a_spoilt_generation_is_named_and_the_one_before_it_taken(plain, spoil, mode, caplog):
    folder = plain / "generations" / "00000002"
    spoil(folder)
    with Store.open(plain, mode=mode) as opened, caplog.at_level(logging.WARNING):
        found = opened.latest()
    assert (found.number, found.upto) == (1, 10)
    assert same_arrays(found.arrays, state(10))
    (warning,) = caplog.messages
    assert "generation 2" in warning
    assert str(folder) in warning


def test_without_any_generation_that_verifies_there_is_none(path, caplog):
    for number in (1, 2):
        flip(chunk_of(path / "generations" / f"{number:08d}"), -5)
    with Store.open(path) as opened:
        assert opened.latest() is None
        assert len(list(opened.records())) == ROWS
    assert len(caplog.messages) == 2
    assert "array 'x' of generation 1" in caplog.messages[1]


def test_behind_a_spoilt_generation_the_journal_has_every_row(path, caplog):
    with Store.open(path) as opened:
        assert opened.commit({"x": np.arange(1000)}, upto=6) == 3
        assert folders(path) == ["00000003"]
        flip(chunk_of(path / "generations" / "00000003"), -5)
        assert opened.latest() is None
        assert [row.sequence for row in opened.records()] == list(range(1, ROWS + 1))
        assert opened.commit({"x": np.arange(7)}, upto=6) == 4
        assert opened.latest().number == 4
    assert "replaying" in caplog.text


def test_a_spoilt_identity_is_found(path):
    change(path, "UPDATE meta SET value = '{}' WHERE key = 'identity'")
    with pytest.raises(DamageError, match="identity"):
        Store.open(path)


@pytest.mark.parametrize("spoil", [lambda data: b"", lambda data: b"x" + data[1:], lambda data: data[:50]])
def test_a_journal_that_is_no_longer_sqlite_is_damage_where_generations_are(path, spoil):
    journal = path / "journal.sqlite"
    journal.write_bytes(spoil(journal.read_bytes()))
    with pytest.raises(DamageError, match=str(journal)):
        Store.open(path)
    shutil.rmtree(path / "generations")
    with pytest.raises(NotAStoreError):
        Store.open(path)
