"""What `CURRENT` says of the log's end: a log that lost rows since is damaged, with a checkpoint or without."""

import logging

import pytest
from logs import ends as ends_of

from store import DamageError, Store, check_store, repair_store
from store.layout import CURRENT_FILE, log_path, read_current, write_current


def made(path, rows=4):
    with Store.open(path, identity={"for": "this"}) as store:
        for index in range(rows):
            store.append("add", f"label {index}", bytes([index]))
    return log_path(path, 1)


def ends(log):
    """Where the header and each batch end."""
    begin, _, commits = ends_of(log)
    return [begin, *commits]


def cut(log, end):
    with log.open("r+b") as file:
        file.truncate(end)


def require_named(path, rows, kept):
    """Each reader names the loss, a writer is kept out, and a repair keeps what is before it."""
    with Store.open(path, mode="read") as store:
        assert store.last == rows
        with pytest.raises(DamageError, match="missing"):
            list(store.heads())
        with pytest.raises(DamageError, match="missing"):
            store.record(rows)
    with pytest.raises(DamageError, match="repair the store"):
        Store.open(path)
    assert [problem.kind for problem in check_store(path)] == ["lost"]
    with pytest.raises(DamageError), Store.open(path, mode="read") as store:
        store.backup(path.with_name("backup"))
    assert repair_store(path).kept == kept
    assert not [problem for problem in check_store(path) if problem.kind != "leftover"]
    with Store.open(path) as store:
        assert [head.sequence for head in store.heads()] == list(range(1, kept + 1))
        assert store.append("add", "after", b"").sequence == kept + 1


@pytest.mark.parametrize("kept", range(4))
def test_a_closed_log_that_is_cut_off_is_damaged_wherever_it_is_cut(tmp_path, kept):
    log = made(tmp_path / "s")
    cut(log, ends(log)[kept])
    require_named(tmp_path / "s", 4, kept)


def test_a_flip_in_the_last_batch_of_a_closed_log_is_named(tmp_path):
    log = made(tmp_path / "s")
    data = bytearray(log.read_bytes())
    data[-100] ^= 1
    log.write_bytes(data)
    require_named(tmp_path / "s", 4, 3)


def test_a_search_warns_of_rows_that_were_cut_off(tmp_path, caplog):
    log = made(tmp_path / "s")
    cut(log, ends(log)[2])
    with Store.open(tmp_path / "s", mode="read") as store, caplog.at_level(logging.WARNING):
        assert len(list(store.heads(kind="add"))) == 2
        assert "ends with row 2" in caplog.text


def crashed(path, rows):
    """A copy of a store as a kill leaves it."""
    with Store.open(path, identity={}) as store:
        for index in range(rows):
            store.append("add", "", bytes([index]))
        copy = path.with_name("crashed")
        copy.mkdir()
        for name in (CURRENT_FILE, "log-00000001"):
            (copy / name).write_bytes((path / name).read_bytes())
    return copy


def test_a_log_that_had_a_row_and_has_none_is_damaged_though_nobody_closed_it(tmp_path):
    path = crashed(tmp_path / "s", 3)
    cut(log_path(path, 1), ends(log_path(path, 1))[0])
    require_named(path, 1, 0)


def test_the_end_of_a_log_that_nobody_closed_may_be_torn_and_the_rows_before_it_are_there(tmp_path):
    path = crashed(tmp_path / "s", 3)
    cut(log_path(path, 1), ends(log_path(path, 1))[2] + 50)
    with Store.open(path) as store:
        assert store.last == 2
        assert store.append("add", "", b"").sequence == 3
    assert read_current(path / CURRENT_FILE).last == 3


def test_a_copy_says_where_its_log_ends(tmp_path):
    with Store.open(tmp_path / "s", identity={}) as store:
        for _ in range(3):
            store.append("add", "", b"")
        store.backup(tmp_path / "backup")
    assert read_current(tmp_path / "backup" / CURRENT_FILE).last == 3


def test_a_store_that_cannot_say_so_is_closed_with_a_warning_and_one_that_is_another_is_left_alone(tmp_path, caplog):
    made(tmp_path / "other", 1)
    other = (tmp_path / "other" / CURRENT_FILE).read_bytes()
    with Store.open(tmp_path / "s", identity={}) as store:
        for _ in range(2):
            store.append("add", "", b"")
        (tmp_path / "s" / CURRENT_FILE).write_bytes(other)
    assert (tmp_path / "s" / CURRENT_FILE).read_bytes() == other
    with Store.open(tmp_path / "t", identity={}) as store:
        for _ in range(2):
            store.append("add", "", b"")
        (tmp_path / "t" / CURRENT_FILE).unlink()
    assert "CURRENT" in caplog.text


def test_a_store_that_says_nothing_of_it_is_read_as_before(tmp_path):
    log = made(tmp_path / "s")
    current = read_current(tmp_path / "s" / CURRENT_FILE)
    write_current(tmp_path / "s", type(current)(current.log, current.log_identity))
    cut(log, ends(log)[2])
    with Store.open(tmp_path / "s") as store:
        assert store.last == 2
