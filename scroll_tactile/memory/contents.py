"""Which touches a memory has, by the hash of their readings: one content is one touch, and has one name.

A touch that is there under its name is not learned a second time, whoever brings it. One that is there under another is
refused where many are learned from files, in one process or by a fleet; `observe` takes it, and a merge is a union.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from scroll_tactile.signals.ranges import CURE

__all__ = ["Contents", "KnownContents", "refusal"]


def refusal(names: Sequence[str], material: str, clipped: bool = False) -> str | None:
    """Why a touch that is there under these names cannot be learned as a material; None where it can.

    clipped: whether all its values lay outside the sensor's range, so that clipping may have made it this touch.
    """
    if not names or material in names:
        return None
    if clipped:
        return (
            f"all its values lie outside the sensor's range, and the memory has what clipping leaves of them already, "
            f"as {names[0]!r} and not as {material!r}: {CURE}"
        )
    return f"the memory has this touch already, as {names[0]!r} and not as {material!r}: relabel one of them"


class Contents:
    """The touches of a memory by their keys. rows: of each its material, its key and its row in the journal."""

    def __init__(self, rows: Iterable[tuple[str, bytes, int]] = ()) -> None:
        self._rows: dict[bytes, tuple[tuple[str, int], ...]] = {}
        for material, key, sequence in rows:
            self.add(material, key, sequence)

    def copy(self) -> Contents:
        """The same touches, to be changed apart."""
        other = Contents()
        other._rows = dict(self._rows)
        return other

    def add(self, material: str, key: bytes, sequence: int) -> None:
        """Add a touch, also one more of the same content."""
        self._rows[key] = (*self._rows.get(key, ()), (material, sequence))

    def remove(self, material: str, key: bytes, sequence: int) -> None:
        """Take a touch out; nothing where it is not there."""
        left = tuple(row for row in self._rows.get(key, ()) if row != (material, sequence))
        if left:
            self._rows[key] = left
        else:
            self._rows.pop(key, None)

    def names(self, key: bytes) -> list[str]:
        """The names of a content, the first that it was given first; none where it is not there."""
        return list(dict.fromkeys(name for name, _ in self._rows.get(key, ())))

    def find(self, material: str, key: bytes) -> int | None:
        """The first row that has a content under this name; None where there is none."""
        return min((sequence for name, sequence in self._rows.get(key, ()) if name == material), default=None)


class KnownContents:
    """The contents of a memory: read when they are first asked for, and changed with it from then on.

    read: reads them. contents: where they are known already.
    """

    def __init__(self, read: Callable[[], Contents], contents: Contents | None = None) -> None:
        self._read, self._contents = read, contents

    def get(self) -> Contents:
        """The contents."""
        if self._contents is None:
            self._contents = self._read()
        return self._contents

    def added(self, rows: Iterable[tuple[str, bytes, int]]) -> None:
        """Touches were added, as the rows of `Contents`; they are not gone through before anybody asked."""
        if self._contents is not None:
            for row in rows:
                self._contents.add(*row)

    def removed(self, rows: Iterable[tuple[str, bytes, int]]) -> None:
        """Touches were taken out, as `added`."""
        if self._contents is not None:
            for row in rows:
                self._contents.remove(*row)

    def unknown(self) -> None:
        """The memory is another, or changed in a way that only reading tells."""
        self._contents = None
