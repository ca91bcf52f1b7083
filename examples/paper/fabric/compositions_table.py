"""A table of what materials are made of, by mass, from a .csv file: a line for each, a column for each constituent."""

from __future__ import annotations

import csv
import math
from collections.abc import Collection
from pathlib import Path

from scroll_tactile.errors import DatasetError

__all__ = ["read_compositions"]

_ROUNDING = 0.01  # of shares as they are printed: thirds of 33 % sum to 99


def read_compositions(path: Path, constituents: Collection[str] | None = None) -> dict[str, dict[str, float | None]]:
    """Material → constituent → its share by mass, 0 where it is absent and None where the cell is empty.

    path: a .csv file whose first line names the columns, the first of them that of the materials. Shares are parts of
    one, or percent where any of the table is above one. Those of a material sum to one to within 1 %, and are divided
    by their sum; with empty cells among them, to one at most. constituents: which columns are read, in the order of the
    table; all but the first where it is None.

    Raises DatasetError, which names file and line, for a file that cannot be read, no constituents or materials, names
    that are empty or come twice, constituents that are not among the columns, cells that are neither empty nor a share,
    and shares that do not sum to one.
    """
    rows = _rows(path)
    head = [cell.strip() for cell in rows[0][1]]
    names = [name for name in head[1:] if constituents is None or name in constituents]
    strange = sorted(set(constituents or ()) - set(head[1:]))
    if strange or not names:
        raise DatasetError(f"expected constituents out of the columns {head[1:]} of {path}; came {strange or 'none'}")
    if len(set(head)) < len(head) or not all(head[1:]):
        raise DatasetError(f"expected columns of different names in the first line of {path}; they are {head}")
    read: dict[str, tuple[int, list[float | None]]] = {}
    for line, cells in rows[1:]:
        material = cells[0].strip()
        if not material or material in read:
            raise DatasetError(
                f"expected a name in line {line} of {path}; it is empty"
                if not material
                else f"{path} describes {material!r} twice, in lines {read[material][0]} and {line}: leave one out"
            )
        if len(cells) > len(head):
            raise DatasetError(f"expected at most {len(head)} cells in line {line} of {path}; came {len(cells)}")
        whole_line = [*cells, *[""] * (len(head) - len(cells))]
        read[material] = line, [_share(path, line, name, whole_line[head.index(name)]) for name in names]
    if not read:
        raise DatasetError(f"expected the composition of a material or more in {path}; there is none")
    whole = 100.0 if max((share or 0.0) for _, shares in read.values() for share in shares) > 1 + _ROUNDING else 1.0
    return {
        material: dict(zip(names, _parts(path, line, material, shares, whole), strict=True))
        for material, (line, shares) in read.items()
    }


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except FileNotFoundError as error:
        raise DatasetError(
            f"expected a table of compositions in {path}; there is no such file. Its first line is such as "
            "fabric,cotton,polyester and the others such as denim,98,2"
        ) from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(f"expected a table of compositions in {path}; it cannot be read: {error}") from error
    if not rows:
        raise DatasetError(f"expected a table of compositions in {path}; it is empty")
    return rows


def _share(path: Path, line: int, name: str, cell: str) -> float | None:
    """A share in the table's unit; None of an empty cell."""
    text = cell.strip().removesuffix("%").strip()
    if not text:
        return None
    try:
        share = float(text)
    except ValueError:
        share = math.nan
    if not 0 <= share <= 100 * (1 + _ROUNDING):
        raise DatasetError(
            f"expected a share of {name!r} in line {line} of {path}, 0 or more, or nothing where it is unknown; came "
            f"{cell.strip()!r}. Columns that are no constituents are left out by naming those that are"
        )
    return share


def _parts(path: Path, line: int, material: str, shares: list[float | None], whole: float) -> list[float | None]:
    total = math.fsum(share for share in shares if share is not None)
    unknown = None in shares
    if total > whole * (1 + _ROUNDING) or (total < whole * (1 - _ROUNDING) and not unknown):
        raise DatasetError(
            f"expected the shares of {material!r} in line {line} of {path} to sum to {whole:g}"
            f"{' at most' if unknown else ''}; they sum to {total:g}. Leave a cell empty where a share is unknown"
        )
    # What is rounded to more than the whole is brought back, and so is what is complete and rounded to less.
    divisor = total if not unknown or total > whole else whole
    return [None if share is None else share / divisor for share in shares]
