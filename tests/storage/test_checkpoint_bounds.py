"""A checkpoint's files are verified before they are parsed, and stand for no more than their size allows."""

import numpy as np
import pytest
from forging import describe_again, refiled
from numcodecs import zstd
from scroll_tactile_store import DamageError, Store, check_store, checkpoint_files
from scroll_tactile_store.checkpoint_files import CheckpointReader
from store_builds import flip, newest, taking_at_most


@pytest.fixture
def path(tmp_path):
    """A store with one row and a checkpoint."""
    with Store.open(tmp_path / "s", identity={}) as opened:
        opened.append("a", "b", b"")
        opened.commit({"rows": np.arange(4000.0).reshape(1000, 4), "one": np.array(1.5)}, last_sequence=1)
    return tmp_path / "s"


def require_damage(path):
    """The checkpoint is passed over, and `check_store` names it."""
    with Store.open(path, mode="read") as opened:
        assert opened.latest() is None
        assert len(list(opened.records())) == 1
    assert any("checkpoint" in problem.what for problem in check_store(path))


def test_what_is_stored_is_verified_before_zarr_gets_it(path, monkeypatch):
    flip(newest(path) / "rows" / "c" / "0" / "0")

    def reached(*_):
        pytest.fail("damaged bytes were decompressed")

    monkeypatch.setattr(checkpoint_files, "_read_zarr", reached)
    with pytest.raises(DamageError, match=r"array 'rows' of checkpoint 1 .*sha256 differs") as refused:
        CheckpointReader(newest(path)).arrays(["rows"])
    assert refused.value.path == newest(path) / "rows" / "c" / "0" / "0"


def test_so_little_that_stands_for_so_much_is_written_as_it_is_and_read_back(path, monkeypatch):
    monkeypatch.setattr(checkpoint_files, "SPARE", 2**20)
    zeros = np.zeros(5 * 2**20, np.uint8)
    with Store.open(path) as opened:
        opened.commit({"zeros": zeros}, last_sequence=1)
        assert opened.latest().arrays["zeros"].tobytes() == zeros.tobytes()
    assert check_store(path) == []


def test_a_frame_that_claims_another_size_is_damage_and_takes_no_memory(path):
    (newest(path) / "rows" / "c" / "0" / "0").write_bytes(zstd.compress(bytes(2**28), 1))
    describe_again(path, files=refiled(path, 1)["files"])
    with taking_at_most(40 * 2**20):
        require_damage(path)


def test_many_arrays_claim_no_more_than_all_files_can_stand_for(path, monkeypatch):
    monkeypatch.setattr(checkpoint_files, "SPARE", 0)
    monkeypatch.setattr(checkpoint_files, "RATIO", 1)
    require_damage(path)
