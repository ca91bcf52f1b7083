"""Checkpoints as zarr writes them, byte for byte, and reads them, a hundred times as fast: most tests do by the way.

Tests of the writing and the reading have zarr do it, as the store does (see conftest.py);
tests/storage/test_store_commit.py compares both.
"""

import json
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import scroll_tactile_store.checkpoint_files
from numcodecs import zstd
from scroll_tactile_store.checkpoint_files import chunk_shape

WRITTEN_BY_ZARR = scroll_tactile_store.checkpoint_files._write_zarr
READ_BY_ZARR = scroll_tactile_store.checkpoint_files._read_zarr


class Group:
    """A written group, whose attributes come last."""

    def __init__(self, path: Path, indent: int | None) -> None:
        self._path, self._indent = path, indent

    def update_attributes(self, known: Mapping[str, Any]) -> None:
        """Write them."""
        about = {"attributes": known, "zarr_format": 3, "node_type": "group"}
        (self._path / "zarr.json").write_text(json.dumps(about, indent=self._indent))


def array_about(array: np.ndarray, level: int | None) -> dict[str, Any]:
    """What zarr says of an array."""
    plain: dict[str, Any] = {"name": "bytes"}
    if array.dtype.itemsize > 1:
        plain["configuration"] = {"endian": "little"}
    packer = [] if level is None else [{"name": "zstd", "configuration": {"level": level, "checksum": False}}]
    return {
        "shape": list(array.shape),
        "data_type": array.dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(chunk_shape(array))}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": 0.0 if array.dtype.kind == "f" else 0,
        "codecs": [plain, *packer],
        "attributes": {},
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }


def write_zarr(path: Path, arrays: Mapping[str, np.ndarray], level: int | None, indent: int | None = 2) -> Any:
    """Write a checkpoint's group and arrays; zarr does where an array has more than one chunk. indent: of the JSON."""
    if any(array.size and chunk_shape(array) != array.shape for array in arrays.values()):
        return WRITTEN_BY_ZARR(path, arrays, level)
    path.mkdir()
    for name, array in arrays.items():
        (path / name).mkdir()
        (path / name / "zarr.json").write_text(json.dumps(array_about(array, level), indent=indent))
        if array.size:
            file = (path / name).joinpath("c", *["0"] * array.ndim)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(array.tobytes() if level is None else zstd.compress(array.tobytes(), level))
    return Group(path, indent)


def read_zarr(content: Mapping[str, bytes]) -> np.ndarray:
    """Read an array as it is usually written; zarr does where it is not, or has more than one chunk."""
    about = json.loads(content["zarr.json"])
    shape = tuple(about["shape"])
    chunks = [data for name, data in content.items() if name != "zarr.json"]
    array = np.zeros(shape, about["data_type"])
    level = about["codecs"][-1].get("configuration", {}).get("level")
    if about != array_about(array, level) or len(chunks) != bool(prod(shape)):
        return READ_BY_ZARR(content)
    if chunks:
        data = chunks[0] if level is None else zstd.decompress(chunks[0])
        array[...] = np.frombuffer(data, array.dtype).reshape(shape)
    return array
