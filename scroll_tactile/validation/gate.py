"""The gate: what is read from a memory's folder passes it before it is replayed, merged, listed, exported or counted.

Checksums tell what was written from what was damaged, and not who wrote it: a folder may come from somebody else. The
gate takes every row and checkpoint for what it must be (see `expected`), and raises DamageError with its place for
anything else. A row with readings is under their hash. What it lets through may be false, as a touch under another
name is.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import chain, takewhile
from pathlib import Path
from typing import Literal, cast

from scroll_tactile_store import Checkpoint, DamageError, Head, NotAStoreError, Record, Store
from scroll_tactile_store.exceptions import reported
from scroll_tactile_store.files import file_size, is_there, sync_folder
from scroll_tactile_store.layout import log_numbers, log_path

from scroll_tactile.embeddings.protocol import window_plan
from scroll_tactile.embeddings.registry import require_configuration
from scroll_tactile.errors import EmbeddingError, InputError, MismatchError
from scroll_tactile.memory.identity import AbsentEmbedding, Identity
from scroll_tactile.memory.touch_rows import (
    ADAPT,
    DECLARE,
    MEMBER,
    OBSERVE,
    RETRACT,
    RETRACTS,
    annotation_of,
    declared_by,
    unspanned,
)
from scroll_tactile.quantities import Quantity
from scroll_tactile.recipe import Recipe, RecipeRequest
from scroll_tactile.signals.windows import WindowPlan
from scroll_tactile.validation.expected import Expected, Unexpected, quantities_of

__all__ = [
    "WRONG",
    "Gate",
    "MemoryStore",
    "beside",
    "check_memory",
    "finish_interrupted",
    "misdeclared",
    "open_memory",
    "sound_rows",
    "wrong_retractions",
    "wrong_values",
]

SMALLEST_ROW = 128  # bytes of the log: a frame and a row without texts
# What reading values of wrong types can raise; what is no error of the values, such as ctrl-C, is none of them.
WRONG = (ArithmeticError, AttributeError, LookupError, MemoryError, RecursionError, TypeError, ValueError)


class Gate:
    """What rows and checkpoints in a folder must be, by the identity there, and the plan of windows it is read with."""

    def __init__(self, path: Path, identity: Identity, plan: WindowPlan) -> None:
        self._path, self._expected = path, Expected(identity, plan)

    def head(self, head: Head) -> Head:
        """This row, which is what its kind must be but for its arrays. Raises as `record`."""
        with self._refusing(f"row {head.sequence}", head.sequence):
            self._expected.head(head, self._most_rows)
        return head

    def record(self, record: Record) -> Record:
        """This row with its arrays. Raises DamageError; MismatchError for what this version does not know."""
        self.head(record)
        with self._refusing(f"row {record.sequence}", record.sequence):
            self._expected.record(record)
        return record

    def checkpoint(self, checkpoint: Checkpoint) -> Checkpoint:
        """This checkpoint. Raises DamageError."""
        with self._refusing(f"checkpoint {checkpoint.number}"):
            self._expected.checkpoint(checkpoint)
        return checkpoint

    @contextmanager
    def _refusing(self, what: str, sequence: int | None = None) -> Iterator[None]:
        """Name the place of what a check refuses."""
        try:
            yield
        except MismatchError as error:
            advice = "Open the memory with the version that wrote it, or a newer one"
            raise MismatchError(f"{what} of {self._path} {error}. {advice}") from None
        except WRONG as error:
            raise self._damage(what, error, sequence) from error

    def _damage(self, what: str, error: Exception, sequence: int | None = None) -> DamageError:
        """The error for what is Unexpected and, as a last net, for what a check itself did not expect."""
        ours = isinstance(error, Unexpected | InputError)
        came = str(error) if ours else f"{type(error).__name__}: {error!s:.200}"
        return DamageError(
            f"{what} of {self._path} is not what is written there: {came}. It is damaged, or was made by another "
            "program: use none of this memory before you know who made it (scroll-tactile memory check)",
            path=self._path,
            sequence=sequence,
        )

    def _most_rows(self) -> int:
        """How many rows the journal can hold, by its size."""
        packed = self._path.is_file()
        logs = [self._path] if packed else [log_path(self._path, number) for number in log_numbers(self._path)]
        return sum(map(file_size, logs)) // SMALLEST_ROW


class MemoryStore(Store):
    """A store that holds a memory: what it reads passes the gate.

    Raises, from each method that reads, what `Gate` does, and what `Identity.read` does.
    """

    _gate: Gate | None = None

    @property
    def gate(self) -> Gate:
        """The gate, by the memory's identity alone where nobody called `read_with`."""
        if self._gate is None:
            identity = Identity.read(self)
            self.read_with(window_plan(identity.sensor, AbsentEmbedding(identity, self.path)))
        assert self._gate is not None
        return self._gate

    def read_with(self, plan: WindowPlan) -> None:
        """Read with this plan of windows from now on."""
        self._gate = Gate(self.path, Identity.read(self), plan)

    def heads(self, after: int = 0, *, kind: str | None = None, label: str | None = None) -> Iterator[Head]:
        """As `Store.heads`."""
        return map(self.gate.head, super().heads(after, kind=kind, label=label))

    def with_key(self, key: bytes) -> Iterator[Head]:
        """As `Store.with_key`."""
        return map(self.gate.head, super().with_key(key))

    def record(self, sequence: int) -> Record:
        """As `Store.record`."""
        return self.gate.record(super().record(sequence))

    def records(self, after: int = 0) -> Iterator[Record]:
        """As `Store.records`."""
        return map(self.gate.record, super().records(after))

    def latest(self) -> Checkpoint | None:
        """As `Store.latest`."""
        newest = super().latest()
        return None if newest is None else self.gate.checkpoint(newest)

    def compaction(self) -> Checkpoint | None:
        """As `Store.compaction`."""
        found = super().compaction()
        return None if found is None else self.gate.checkpoint(found)


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
    store = _opened_or_made(path, request, mode)
    try:
        identity = Identity.read(store)
        recipe = identity.recipe(store.path, request)
        store.read_with(recipe.plan)
    except BaseException:
        store.close()
        raise
    return store, identity, recipe


