"""Damaged bytes in every format, and files larger than memory should be."""

import tracemalloc
from pathlib import Path

import bags
import h5py
import numpy as np
import pytest
import zarr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_sets import TIP, lerobot, robomimic

from scroll_tactile.errors import InputError
from scroll_tactile.recordings import describe, iterate, read


def ros(folder: Path, form: str, compress: str = "") -> Path:
    store = bags.typestore(1 if form == "bag" else 2)
    messages = [(bags.START + i / 100, bags.array(store, row)) for i, row in enumerate(TIP)]
    path = folder / ("b.bag" if form == "bag" else "b")
    return bags.write(path, store, {"/skin": messages}, form=form, compress=compress)


def npy(folder: Path) -> Path:
    np.save(folder / "a.npy", TIP)
    return folder / "a.npy"


def csv(folder: Path) -> Path:
    (folder / "a.csv").write_text("time,a,b\n" + "".join(f"{i},{i * 2},{i / 3}\n" for i in range(20)))
    return folder / "a.csv"


def buffer(folder: Path) -> Path:
    group = zarr.open_group(folder / "b.zarr", mode="w")
    group.create_array("data/tactile", data=TIP)
    group.create_array("meta/episode_ends", data=np.array([5, 30]))
    return folder / "b.zarr"


FORMATS = {
    "bag": (lambda d: ros(d, "bag", "lz4"), {"topic": "/skin", "field": "data"}),
    "db3": (lambda d: ros(d, "db3"), {"topic": "/skin", "field": "data"}),
    "mcap": (lambda d: ros(d, "mcap", "STORAGE ZSTD"), {"topic": "/skin", "field": "data"}),
    "lerobot": (lerobot, {"field": "tip"}),
    "hdf5": (lambda d: robomimic(d / "d.h5"), {"field": "obs/tactile"}),
    "zarr": (buffer, {"field": "tactile"}),
    "npy": (npy, {}),
    "csv": (csv, {}),
}
BYTES = st.lists(
    st.tuples(st.sampled_from(["flip", "cut", "drop", "insert", "high"]), st.floats(0, 1), st.integers(0, 255)),
    min_size=1,
    max_size=6,
)


def damaged(whole: bytes, changes: list[tuple[str, float, int]]) -> bytes:
    data = bytearray(whole)
    for how, share, value in changes:
        i = int(share * len(data))
        if how == "flip" and i < len(data):
            data[i] ^= value
        elif how == "cut":
            del data[i:]
        elif how == "drop":
            del data[i : i + value]
        elif how == "insert":
            data[i:i] = bytes([value]) * 8
        elif how == "high":
            data[i : i + 8] = b"\xff" * len(data[i : i + 8])
    return bytes(data)


@pytest.mark.parametrize("form", FORMATS)
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(changes=BYTES, which=st.integers(0, 20))
def test_damaged_bytes_are_read_or_refused(tmp_path, form, changes, which):
    make, options = FORMATS[form]
    folder = tmp_path / "once"
    if not folder.exists():
        folder.mkdir()
        make(folder)
    path = folder if form == "lerobot" else next(p for p in folder.iterdir() if not p.name.startswith("."))
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    file = files[which % len(files)]
    whole = file.read_bytes()
    file.write_bytes(damaged(whole, changes))
    try:
        for reader in (lambda: read(path, **options), lambda: describe(path)):
            try:
                reader()
            except InputError as error:
                assert str(error)
    finally:
        file.write_bytes(whole)


def test_a_shape_that_is_only_claimed_is_not_allocated(tmp_path):
    head = {"descr": "<f4", "fortran_order": False, "shape": (10, 1 << 40)}
    with (tmp_path / "a.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, head)
        file.write(b"\0" * 100)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("tactile", shape=(10, 1 << 40), chunks=(1, 1024), dtype="f4")
    group = zarr.open_group(tmp_path / "a.zarr", mode="w")
    group.create_array("tactile", shape=(10, 1 << 40), chunks=(1, 1024), dtype="f4")
    for name in ("a.npy", "a.h5", "a.zarr"):
        with pytest.raises(InputError):
            read(tmp_path / name, field=None if name == "a.npy" else "tactile")


@pytest.mark.parametrize("form", ["bag", "mcap", "db3"])
def test_a_long_file_is_read_in_little_memory(tmp_path, form):
    store = bags.typestore(1 if form == "bag" else 2)
    kind = store.types["std_msgs/msg/UInt8MultiArray"]
    layout = store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    pictures = [(bags.START + i / 10, kind(layout=layout, data=np.full(1 << 20, i, np.uint8))) for i in range(48)]
    messages = [(bags.START + i / 100, bags.array(store, np.full(19, i))) for i in range(480)]
    path = tmp_path / ("b.bag" if form == "bag" else "b")
    bags.write(path, store, {"/camera": pictures, "/skin": messages}, form=form)
    del pictures
    tracemalloc.start()
    try:
        count = sum(len(block) for block in iterate(path, topic="/skin", field="data"))
        width = [block.readings.shape for block in iterate(path, topic="/camera", field="data")]
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert count == 480
    assert sum(shape[0] for shape in width) == 48
    assert peak < 2**26  # blocks of 16 MB, and what they are made of
