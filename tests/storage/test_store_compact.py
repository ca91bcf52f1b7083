"""Compaction: a base stands for rows that have given up their arrays."""

import logging
import sqlite3
from contextlib import closing

import numpy as np
import pytest
import store.generations
from store_builds import as_after_a_crash, change, folders, query

from store import CompactedError, DamageError, RecordError, Store, StoreError

LAST = 12


def noise(number):
    return np.random.default_rng(number).integers(0, 2**60, 400)


def add(opened, number):
    return opened.append("a", f"row {number}", bytes([number]), arrays={"x": noise(number)}).sequence


def sums(upto):
    return {"sum": np.array(upto * (upto + 1) // 2), "bulk": np.full(500, upto)}


@pytest.fixture
def opened(tmp_path):
    """Twelve rows, and a generation up to the last; one up to row 8 was before it."""
    with Store.open(tmp_path / "s", identity={"for": "compaction"}) as fresh:
        for number in range(1, LAST + 1):
            add(fresh, number)
        fresh.commit(sums(8), upto=8)
        fresh.commit(sums(LAST), upto=LAST)
        yield fresh


def spoil(opened, number):
    chunk = opened.path / "generations" / f"{number:08d}" / "bulk" / "c" / "0"
    chunk.write_bytes(chunk.read_bytes()[:-1])


def payloads(path):
    return [sequence for (sequence,) in query(path, "SELECT sequence FROM payload ORDER BY sequence")]


def agrees(opened, compacted, last=LAST):
    assert (opened.last, opened.compacted) == (last, compacted)
    assert [head.label for head in opened.heads()] == [f"row {number}" for number in range(1, last + 1)]
    found = [(row.sequence, row.arrays["x"].tobytes()) for row in opened.records(compacted)]
    assert found == [(number, noise(number).tobytes()) for number in range(compacted + 1, last + 1)]
    for after in range(compacted):
        with pytest.raises(CompactedError, match=f"records 1 to {compacted}"):
            opened.records(after)
    base = opened.base()
    if compacted:
        assert (base.upto, base.arrays["sum"]) == (compacted, sums(compacted)["sum"])
    else:
        assert base is None
    return True


def test_rows_give_up_their_arrays_for_the_base_and_keep_their_heads(opened):
    before = list(opened.heads())
    opened.compact(sums(5), upto=5, attributes={"made": "now"})
    assert agrees(opened, 5)
    assert list(opened.heads()) == before
    assert payloads(opened.path) == list(range(6, LAST + 1))
    assert opened.base().attributes == {"made": "now"}
    assert opened.base().arrays["bulk"][100:102].tolist() == [5, 5]
    # The newest is still the one with all rows, whatever its number.
    assert opened.latest().upto == LAST
    opened.close()
    for mode in ("read", "write"):
        with Store.open(opened.path, mode=mode) as again:
            assert agrees(again, 5)


def test_the_space_is_given_back_to_the_disk(opened):
    before = opened.size()["journal"]
    opened.compact(sums(LAST), upto=LAST)
    # A row without its arrays takes some 200 bytes, a table a page; the log is empty.
    assert opened.size()["journal"] < before / 2
    assert (opened.path / "journal.sqlite").stat().st_size < 9 * 4096
    assert (opened.path / "journal.sqlite-wal").stat().st_size == 0


def test_the_base_stays_while_generations_come_and_go(opened):
    opened.compact(sums(5), upto=5)
    base = opened.base().number
    for number in range(LAST + 1, LAST + 6):
        add(opened, number)
        opened.commit(sums(number), upto=number)
        assert agrees(opened, 5, number)
        assert opened.base().number == base
    assert len(folders(opened.path)) == 2  # the current and the base
    with Store.open(opened.path, mode="read") as reader:
        assert agrees(reader, 5, LAST + 5)


def test_there_is_one_generation_and_beside_it_the_base(opened):
    assert folders(opened.path) == ["00000002"]
    opened.compact(sums(5), upto=5)
    assert folders(opened.path) == ["00000002", "00000003"]
    add(opened, LAST + 1)
    opened.commit(sums(LAST + 1), upto=LAST + 1)
    assert folders(opened.path) == ["00000003", "00000004"]
    opened.compact(sums(9), upto=9)
    assert folders(opened.path) == ["00000004", "00000005"]
    assert agrees(opened, 9, LAST + 1)


def test_a_generation_with_all_rows_has_to_be_there_first(opened):
    add(opened, LAST + 1)
    with pytest.raises(RecordError, match=f"all {LAST + 1} records; the newest has those up to {LAST}: commit one"):
        opened.compact(sums(5), upto=5)
    opened.commit(sums(LAST + 1), upto=LAST + 1)
    assert payloads(opened.path) == list(range(1, LAST + 2))
    opened.compact(sums(5), upto=5)
    with Store.open(opened.path.with_name("fresh"), identity={}) as fresh:
        add(fresh, 1)
        with pytest.raises(RecordError, match="all 1 records; there is none"):
            fresh.compact(sums(1), upto=1)


@pytest.mark.parametrize("upto", [4, -1, LAST + 1, True, 5.0])
def test_there_is_no_way_back_before_the_base(opened, upto):
    opened.compact(sums(5), upto=5)
    for call in (opened.commit, opened.commit_later, opened.compact):
        with pytest.raises(RecordError, match=f"upto must be a sequence from 5, .* to {LAST}"):
            call(sums(0), upto=upto)
    assert agrees(opened, 5)


def test_a_damaged_base_is_named_and_the_newest_generation_gone_on_from(opened, caplog):
    opened.compact(sums(5), upto=5)
    spoil(opened, 3)
    with pytest.raises(DamageError, match="array 'bulk' of generation 3"):
        opened.base()
    assert opened.latest().upto == LAST
    # It is kept all the same, for a repair to decide.
    for number in range(LAST + 1, LAST + 4):
        add(opened, number)
        opened.commit(sums(number), upto=number)
    assert "00000003" in folders(opened.path)
    assert caplog.records == []


def test_nothing_is_given_up_beside_a_newest_generation_that_cannot_be_read(opened):
    spoil(opened, 2)
    with pytest.raises(DamageError, match=r"generation 2, .* nothing was given up") as caught:
        opened.compact(sums(5), upto=5)
    assert caught.value.path == opened.path / "generations" / "00000002"
    assert payloads(opened.path) == list(range(1, LAST + 1))
    opened.commit(sums(LAST), upto=LAST)
    opened.compact(sums(5), upto=5)
    assert agrees(opened, 5)


def test_a_damaged_newest_generation_is_passed_over_for_the_base(opened, caplog):
    opened.compact(sums(5), upto=5)
    spoil(opened, 2)
    assert opened.latest().upto == 5
    assert "replaying" in caplog.text
    assert [row.sequence for row in opened.records(opened.latest().upto)] == list(range(6, LAST + 1))
    assert opened.base().upto == 5


@pytest.mark.parametrize("assignment", ["base = 0", "upto = 6", "checksum = x''", "base = 7"])
def test_a_damaged_row_of_the_base_is_not_believed(opened, assignment, caplog):
    opened.compact(sums(5), upto=5)
    change(opened.path, f"UPDATE generation SET {assignment} WHERE number = 3")
    assert opened.compacted == 0
    with pytest.raises(DamageError, match="the arrays of row 1 are missing"):
        list(opened.records())
    # Whoever goes on from the newest generation would not meet that: opening says it.
    with Store.open(opened.path, mode="read"):
        assert f"{opened.path}: the row of generation 3 fails its checksum" in caplog.text
    if assignment != "base = 0":
        with pytest.raises(DamageError, match="row of generation 3"):
            opened.base()
    assert opened.latest().upto == LAST
    for number in range(LAST + 1, LAST + 4):
        add(opened, number)
        opened.commit(sums(number), upto=number)
    # Nobody knows what it was, so it stays for a repair to find.
    assert "00000003" in folders(opened.path)


def test_a_row_that_passes_for_a_base_is_not_believed(opened, caplog):
    """A flipped bit in `base` of a generation that is none."""
    change(opened.path, "UPDATE generation SET base = 1 WHERE number = 2")
    assert opened.compacted == 0
    assert len(list(opened.records())) == LAST
    assert opened.latest() is None


class CrashError(Exception):
    pass


def crash(*_, **__):
    raise CrashError


STEPS = {
    "before the folder is written": (store.generations, "write_group"),
    "before the journal knows it": ("journal", "make_current"),
    "before what is dropped is removed": (store.generations, "remove_others"),
    "before the space is given back": ("journal", "shrink"),
}


@pytest.mark.parametrize(("owner", "name"), STEPS.values(), ids=STEPS)
def test_a_crash_between_two_steps_leaves_all_of_it_or_none(opened, monkeypatch, tmp_path, owner, name):
    done = name in ("remove_others", "shrink")
    with monkeypatch.context() as broken:
        broken.setattr(opened._journal if owner == "journal" else owner, name, crash)
        with pytest.raises(CrashError):
            opened.compact(sums(5), upto=5)
    # Both as another process would find it, and in this one, which goes on.
    as_after_a_crash(opened, tmp_path / "copy")
    with Store.open(tmp_path / "copy", mode="read") as reader:
        assert agrees(reader, 5 if done else 0)
    with Store.open(tmp_path / "copy") as again:
        assert agrees(again, 5 if done else 0)
        assert len(folders(again.path)) == 1 + done
    assert agrees(opened, 5 if done else 0)
    assert opened.latest().upto == LAST
    opened.commit(sums(LAST), upto=LAST)
    opened.compact(sums(6), upto=6)
    assert agrees(opened, 6)
    assert len(folders(opened.path)) == 2


def test_a_failed_transaction_keeps_its_folder_until_it_is_certain_that_nothing_names_it(opened, monkeypatch):
    """What could not be synced may be on the disk all the same."""
    with monkeypatch.context() as broken:
        broken.setattr(opened._journal, "make_current", crash)
        with pytest.raises(CrashError):
            opened.commit(sums(LAST), upto=LAST)
    assert folders(opened.path) == ["00000002", "00000003"]
    assert opened.latest().number == 2
    assert opened.commit(sums(LAST), upto=LAST) == 4
    assert folders(opened.path) == ["00000004"]


def test_space_that_cannot_be_given_back_is_no_failure(opened, monkeypatch, caplog):
    def full():
        raise StoreError("no room for it")

    monkeypatch.setattr(opened._journal, "shrink", full)
    with caplog.at_level(logging.WARNING):
        opened.compact(sums(5), upto=5)
    assert "the space was not given back yet: no room for it" in caplog.text
    assert agrees(opened, 5)


def test_a_reader_inside_the_file_only_delays_the_space(opened, caplog, monkeypatch):
    with closing(sqlite3.connect(opened.path / "journal.sqlite", isolation_level=None)) as other:
        other.execute("BEGIN")
        other.execute("SELECT count(*) FROM record").fetchone()
        opened._journal._connection.execute("PRAGMA busy_timeout = 50")
        opened.compact(sums(5), upto=5)
        assert "the space was not given back yet" in caplog.text
    assert agrees(opened, 5)
    opened.close()
    assert not (opened.path / "journal.sqlite-wal").exists()
    with Store.open(opened.path) as again:
        assert agrees(again, 5)


def test_a_reader_in_the_middle_gets_the_rest_or_is_told(opened):
    with Store.open(opened.path, mode="read") as reader:
        early, late, heads = reader.records(), reader.records(), reader.heads()
        assert [next(early).sequence for _ in range(3)] == [1, 2, 3]
        for expected in range(1, 8):
            assert next(late).sequence == expected
        opened.compact(sums(5), upto=5)
        with pytest.raises(CompactedError, match="row 4"):
            next(early)
        assert [row.sequence for row in late] == list(range(8, LAST + 1))
        assert [head.sequence for head in heads] == list(range(1, LAST + 1))
        assert agrees(reader, 5)
