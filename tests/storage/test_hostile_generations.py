"""A generation from elsewhere, however forged, is damage at its place; one of an earlier release is read as ever."""

import json
import os
import shutil
import struct
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
from forged import describe_again, in_a_process, put_generation, write_first_format
from forging import put_row
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from store.groups import GroupReader
from store_builds import flip

from store import DamageError, RecordError, Store, StoreError, VersionError, check_store
from store import chunks as store_chunks
from store import records as store_records

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
    """A store with one row and a generation, not to be changed."""
    path = tmp_path_factory.mktemp("kept") / "s"
    with Store.open(path, identity={}) as opened:
        opened.append("a", "b", b"")
        opened.commit(ARRAYS, upto=1)
    return path


@pytest.fixture
def path(kept, tmp_path):
    return shutil.copytree(kept, tmp_path / "s")


@pytest.fixture
def earlier(path):
    """The same, its generation of the first format."""
    shutil.rmtree(path / "generations" / "00000001")
    put_generation(path, 1, write_first_format(path / "generations" / "00000001", ARRAYS))
    return path


def same(found):
    return found is not None and all(
        (found.arrays[name].dtype, found.arrays[name].shape) == (array.dtype, array.shape)
        and found.arrays[name].tobytes() == array.tobytes()
        for name, array in ARRAYS.items()
    )


def require_damage(path):
    """The generation is passed over, and `check_store` names it."""
    with Store.open(path, mode="read") as opened:
        assert opened.latest() is None
        assert len(list(opened.records())) == 1
    problems = check_store(path)
    assert any("generation" in problem.what for problem in problems)


def test_zarr_reads_what_is_written_without_a_warning(path):
    import zarr

    group = zarr.open_group(path / "generations" / "00000001", mode="r")
    for name, array in ARRAYS.items():
        found = np.asarray(group[name][...])
        assert found.tobytes() == array.tobytes()
        assert found.shape[: array.ndim] == array.shape
        assert group[name].attrs["dtype"] == array.dtype.str


def test_a_generation_is_read_without_zarr(path):
    code = (
        "import sys, store\n"
        "with store.Store.open(sys.argv[1], mode='read') as opened: print(len(opened.latest().arrays))\n"
        "print({'zarr', 'numcodecs.blosc'} & set(sys.modules))"
    )
    run = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    assert run.stdout.split("\n")[0] == str(len(ARRAYS))
    assert "zarr" not in run.stdout


@pytest.mark.parametrize("rows", [None, 7, 5000])
@pytest.mark.parametrize("level", [0, 1, 3, 9])
def test_a_generation_of_the_first_format_is_read(path, rows, level):
    shutil.rmtree(path / "generations" / "00000001")
    content = write_first_format(path / "generations" / "00000001", ARRAYS, rows=rows, level=level)
    put_generation(path, 1, content)
    with Store.open(path, mode="read") as opened:
        assert same(opened.latest())
    assert check_store(path) == []


def test_what_is_stored_is_verified_before_it_is_decompressed(path, monkeypatch):
    flip(path / "generations" / "00000001" / "rows" / "c" / "0" / "0")

    def reached(*_):
        pytest.fail("damaged bytes were decompressed")

    monkeypatch.setattr(store_chunks, "decompress_zstd", reached)
    with Store.open(path, mode="read") as opened, pytest.raises(DamageError, match="sha256 differs"):
        (row,) = opened._journal.generations()
        GroupReader(path / "generations" / "00000001", 1, row.verified(path)[1]).arrays(["rows"])


def test_so_little_that_stands_for_so_much_is_written_as_it_is_and_read_back(path, monkeypatch):
    monkeypatch.setattr(store_chunks, "SPARE", 2**20)
    zeros = np.zeros(5 * 2**20, np.uint8)
    with Store.open(path) as opened:
        opened.commit({"zeros": zeros}, upto=1)
        assert opened.latest().arrays["zeros"].tobytes() == zeros.tobytes()
    assert check_store(path) == []


def test_a_shard_of_more_chunks_than_it_has_bytes_for_takes_no_memory(path):
    folder = path / "generations" / "00000001"
    shutil.rmtree(folder)
    content = write_first_format(folder, {"rows": np.zeros(2**22, np.uint8)}, rows=2**22)
    header = folder / "rows" / "zarr.json"
    metadata = json.loads(header.read_text())
    metadata["codecs"][0]["configuration"]["chunk_shape"] = [1]
    header.write_text(json.dumps(metadata))
    put_generation(path, 1, content)
    tracemalloc.start()
    try:
        require_damage(path)
        assert tracemalloc.get_traced_memory()[1] < 2**26
    finally:
        tracemalloc.stop()


BEHIND = struct.pack("<i", 2**30)


def crafted(size, flags):
    return struct.pack("<BBBBIII", 2, 1, flags, 1, size, size, 2**31 - 1)


