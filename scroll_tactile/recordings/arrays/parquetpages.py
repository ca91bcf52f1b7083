"""What the pages of a parquet file claim to hold, looked at before pyarrow is: it allocates whatever they claim.

The file ends with a footer that says where the pages of each column are, and each page begins with a header that says
what it becomes. Both are structures in Thrift's compact protocol (apache/parquet-format: parquet.thrift has the numbers
of their fields). They are read here as the code that Thrift generates reads them, and refused where that code and this
could read different things: a column that only pyarrow sees would be bounded by nobody.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from scroll_tactile.errors import RecordingError
from scroll_tactile.recordings.bounds import Budget

__all__ = ["LONGEST_LIST", "require_bounded_pages"]

LONGEST_LIST = 1 << 16
"""The most row groups, columns or other elements that a list in a footer may have: pyarrow makes 1 KB of each."""

_I16, _I32, _I64, _BINARY, _LIST, _SET, _STRUCT = 4, 5, 6, 8, 9, 10, 12
_BITS = {_I16: 16, _I32: 32, _I64: 64}
_DEEPEST = 32  # structures, lists or groups of columns within each other
_HEADER = 1 << 14  # bytes of a page's header, the largest and smallest value of the page in it
_A_PAGE = 10  # steps of work
_VALUE = 8  # bytes of a value in memory: a wide number, or a narrow one and its place in a list

# What the lists of a footer hold. Thrift's code does not compare it with what a list says of itself.
_COLUMN: Any = {
    3: {2: [_I32], 3: [_BINARY], 8: [{}], 13: [{}], 16: {2: [_I64], 3: [_I64]}, 17: {2: [_I32]}},
    8: {2: {1: [_BINARY]}},
}
_FOOTER: Any = {2: [{}], 4: [{1: [_COLUMN], 4: [{}]}], 5: [{}], 7: [{}]}
_ABOUT = {0: 5, 2: 7, 3: 8}  # fields of a page's header by its type: data, a dictionary, and data of version 2

_Struct = dict[tuple[int, int], Any]


def require_bounded_pages(path: Path, columns: Collection[str] | None, budget: Budget) -> None:
    """Charge the budget for the pages of these columns, or of all; raises RecordingError where they claim too much.

    Raises another error, which `guarded` makes one, for a file that no writer writes.
    """
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(size - 8, 0))
        length, magic = int.from_bytes(file.read(4), "little"), file.read(4)
        if magic != b"PAR1" or length > size - 12:
            raise ValueError(f"{path.name} does not end as a parquet file does")
        budget.work(length)
        file.seek(size - 8 - length)
        footer = _Thrift(file.read(length)).struct(_FOOTER)
        elements = iter(footer[2, _LIST])
        chosen = list(_chosen(elements, None if columns is None else {name.encode() for name in columns}))
        for group in footer[4, _LIST]:
            for column, is_read in zip(group[1, _LIST], chosen, strict=True):
                if is_read:
                    _charge(file, column[3, _STRUCT], size - 8 - length, budget)


def _chosen(
    elements: Iterator[_Struct], columns: set[bytes] | None, path: bytes = b"", depth: int = 0
) -> Iterator[bool]:
    """Whether each column below the next element of a schema is read: pyarrow does if one of `columns` is its path."""
    element = next(elements, {})
    children = element.get((5, _I32), 0)
    if depth:
        path += (b"." if path else b"") + element[4, _BINARY]
        columns = None if columns is not None and path in columns else columns
    if depth > _DEEPEST:
        raise ValueError(f"more than {_DEEPEST} groups of columns within each other")
    if not children and (1, _I32) in element:
        yield columns is None
    for _ in range(children):
        yield from _chosen(elements, columns, path, depth + 1)


def _charge(file: BinaryIO, column: _Struct, size: int, budget: Budget) -> None:
    """Charge the budget for what the pages of a column claim; raises ValueError where they leave their place.

    Raises RecordingError where there are none, as in a file without rows.
    """
    place = column[9, _I64]
    if 0 < (dictionary := column.get((11, _I64), 0)) < place:
        place = dictionary
    if not place and not column[5, _I64]:  # as pyarrow writes it
        raise RecordingError(f"{file.name} has no rows: remove it, or write it again")
    end, values = place + column[7, _I64], 0
    if end > size:
        raise ValueError(f"a column ends at byte {end}, behind the {size} bytes of all")
    while place < end:
        budget.work(_A_PAGE)
        file.seek(place)
        thrift = _Thrift(file.read(min(_HEADER, end - place)))
        header = thrift.struct({})
        form, whole, stored = (header[field, _I32] for field in (1, 2, 3))
        count = header[_ABOUT[form], _STRUCT][1, _I32]
        place += thrift.at + stored
        if min(whole, stored, count) < 0 or place > end:
            raise ValueError(
                f"a page of {count} values, {whole} bytes in {stored}, ends at {place}, its column at {end}"
            )
        budget.take(max(whole, stored, _VALUE * count))
        values += count if form != 2 else 0
    if values != column[5, _I64]:  # where it misses values, pyarrow may look for them behind the column's end
        raise ValueError(f"a column of {column[5, _I64]} values has {values} in its pages")


class _Thrift:
    """Reads a structure of Thrift's compact protocol; `at` is behind what was read.

    Raises IndexError where the data end, and ValueError for what no writer writes.
    """

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def struct(self, lists: Any, depth: int = 0) -> _Struct:
        """Values by their field's number and kind: Thrift's code passes over a field of another kind.

        lists: what the lists in it hold, by field.
        """
        found: _Struct = {}
        field = 0
        while kind := (head := self._byte()) & 15:
            field = field + (head >> 4) if head >> 4 else self._integer(16)
            if (field, kind) in found or not 0 <= field < 1 << 15:
                raise ValueError(f"field {field} of a structure, twice or beyond all")
            found[field, kind] = kind == 1 if kind in (1, 2) else self._value(kind, lists.get(field), depth)
        return found

    def _value(self, kind: int, lists: Any, depth: int) -> Any:
        if depth > _DEEPEST:
            raise ValueError(f"more than {_DEEPEST} structures within each other")
        if kind in _BITS:
            return self._integer(_BITS[kind])
        if kind == _STRUCT:
            return self.struct(lists if isinstance(lists, dict) else {}, depth + 1)
        if kind in (_LIST, _SET):
            return self._list(lists[0] if isinstance(lists, list) else None, depth + 1)
        if kind not in (1, 2, 3, 7, _BINARY):
            raise ValueError(f"a value of kind {kind}")
        return self._bytes(self._number() if kind == _BINARY else 8 if kind == 7 else 1)

    def _list(self, lists: Any, depth: int) -> list[Any]:
        head = self._byte()
        count, kind = self._number() if head >> 4 == 15 else head >> 4, head & 15
        if count > LONGEST_LIST or (
            count and lists is not None and kind != (_STRUCT if isinstance(lists, dict) else lists)
        ):
            raise ValueError(f"a list of {count} values of kind {kind}")
        return [self._value(kind, lists, depth) for _ in range(count)]

    def _byte(self) -> int:
        self.at += 1
        return self.data[self.at - 1]

    def _bytes(self, count: int) -> bytes:
        self.at += count
        if self.at > len(self.data):
            raise IndexError(f"{count} bytes of a value, more than there are")
        return self.data[self.at - count : self.at]

    def _number(self) -> int:
        value = shift = 0
        while (byte := self._byte()) & 0x80 and shift < 63:
            value |= (byte & 0x7F) << shift
            shift += 7
        return value | byte << shift

    def _integer(self, bits: int) -> int:
        value = self._number()
        if value >> bits:
            raise ValueError(f"a number of more than {bits} bits")
        return value >> 1 ^ -(value & 1)
