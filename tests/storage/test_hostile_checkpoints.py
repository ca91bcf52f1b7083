"""A checkpoint from elsewhere, however forged, is damage at its place."""

import json
import os
import shutil

import numpy as np
import pytest
from folder_attacks import CHECKPOINTS
from forging import describe_again, get_current, put_row, set_current
from scroll_tactile_store import DamageError, RecordError, Store, check_store
from scroll_tactile_store import chunks as store_chunks
from scroll_tactile_store import records as store_records
from scroll_tactile_store.checkpoint_files import CheckpointReader
from store_builds import flip, in_turns, newest, taking_at_most

ARRAYS = {
    "rows": np.arange(4000.0).reshape(1000, 4),
    "long": np.arange(1_200_000, dtype=np.int32).reshape(1_200, 1_000) % 1000,
    "names": np.array([["wool", "silk ü"]]),
    "flags": np.arange(300) % 3 == 0,
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


def test_zarr_reads_what_is_written_without_a_warning(path):
    import zarr

    group = zarr.open_group(newest(path), mode="r")
    for name, array in ARRAYS.items():
        found = np.asarray(group[name][...])
        if array.dtype.kind in "iu" and array.itemsize >= 4:  # byte by byte, the lowest first
            assert found.shape == (array.itemsize, *array.shape)
            found = np.moveaxis(found, 0, -1)
        assert found.tobytes() == array.tobytes()
        assert found.shape[: array.ndim] == array.shape
        assert group[name].attrs["dtype"] == array.dtype.str


def test_what_is_stored_is_verified_before_it_is_decompressed(path, monkeypatch):
    flip(newest(path) / "rows" / "c" / "0" / "0")

    def reached(*_):
        pytest.fail("damaged bytes were decompressed")

    monkeypatch.setattr(store_chunks, "decompress_zstd", reached)
    with pytest.raises(DamageError, match="sha256 differs"):
        CheckpointReader(newest(path)).arrays(["rows"])


def test_so_little_that_stands_for_so_much_is_written_as_it_is_and_read_back(path, monkeypatch):
    monkeypatch.setattr(store_chunks, "SPARE", 2**20)
    zeros = np.zeros(5 * 2**20, np.uint8)
    with Store.open(path) as opened:
        opened.commit({"zeros": zeros}, last_sequence=1)
        assert opened.latest().arrays["zeros"].tobytes() == zeros.tobytes()
    assert check_store(path) == []


def test_a_shape_that_no_file_stands_for_takes_no_memory(path):
    """A checkpoint claims another shape of its rows everywhere, and as many files as these would have."""
    shape = chunk = [2**29]
    header = newest(path) / "rows" / "zarr.json"
    grid = {"name": "regular", "configuration": {"chunk_shape": chunk}}
    header.write_text(json.dumps(json.loads(header.read_text()) | {"shape": shape, "chunk_grid": grid}))
    arrays = json.loads((newest(path) / "zarr.json").read_text())["attributes"]["arrays"]
    files = ["0" * 64] * 2**10
    describe_again(path, arrays=arrays | {"rows": arrays["rows"] | {"shape": shape, "files": files}})
    with Store.open(path, mode="read") as opened, taking_at_most(200 * 2**20):
        assert opened.latest() is None


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
        assert opened.latest(only=()) is None
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
