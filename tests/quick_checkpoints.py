"""Checkpoints as zarr writes them, byte for byte, a hundred times as fast: most tests write some by the way.

Tests of the writing have zarr write them, as the store does (see conftest.py); tests/storage/test_store_commit.py
compares the files of both.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scroll_tactile_store.checkpoint_files
from numcodecs import zstd
from scroll_tactile_store.checkpoint_files import CheckpointDraft
from scroll_tactile_store.chunks import ArrayContent

WRITTEN_BY_ZARR = scroll_tactile_store.checkpoint_files._write_zarr


class Group:
    """A written group, whose attributes come last."""

    def __init__(self, path: Path, indent: int | None) -> None:
        self._path, self._indent = path, indent

    def update_attributes(self, known: Mapping[str, Any]) -> None:
        """Write them."""
        about = {"attributes": known, "zarr_format": 3, "node_type": "group"}
        (self._path / "zarr.json").write_text(json.dumps(about, indent=self._indent))


def array_about(array: np.ndarray, content: ArrayContent, level: int | None) -> dict[str, Any]:
    """What zarr says of an array."""
    plain: dict[str, Any] = {"name": "bytes"}
    if content.plain.itemsize > 1:
        plain["configuration"] = {"endian": "little"}
    packer = [] if level is None else [{"name": "zstd", "configuration": {"level": level, "checksum": False}}]
    fill: Any = {"b": False, "f": 0.0}.get(content.plain.kind, 0)
    return {
        "shape": list(content.plain_shape),
        "data_type": content.plain.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(content.chunk)}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": fill,
        "codecs": [plain, *packer],
        "attributes": {"dtype": array.dtype.str},
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }


def write_zarr(
    path: Path,
    draft: CheckpointDraft,
    described: Mapping[str, ArrayContent],
    level: int | None,
    indent: int | None = 2,
) -> Any:
    """Write a checkpoint's group and arrays; zarr does where an array has more than one chunk. indent: of the JSON."""
    if any(len(list(content.places(content.chunk))) > 1 for content in described.values()):
        return WRITTEN_BY_ZARR(path, draft, described, level)
    path.mkdir()
    for name, array in draft.arrays.items():
        content = described[name]
        (path / name).mkdir()
        (path / name / "zarr.json").write_text(json.dumps(array_about(array, content, level), indent=indent))
        for place in content.places(content.chunk):
            file = (path / name).joinpath("c", *map(str, place))
            file.parent.mkdir(parents=True, exist_ok=True)
            data = np.ascontiguousarray(content.to_plain(array)).tobytes()
            file.write_bytes(data if level is None else zstd.compress(data, level))
    return Group(path, indent)
