"""How long the pages of a parquet file say they become: pyarrow takes memory for as much, whatever that is.

A column's own total stands in the file's footer, and nobody compares the two. A page begins with a header in Thrift's
compact protocol (parquet-format, PageHeader), whose second and third fields are its lengths.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any, BinaryIO

from scroll_tactile.errors import RecordingError
from scroll_tactile.recordings.bounds import Budget

__all__ = ["require_bounded_pages"]

_HEADER = 1 << 16  # bytes of a page's header, the largest and smallest value of the page in it
_A_PAGE = 10  # steps of work
_DEEPEST = 8  # structures within each other


def require_bounded_pages(path: Path, metadata: Any, columns: Collection[str], budget: Budget) -> None:
    """Raises RecordingError where pages of these columns claim more than the budget has room for, or are none."""
    claimed = Budget(budget.address, budget.stored)
    with path.open("rb") as file:
        for i in range(metadata.num_row_groups):
            group = metadata.row_group(i)
            for j in range(group.num_columns):
                claimed.work()
                column = group.column(j)
                if column.path_in_schema in columns or column.path_in_schema.partition(".")[0] in columns:
                    _require_bounded(file, column, claimed)


def _require_bounded(file: BinaryIO, column: Any, claimed: Budget) -> None:
    first = column.data_page_offset
    if column.has_dictionary_page and 0 < column.dictionary_page_offset < first:
        first = column.dictionary_page_offset
    place, end = first, first + column.total_compressed_size
    while place < end:
        claimed.work(_A_PAGE)
        file.seek(place)
        try:
            header = _Header(file.read(min(_HEADER, end - place)))
            whole, compressed = header.sizes()
        except (IndexError, KeyError, ValueError) as error:
            raise RecordingError(f"{claimed.address} has a page without a header at byte {place}") from error
        if whole < 0 or compressed < 0:
            raise RecordingError(f"{claimed.address} has a page of {whole} bytes in {compressed} at byte {place}")
        claimed.take(whole)
        place += header.i + compressed


class _Header:
    """Reads a structure of Thrift's compact protocol; `i` is behind what was read."""

    def __init__(self, data: bytes) -> None:
        self.data, self.i = data, 0

    def sizes(self) -> tuple[int, int]:
        """A page's bytes once decompressed, and as they are; the whole header is read."""
        found = self._structure(0)
        return found[2], found[3]

    def _byte(self) -> int:
        self.i += 1
        return self.data[self.i - 1]

    def _number(self) -> int:
        value = shift = 0
        while (byte := self._byte()) & 0x80:
            value |= (byte & 0x7F) << shift
            shift += 7
        return value | byte << shift

    def _signed(self) -> int:
        value = self._number()
        return value >> 1 ^ -(value & 1)

    def _structure(self, depth: int) -> dict[int, int]:
        """The whole numbers in a structure by their fields; all else is passed over."""
        if depth > _DEEPEST:
            raise ValueError("structures within each other")
        found, field = {}, 0
        while about := self._byte():
            field = field + (about >> 4) if about >> 4 else self._signed()
            if about & 15 in (4, 5, 6):
                found[field] = self._signed()
            else:
                self._pass(about & 15, depth)
        return found

    def _pass(self, kind: int, depth: int) -> None:
        if kind in (1, 2):  # a truth value, which stands in the field itself
            return
        if kind == 8:
            length = self._number()
            self.i += length
        elif kind == 12:
            self._structure(depth + 1)
        elif kind in (3, 7):
            self.i += 1 if kind == 3 else 8
        else:  # a header of a page has neither lists nor maps
            raise ValueError(f"a field of kind {kind}")
