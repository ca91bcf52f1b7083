"""The gate: a memory is opened through it, and rows of its journal are looked at before anybody uses them.

Checksums find what was damaged; they do not tell who wrote it. So a row may claim no more than it holds, its names must
be names, and its readings must hash to its key. Whether numbers fit each other is not asked. What a checkpoint's arrays
must be stands beside the dataclasses that they fill, see `statistics.fields`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from itertools import chain, takewhile
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from scroll_tactile_store import DamageError, Head, NotAStoreError, Record, Store
from scroll_tactile_store.exceptions import reported
from scroll_tactile_store.files import sync_folder

from scroll_tactile.embeddings.registry import require_configuration
from scroll_tactile.errors import EmbeddingError, InputError, MismatchError
from scroll_tactile.memory.identity import AbsentEmbedding, Identity
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import Kind, RowFields, refusing, unpack_codes, unpack_readings
from scroll_tactile.recipe import Recipe, RecipeRequest
from scroll_tactile.settings import Settings, require_name
from scroll_tactile.signals.stream import Stream
from scroll_tactile.statistics.fields import Must, expect
from scroll_tactile.statistics.grid import BITS

__all__ = ["MemoryStore", "beside", "check_memory", "finish_interrupted", "open_memory"]

KINDS = frozenset(Kind)
NAMED = (Kind.OBSERVE, Kind.MEMBER, Kind.DECLARE, Kind.DESCRIBE)  # rows whose label is a name, and never empty
FEWEST = 2**20  # rows that may be retracted at once, and as many as the log has bytes
R = TypeVar("R", bound=Head)


class MemoryStore(Store):
    """A store that holds a memory: rows that it reads are rows of a memory.

    Raises, from each method that reads rows, DamageError for a row that is none, MismatchError for a kind that this
    version does not know, and what `Identity.read` does.
    """

    @cached_property
    def recipe(self) -> Recipe:
        """What the memory was made with; its embedding is made when it is needed. Raises as `Identity.read`."""
        identity = Identity.read(self)
        settings = Settings(exemplars=identity.exemplars, kept_touches=identity.kept_touches)
        return Recipe(identity.sensor, AbsentEmbedding(identity, self.path), settings)

    def heads(self, after: int = 0, *, kind: str | None = None) -> Iterator[Head]:
        """As `Store.heads`."""
        return map(self.sound, super().heads(after, kind=kind))

    def with_key(self, key: bytes) -> Iterator[Head]:
        """As `Store.with_key`."""
        return map(self.sound, super().with_key(key))

    def record(self, sequence: int) -> Record:
        """As `Store.record`."""
        return self.sound(super().record(sequence))

    def records(self, after: int = 0) -> Iterator[Record]:
        """As `Store.records`."""
        return map(self.sound, super().records(after))

    def sound(self, row: R) -> R:
        """This row, whose kind, names and attributes are those of a memory, and its arrays where it comes with them."""
        if row.kind not in KINDS:
            raise MismatchError(
                f"row {row.sequence} of {self.path} is of kind {row.kind!r}, which this version does not know. Open "
                "the memory with the version that wrote it, or a newer one"
            )
        with refusing(self.path, row):
            if row.label or row.kind in NAMED:
                require_name(row.label)
            told = RowFields.model_validate(dict(row.attributes))
            if told.sequences:
                rows, most = (range(first, last + 1) for first, last in told.sequences), max(FEWEST, self._log.size())
                expect(sum(map(len, rows)) <= most, "sequences", f"at most {most} rows", told.sequences)
            if isinstance(row, Record) and row.kind == Kind.OBSERVE:
                self._require_touch(row, told)
        return row

    def _require_touch(self, row: Record, told: RowFields) -> None:
        """Raise Unexpected for readings and codes that are not those of a touch of so many columns."""
        sensor, readings, codes = self.recipe.sensor, unpack_readings(row.arrays), unpack_codes(row.arrays)
        nbytes = None if readings is None else readings.nbytes
        expect(told.nbytes == nbytes, "nbytes", f"{nbytes}, the size of the row's readings", told.nbytes)
        expect(told.columns is not None and bool(row.arrays), "arrays", "codes or readings of some columns", "none")
        if readings is not None:
            Must("float32", " ".join(map(str, ("*", *sensor.shape)))).check("readings", readings, {})
            low, high = sensor.limits
            inside = bool(np.all((readings >= low) & (readings <= high)))
            expect(inside, "readings", f"values from {low} to {high}", (readings.min(), readings.max()))
            expect(Stream(sensor, readings).key == row.key, "key", "the content hash of its readings", row.key)
        if codes:
            scales = {scale for stage in self.recipe.plan.scored_stages(told.columns or 0) for scale in stage}
            expect(codes.keys() == scales, "scales", f"{sorted(scales)}", sorted(codes))
        for scale, rows in codes.items():
            Must("int32", "* d", -(2**BITS), 2**BITS).check(f"{scale}", rows, {"d": self.recipe.embedding.dimension})


def finish_interrupted(path: Path) -> None:
    """Put the memory embedded anew in place, where the exchange was cut short just before that."""
    folder, whole = path.resolve(), beside(path, "reembedded")
    if not os.path.exists(folder) and os.path.exists(whole):
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
    if request.sensor is None and not os.path.exists(Path(path)):
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

    Checksums are for `check_store`. Raises StoreError where the folder cannot be read, or holds no store.
    """
    found: list[str] = []
    with MemoryStore.open(path, mode="read") as store, _noted(found):
        if (configuration := Identity.read(store).embedding.configuration) is not None:
            require_configuration(configuration)
        memory = Memory(store.recipe)
        for read in (store.latest, store.compaction):
            with _noted(found):
                if (checkpoint := read()) is not None:
                    memory.empty_like().fill(checkpoint, store.path)
        compacted = takewhile(lambda head: head.sequence <= store.compacted, Store.heads(store))
        for row in chain(compacted, Store.records(store, store.compacted)):
            with _noted(found):
                store.sound(row)
                if isinstance(row, Record) and row.kind == Kind.MERGE:
                    memory.empty_like().fill(row, store.path)
    return found


@contextmanager
def _noted(found: list[str]) -> Iterator[None]:
    try:
        yield
    except (DamageError, EmbeddingError, MismatchError) as error:
        found.append(str(error))
