"""What a journal row holds of a touch, and how it is packed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import BITS

__all__ = ["Added", "Codes", "pack_codes", "spans", "unpack_codes", "unspanned"]

Codes = dict[Scale, npt.NDArray[np.int32]]
Added = tuple[str, Codes, int]
"""A material, the codes of a touch of it by scale, and 1 where it came or -1 where it was retracted."""

LARGE, BLOCK = 2**13, 2**10  # codes


def pack_codes(codes: Mapping[Scale, npt.NDArray[np.int32]]) -> dict[str, npt.NDArray[Any]]:
    """Codes by scale as the arrays of a journal row: their distinct values, and places among them.

    Windows hold few distinct values (a proportion of 22 positions has 23), so a place is a byte and packs well.
    A network's features hardly repeat: they are kept as they are.
    """
    arrays: dict[str, npt.NDArray[Any]] = {}
    for scale, rows in codes.items():
        first = rows.min(initial=2**BITS)
        # Feature by feature: one feature's values in neighbouring windows are alike.
        above = np.subtract(rows.T, first, order="C")
        values = _distinct(above)
        if 4 * len(values) > rows.size and rows.size > 2**8:
            arrays[f"codes-{scale}"] = rows
            continue
        kind = np.uint8 if len(values) <= 2**8 else np.uint16 if len(values) <= 2**16 else np.uint32
        # A table of all the codes there can be, of which only the pages with one of these are ever made.
        table = np.empty(int(values.max(initial=0)) + 1, dtype=kind)
        table[values] = np.arange(len(values), dtype=kind)
        arrays[f"values-{scale}"] = (values + first).astype(np.int32)
        arrays[f"places-{scale}"] = table[above]
    return arrays


def _distinct(numbers: npt.NDArray[np.int32]) -> npt.NDArray[np.integer]:
    """The distinct ones of numbers from 0 up, ascending."""
    if numbers.size < LARGE:
        return np.unique(numbers)
    # Marked in a table and in one of its blocks, and not by sorting: half of the time for a touch of BioTac.
    marked = np.zeros((int(numbers.max()) // BLOCK + 1) * BLOCK, dtype=bool)
    filled = np.zeros(len(marked) // BLOCK, dtype=bool)
    marked[numbers] = filled[numbers // BLOCK] = True
    blocks = np.flatnonzero(filled)
    block, within = np.divmod(np.flatnonzero(marked.reshape(-1, BLOCK)[blocks]), BLOCK)
    return np.asarray(blocks[block] * BLOCK + within)


def unpack_codes(arrays: Mapping[str, npt.NDArray[Any]]) -> Codes:
    """The codes that `pack_codes` packed."""
    plain = {_scale(name): rows for name, rows in arrays.items() if name.startswith("codes-")}
    scales = [_scale(name) for name in arrays if name.startswith("values-")]
    packed = {
        scale: np.ascontiguousarray(arrays[f"values-{scale}"][arrays[f"places-{scale}"].T]).astype(np.int32, copy=False)
        for scale in scales
    }
    return dict(sorted((plain | packed).items()))


def _scale(name: str) -> Scale:
    return Scale.numbered(int(name.partition("-")[2]))


def spans(sequences: Iterable[int]) -> list[list[int]]:
    """Whole numbers as [first, last] pairs of those that follow each other: 1, 2, 3, 7 → [[1, 3], [7, 7]]."""
    pairs: list[list[int]] = []
    for sequence in sorted(sequences):
        if pairs and pairs[-1][1] == sequence - 1:
            pairs[-1][1] = sequence
        else:
            pairs.append([sequence, sequence])
    return pairs


def unspanned(pairs: Any) -> list[int]:
    """The numbers that `spans` made pairs of."""
    return [sequence for first, last in pairs for sequence in range(first, last + 1)]
