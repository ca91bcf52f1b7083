"""A table of materials' attributes in grades, from a .csv file: a line for each material, a column for each attribute.

Such as a publisher's list of what was touched, graded in whole numbers from 0: soft 0, firm 1, stiff 2; where it says
what a material is (foam, wood, plant fibre), a column of 0 and 1 for each. Lists are not ours to hand on, so the file
is the reader's own::

    material,stiffness,roughness,foam
    mat1,2,0,0
"""

from __future__ import annotations

import csv
from pathlib import Path

from scroll_tactile.errors import DatasetError

__all__ = ["read_grades"]

MOST = 20  # grades are predicted step by step, each by a head of its own: they are no measures


def read_grades(path: Path) -> dict[str, dict[str, int]]:
    """Attribute → material → grade, of a file whose first line names the columns, the first that of the materials.

    Raises DatasetError, which names file and line, for a file that cannot be read, no attributes or materials, columns
    or materials that come twice, and cells that are not whole numbers from 0 to MOST.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if any(map(str.strip, row))]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(
            f"expected a table of grades in {path}; it cannot be read: {error}. Its first line is such as "
            "material,stiffness,roughness and the others such as mat1,2,0"
        ) from error
    if len(rows) < 2 or len(rows[0][1]) < 2:
        raise DatasetError(f"expected a line of column names, two or more, and a line for each material in {path}")
    head = rows[0][1]
    if len(set(head)) < len(head) or not all(head[1:]):
        raise DatasetError(f"expected columns of different names in the first line of {path}; they are {head}")
    found: dict[str, dict[str, int]] = {name: {} for name in head[1:]}
    for line, (material, *cells) in rows[1:]:
        if not material or material in found[head[1]]:
            raise DatasetError(f"expected a new material's name in line {line} of {path}; came {material!r}")
        sound = all(cell.isascii() and cell.isdigit() and len(cell) < 3 and int(cell) <= MOST for cell in cells)
        if len(cells) != len(found) or not sound:
            raise DatasetError(
                f"expected a grade for each of {len(found)} columns, whole numbers from 0 to {MOST}, in line {line} of "
                f"{path}; came {cells}"
            )
        for name, cell in zip(found, cells, strict=True):
            found[name][material] = int(cell)
    return found
