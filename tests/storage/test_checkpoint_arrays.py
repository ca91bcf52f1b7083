"""The arrays of a checkpoint: zarr reads what is written, and nothing gets to zarr that was not written so.

That such claims take no memory shows tests/test_strangers.py.
"""

import json
import shutil

import numpy as np
import pytest
from forging import describe_again, get_current, group_of, refiled
from numcodecs import zstd
from scroll_tactile_store import Store, check_store, checkpoint_files
from store_builds import damage, flip, newest, same_arrays

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


def test_zarr_alone_reads_what_is_written_without_a_warning(kept):
    import zarr

    group = zarr.open_group(newest(kept), mode="r")
    assert same_arrays({name: np.asarray(group[name][...]) for name in ARRAYS}, ARRAYS)


CLAIMS = {  # of an array, with the right sha256
    "objects": {"data_type": "variable_length_bytes"},
    "text": {"data_type": {"name": "fixed_length_utf32", "configuration": {"length_bytes": 400}}},
    "lengths whose product overflows": {"shape": [2**40, 2**40]},
    "more chunks than files": {"shape": [10**6, 4]},
    "a pickle": {"codecs": [{"name": "bytes"}, {"name": "numcodecs.pickle"}]},
    "a codec of another list": {"codecs": [{"name": "bytes"}, {"name": "gzip", "configuration": {"level": 1}}]},
    "chunks of nothing": {"chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [0, 4]}}},
    "a larger chunk": {"chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [2**40, 4]}}},
}


def claiming(*sha256, **about):
    """The array "rows" of the newest checkpoint has another description; sha256: in place of the right one."""

    def attack(path):
        number = get_current(path)["newest"]["number"]
        header = group_of(path, number) / "rows" / "zarr.json"
        header.write_text(json.dumps(json.loads(header.read_text()) | about))
        files = refiled(path, number)["files"]
        describe_again(path, files=files | dict(zip(["rows/zarr.json"], sha256, strict=False)))

    return attack


def claiming_a_frame(path):
    (newest(path) / "rows" / "c" / "0" / "0").write_bytes(zstd.compress(bytes(2**28), 1))
    describe_again(path, files=refiled(path, 1)["files"])


FORGED = {name: claiming(**about) for name, about in CLAIMS.items()}
FORGED |= {f"{sha256} for a sha256": claiming(sha256) for sha256 in ("0" * 64, None)}
FORGED["a frame of another size"] = claiming_a_frame
FORGED["a flipped bit"] = lambda path: flip(newest(path) / "rows" / "c" / "0" / "0")
FILES = {
    "a list": ["rows/zarr.json"],
    "a name that leads out": {"../rows/zarr.json": "0" * 64},
    "a file of no array": {"rows/x": "0" * 64},
}
FORGED |= {
    f"for files {name}": lambda path, files=files: describe_again(path, files=files) for name, files in FILES.items()
}


@pytest.mark.parametrize("forge", FORGED.values(), ids=FORGED)
def test_what_is_never_written_is_damage_gets_not_to_zarr(path, monkeypatch, forge):
    forge(path)
    read, got = checkpoint_files._read_zarr, []
    monkeypatch.setattr(checkpoint_files, "_read_zarr", lambda of: [got.append(of), read(of)][1])
    with Store.open(path, mode="read") as opened:
        assert opened.latest() is None
        assert len(list(opened.records())) == 1
    assert any("checkpoint" in problem.what for problem in check_store(path))
    file = newest(path) / "rows" / "zarr.json"
    assert file.read_bytes() not in [of.get("zarr.json") for of in got]


def test_many_arrays_claim_no_more_than_all_files_can_stand_for(path, monkeypatch):
    monkeypatch.setattr(checkpoint_files, "SPARE", 0)
    monkeypatch.setattr(checkpoint_files, "RATIO", 1)
    assert any("checkpoint" in problem.what for problem in damage(path))
