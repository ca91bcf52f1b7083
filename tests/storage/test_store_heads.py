"""Rows without their arrays, and single rows."""

import numpy as np
import pytest
from store_builds import change

import store.journal
from store import CompactedError, DamageError, Head, Record, RecordError, Store


@pytest.fixture
def opened(opened):
    for number in range(1, 11):
        kind, label = ("add", "take")[number % 3 == 0], ("wool", "é'\"\U0001f9f6")[number % 2]
        opened.append(kind, label, bytes([number]), arrays={"x": np.arange(number)}, attributes={"n": number})
    return opened


def sequences(rows):
    return [row.sequence for row in rows]


@pytest.mark.parametrize("together", [1, 3, 10, 4096])
def test_heads_are_the_records_without_their_arrays(opened, monkeypatch, together):
    monkeypatch.setattr(store.journal, "TOGETHER", together)
    heads, records = list(opened.heads()), list(opened.records())
    assert {type(head) for head in heads} == {Head}
    for head, record in zip(heads, records, strict=True):
        for name in ("sequence", "kind", "label", "key", "time", "attributes"):
            assert getattr(head, name) == getattr(record, name)
        assert head.size > 0
    assert sequences(opened.heads(7)) == [8, 9, 10]
    assert sequences(opened.heads(10)) == sequences(opened.heads(99)) == []


@pytest.mark.parametrize("together", [1, 2, 4096])
def test_heads_of_one_kind_or_label(opened, monkeypatch, together):
    monkeypatch.setattr(store.journal, "TOGETHER", together)
    assert sequences(opened.heads(kind="take")) == [3, 6, 9]
    assert sequences(opened.heads(3, kind="take")) == [6, 9]
    assert sequences(opened.heads(label="wool")) == [2, 4, 6, 8, 10]
    assert sequences(opened.heads(kind="take", label="é'\"\U0001f9f6")) == [3, 9]
    assert sequences(opened.heads(kind="wool")) == []


def test_heads_end_where_the_last_was_when_they_were_asked_for(opened):
    heads = opened.heads(8)
    opened.append("add", "late", b"")
    assert sequences(heads) == [9, 10]


@pytest.mark.parametrize(("name", "value"), [("kind", "a\0"), ("label", "\ud800"), ("label", 3)])
def test_a_filter_that_no_record_could_have_is_refused(opened, name, value):
    with pytest.raises(RecordError, match=f"the {name}"):
        opened.heads(**{name: value})


def test_heads_from_before_the_beginning_are_refused(opened):
    with pytest.raises(ValueError, match="negative"):
        opened.heads(-1)


def test_damaged_heads_are_named(opened):
    change(opened.path, "UPDATE record SET time = time + 1 WHERE sequence = 6")
    rows = opened.heads()
    assert [next(rows).sequence for _ in range(5)] == [1, 2, 3, 4, 5]
    with pytest.raises(DamageError, match="row 6 fails its checksum") as caught:
        next(rows)
    assert sequences(opened.heads(caught.value.sequence)) == [7, 8, 9, 10]
    with pytest.raises(DamageError, match="row 6"):
        list(opened.heads(kind="take"))
    assert sequences(opened.heads(label="é'\"\U0001f9f6")) == [1, 3, 5, 7, 9]


@pytest.mark.parametrize("together", [1, 4096])
@pytest.mark.parametrize("gone", ["4 AND 6", "1 AND 2", "9 AND 10"])
def test_missing_heads_are_named_where_all_are_asked_for(opened, monkeypatch, together, gone):
    monkeypatch.setattr(store.journal, "TOGETHER", together)
    change(opened.path, f"DELETE FROM record WHERE sequence BETWEEN {gone}")
    with pytest.raises(DamageError, match=f"rows {gone.replace('AND', 'to')} are missing"):
        list(opened.heads())
    assert set(sequences(opened.heads(kind="take"))) <= {3, 6, 9}


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
    change(opened.path, "UPDATE payload SET bytes = x'00' WHERE sequence = 4")
    change(opened.path, "DELETE FROM record WHERE sequence = 5")
    for sequence, said in ((4, "the arrays of row 4 fail"), (5, "rows 5 to 5 are missing")):
        with pytest.raises(DamageError, match=said):
            opened.record(sequence)
    assert [opened.record(sequence).sequence for sequence in (3, 6)] == [3, 6]


def test_compacted_records_have_heads_only(opened):
    before = list(opened.heads())
    opened.commit({}, upto=10)
    opened.compact({}, upto=6)
    assert list(opened.heads()) == before
    assert sequences(opened.heads(kind="take")) == [3, 6, 9]
    for sequence in (1, 6):
        with pytest.raises(CompactedError, match=f"row {sequence} .* rows 1 to 6 were"):
            opened.record(sequence)
    assert opened.record(7).arrays["x"].tolist() == list(range(7))
