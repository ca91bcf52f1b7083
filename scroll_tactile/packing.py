"""What a journal row holds of a touch, and how it is packed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.ridge.codes import BITS

__all__ = ["Codes", "pack_codes", "spans", "unpack_codes", "unspanned"]

Codes = dict[int, npt.NDArray[np.int32]]
LARGE = 2**13  # codes


def pack_codes(codes: Mapping[int, npt.NDArray[np.int32]]) -> dict[str, npt.NDArray[Any]]:
    """Codes by scale as the arrays of a journal row: their distinct values, and places among them.

    Windows hold few distinct values (a proportion of 22 positions has 23), so a place is a byte and packs well.
    A network's features hardly repeat: they are kept as they are.
    """
    arrays: dict[str, npt.NDArray[Any]] = {}
    for scale, rows in codes.items():
        values, places = _distinct(rows)
        if 4 * len(values) > rows.size and rows.size > 2**8:
            arrays[f"codes-{scale}"] = rows
            continue
        kind = np.uint8 if len(values) <= 2**8 else np.uint16 if len(values) <= 2**16 else np.uint32
        arrays[f"values-{scale}"] = values
        # Feature by feature: one feature's values in neighbouring windows are alike.
        arrays[f"places-{scale}"] = np.ascontiguousarray(places.reshape(rows.shape).T.astype(kind))
    return arrays


def _distinct(rows: npt.NDArray[np.int32]) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.integer]]:
    """The distinct codes, ascending, and for each of the rows' codes its place among them."""
    if rows.size < LARGE:
        return np.unique(rows, return_inverse=True)
    # By a table of all codes there can be, not by sorting: a third of the time for a touch of BioTac.
    at = rows + np.int32(2**BITS)
    there = np.zeros(2 ** (BITS + 1) + 1, dtype=bool)
    there[at] = True
    values = np.flatnonzero(there)
    table = np.empty(len(there), dtype=np.uint32)
    table[values] = np.arange(len(values), dtype=np.uint32)
    return (values - 2**BITS).astype(np.int32), table[at]


def unpack_codes(arrays: Mapping[str, npt.NDArray[Any]]) -> Codes:
    """The codes that `pack_codes` packed."""
    plain = {int(name.removeprefix("codes-")): rows for name, rows in arrays.items() if name.startswith("codes-")}
    scales = [int(name.removeprefix("values-")) for name in arrays if name.startswith("values-")]
    packed = {
        scale: np.ascontiguousarray(arrays[f"values-{scale}"][arrays[f"places-{scale}"].T]).astype(np.int32, copy=False)
        for scale in scales
    }
    return dict(sorted((plain | packed).items()))


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
