"""What most tests write in zarr's place is what zarr writes."""

import numpy as np
import pytest
from quick_checkpoints import WRITTEN_BY_ZARR, write_zarr
from scroll_tactile_store.checkpoint_files import CheckpointDraft, write_checkpoint
from scroll_tactile_store.chunks import ArrayContent
from scroll_tactile_store.encoding import array_digest

RNG = np.random.default_rng(0)
ARRAYS = {
    "floats": RNG.standard_normal((30, 4)),
    "short-floats": RNG.standard_normal((3, 2, 5)).astype(np.float32),
    "integers": RNG.integers(-(2**60), 2**60, (7, 3)),
    "small-integers": RNG.integers(0, 99, (40,)).astype(np.int16),
    "unsigned": RNG.integers(0, 99, (4, 4)).astype(np.uint32),
    "bytes": RNG.integers(0, 255, (2, 9)).astype(np.uint8),
    "flags": RNG.integers(0, 2, 8).astype(bool),
    "text": np.array(["felt", "ü"]),
    "zeros": np.zeros((5, 5)),
    "none": np.zeros((0, 3)),
    "no-text": np.zeros((0,), "U3"),
    "one": np.array(2.5),
    "one-integer": np.array(7),
}


def files(path):
    return {str(one.relative_to(path)): one.read_bytes() for one in path.rglob("*") if one.is_file()}


@pytest.mark.parametrize("level", [None, 3, 6])
def test_every_file_has_the_bytes_that_zarr_gives_it(tmp_path, level):
    arrays = ARRAYS | ({"chunks": RNG.integers(0, 9, 10**6)} if level == 3 else {})  # which zarr writes
    draft = CheckpointDraft(arrays, 3, "{}", level or 3)
    described = {name: ArrayContent(one.dtype, one.shape, array_digest(one)) for name, one in arrays.items()}
    for name, write in (("zarr", WRITTEN_BY_ZARR), ("quick", write_zarr)):
        group = write(tmp_path / name, draft, described, level)
        group.update_attributes({"number": 1, "arrays": {"ü": [1, 2.5, None, True]}, "identity": {}})
    assert files(tmp_path / "quick") == files(tmp_path / "zarr")


def test_the_store_writes_through_zarr_here(tmp_path, monkeypatch):
    monkeypatch.setattr("zarr.create_group", None)
    with pytest.raises(TypeError):
        write_checkpoint(tmp_path, 1, CheckpointDraft({"a": np.ones(3)}, 1, "{}", 3), {})
