"""A checkpoint from elsewhere, however forged, is damage at its place."""

import os
import shutil

import numpy as np
import pytest
from folder_attacks import ARRAYS as ARRAYS_CLAIM
from folder_attacks import CHECKPOINTS
from forging import describe_again, get_current, put_row, refiled, set_current
from numcodecs import zstd
from scroll_tactile_store import DamageError, RecordError, Store, check_store, checkpoint_files
from scroll_tactile_store import records as store_records
from scroll_tactile_store.checkpoint_files import CheckpointReader
from store_builds import flip, in_turns, newest, taking_at_most

ARRAYS = {
    "rows": np.arange(4000.0).reshape(1000, 4),
    "long": np.arange(1_200_000, dtype=np.int32).reshape(1_200, 1_000) % 1000,
    "bytes": np.arange(300).astype(np.uint8),
    "none": np.zeros((0, 3), np.float32),
    "one": np.array(1.5),
}


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A store with one row and a checkpoint, not to be changed."""
    path = tmp_path_factory.mktemp("kept") / "s"
    with Store.open(path, identity={}) as opened:
        opened.append("a", "b", b"")
        opened.commit(ARRAYS, last_sequence=1)
    return path


@pytest.fixture
def path(kept, tmp_path):
    return shutil.copytree(kept, tmp_path / "s")


def require_damage(path):
    """The checkpoint is passed over, and `check_store` names it."""
    with Store.open(path, mode="read") as opened:
        assert opened.latest() is None
        assert len(list(opened.records())) == 1
    problems = check_store(path)
    assert any("checkpoint" in problem.what for problem in problems)


def test_zarr_alone_reads_what_is_written_without_a_warning(path):
    import zarr

    group = zarr.open_group(newest(path), mode="r")
    for name, array in ARRAYS.items():
        found = np.asarray(group[name][...])
        assert (found.dtype, found.shape, found.tobytes()) == (array.dtype, array.shape, array.tobytes())


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


@pytest.mark.parametrize("forge", ARRAYS_CLAIM.values(), ids=ARRAYS_CLAIM)
def test_an_array_that_claims_what_is_never_written_is_damage_and_takes_no_memory(path, forge):
    forge(path)
    with taking_at_most(40 * 2**20):
        require_damage(path)
    assert list(CheckpointReader(newest(path)).arrays(["one"])) == ["one"]


def test_a_frame_that_claims_another_size_is_damage_and_takes_no_memory(path):
    (newest(path) / "rows" / "c" / "0" / "0").write_bytes(zstd.compress(bytes(2**28), 1))
    describe_again(path, files=refiled(path, 1)["files"])
    with taking_at_most(40 * 2**20):
        require_damage(path)


def test_many_arrays_claim_no_more_than_all_files_can_stand_for(path, monkeypatch):
    monkeypatch.setattr(checkpoint_files, "SPARE", 0)
    monkeypatch.setattr(checkpoint_files, "RATIO", 1)
    require_damage(path)


PLACES = ("rows/c/0/0", "zarr.json", "rows/zarr.json")


def linked(place):
    place.unlink()
    place.symlink_to("/dev/zero")


def of_holes(place):
    with place.open("r+b") as file:
        file.truncate(2**34)


def piped(place):
    place.unlink()
    os.mkfifo(place)


def moved(place):
    real = place.parent.parent / "elsewhere"
    place.parent.rename(real)
    place.parent.symlink_to(real)


@pytest.mark.parametrize(
    ("do", "place"),
    [
        *((linked, place) for place in PLACES),
        *((moved, place) for place in PLACES[::2]),
        *zip((piped, of_holes), PLACES, strict=False),
    ],
)
def test_only_regular_files_of_a_size_that_is_written_in_real_folders_are_read(path, do, place):
    do(newest(path) / place)
    require_damage(path)


DEEP = "[" * 100_000 + "]" * 100_000


@pytest.mark.parametrize(("is_compaction", "forge"), in_turns(CHECKPOINTS), ids=CHECKPOINTS)
def test_what_a_checkpoint_never_says_of_itself_is_damage(path, forge, is_compaction):
    forge(path)
    if is_compaction:
        set_current(path, compaction=get_current(path)["newest"])
    with Store.open(path, mode="read") as opened:
        assert opened.latest() is None
        if is_compaction:
            with pytest.raises(DamageError, match="checkpoint"):
                opened.compaction()
    assert check_store(path)


TEXTS = ["[1, 2]", "{", DEEP, '{"a":NaN}', '{"a":1e999}', f'{{"a":{"9" * 5000}}}']


@pytest.mark.parametrize("text", TEXTS)
def test_a_text_that_was_never_written_is_damage(path, text):
    describe_again(path, text=text)
    put_row(path, attributes=text)
    with Store.open(path, mode="read") as opened:
        assert opened.latest() is None
        with pytest.raises(DamageError) as refused:
            list(opened.heads())
    assert refused.value.sequence == 2
    assert any("row 2 fails" in problem.what for problem in check_store(path))


def test_more_attributes_than_are_read_are_not_written(opened, monkeypatch):
    monkeypatch.setattr(store_records, "MOST_VALUES", 2**10)
    monkeypatch.setattr(store_records, "LARGEST_JSON", 2**14)
    for many in ({"many": [0] * 2**10}, {"long": "x" * 2**14}):
        with pytest.raises(RecordError, match="attributes"):
            opened.append("a", "b", b"", attributes=many)
        with pytest.raises(RecordError, match="attributes"):
            opened.commit({}, last_sequence=0, attributes=many)
