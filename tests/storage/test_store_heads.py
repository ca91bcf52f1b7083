"""Rows without their arrays, and single rows."""

import numpy as np
import pytest
from scroll_tactile_store import DamageError, Record, RecordError, Store
from store_builds import flip_row


@pytest.fixture
def opened(opened):
    for number in range(1, 11):
        kind, label = ("add", "take")[number % 3 == 0], ("wool", "é'\"\U0001f9f6")[number % 2]
        opened.append(kind, label, bytes([number]), arrays={"x": np.arange(number)}, attributes={"n": number})
    return opened


def sequences(rows):
    return [row.sequence for row in rows]


def test_heads_behind_a_row_of_one_kind(opened):
    heads = opened.heads(8)
    opened.append("add", "late", b"")
    assert sequences(heads) == [9, 10, 11]
    for asked, expected in (
        ({"after": 7}, [8, 9, 10, 11]),
        ({"after": 99}, []),
        ({"kind": "take"}, [3, 6, 9]),
        ({"after": 3, "kind": "take"}, [6, 9]),
        ({"kind": "wool"}, []),
    ):
        assert sequences(opened.heads(**asked)) == expected


def test_damaged_heads_are_named(opened):
    """A checkpoint contains them, and whoever opens the store has not read them."""
    opened.commit({}, last_sequence=9)
    opened.close()
    flip_row(opened.path, 6)
    with Store.open(opened.path, mode="read") as reader:
        rows = reader.heads()
        assert [next(rows).sequence for _ in range(5)] == [1, 2, 3, 4, 5]
        with pytest.raises(DamageError, match="row 6 is") as caught:
            next(rows)
        assert sequences(reader.heads(caught.value.sequence)) == [7, 8, 9, 10]
        with pytest.raises(DamageError, match="row 6 is"):
            list(reader.with_key(b"\6"))


def test_a_single_record(opened):
    record = opened.record(7)
    assert isinstance(record, Record)
    assert (record.sequence, record.attributes, record.arrays["x"].tolist()) == (7, {"n": 7}, list(range(7)))
    with Store.open(opened.path, mode="read") as reader:
        assert reader.record(10).key == b"\x0a"


@pytest.mark.parametrize("wrong", [0, -1, 11, True, 1.0, "1", None])
def test_a_record_that_is_not_there_is_refused(opened, wrong):
    with pytest.raises(RecordError, match="has records 1 to 10, not"):
        opened.record(wrong)


def test_damage_of_one_record_is_not_that_of_another(opened):
    opened.commit({}, last_sequence=10)
    opened.close()
    flip_row(opened.path, 5)
    flip_row(opened.path, 4, arrays=True)
    with Store.open(opened.path, mode="read") as reader:
        for sequence, said in ((4, "row 4 is not as it was written"), (5, "row 5 is not as it was written")):
            with pytest.raises(DamageError, match=said) as caught:
                reader.record(sequence)
            assert caught.value.sequence == sequence
        assert [reader.record(sequence).sequence for sequence in (3, 6)] == [3, 6]
        assert sequences(reader.heads(5)) == [6, 7, 8, 9, 10]
        assert next(reader.heads(3)).sequence == 4  # its head verifies by itself
