"""Generations: zarr groups that are written whole and made durable before they count."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from store.arrays import array_digest, chunk_digest, flat_bytes
from store.files import remove_tree, sync_folder, sync_tree
from store.records import JSON
from store.reporting import reported

__all__ = [
    "GROUP_VERSION",
    "PARTIAL",
    "folder_name",
    "highest_number",
    "numbers",
    "own_digest",
    "remove_others",
    "write_generation",
]

logger = logging.getLogger(__name__)

GROUP_VERSION = 1
PARTIAL = ".partial"

# Pieces of a large array: small enough to be compressed in cache-sized steps and on several
# threads, large enough that a hundred megabytes are some tens of files to make durable.
CHUNK_BYTES = 4 * 2**20


def folder_name(number: int) -> str:
    """Return the name of a generation's folder: its number in eight digits, or more when it needs them."""
    return f"{number:08d}"


def write_generation(
    parent: Path,
    number: int,
    upto: int,
    arrays: Mapping[str, np.ndarray],
    attributes: Mapping[str, JSON],
    chunks: Mapping[str, int],
    identity: Mapping[str, JSON],
) -> dict[str, Any]:
    """Write checked arrays as a durable zarr group in `parent` and return what must be read back.

    That is the group's format and, for each array, its dtype, shape and sha256, and for one that is in
    `chunks` (name → rows) a digest of each chunk, as JSON. The group says the same of itself, and what
    store it is of, so that it can be verified without the journal. On any error nothing is left behind.
    Raises StoreFullError, ReadOnlyError or StoreError.
    """
    described = {name: _describe(array, chunks.get(name)) for name, array in arrays.items()}
    content = {"format": GROUP_VERSION, "arrays": described}
    final = parent / folder_name(number)
    draft = parent / (folder_name(number) + PARTIAL)
    try:
        with reported(draft, f"writing generation {number}"):
            parent.mkdir(exist_ok=True)
            remove_tree(draft)
            known = {"number": number, "upto": upto, "attributes": attributes, "identity": identity, **content}
            _write_group(draft, known | {"sha256": own_digest(known)}, arrays, chunks)
            sync_tree(draft)
            draft.rename(final)
            sync_folder(parent)
    except BaseException:
        remove_tree(draft)
        remove_tree(final)
        raise
    return content


def own_digest(known: Mapping[str, Any]) -> str:
    """Return the sha256, in hexadecimal, over a group's other attributes, as compact JSON with sorted keys."""
    return hashlib.sha256(json.dumps(known, sort_keys=True, separators=(",", ":")).encode("ascii")).hexdigest()


def _describe(array: np.ndarray, rows: int | None) -> dict[str, Any]:
    described = {"dtype": array.dtype.str, "shape": list(array.shape), "sha256": array_digest(array)}
    if rows is None:
        return described
    pieces = [chunk_digest(array[first : first + rows]) for first in range(0, len(array), rows)]
    return described | {"rows": rows, "chunks": pieces}


def _write_group(
    path: Path, attributes: dict[str, Any], arrays: Mapping[str, np.ndarray], chunks: Mapping[str, int]
) -> None:
    # Imported late: 300 ms that a process which only appends or reads the journal need not spend.
    import zarr
    from zarr.codecs import BloscCodec
    from zarr.storage import LocalStore

    group = zarr.create_group(store=LocalStore(path), zarr_format=3, attributes=attributes)
    for name, array in arrays.items():
        plain = _without_text(array)
        target = group.create_array(
            name,
            shape=plain.shape,
            dtype=plain.dtype,
            **_layout(plain, chunks.get(name)),
            compressors=BloscCodec(cname="zstd", clevel=1, shuffle="shuffle"),
            fill_value=0,
            attributes={"dtype": array.dtype.str},
            # A chunk that equals the fill value would have no file, nor would a lost one.
            config={"write_empty_chunks": True},
        )
        target[...] = plain


def _without_text(array: np.ndarray) -> np.ndarray:
    # zarr v3 has no settled type for fixed-width text and warns of it: code points have one.
    if array.dtype.kind != "U":
        return array
    shape = (*array.shape, array.dtype.itemsize // 4)
    return flat_bytes(array).view("<u4").reshape(shape)


def _layout(array: np.ndarray, rows: int | None) -> dict[str, Any]:
    if rows is None:
        return {"chunks": _chunks(array)}
    # One file for all the chunks: hundreds of small ones would each have to be made durable.
    rest = tuple(max(1, length) for length in array.shape[1:])
    return {"chunks": (rows, *rest), "shards": (rows * max(1, -(-len(array) // rows)), *rest)}


def _chunks(array: np.ndarray) -> tuple[int, ...]:
    chunks, piece = [], array.nbytes
    for length in array.shape:
        slab = piece // max(length, 1)
        chunks.append(max(1, length if piece <= CHUNK_BYTES else CHUNK_BYTES // max(slab, 1)))
        piece = slab * chunks[-1]
    return tuple(chunks)


def highest_number(parent: Path) -> int:
    """Return the highest number of a generation's folder in `parent`, finished or not; 0 for none."""
    return max(numbers(parent, unfinished=True), default=0)


def numbers(parent: Path, *, unfinished: bool = False) -> list[int]:
    """Return the numbers of the generations' folders in `parent`, ascending; finished ones unless told otherwise."""
    if not parent.is_dir():
        return []
    names = (entry.name for entry in parent.iterdir())
    stems = {name.removesuffix(PARTIAL) if unfinished else name for name in names}
    return sorted(int(stem) for stem in stems if stem.isascii() and stem.isdigit())


def remove_others(parent: Path, kept: Collection[int]) -> None:
    """Remove every generation's folder, finished or not, that is not numbered in `kept`.

    What does not carry a generation's name is left alone; what cannot be removed stays for the next open.
    """
    if not parent.is_dir():
        return
    names = {folder_name(number) for number in kept}
    for entry in sorted(parent.iterdir()):
        stem = entry.name.removesuffix(PARTIAL)
        if entry.name not in names and stem.isascii() and stem.isdigit():
            remove_tree(entry)
            logger.debug("removed %s", entry)