@pytest.mark.parametrize("flags", [0x20, 0x80, 0x02])
def test_a_crafted_frame_in_a_chunk_kills_neither_opening_nor_checking(earlier, flags):
    chunk = earlier / "generations" / "00000001" / "rows" / "c" / "0" / "0"
    chunk.write_bytes(crafted(ARRAYS["rows"].nbytes, flags) + BEHIND)
    run = in_a_process(
        """
        with store.Store.open(sys.argv[1], mode="read") as opened:
            print(opened.latest())
        print(any("rows" in str(problem.path) for problem in store.check_store(sys.argv[1])))
        """,
        earlier,
    )
    assert (run.returncode, run.stdout) == (0, "None\nTrue\n"), run.stderr


def claim(path, shape, **metadata):
    """Let the generation claim another shape of its rows, everywhere."""
    folder = path / "generations" / "00000001"
    header = folder / "rows" / "zarr.json"
    header.write_text(json.dumps(json.loads(header.read_text()) | {"shape": shape} | metadata))
    arrays = json.loads((folder / "zarr.json").read_text())["attributes"]["arrays"]
    put_generation(path, 1, describe_again(folder, arrays=arrays | {"rows": arrays["rows"] | {"shape": shape}}))


@pytest.mark.parametrize("shape", [[2**29], [2**29, 2], [2**37], [2**40, 2**20], [2**62]])
@pytest.mark.parametrize("chunk", [[2**29], [1]])
def test_a_shape_that_no_file_stands_for_takes_no_memory_and_no_time(earlier, shape, chunk):
    shutil.rmtree(earlier / "generations" / "00000001" / "rows" / "c")
    claim(earlier, shape, chunk_grid={"name": "regular", "configuration": {"chunk_shape": chunk}})
    run = in_a_process(
        """
        with store.Store.open(sys.argv[1], mode="read") as opened:
            print(opened.latest())
        print(len(store.check_store(sys.argv[1])) > 0)
        """,
        earlier,
        memory=200 * 2**20,
        seconds=20,
    )
    assert (run.returncode, run.stdout) == (0, "None\nTrue\n"), run.stderr


def linked(place):
    place.unlink()
    place.symlink_to("/dev/zero")


def piped(place):
    place.unlink()
    os.mkfifo(place)


def moved(place):
    real = place.parent.parent / "elsewhere"
    place.parent.rename(real)
    place.parent.symlink_to(real)


@pytest.mark.parametrize("do", [linked, piped, moved])
@pytest.mark.parametrize("place", ["zarr.json", "rows/zarr.json", "rows/c/0/0"])
def test_only_regular_files_in_real_folders_are_read(path, do, place):
    if do is moved and place == "zarr.json":
        pytest.skip("the folder of a generation is looked at elsewhere")
    do(path / "generations" / "00000001" / place)
    require_damage(path)


@pytest.mark.parametrize("place", ["zarr.json", "rows/zarr.json", "rows/c/0/0"])
def test_a_file_larger_than_any_that_is_written_is_not_read(path, place):
    with (path / "generations" / "00000001" / place).open("r+b") as file:
        file.truncate(2**34)
    require_damage(path)


DEEP = "[" * 100_000 + "]" * 100_000
ROWS = {"dtype": "<f8", "shape": [1000, 4], "sha256": "0" * 64}
CONTENTS = {
    "no format": {"arrays": {}},
    "a format in words": {"format": "x", "arrays": {}},
    "format 0": {"format": 0, "arrays": {}},
    "a format that is true": {"format": True, "arrays": {}},
    "no arrays": {"format": 1},
    "arrays in a list": {"format": 1, "arrays": [1]},
    "an array in a list": {"format": 1, "arrays": {"rows": [1]}},
    "a list": "[1, 2]",
    "nothing": "",
    "no JSON": "{",
    "too deep": DEEP,
    "too deep inside": f'{{"format":1,"arrays":{DEEP}}}',
    "a name that leads out": {"format": 1, "arrays": {"../rows": ROWS}},
    "a name in two cases": {"format": 1, "arrays": {"rows": ROWS, "Rows": ROWS}},
    "objects": {"format": 1, "arrays": {"rows": ROWS | {"dtype": "|O"}}},
    "no dtype": {"format": 1, "arrays": {"rows": {"shape": [1], "sha256": "0" * 64}}},
    "a dtype of fields": {"format": 1, "arrays": {"rows": ROWS | {"dtype": [["a", "<i4"]]}}},
    "a shape in words": {"format": 1, "arrays": {"rows": ROWS | {"shape": "4"}}},
    "a negative length": {"format": 1, "arrays": {"rows": ROWS | {"shape": [-1]}}},
    "a length that is true": {"format": 1, "arrays": {"rows": ROWS | {"shape": [True]}}},
    "a length of 4.0": {"format": 1, "arrays": {"rows": ROWS | {"shape": [4.0]}}},
    "an infinite length": '{"format":1,"arrays":{"rows":{"dtype":"<f8","shape":[1e999],"sha256":"0"}}}',
    "a length above any": {"format": 1, "arrays": {"rows": ROWS | {"shape": [2**63]}}},
    "a length of 5000 digits": f'{{"format":1,"arrays":{{"rows":{{"shape":[{"9" * 5000}]}}}}}}',
    "lengths whose product overflows": {"format": 1, "arrays": {"rows": ROWS | {"shape": [2**40, 2**40]}}},
    "a hundred axes": {"format": 1, "arrays": {"rows": ROWS | {"shape": [1] * 100}}},
    "no sha256": {"format": 1, "arrays": {"rows": ROWS | {"sha256": None}}},
    "a short sha256": {"format": 1, "arrays": {"rows": ROWS | {"sha256": "00"}}},
    "no files": {"format": 2, "arrays": {"rows": ROWS}},
    "files in words": {"format": 2, "arrays": {"rows": ROWS | {"files": "x"}}},
    "too many files": {"format": 2, "arrays": {"rows": ROWS | {"files": ["0" * 64] * 2}}},
    "a file that is none": {"format": 2, "arrays": {"rows": ROWS | {"files": [1]}}},
}


