"""Bytes that changed on the disk are found, named, and gone around."""

import logging
import shutil
from itertools import islice

import numpy as np
import pytest
from store_builds import (
    LAST,
    change_rows,
    flip,
    flip_row,
    folders,
    frames,
    log_of,
    lose_rows,
    newest,
    same_arrays,
    spoil,
    state,
)

from store import DamageError, Store, repair_store
from store.framing import FRAME_BYTES


@pytest.mark.parametrize(("row", "covered"), [(1, "checkpoint 1 (up to row 15)"), (14, "checkpoint 1"), (17, "no")])
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


def test_a_writer_goes_on_behind_damage_that_a_checkpoint_covers_and_refuses_behind_any_other(plain):
    flip_row(plain, 14)
    with Store.open(plain) as opened:
        assert opened.append("a", "b", b"").sequence == LAST + 1
    flip_row(plain, 17)
    before = log_of(plain).read_bytes()
    with pytest.raises(DamageError, match="repair the store"):
        Store.open(plain)
    assert log_of(plain).read_bytes() == before


def test_every_byte_of_a_row_and_its_frame_is_under_a_checksum(plain):
    """Of one that nobody reads at opening, and of one behind the checkpoint."""
    data = log_of(plain).read_bytes()
    for row in (9, 18):
        frame = frames(plain)[row]
        for place in [*range(frame.offset, frame.offset + FRAME_BYTES + 90), *range(frame.end - 9, frame.end)]:
            flipped = bytearray(data)
            flipped[place] ^= 1 << place % 8
            log_of(plain).write_bytes(flipped)
            with Store.open(plain, mode="read") as opened:
                assert [each.sequence for each in islice(opened.records(), row - 1)] == list(range(1, row))
                for after in (0, row - 1):
                    with pytest.raises(DamageError, match=f"row {row} is") as caught:
                        list(opened.records(after))
                    assert caught.value.sequence == row
                assert [each.sequence for each in opened.records(row)] == list(range(row + 1, LAST + 1))
        log_of(plain).write_bytes(data)


def test_the_head_of_a_row_is_not_lost_with_its_arrays(plain):
    flip_row(plain, 3, arrays=True)
    with Store.open(plain, mode="read") as opened:
        with pytest.raises(DamageError, match="row 3 is not as it was written"):
            opened.record(3)
        assert [head.sequence for head in opened.heads()] == list(range(1, LAST + 1))


@pytest.mark.parametrize("row", [2, 17])
def test_exchanged_and_doubled_rows_are_found(plain, row):
    def swap(found):
        found[row], found[row + 1] = found[row + 1], found[row]

    def double(found):
        found[row + 1] = found[row]

    for change, said in ((swap, f"row {row} is missing"), (double, f"row {row + 1} is missing")):
        path = shutil.copytree(plain, plain.with_name(change.__name__))
        change_rows(path, change)
        with Store.open(path, mode="read") as opened, pytest.raises(DamageError, match=said):
            list(opened.heads())


def test_missing_rows_are_named_and_their_numbers_not_given_again(plain):
    lose_rows(plain, 2, 3)
    with Store.open(plain) as opened:
        for read in (opened.records, opened.heads):
            with pytest.raises(DamageError, match="rows 2 to 3 are missing") as caught:
                list(read())
            assert [row.sequence for row in read(caught.value.sequence)] == list(range(4, LAST + 1))
    lose_rows(plain, *range(4, LAST + 1))
    with Store.open(plain, mode="read") as opened:
        assert opened.last == LAST
        with pytest.raises(DamageError, match=f"rows 2 to {LAST} are missing"):
            list(opened.records())
    repair_store(plain)
    with Store.open(plain) as opened:
        assert opened.append("a", "b", b"").sequence == 16


def file_of(folder):
    return folder / "rows" / "c" / "0" / "0"


def rewrite(file, change):
    file.write_bytes(change(file.read_bytes()))


SPOIL = {
    "a bit of an array": spoil,
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
        folder / "zarr.json", lambda data: data.replace(b'"format": 1', b'"format": 9')
    ),
    "nothing left": shutil.rmtree,
}


@pytest.mark.parametrize("harm", SPOIL.values(), ids=SPOIL.keys())
@pytest.mark.parametrize("mode", ["read", "write"])
def test_a_spoilt_checkpoint_is_named_and_the_base_taken(compacted, harm, mode, caplog):
    folder = newest(compacted)
    harm(folder)
    with Store.open(compacted, mode=mode) as opened, caplog.at_level(logging.WARNING):
        found = opened.latest()
    assert found.upto == 6
    assert same_arrays(found.arrays, state(6))
    (warning,) = caplog.messages
    assert str(folder) in warning


def test_behind_a_spoilt_checkpoint_the_log_has_every_row(plain, caplog):
    with Store.open(plain) as opened:
        spoil(newest(plain))
        assert opened.latest() is None
        assert [row.sequence for row in opened.records()] == list(range(1, LAST + 1))
        assert opened.commit({"x": np.arange(7)}, upto=6) == 2  # an older one takes no one's place
        assert folders(plain) == ["00000001"]
        assert opened.commit({"x": np.arange(7)}, upto=LAST) == 2
        assert opened.latest().number == 2
    assert "array 'rows' of checkpoint 1" in caplog.text and "replaying" in caplog.text


def test_a_spoilt_identity_is_found(plain):
    flip(log_of(plain), FRAME_BYTES + 3)
    for mode in ("read", "write"):
        with pytest.raises(DamageError, match="payload of frame 0"):
            Store.open(plain, mode=mode)


@pytest.mark.parametrize("spoil", [lambda data: b"", lambda data: b"x" + data[1:], lambda data: data[:50]])
def test_a_log_that_is_no_longer_one_is_damage(plain, spoil):
    rewrite(log_of(plain), spoil)
    for mode in ("read", "write"):
        with pytest.raises(DamageError, match=str(log_of(plain))):
            Store.open(plain, mode=mode)
