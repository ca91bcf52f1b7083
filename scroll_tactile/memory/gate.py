"""The gate: a memory is opened through it, and rows of its journal are looked at before anybody uses them.

Checksums find what was damaged; they do not tell who wrote it. So a row may claim no more than it holds, its names must
be names, and its readings must hash to its key. Whether numbers fit each other is not asked. What a checkpoint's arrays
must be stands beside the dataclasses that they fill, see `statistics.fields`.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cached_property, lru_cache
from itertools import chain, takewhile
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scroll_tactile_store import DamageError, Head, NotAStoreError, Record, Store
from scroll_tactile_store.exceptions import reported
from scroll_tactile_store.files import is_there, sync_folder

from scroll_tactile.embeddings.registry import require_configuration
from scroll_tactile.errors import EmbeddingError, InputError, MismatchError
from scroll_tactile.memory.descriptions import checked
from scroll_tactile.memory.identity import AbsentEmbedding, Identity
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import (
    ADAPT,
    CODES,
    DECLARE,
    DESCRIBE,
    KINDS,
    MEMBER,
    MERGE,
    OBSERVE,
    PACKED_SHAPE,
    PACKED_ZERO,
    RETRACT,
    SENSE,
    Arrays,
    RowFields,
    declared_by,
    only_readings,
    refusing,
    unpack_readings,
)
from scroll_tactile.recipe import Recipe, RecipeRequest
from scroll_tactile.settings import Settings, require_name
from scroll_tactile.signals.correction import Correction
from scroll_tactile.signals.stream import Stream, fewest_readings
from scroll_tactile.signals.windows import WindowPlan
from scroll_tactile.statistics.fields import KEY_BYTES, Must, expect
from scroll_tactile.statistics.grid import BITS

__all__ = ["MemoryStore", "beside", "check_memory", "finish_interrupted", "open_memory", "sound_rows"]

SMALLEST_ROW = 128  # bytes of the log: a frame and a row without texts
ITEM = np.dtype(np.float32).itemsize
NAMED = (OBSERVE, MEMBER, DECLARE, DESCRIBE)  # rows whose label is a name; that of others may be empty


class MemoryStore(Store):
    """A store that holds a memory: rows that it reads are rows of a memory.

    Raises, from each method that reads rows, DamageError for a row that is none, MismatchError for a kind or for arrays
    that this version does not know, and what `Identity.read` does.
    """

    _own = math.inf  # the first row that this writer appended: in a batch it is on no disk yet

    def append(self, *row: Any, **more: Any) -> Head:
        """As `Store.append`."""
        head = super().append(*row, **more)
        self._own = min(self._own, head.sequence)
        return head

    @cached_property
    def recipe(self) -> Recipe:
        """What the memory was made with; its embedding is made when it is needed. Raises as `Identity.read`."""
        identity = Identity.read(self)
        settings = Settings(exemplars=identity.exemplars, kept_touches=identity.kept_touches)
        return Recipe(identity.sensor, AbsentEmbedding(identity, self.path), settings)

    def heads(self, after: int = 0, *, kind: str | None = None) -> Iterator[Head]:
        """As `Store.heads`."""
        return map(self.sound_head, super().heads(after, kind=kind))

    def with_key(self, key: bytes) -> Iterator[Head]:
        """As `Store.with_key`."""
        return map(self.sound_head, super().with_key(key))

    def record(self, sequence: int) -> Record:
        """As `Store.record`."""
        return self.sound_record(super().record(sequence))

    def records(self, after: int = 0) -> Iterator[Record]:
        """As `Store.records`."""
        return map(self.sound_record, super().records(after))

    def sound_head(self, head: Head) -> Head:
        """This row, whose kind, name, key and attributes are those of a memory."""
        self._fields(head)
        return head

    def _fields(self, head: Head) -> RowFields:
        with refusing(self.path, f"row {head.sequence}", head.sequence):
            if head.kind not in KINDS:
                raise MismatchError(f"is of kind {head.kind!r}, which this version does not know")
            if head.label or head.kind in NAMED:
                require_name(head.label)
            expect(head.kind not in (OBSERVE, MEMBER) or len(head.key) == KEY_BYTES, "key", "32 bytes", head.key)
            told = RowFields.model_validate(head.attributes)
            if head.kind in (OBSERVE, SENSE):
                self._require_size(told.columns, told.nbytes)
            elif head.kind == RETRACT:
                self._require_spans(told.sequences, head.sequence)
            elif head.kind == ADAPT and told.retracts is None:
                Correction.from_text(told.correction, self.recipe.sensor)
            elif head.kind == DECLARE:
                declared_by(head)
            elif head.kind == DESCRIBE and told.constituents is not None:
                checked(head.label, told.constituents)
        return told

    def _require_size(self, columns: int | None, nbytes: int | None) -> None:
        sensor = self.recipe.sensor
        readings, rest = divmod(nbytes or 0, ITEM * sensor.channels)
        frame = self.recipe.plan.widths[0]
        # Of a camera's frames the first may be its resting image, which is no column.
        fitting = (readings * frame, (readings - 1) * frame) if sensor.camera else (readings,)
        sound = nbytes is None or (columns in fitting and not rest and readings >= fewest_readings(sensor))
        expect(columns is not None and sound, "columns", f"those of {nbytes} bytes of readings", columns)

    def _require_spans(self, pairs: list[tuple[int, int]] | None, sequence: int) -> None:
        """Raise Unexpected for anything but spans of earlier rows, ascending, of no more rows than logs can hold."""
        before = rows = 0
        for first, last in pairs or ():
            expect(before < first <= last < sequence, "sequences", f"spans of rows before {sequence}, ascending", pairs)
            before, rows = last, rows + last - first + 1
        if sequence >= self._own:
            return
        most = self._log.size() // SMALLEST_ROW
        expect(0 < rows <= most, "sequences", f"1 to {most} rows, which the journal can hold", rows)

    def sound_record(self, record: Record) -> Record:
        """This row, of which the arrays, too, are those of a memory."""
        told = self._fields(record)
        if record.kind == OBSERVE:
            with refusing(self.path, f"row {record.sequence}", record.sequence):
                self._require_arrays(record, told)
        return record

    def _require_arrays(self, record: Record, told: RowFields) -> None:
        arrays = record.arrays
        if unknown := [name for name in arrays if not name.startswith((CODES, "readings-"))]:
            raise MismatchError(f"has arrays {unknown[:5]}, which this version does not know")
        packed = only_readings(arrays)
        expect((told.nbytes is None) == (not packed), "nbytes", "the size of the row's readings", told.nbytes)
        expect(bool(arrays), "arrays", "codes or readings", "none")
        if told.nbytes is not None:
            sensor = self.recipe.sensor
            readings = self._readings(packed, told.nbytes // (ITEM * sensor.channels))
            expect(Stream(sensor, readings).key == record.key, "key", "the content hash of its readings", record.key)
        if len(packed) < len(arrays):
            rows = {f"{CODES}{scale}": count for scale, count in _rows_of(self.recipe.plan, told.columns or 0).items()}
            expect(arrays.keys() - packed.keys() == rows.keys(), "scales", f"{sorted(rows)}", sorted(arrays))
            for name, count in rows.items():
                must = Must("int32", f"{count} d", -(2**BITS), 2**BITS)
                must.check(name, arrays[name], {"d": self.recipe.embedding.dimension})

    def _readings(self, packed: Arrays, count: int) -> npt.NDArray[np.float32]:
        """So many readings of a row; what it claims is compared with what it has before anything is made of it."""
        sensor = self.recipe.sensor
        shape = (count, *sensor.shape)
        if PACKED_SHAPE in packed:
            claimed = packed[PACKED_SHAPE].tolist()
            expect(claimed == list(shape), PACKED_SHAPE, f"{shape}", claimed)
            Must("uint8", f"{-(-count * sensor.channels // 8)}").check(PACKED_ZERO, packed.get(PACKED_ZERO), {})
        with np.errstate(all="ignore"):
            readings = unpack_readings(packed)
        Must("float32", " ".join(map(str, shape))).check("readings", readings, {})
        assert readings is not None
        low, high = sensor.limits
        inside = bool(np.all((readings >= low) & (readings <= high)))
        expect(inside, "readings", f"values from {low} to {high}", (readings.min(), readings.max()))
        return readings


@lru_cache(256)
def _rows_of(plan: WindowPlan, columns: int) -> Counter[int]:
    """How many rows of codes a touch of so many columns has, by the number of the scale."""
    found: Counter[int] = Counter()
    for stage in plan.scored_stages(columns):
        found.update({int(scale): len(groups) for scale, groups in stage.items()})
    return found


def finish_interrupted(path: Path) -> None:
    """Put the memory embedded anew in place, where the exchange was cut short just before that."""
    folder, whole = path.resolve(), beside(path, "reembedded")
    if not is_there(folder) and is_there(whole):
        with reported(folder, "putting a memory embedded anew in place"):
            whole.rename(folder)
            sync_folder(folder.parent)


def beside(path: Path, what: str) -> Path:
    """The folder beside a memory in which one that is embedded anew lies, or the one before it."""
    folder = path.resolve()
    return folder.with_name(f"{folder.name}.{what}")


def open_memory(
    path: str | os.PathLike[str], request: RecipeRequest, mode: Literal["write", "read"]
) -> tuple[MemoryStore, Identity, Recipe]:
    """The store in a folder, what is written there of its making, and its recipe; a new one where a sensor is given.

    Raises as `TactileLearner.open`.
    """
    finish_interrupted(Path(path))
    if request.sensor is None and not is_there(Path(path)):
        raise InputError(f"there is no memory in {path}; to make one, say which sensor it is for")
    try:
        store = MemoryStore.open(path, mode=mode)
    except NotAStoreError:
        if request.sensor is None or mode == "read":
            raise
        store = MemoryStore.open(path, identity=Identity.of(request.recipe()).to_json(), mode=mode)
    try:
        identity = Identity.read(store)
        recipe = identity.recipe(store.path, request)
    except BaseException:
        store.close()
        raise
    return store, identity, recipe


def check_memory(path: str | os.PathLike[str]) -> list[str]:
    """All that is wrong with a memory whose bytes are as they were written, one sentence each; nothing is replayed.

    Checksums are `store.check_store`'s: a row that fails its own is left out here. Raises StoreError where the folder
    cannot be read, or holds no store.
    """
    found: list[str] = []

    def note(error: Exception) -> None:
        found.append(str(error))

    with MemoryStore.open(path, mode="read") as store:
        try:
            if (configuration := Identity.read(store).embedding.configuration) is not None:
                require_configuration(configuration)
            memory = Memory(store.recipe)
        except (DamageError, EmbeddingError, MismatchError) as error:
            return [str(error)]
        for read in (store.latest, store.compaction):
            try:
                if (checkpoint := read()) is not None:
                    memory.empty_like().fill(checkpoint, store.path)
            except DamageError as error:
                note(error)
        for row in sound_rows(lambda after: _rows(store, after), lambda damage: None):
            try:
                if isinstance(row, Record):
                    store.sound_record(row)
                    if row.kind == MERGE:
                        memory.empty_like().fill(row, store.path)
                else:
                    store.sound_head(row)
            except (DamageError, MismatchError) as error:
                note(error)
    return found


def _rows(store: MemoryStore, after: int) -> Iterator[Head]:
    """The rows after one as they are, with their arrays where these were not compacted."""
    compacted = takewhile(lambda head: head.sequence <= store.compacted, Store.heads(store, after))
    return chain(compacted, Store.records(store, max(after, store.compacted)))


def sound_rows(read: Callable[[int], Iterator[Head]], tell: Callable[[DamageError], object]) -> Iterator[Head]:
    """The rows of a journal without the damaged ones. read: reads those after one. tell: is called with each damage."""
    after = 0
    while True:
        try:
            for row in read(after):
                yield row
                after = row.sequence
            return
        except DamageError as damage:
            tell(damage)
            if damage.sequence is None or damage.sequence <= after:
                return
            after = damage.sequence
