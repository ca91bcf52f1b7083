"""Bytes that changed on the disk, or were never written so, are found, named, and gone around."""

import logging
import shutil
from pathlib import Path

import numpy as np
import pytest
from forging import DIGEST_BYTES, ROW, digest, log_of, pack, read_log, write_log
from numcodecs import zstd
from scroll_tactile_store import DamageError, Store, check_store, repair_store
from second_reader import HEAD
from store_builds import (
    IDENTITY,
    LAST,
    change_rows,
    compaction,
    contents,
    flip,
    flip_row,
    folders,
    is_refused,
    lose_rows,
    newest,
    same_arrays,
    sequences,
    spoil,
    state,
)


def said(path):
    return " | ".join(f"{problem.kind}: {problem.what}" for problem in check_store(path))


def test_a_sound_store_has_no_problems_and_stays_as_it_is(either):
    before, files = contents(either), len(list(Path("/proc/self/fd").iterdir()))
    assert check_store(either) == check_store(str(either)) == []
    assert contents(either) == before
    assert len(list(Path("/proc/self/fd").iterdir())) == files


def test_what_is_there_too_much_is_left_over_and_no_damage(either):
    checkpoints = either / "checkpoints"
    shutil.copytree(newest(either), checkpoints / "00000009")
    for folder in ("00000010.partial", "00000001.damaged", "notes"):
        (checkpoints / folder).mkdir()
    for name in ("log-00000001.damaged", "log-00000009", "log-00000010.new", "CURRENT.new", "thesis.txt"):
        (either / name).write_bytes(b"half")
    aside = ["00000001.damaged", "log-00000001.damaged"]
    for left in ([*aside, "00000009", "00000010.partial", "CURRENT.new", "log-00000009", "log-00000010.new"], aside):
        problems = check_store(either)
        assert {problem.kind for problem in problems} == {"leftover"}
        assert sorted(problem.path.name for problem in problems) == sorted(left)
        Store.open(either).close()
    assert (either / "thesis.txt").exists() and (checkpoints / "notes").exists()


# Rows.


@pytest.mark.parametrize("row", [1, 14])
@pytest.mark.parametrize("arrays", [False, True])
def test_a_flipped_bit_in_a_row_is_named_and_gone_around(plain, row, arrays):
    flip_row(plain, row, arrays=arrays)
    with Store.open(plain, mode="read") as opened:
        rows = opened.records()
        assert [next(rows).sequence for _ in range(1, row)] == list(range(1, row))
        reads = [lambda: next(rows), lambda: opened.record(row)]
        if arrays:  # its head verifies by itself
            assert sequences(opened.heads()) == list(range(1, LAST + 1))
        else:
            reads += [lambda: list(opened.heads()), lambda: list(opened.with_key(bytes([row])))]
        for read in reads:
            with pytest.raises(DamageError, match=f"row {row} is ") as caught:
                read()
            assert "checkpoint 1 (up to row 15)" in str(caught.value)
            assert (caught.value.path, caught.value.sequence) == (log_of(plain), row)
        assert sequences(opened.records(row)) == sequences(opened.heads(row)) == list(range(row + 1, LAST + 1))
        assert opened.record(row + 1).sequence == row + 1


def test_behind_damage_that_no_checkpoint_covers_nobody_goes_on(plain):
    flip_row(plain, 14)
    with Store.open(plain) as opened:
        assert opened.append("a", "b", b"").sequence == LAST + 1
    with Store.open(plain, mode="read") as reader:
        flip_row(plain, 17)
        before = log_of(plain).read_bytes()
        is_refused(plain)
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
        if row > 15:  # behind the checkpoint
            is_refused(path)
        else:
            with pytest.raises(DamageError, match="repair"), Store.open(path, mode="read") as opened:
                list(opened.heads())


def test_missing_rows_are_named_and_their_numbers_not_given_again(plain):
    lose_rows(plain, 17, 18)
    with Store.open(plain) as opened:
        for read in (opened.records, opened.heads):
            with pytest.raises(DamageError, match="rows 17 to 18 are missing") as caught:
                list(read())
            assert sequences(read(caught.value.sequence)) == [19, 20]
    lose_rows(plain, 19, 20)
    is_refused(plain, f"ends with row 16, and had row {LAST}")
    repair_store(plain)
    with Store.open(plain) as opened:
        assert opened.append("a", "b", b"").sequence == 17


def row(*, sequence=LAST + 1, time=0.0, size=None, arrays=1, key=b"k", kind=b"a", attributes=b"{}", body=None):
    """The bytes of a row with the right digest of its head."""
    texts, body = (key, kind, b"label", attributes), pack([]) if body is None else body
    fields = ROW.pack(sequence, time, len(body) if size is None else size, arrays, *map(len, texts))
    return fields + digest(fields + b"".join(texts)) + b"".join(texts) + body