@pytest.mark.parametrize("base", [0, 1])
@pytest.mark.parametrize("content", CONTENTS.values(), ids=CONTENTS)
def test_a_content_that_was_never_written_is_damage(path, content, base):
    put_generation(path, 1, content, base=base)
    with Store.open(path, mode="read") as opened:
        assert opened.latest() is None
        assert opened.latest(only=()) is None
        if base:
            with pytest.raises(DamageError, match="generation 1"):
                opened.base()
    assert check_store(path)


@pytest.mark.parametrize(
    "attributes", ["", "[]", "1", "{", DEEP, f'{{"a":{DEEP}}}', '{"a":NaN}', '{"a":1e999}', '{"a":-Infinity}']
)
def test_attributes_that_were_never_written_are_damage(path, attributes):
    with Store.open(path, mode="read") as opened:
        (row,) = opened._journal.generations()
    put_generation(path, 1, row.content.decode(), attributes=attributes)
    put_row(path, attributes=attributes)
    with Store.open(path, mode="read") as opened:
        assert opened.latest() is None
        with pytest.raises(DamageError) as refused:
            list(opened.heads())
    assert refused.value.sequence == 2


OWN = {
    "a number in words": {"number": "1"},
    "a number below 0": {"number": -1},
    "no upto": {"upto": None},
    "an upto above any": {"upto": 2**63},
    "attributes in a list": {"attributes": [1]},
    "an identity in words": {"identity": "x"},
    "no format": {"format": None},
    "arrays in a list": {"arrays": [1]},
}


@pytest.mark.parametrize("change", OWN.values(), ids=OWN)
def test_what_a_group_says_of_itself_is_damage_where_it_was_never_written(path, change):
    describe_again(path / "generations" / "00000001", **change)
    (path / "journal.sqlite").unlink()
    (path / "journal.sqlite").write_bytes(b"")
    assert any("zarr.json" in problem.what for problem in check_store(path))


def test_more_attributes_than_are_read_are_not_written(opened, monkeypatch):
    monkeypatch.setattr(store_records, "MOST_VALUES", 2**10)
    monkeypatch.setattr(store_records, "LARGEST_JSON", 2**14)
    for many in ({"many": [0] * 2**10}, {"long": "x" * 2**14}):
        with pytest.raises(RecordError, match="attributes"):
            opened.append("a", "b", b"", attributes=many)
        with pytest.raises(RecordError, match="attributes"):
            opened.commit({}, upto=0, attributes=many)


@settings(deadline=None, max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), first=st.booleans())
def test_a_harmed_generation_is_damage_or_what_it_was(kept, tmp_path_factory, seed, first):
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.getbasetemp() / "harmed" / "00000001"
    shutil.rmtree(folder, ignore_errors=True)
    if first:
        small = {name: array for name, array in ARRAYS.items() if name != "long"}
        content = write_first_format(folder, small, rows=[None, 300][seed % 2])
    else:
        shutil.copytree(kept / "generations" / "00000001", folder)
        content = json.loads((folder / "zarr.json").read_text())["attributes"]
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    file = files[int(rng.integers(len(files)))]
    data = bytearray(file.read_bytes())
    for _ in range(rng.integers(1, 4)):
        data[int(rng.integers(len(data) if rng.random() < 0.5 else min(len(data), 64)))] = int(rng.integers(256))
    if rng.random() < 0.2:
        del data[int(rng.integers(len(data))) :]
    file.write_bytes(data)
    try:
        found = GroupReader(folder, 1, content).arrays()
    except (DamageError, VersionError):
        return
    assert all(found[name].tobytes() == ARRAYS[name].tobytes() for name in found)


def test_memory_that_is_short_is_no_damage(path, monkeypatch):
    def starve(*_):
        raise MemoryError

    monkeypatch.setattr(store_chunks, "decompress_zstd", starve)
    with Store.open(path, mode="read") as opened, pytest.raises(StoreError) as refused:
        opened.latest()
    assert not isinstance(refused.value, DamageError)