def _opened_or_made(
    path: str | os.PathLike[str], request: RecipeRequest, mode: Literal["write", "read"]
) -> MemoryStore:
    try:
        return MemoryStore.open(path, mode=mode)
    except NotAStoreError:
        if request.sensor is None or mode == "read":
            raise
    return MemoryStore.open(path, identity=Identity.of(request.recipe()).to_json(), mode=mode)


def check_memory(path: str | os.PathLike[str]) -> list[str]:
    """All that the gate finds in a folder, one sentence each; nothing of a sound memory, and nothing is replayed.

    Checksums are `store.check_store`'s: a row that fails its own is passed over here. Raises StoreError where the
    folder cannot be read, or holds no store.
    """
    with MemoryStore.open(path, mode="read") as store:
        try:
            gate, configuration = store.gate, Identity.read(store).embedding.configuration
            if configuration is not None:
                require_configuration(configuration)
        except (DamageError, EmbeddingError, MismatchError) as error:
            return [str(error)]
        found, heads, compaction = list[str](), list[Head](), None
        for read in (store.latest, store.compaction):
            try:
                compaction = read()
            except DamageError as damage:
                found.append(str(damage))
        declared = None if found else quantities_of({} if compaction is None else compaction.attributes)
        for row in sound_rows(partial(_rows, store), lambda damage: None):
            try:
                gate.record(row) if isinstance(row, Record) else gate.head(row)
            except (DamageError, MismatchError) as error:
                found.append(str(error))
            else:
                heads.append(replace(row, arrays={}) if isinstance(row, Record) else row)
        later = (head for head in heads if head.sequence > store.compacted)
        wrong = () if declared is None else wrong_values(store.path, later, declared)
        return [*found, *map(str, wrong_retractions(store.path, heads)), *map(str, wrong)]


def _rows(store: MemoryStore, after: int) -> Iterator[Head]:
    """The rows after one, with their arrays where they were not compacted; they do not pass the gate."""
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


def wrong_retractions(path: Path, heads: Sequence[Head]) -> Iterator[DamageError]:
    """What is wrong with the rows, in order, that take back what is not there to be taken, or was taken back before."""
    kinds = {head.sequence: RETRACT if RETRACTS in head.attributes else head.kind for head in heads}
    for head in heads:
        kind, gone = OBSERVE, unspanned(head.attributes["sequences"]) if head.kind == RETRACT else []
        if head.kind == ADAPT and RETRACTS in head.attributes:
            kind, gone = ADAPT, [cast(int, head.attributes[RETRACTS])]
        if others := [sequence for sequence in gone if kinds.get(sequence, kind) != kind]:
            what = "observations" if kind == OBSERVE else "adaptation"
            yield DamageError(
                f"row {head.sequence} of {path} retracts {others[:5]}, which are no {what}, or retracted before",
                path=path,
                sequence=head.sequence,
            )
        kinds.update((sequence, RETRACT) for sequence in gone)


def wrong_values(path: Path, heads: Iterable[Head], quantities: dict[str, Quantity]) -> Iterator[DamageError]:
    """What is wrong with the rows, in order, that have a value of no quantity, or declare one otherwise.

    quantities: those that were declared before; what the rows declare is added.
    """
    for head in heads:
        if head.kind == DECLARE:
            quantity = declared_by(head)
            if quantities.setdefault(quantity.name, quantity) != quantity:
                before = quantities[quantity.name]
                yield misdeclared(path, head, f"{quantity}, which was declared as {before}")
        elif head.kind in (OBSERVE, MEMBER):
            for name, steps in annotation_of(head.attributes).values:
                known = quantities.get(name)
                if known is None or steps > known.steps:
                    yield misdeclared(path, head, f"a value of {name!r}, {steps} steps, of {known or 'no quantity'}")


def misdeclared(path: Path, row: Head, what: str) -> DamageError:
    """The error for a row that has something that cannot be after the rows before it."""
    return DamageError(
        f"row {row.sequence} of {path} has {what}: it is damaged, or was made by another program (scroll-tactile "
        "memory check)",
        path=path,
        sequence=row.sequence,
    )
