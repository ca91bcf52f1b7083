"""Arrays kept in chunks: one file, of which a part is read and verified without the rest."""

import json
import string
from pathlib import Path

import numpy as np
import pytest
import zarr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from store_builds import flip_chunk

from store import DamageError, RecordError, Store, StoreError

several = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
DTYPES = ["|b1", "|u1", "<i4", "<i8", "<f4", "<f8", "<U3"]


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    with Store.open(tmp_path_factory.mktemp("kept") / "s", identity={}) as opened:
        yield opened


def file_of(opened, name="x", axes=2):
    (folder,) = [one for one in (opened.path / "generations").iterdir() if one.name.endswith("1")]
    return folder / name / "c" / Path(*"0" * axes)


@pytest.fixture
def readings(tmp_path):
    """A store with forty streams of 25 readings, one a chunk."""
    x = np.random.default_rng(0).normal(size=(1000, 19)).astype(np.float32)
    with Store.open(tmp_path / "s", identity={}) as opened:
        opened.commit({"x": x, "y": x}, upto=0, chunks={"x": 25})
        yield opened, x


@several
@given(
    st.sampled_from(DTYPES).flatmap(
        lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=9))
    ),
    st.integers(1, 12),
    st.data(),
)
def test_any_rows_of_any_array_come_back(kept, array, rows, data):
    number = kept.commit({"x": array, "plain": array}, upto=0, chunks={"x": rows})
    first = data.draw(st.integers(0, len(array)))
    last = data.draw(st.integers(first, len(array)))
    found = kept.read_rows("x", first, last, generation=number)
    assert (found.dtype, found.shape) == (array.dtype, array[first:last].shape)
    assert found.tobytes() == array[first:last].tobytes()
    assert found.flags.writeable
    whole = kept.latest().arrays
    assert whole["x"].tobytes() == whole["plain"].tobytes() == array.tobytes()


def test_what_is_committed_later_is_chunked_too(readings):
    opened, x = readings
    opened.commit_later({"x": x + 1}, upto=0, chunks={"x": 7})
    opened.flush()
    assert opened.read_rows("x", 20, 30).tobytes() == (x + 1)[20:30].tobytes()


def test_all_chunks_are_one_file(readings):
    opened, _ = readings
    file = file_of(opened)
    assert [one for one in file.parents[1].rglob("*") if one.is_file()] == [file]


def test_only_the_chunk_asked_for_is_read(readings, monkeypatch):
    opened, x = readings
    size = file_of(opened).stat().st_size
    read = []
    get = zarr.storage.LocalStore.get

    async def counted(self, key, prototype, byte_range=None):
        found = await get(self, key, prototype, byte_range)
        if "/c/" in key and found is not None:
            read.append(len(found))
        return found

    monkeypatch.setattr(zarr.storage.LocalStore, "get", counted)
    assert opened.read_rows("x", 500, 525).tobytes() == x[500:525].tobytes()
    # The index of the file, and a fortieth of the rest.
    assert 0 < sum(read) < size / 10


def test_damage_in_a_chunk_is_named_and_does_not_matter_to_the_others(readings, caplog):
    opened, x = readings
    flip_chunk(file := file_of(opened), 7, 40)
    assert opened.read_rows("x", 0, 175).tobytes() == x[:175].tobytes()
    assert opened.read_rows("x", 200, 1000).tobytes() == x[200:].tobytes()
    for first, last in ((175, 200), (199, 201), (0, 1000)):
        with pytest.raises(DamageError, match=r"chunk 7 \(rows 175 to 200\) of array 'x' of generation 1") as caught:
            opened.read_rows("x", first, last)
        assert caught.value.path == file
        assert str(file) in str(caught.value)
    assert opened.latest() is None
    assert "array 'x' of generation 1" in caplog.text


def test_a_chunk_in_anothers_place_is_found(readings):
    opened, x = readings
    folder = file_of(opened).parents[2]
    node = zarr.open_array(folder, mode="r+")
    node[:25], node[25:50] = x[25:50], x[:25]
    with pytest.raises(DamageError, match="chunk 0"):
        opened.read_rows("x", 0, 1)
    assert opened.read_rows("x", 60, 61).tobytes() == x[60:61].tobytes()


def test_rows_of_a_generation_are_read_as_long_as_it_is_there(readings):
    opened, x = readings
    opened.commit({"x": x + 1}, upto=0, chunks={"x": 10})
    assert opened.read_rows("x", 3, 5, generation=1).tobytes() == x[3:5].tobytes()
    with Store.open(opened.path, mode="read") as reader:
        assert reader.read_rows("x", 3, 5).tobytes() == (x + 1)[3:5].tobytes()
    opened.commit({"x": x + 2}, upto=0, chunks={"x": 10})
    with pytest.raises(StoreError, match="generation 1 no longer"):
        opened.read_rows("x", 3, 5, generation=1)


def test_without_a_generation_there_are_no_rows(tmp_path):
    with Store.open(tmp_path / "s", identity={}) as opened, pytest.raises(StoreError, match="no generation"):
        opened.read_rows("x", 0, 1)


@pytest.mark.parametrize(
    ("name", "first", "last", "said"),
    [
        ("y", 0, 1, r"keeps \['x'\] in chunks, not 'y'"),
        ("z", 0, 1, "not 'z'"),
        ("x", -1, 1, "not -1 to 1"),
        ("x", 3, 2, "not 3 to 2"),
        ("x", 0, 1001, "rows 0 to 1000, not 0 to 1001"),
    ],
)
def test_rows_that_are_not_there_are_refused(readings, name, first, last, said):
    with pytest.raises(RecordError, match=said):
        readings[0].read_rows(name, first, last)


@pytest.mark.parametrize(
    ("chunks", "said"),
    [({"z": 1}, "'z'"), ({"x": 0}, "0 rows"), ({"x": True}, "True"), ({"x": 2.0}, "2.0"), ({"n": 1}, "no axes")],
)
def test_chunks_that_cannot_be_are_refused_at_once(kept, chunks, said):
    for commit in (kept.commit, kept.commit_later):
        with pytest.raises(RecordError, match=said):
            commit({"x": np.zeros(3), "n": np.array(3)}, upto=0, chunks=chunks)


def test_who_reads_arrays_as_a_whole_may_pass_over_the_chunks(readings):
    opened, x = readings
    (row,) = opened._journal.generations()
    content = json.loads(row.content)
    assert content["format"] == 1
    digests = content["arrays"]["x"]["chunks"]
    assert len(digests) == 40
    assert all(len(digest) == 32 and set(digest) <= set(string.hexdigits) for digest in digests)
    assert content["arrays"]["x"]["sha256"] == content["arrays"]["y"]["sha256"]
    assert zarr.open_array(opened.path / "generations" / "00000001" / "x", mode="r")[...].tobytes() == x.tobytes()
