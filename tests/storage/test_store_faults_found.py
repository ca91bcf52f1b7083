"""What the judges of tests/faults found in the store, each as small as it can be."""

import errno
import os

import pytest
import scroll_tactile_store.archive
import scroll_tactile_store.backup
import scroll_tactile_store.log_writer
from forging import log_of
from scroll_tactile_store import DamageError, Store, check_store
from scroll_tactile_store.layout import read_current


@pytest.fixture
def path(tmp_path):
    """A store of three rows."""
    with Store.open(tmp_path / "s", identity={"a": 1}) as store:
        for i in range(3):
            store.append("kind", "label", bytes([i]), attributes={"i": i})
    return tmp_path / "s"


@pytest.mark.parametrize(
    "module", [scroll_tactile_store.archive, scroll_tactile_store.backup], ids=["a reader", "a backup"]
)
def test_whoever_comes_while_a_log_takes_the_place_of_another_takes_the_new_one(path, monkeypatch, module):
    before = [read_current(path / "CURRENT")]
    with Store.open(path) as writer:
        writer.compact({}, last_sequence=2)
    with Store.open(path, mode="read") as reader:
        monkeypatch.setattr(module, "read_current", lambda *given: before.pop() if before else read_current(*given))
        if module is scroll_tactile_store.backup:
            reader.backup(path.parent / "copy")
            path = path.parent / "copy"
        with Store.open(path, mode="read") as again:
            assert (again.last, again.compacted, before) == (3, 2, [])


def test_a_log_that_gets_a_hole_while_it_is_read_is_damage(path):
    with Store.open(path, mode="read") as reader:
        os.truncate(log_of(path), 2**40)
        with pytest.raises(DamageError, match="nothing of it was read"):
            reader.last  # noqa: B018
    assert any("nothing of it was read" in problem.what for problem in check_store(path))


def test_a_compaction_that_is_committed_stands_though_its_log_cannot_be_opened_at_once(path, monkeypatch, caplog):
    synced = scroll_tactile_store.log_writer.sync_open

    def failing(descriptor, **how):
        if read_current(path / "CURRENT").log == 2:
            monkeypatch.setattr(scroll_tactile_store.log_writer, "sync_open", synced)
            raise OSError(errno.EIO, "the disk")
        synced(descriptor, **how)

    with Store.open(path) as writer:
        monkeypatch.setattr(scroll_tactile_store.log_writer, "sync_open", failing)
        writer.compact({}, last_sequence=2)
        assert "could not be opened yet" in caplog.text
        assert (writer.compacted, writer.append("kind", "label", b"3").sequence) == (2, 4)
    assert (check_store(path), log_of(path).name) == ([], "log-00000002")
