"""Bytes that changed on the disk are found, named, and gone around."""

import logging
import shutil

import numpy as np
import pytest
from forging import log_of
from scroll_tactile_store import DamageError, Store, check_store, repair_store
from store_builds import (
    LAST,
    change_rows,
    compaction,
    flip_row,
    folders,
    lose_rows,
    newest,
    same_arrays,
    spoil,
    state,
)


@pytest.mark.parametrize(("row", "covered"), [(1, "checkpoint 1 (up to row 15)"), (14, "checkpoint 1")])
@pytest.mark.parametrize("arrays", [False, True])
def test_a_flipped_bit_in_a_row_is_named_and_gone_around(plain, row, covered, arrays):
    flip_row(plain, row, arrays=arrays)
    with Store.open(plain, mode="read") as opened:
        found = opened.records()
        for expected in range(1, row):
            assert next(found).sequence == expected
        with pytest.raises(DamageError, match=f"row {row} is ") as caught:
            next(found)
        assert covered in str(caught.value)
        assert (caught.value.path, caught.value.sequence) == (log_of(plain), row)
        assert [each.sequence for each in opened.records(row)] == list(range(row + 1, LAST + 1))


def test_behind_damage_that_no_checkpoint_covers_nobody_goes_on(plain):
    flip_row(plain, 14)
    with Store.open(plain) as opened:
        assert opened.append("a", "b", b"").sequence == LAST + 1
    with Store.open(plain, mode="read") as reader:
        flip_row(plain, 17)
        before = log_of(plain).read_bytes()
        for mode in ("write", "read"):
            with pytest.raises(DamageError, match="repair the store"):
                Store.open(plain, mode=mode)
        with pytest.raises(DamageError, match="row 17 is"):
            reader.record(17)
    assert log_of(plain).read_bytes() == before


@pytest.mark.parametrize("row", [2, 17])
def test_exchanged_and_doubled_rows_are_found(plain, row):
    def swap(found):
        found[row], found[row + 1] = found[row + 1], found[row]

    def double(found):
        found[row + 1] = found[row]

    for change in (swap, double):
        path = shutil.copytree(plain, plain.with_name(change.__name__))
        change_rows(path, change)
        with pytest.raises(DamageError, match="repair the store"), Store.open(path, mode="read") as opened:
            list(opened.heads())


def test_missing_rows_are_named_and_their_numbers_not_given_again(plain):
    lose_rows(plain, 17, 18)
    with Store.open(plain) as opened:
        for read in (opened.records, opened.heads):
            with pytest.raises(DamageError, match="rows 17 to 18 are missing") as caught:
                list(read())
            assert [row.sequence for row in read(caught.value.sequence)] == [19, 20]
    lose_rows(plain, 19, 20)
    with pytest.raises(DamageError, match=f"ends with row 16, and had row {LAST}"):
        Store.open(plain, mode="read")
    repair_store(plain)
    with Store.open(plain) as opened:
        assert opened.append("a", "b", b"").sequence == 17


def file_of(folder):
    return folder / "rows" / "c" / "0" / "0"


def rewrite(file, change):
    file.write_bytes(change(file.read_bytes()))


SPOIL = {
    # what is done to a checkpoint; what a check says of it
    "a bit of an array": (spoil, "array 'rows' of checkpoint"),
    "a zeroed end": (lambda folder: rewrite(file_of(folder), lambda data: data[:-60] + bytes(60)), "array 'rows'"),
    "a file cut short": (lambda folder: rewrite(file_of(folder), lambda data: data[:-9]), "array 'rows'"),
    "no file": (lambda folder: file_of(folder).unlink(), "array 'rows'"),
    "no array": (lambda folder: shutil.rmtree(folder / "rows"), "array 'rows'"),
    "an array's shape": (
        lambda folder: rewrite(folder / "rows" / "zarr.json", lambda data: data.replace(b"100", b"101")),
        "array 'rows'",
    ),
    "no group": (lambda folder: (folder / "zarr.json").unlink(), "zarr.json cannot be read"),
    "the group's format": (
        lambda folder: rewrite(folder / "zarr.json", lambda data: data.replace(b'"format": 3', b'"format": 9')),
        "its sha256 differs",
    ),
    "nothing left": (shutil.rmtree, "zarr.json cannot be read"),
}


@pytest.mark.parametrize("is_compaction", [False, True])
@pytest.mark.parametrize(("harm", "said"), SPOIL.values(), ids=SPOIL)
def test_a_spoilt_checkpoint_is_named_and_the_other_taken(compacted, harm, said, is_compaction, caplog):
    folder = (compaction if is_compaction else newest)(compacted)
    harm(folder)
    problems = check_store(compacted)
    assert said in " ".join(problem.what for problem in problems)
    assert all(problem.path.is_relative_to(folder) and str(problem.path) in problem.what for problem in problems)
    assert {problem.kind for problem in problems} == {"lost" if is_compaction else "spare"}
    with Store.open(compacted, mode="read") as opened, caplog.at_level(logging.WARNING):
        found = opened.latest()
        if is_compaction:
            with pytest.raises(DamageError, match="checkpoint"):
                opened.compaction()
    assert found.last_sequence == (15 if is_compaction else 6)
    assert same_arrays(found.arrays, state(found.last_sequence))
    assert {str(folder) in warning for warning in caplog.messages} == ({True} if not is_compaction else set())


def test_behind_a_spoilt_checkpoint_the_log_has_every_row(plain, caplog):
    with Store.open(plain) as opened:
        spoil(newest(plain))
        assert opened.latest() is None
        assert [row.sequence for row in opened.records()] == list(range(1, LAST + 1))
        assert opened.commit({"x": np.arange(7)}, last_sequence=6) == 2  # an older one takes no one's place
        assert folders(plain) == ["00000001"]
        assert opened.commit({"x": np.arange(7)}, last_sequence=LAST) == 2
        assert opened.latest().number == 2
    assert "array 'rows' of checkpoint 1" in caplog.text and "replaying" in caplog.text
