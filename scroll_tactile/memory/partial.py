"""Partial memories: what some touches taught, as one file that travels, and is merged like a memory's folder.

A partial holds the sums, the sampled touches, the kept touches and the descriptions of a memory, and of each touch its
name, content hash, time and source. With its rows it holds each touch's readings (or codes), too: then a touch that
came twice can be counted once, and retracted where it was merged into. Without, it holds the exemplars' readings
instead; or, for those who may not share readings, neither these nor kept touches.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, Self, cast

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import MismatchError
from scroll_tactile.memory.descriptions import Description
from scroll_tactile.memory.exemplars import Exemplar
from scroll_tactile.memory.expected import KEY_BYTES, MOST_COLUMNS, array, counts, expect
from scroll_tactile.memory.expected import name as material_name
from scroll_tactile.memory.gate import WRONG, Gate
from scroll_tactile.memory.identity import Identity
from scroll_tactile.memory.row_checks import check_description
from scroll_tactile.memory.rows import MEMBER, OBSERVE, SOURCE, Arrays
from scroll_tactile.memory.state import Memory
from scroll_tactile.signals.windows import WindowPlan
from store import Checkpoint, DamageError, Head, Record, RecordError
from store.encoding import check_arrays, encode_payload
from store.packed import PackedFile, PackedWriter, packing

__all__ = ["Joint", "Partial", "PartialWriter", "sums_without", "write_partial"]

DIGEST = 32  # bytes of a sha256
MOST_BYTES = 2**28  # of a row's payload


class PartialWriter:
    """Writes the touches of a partial, one by one, then its sums; made by `write_partial`."""

    def __init__(self, packed: PackedWriter) -> None:
        self._packed = packed
        self._heads: list[Head] = []
        self._sizes: list[int] = []
        self._digests: list[bytes] = []

    def touch(self, head: Head, arrays: Arrays | None = None) -> None:
        """Add a touch; arrays: of its row, in a partial with rows."""
        self._heads.append(head)
        if arrays is not None:
            payload = encode_payload(check_arrays(arrays))
            self._packed.row(payload)
            self._sizes.append(len(payload))
            self._digests.append(hashlib.sha256(payload).digest())

    def finish(
        self,
        identity: Mapping[str, Any],
        memory: Memory,
        candidates: list[Exemplar] | None,
        note: Mapping[str, Any] | None = None,
    ) -> None:
        """Write what the touches taught, and whose memory it is; f* and the numbers of rows stay behind.

        candidates: those for exemplars, with their readings; None where the rows have them. note: whatever else is to
        be said of the file, in JSON's types.
        """
        arrays, attributes = memory.to_arrays(0, candidates or [])
        arrays |= {field: np.zeros(0, np.int64) for field in ("retracted", "excluded")}
        gone = ("tuned", "exemplar") if candidates is None else ("tuned",)
        arrays = {field: values for field, values in arrays.items() if not field.startswith(gone)}
        attributes = {field: value for field, value in attributes.items() if not field.startswith(gone)}
        attributes["tuned_upto"] = 0
        rows = bool(self._sizes)
        if rows and len(self._sizes) != len(self._heads):
            raise RecordError("of a partial either all touches have a row, or none has")
        touches, names = _touches_to_arrays(self._heads)
        if rows:
            touches["row-sizes"] = np.array(self._sizes, np.int64)
            touches["row-digests"] = _rows_of_bytes(self._digests)
        self._packed.arrays("touches", touches)
        self._packed.arrays("sums", arrays)
        self._packed.finish(
            {"identity": identity, "attributes": attributes, "touched": names, "has_rows": rows, "note": note or {}}
        )


@contextmanager
def write_partial(path: Path) -> Iterator[PartialWriter]:
    """Write a partial that appears whole and durable when the block ends, or not at all. Raises StoreError."""
    with packing(path) as packed:
        yield PartialWriter(packed)


class Partial:
    """A partial that is read. It passes the gate, and is merged as a journal: `heads`, `record`, `base`.

    path, identity: as of a store. has_rows: whether it holds each touch's row. compacted: its last touch where it has
    no rows, for which the sums then stand, as in a compacted memory; else 0. descriptions: by material.
    note: as `finish` was given it.

    Raises NotAStoreError for what is none, VersionError for a newer one, DamageError, MismatchError.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = PackedFile(path)
        try:
            self._read()
        except BaseException:
            self._file.close()
            raise

    def _read(self) -> None:
        about = self._file.about
        try:
            self.identity = cast("Mapping[str, Any]", _mapping("identity", about.get("identity")))
            self._attributes = cast("dict[str, Any]", _mapping("attributes", about.get("attributes")))
            self.note = cast("Mapping[str, Any]", _mapping("note", about.get("note")))
            expect(isinstance(about.get("has_rows"), bool), "has_rows", "true or false", about.get("has_rows"))
            self.has_rows = bool(about["has_rows"])
            touches = self._file.arrays("touches")
            self._heads = _touches_from_arrays(touches, about.get("touched"))
            self._sizes, self._digests = self._rows_in(touches)
            self.descriptions = cast("dict[str, Description]", self._attributes.get("descriptions", {}))
            for name, constituents in self.descriptions.items():
                check_description("descriptions", material_name("descriptions", name), constituents)
        except WRONG as error:
            raise self._file.damage(f"what it says of its touches is none: {error}") from error
        self._places = np.concatenate([[0], np.cumsum(self._sizes)]).tolist()
        self.made_with = Identity.read(self)
        self._gate: Gate | None = None

    def _rows_in(self, touches: Arrays) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.uint8]]:
        count = len(self._heads) if self.has_rows else 0
        if not count:
            return np.zeros(0, np.int64), np.zeros((0, DIGEST), np.uint8)
        sizes = counts("row-sizes", array(touches, "row-sizes", ("int64",), (count,)), 0, MOST_BYTES)
        expect(int(sizes.sum()) == self._file.rows, "row-sizes", f"{self._file.rows} bytes", sizes.sum())
        return sizes, array(touches, "row-digests", ("uint8",), (count, DIGEST))

    def read_with(self, plan: WindowPlan, *, thorough: bool = False) -> None:
        """Read with this plan of windows from now on: see `MemoryStore.read_with`."""
        self._gate = Gate(self.path, self.made_with, plan, thorough=thorough)

    @property
    def gate(self) -> Gate:
        """The gate, after `read_with`."""
        assert self._gate is not None, "read_with comes first"
        return self._gate

    @property
    def compacted(self) -> int:
        """The last touch that the sums alone stand for; 0 with rows."""
        return 0 if self.has_rows else len(self._heads)

    @property
    def named(self) -> Sequence[Head]:
        """The touches, which have not passed the gate."""
        return self._heads

    def head(self, sequence: int) -> Head:
        """A touch without its arrays. Raises DamageError."""
        return self.gate.head(self._heads[sequence - 1])

    def heads(self, after: int = 0, *, kind: str | None = None, label: str | None = None) -> Iterator[Head]:
        """The touches behind one, in order, without their arrays. Raises DamageError."""
        for head in self._heads[after:]:
            if kind in (None, head.kind) and label in (None, head.label):
                yield self.gate.head(head)

    def record(self, sequence: int) -> Record:
        """A touch with its arrays; it is verified first. Raises DamageError."""
        i = sequence - 1
        arrays = self._file.row(self._places[i], int(self._sizes[i]), self._digests[i].tobytes())
        return self.gate.record(Record(**vars(self._heads[i]), arrays=arrays))

    def base(self) -> Checkpoint | None:
        """What stands for the touches that have no rows: the sums; None with rows.

        Raises MismatchError where these are a step of a fleet's run, which leaves exemplars to the rows.
        """
        if not self.has_rows and self.made_with.exemplars and "exemplars" not in self._attributes:
            raise MismatchError(f"{self.path} is a step of a fleet's run: merge the partials that it was made of")
        return None if self.has_rows else self.sums()

    def sums(self) -> Checkpoint:
        """What all touches taught. Raises DamageError, also where these are not the touches it names."""
        found = Checkpoint(0, len(self._heads), self._attributes, self._file.arrays("sums"))
        sums = self.gate.generation(found)
        observed = sums.arrays["observations"]
        said = dict(zip(cast("list[str]", sums.attributes["materials"]), observed.tolist(), strict=True))
        named = Counter(head.label for head in self._heads)
        if observed.ndim != 1 or said != named:
            raise self._file.damage("it counts other touches than it names")
        return sums

    def verify(self) -> None:
        """Read all of it, and raise DamageError where anything fails its checksum."""
        self._file.arrays("sums")
        for i in range(len(self._sizes)):
            self._file.row(self._places[i], int(self._sizes[i]), self._digests[i].tobytes())

    def close(self) -> None:
        """Release the file; a second call does nothing."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Joint:
    """Partials with rows as one, read in place: touches one after another, and the sums of all of them.

    parts: each with the numbers of its touches that are left out, since they came before; one may come several times,
    with some of them. sums: those of the others. descriptions: by material. refused: material and key of touches that
    are in the sums, and that a merge leaves out. Raises MismatchError where they are of different memories.
    """

    has_rows = True
    compacted = 0

    def __init__(
        self,
        parts: Sequence[tuple[Partial, Collection[int]]],
        sums: Partial,
        descriptions: Mapping[str, Description],
        refused: Collection[tuple[str, bytes]] = (),
    ) -> None:
        self.path, self.identity, self._sums = sums.path, sums.identity, sums
        self.descriptions, self.refused = dict(descriptions), frozenset(refused)
        self._parts = [partial for partial, _ in parts]
        for partial in self._parts:
            if partial.identity != self.identity:
                raise MismatchError(f"{partial.path} is of another memory than {self.path}: partials of one join")
        self._touches = [
            (number, head.sequence)
            for number, (partial, left_out) in enumerate(parts)
            for head in partial.named
            if head.sequence not in left_out
        ]

    def read_with(self, plan: WindowPlan, *, thorough: bool = False) -> None:
        """As `Partial.read_with`; second moments are looked at where they are summed up."""
        for partial in self._parts:
            partial.read_with(plan)
        self._sums.read_with(plan, thorough=thorough)

    def heads(self, after: int = 0, *, kind: str | None = None, label: str | None = None) -> Iterator[Head]:
        """As `Partial.heads`."""
        for sequence, (number, own) in enumerate(self._touches[after:], start=after + 1):
            head = self._parts[number].head(own)
            if kind in (None, head.kind) and label in (None, head.label):
                yield replace(head, sequence=sequence)

    def record(self, sequence: int) -> Record:
        """As `Partial.record`."""
        number, own = self._touches[sequence - 1]
        return self._parts[number].record(own)

    def base(self) -> None:
        """No base: there are rows."""

    def sums(self) -> Checkpoint:
        """As `Partial.sums`. Raises DamageError where they are not the sums of these touches."""
        found = self._sums.sums()
        if found.upto != len(self._touches):
            raise DamageError(f"{self.path} sums up {found.upto} touches of {len(self._touches)}", path=self.path)
        return found


def sums_without(source: Partial | Joint, memory: Memory, left_out: Collection[int]) -> Memory:
    """What the touches of a source taught, without some of them, whose rows it must have, exactly.

    memory: any of that making. Raises DamageError.
    """
    found = source.sums()
    sums, gone = memory.of_sums(found.arrays, found.attributes), memory.of_nothing()
    if not left_out:
        return sums
    for sequence in left_out:
        record = source.record(sequence)
        columns, codes = memory.codes(record)
        gone.statistics.add(record.label, codes, columns)
    rest = memory.of_nothing()
    rest.statistics = sums.statistics - gone.statistics
    rest.exemplars = None  # the rows have them
    rest.choose([head for head in source.heads() if head.sequence not in left_out], source, sums)
    return rest


def _mapping(field: str, value: object) -> object:
    expect(isinstance(value, dict), field, "a JSON object", value)
    return value


def _touches_to_arrays(heads: Sequence[Head]) -> tuple[dict[str, npt.NDArray[Any]], list[str]]:
    """The touches as arrays, a place for each, and the materials that these name by number."""
    names = sorted({head.label for head in heads})
    numbers = {name: number for number, name in enumerate(names)}
    said = [cast("str | None", head.attributes.get(SOURCE)) for head in heads]
    sources = {source: number for number, source in enumerate(sorted({source for source in said if source}))}
    texts = [source.encode() for source in sources]
    numeric = {
        "materials": [numbers[head.label] for head in heads],
        "columns": [cast(int, head.attributes.get("columns", 0)) for head in heads],
        "bytes": [cast(int, head.attributes.get("nbytes", 0)) for head in heads],
        "sources": [-1 if source is None else sources[source] for source in said],
        "source-lengths": [len(text) for text in texts],
    }
    arrays: dict[str, npt.NDArray[Any]] = {name: np.array(values, np.int64) for name, values in numeric.items()}
    arrays["keys"] = _rows_of_bytes([head.key for head in heads])
    arrays["times"] = np.array([head.time for head in heads], np.float64)
    arrays["source-texts"] = np.frombuffer(b"".join(texts), np.uint8)
    return arrays, names


def _touches_from_arrays(arrays: Arrays, names: object) -> list[Head]:
    """The touches that `_touches_to_arrays` gave. Raises Unexpected, UnicodeDecodeError."""
    expect(isinstance(names, list), "touched", "names of materials", names)
    materials = [material_name("touched", each) for each in cast("list[Any]", names)]
    keys = array(arrays, "keys", ("uint8",), (None, None))
    count = len(keys)
    expect(not count or keys.shape[1] == KEY_BYTES, "keys", f"{KEY_BYTES} bytes each", keys.shape)
    times = array(arrays, "times", ("float64",), (count,)).tolist()

    def numbers(field: str, least: int, most: int, length: int | None = count) -> list[int]:
        values: list[int] = counts(field, array(arrays, field, ("int64",), (length,)), least, most).tolist()
        return values

    lengths = numbers("source-lengths", 1, 2**16, None)
    blob = array(arrays, "source-texts", ("uint8",), (sum(lengths),)).tobytes()
    edges = np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]).tolist()
    sources = [blob[begin:end].decode() for begin, end in pairwise(edges)]
    places, from_sources = numbers("materials", 0, len(materials) - 1), numbers("sources", -1, len(sources) - 1)
    columns, sizes = numbers("columns", 0, MOST_COLUMNS), numbers("bytes", 0, MOST_BYTES)
    heads = []
    for i in range(count):
        said: dict[str, Any] = {"columns": columns[i]} if columns[i] else {}
        said |= {"nbytes": sizes[i]} if sizes[i] else {}
        said |= {SOURCE: sources[from_sources[i]]} if from_sources[i] >= 0 else {}
        kind = OBSERVE if columns[i] else MEMBER
        heads.append(Head(i + 1, kind, materials[places[i]], keys[i].tobytes(), times[i], said, 0))
    return heads


def _rows_of_bytes(keys: Iterable[bytes]) -> npt.NDArray[np.uint8]:
    found = list(keys)
    return np.frombuffer(b"".join(found), np.uint8).reshape(len(found), -1) if found else np.zeros((0, 0), np.uint8)