WHOLE, FOUR, ABC = row(), b"abcd", zstd.compress(b"abc")
ROWS = {
    "nothing": b"",
    "cut off": WHOLE[:-1],
    "too long": WHOLE + b"x",
    "another head": WHOLE[: ROW.size + DIGEST_BYTES] + b"K" + WHOLE[ROW.size + DIGEST_BYTES + 1 :],
    "number 0": row(sequence=0),
    "a number beyond all": row(sequence=2**63),
    "another size": row(size=2**63),
    "neither with arrays nor without": row(arrays=2),
    "no UTF-8": row(kind=b"\xff"),
    "attributes in a list": row(attributes=b"[]"),
}
PAYLOADS = {
    "no payload": b"no payload at all",
    "no bytes": b"",
    "no JSON": pack([], "{"),
    "an array in words": pack([], '{"x":"y"}'),
    "bytes behind the last buffer": pack([("x", "|u1", [4], FOUR, 4)]) + b"x",
    "sizes whose product overflows": pack([("x", "<f8", [2**32, 2**32], b"", 0)]),
    "a buffer of another size": pack([("x", "|u1", [5], FOUR, 4)]),
    "fewer bytes than none": pack([("x", "|u1", [4], FOUR, -4), ("y", "|u1", [8], FOUR, 8)]),
    "two frames of zstd": pack([("x", "|u1", [6], 2 * ABC, 2 * len(ABC))]),
    **{dtype: pack([("x", dtype, [1], bytes(8), 8)]) for dtype in ("|O8", "<U2", "|b1", ">i8", "<M8[s]", "i4,i4")},
}
ROWS |= {name: row(body=body) for name, body in PAYLOADS.items()}


@pytest.mark.parametrize("name", ROWS)
def test_a_row_that_was_never_made_is_damage_there_and_a_repair_ends_before_it(plain, name):
    write_log(plain, [*read_log(plain)[1], WHOLE])
    assert check_store(plain) == []
    write_log(plain, [*read_log(plain)[1][:-1], ROWS[name]])
    with pytest.raises(DamageError, match="row") as caught, Store.open(plain, mode="read") as opened:
        assert sequences(opened.heads(LAST)) == [LAST + 1]
        list(opened.records())
    assert "row" in said(plain)
    if name in PAYLOADS:
        assert caught.value.sequence == LAST + 1
        (problem,) = check_store(plain)
        assert (problem.kind, f"row {LAST + 1}" in problem.what) == ("lost", True)
    assert repair_store(plain).kept == LAST


# The first frame.


@pytest.mark.parametrize("text", [b"[" * 9000 + b"]" * 9000, b"null", b"x", b"\xff"])
def test_a_forged_identity_is_damage_and_a_checkpoint_knows_the_right_one(either, text):
    write_log(either, read_log(either)[1], header=text)
    is_refused(either, "identity")
    assert "was never written so" in said(either)
    repair_store(either)
    with Store.open(either) as opened:
        assert (opened.identity, opened.last) == (IDENTITY, LAST)


def test_an_identity_that_nothing_knows_is_lost(either):
    shutil.rmtree(either / "checkpoints")
    flip(log_of(either), HEAD.size + 2)
    assert "lost: nothing in" in said(either)
    before = log_of(either).read_bytes()
    with pytest.raises(DamageError, match="what the store in"):
        repair_store(either)
    assert log_of(either).read_bytes() == before


# Checkpoints.


def rewrite(name, change):
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


CHUNK, ITSELF, ARRAY = "rows/c/0/0", "zarr.json", "array 'rows'"
SPOIL = {
    # what is done to a checkpoint; what a check says of it
    "a bit of an array": (spoil, ARRAY),
    "a zeroed end": (rewrite(CHUNK, lambda data: data[:-60] + bytes(60)), ARRAY),
    "a file cut short": (rewrite(CHUNK, lambda data: data[:-9]), ARRAY),
    "no file": (lambda folder: (folder / CHUNK).unlink(), ARRAY),
    "no array": (lambda folder: shutil.rmtree(folder / "rows"), ARRAY),
    "an array's shape": (rewrite("rows/zarr.json", lambda data: data.replace(b"100", b"101")), ARRAY),
    "no group": (lambda folder: (folder / ITSELF).unlink(), "zarr.json cannot be read"),
    "its format": (rewrite(ITSELF, lambda data: data.replace(b'"format": 3', b'"format": 9')), "its sha256 differs"),
    "nothing left": (shutil.rmtree, "zarr.json cannot be read"),
    "another": (
        lambda folder: shutil.copytree(next(folder.parent.glob(f"*[!{folder.name[-1]}]")), folder, dirs_exist_ok=True),
        "another than was",
    ),
}


@pytest.mark.parametrize("is_compaction", [False, True])
@pytest.mark.parametrize(("harm", "words"), SPOIL.values(), ids=SPOIL)
def test_a_spoilt_checkpoint_is_named_and_the_other_taken(compacted, harm, words, is_compaction, caplog):
    folder = (compaction if is_compaction else newest)(compacted)
    harm(folder)
    problems = check_store(compacted)
    assert words in " ".join(problem.what for problem in problems)
    assert all(problem.path.is_relative_to(folder) and str(folder) in problem.what for problem in problems)
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
        assert sequences(opened.records()) == list(range(1, LAST + 1))
        assert opened.commit({"x": np.arange(7)}, last_sequence=6) == 2  # an older one takes no one's place
        assert folders(plain) == ["00000001"]
        assert opened.commit({"x": np.arange(7)}, last_sequence=LAST) == 2
        assert opened.latest().number == 2
    assert "array 'rows' of checkpoint 1" in caplog.text and "replaying" in caplog.text
