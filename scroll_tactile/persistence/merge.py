"""Merging another memory into ours: which of its rows are appended, which are left out, and which are refused."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel
from scroll_tactile_store import Checkpoint, Head, Store
from scroll_tactile_store.files import same_folder

from scroll_tactile.errors import AnnotationError, DescriptionError, MismatchError, ObservationError
from scroll_tactile.memory.descriptions import Description, describe, require_units
from scroll_tactile.memory.identity import EmbeddingIdentity, Identity
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import (
    DECLARE,
    DESCRIBE,
    LABELS,
    MEMBER,
    MERGE,
    OBSERVE,
    RETRACT,
    SOURCE,
    VALUES,
    active_rows,
    annotation_of,
    declaration,
)
from scroll_tactile.persistence.contents import ListedContents, Rows, StoredContents, refusal
from scroll_tactile.persistence.packing import sums_without
from scroll_tactile.persistence.replaying import append_row
from scroll_tactile.quantities import Quantity, require_declarable
from scroll_tactile.validation.expected import quantities_of
from scroll_tactile.validation.gate import MemoryStore, wrong_retractions, wrong_values

__all__ = ["Choice", "MergePlan", "MergeRules"]

Choice = Literal["same", "ours", "theirs"]
"""Whose description of a material is kept where two memories describe it; "same": they must agree."""


@dataclass(frozen=True)
class MergeRules:
    """How another memory is merged into ours.

    one_name: as in learning from files, a content has one name, the first in either memory: touches under another name
    are refused. clipped: contents that clipping produced; their refusals mention it. default_source: for touches
    without a source.
    """

    one_name: bool = False
    descriptions: Choice = "same"
    clipped: Collection[bytes] = ()
    default_source: str | None = None


@dataclass(frozen=True)
class MergePlan:
    """What a merge will append to our journal, in order.

    source: the other memory. rows: heads of its journal that are appended. compaction: its compaction checkpoint, which
    stands for the rows that it compacted. shared: how many streams both observed, or the other has twice. left_out:
    rows that are not appended: shared streams, and refused ones. refused: touches that have another name already, each
    with the reason. descriptions: material → the description that is taken over. quantities: that ours lacks.
    default_source: see `MergeRules`. newest: its newest checkpoint, whose sums may be added in place of its rows.
    """

    source: MemoryStore
    compaction: Checkpoint | None
    rows: list[Head]
    shared: int
    left_out: set[int]
    refused: list[tuple[Head, str]]
    descriptions: dict[str, Description]
    quantities: list[Quantity]
    default_source: str | None
    newest: Checkpoint | None

    @classmethod
    def of(
        cls,
        ours: Store,
        memory: Memory,
        theirs: MemoryStore,
        contents: ListedContents | StoredContents,
        rules: MergeRules,
    ) -> Self:
        """Plan a merge from both journals. contents: which touches ours has.

        Raises MismatchError where the two recipes differ, a quantity's unit or range, the annotation of a shared
        stream, or their descriptions and `descriptions` is "same"; ObservationError where a touch that must be
        left out was compacted; DamageError for a damaged row of theirs, and for a shared stream whose readings do not
        hash to its key, in either memory.
        """
        _require_mergeable(ours, memory, theirs)
        compacted, found, heads = theirs.compacted, theirs.compaction(), list(theirs.heads())
        quantities = _quantities(ours, memory, theirs, found, heads)
        incoming = active_rows(heads)
        declared = memory.quantities | {quantity.name: quantity for quantity in quantities}
        known, refused = _already_there(incoming, contents, ours.path, compacted, rules, declared)
        if refused and not rules.one_name:
            raise MismatchError(f"{theirs.path} cannot be merged into {ours.path}: {refused[0][1]}")
        left_out = {*known, *(head.sequence for head, _ in refused)}
        out = [head for head in incoming if head.sequence in left_out]
        if fixed := [head for head in out if head.sequence <= compacted or head.kind == MEMBER]:
            raise _cannot_be_left_out(ours, theirs, fixed, refused)
        rows = [head for head in incoming if head.sequence not in left_out]
        bare = [head for head in rows if head.kind == OBSERVE and "nbytes" not in head.attributes]
        if bare and memory.exemplars is not None:
            raise MismatchError(
                f"{theirs.path} kept no readings of what it observed (exemplars=0), of which {ours.path} keeps "
                "exemplars: touch it again, or merge into a memory made with exemplars=0"
            )
        described = _descriptions(ours, memory, theirs, found, rules.descriptions)
        newest = _require_sound(theirs, heads, coming={head.sequence for head in rows})
        for sequence in known.values():
            if sequence > ours.compacted and next(ours.heads(sequence - 1)).kind == OBSERVE:
                ours.record(sequence)
        source = rules.default_source
        return cls(theirs, found, rows, len(known), left_out, refused, described, quantities, source, newest)

    def append_to(self, ours: Store, memory: Memory, progress: Callable[[int, int], object]) -> int:
        """Append the rows to our journal and add them to our memory; returns the number of observations added.

        The caller opens a batch around it: where one row does not pass the gate none is kept. progress: called with
        (rows done, rows in all).
        """
        compaction = self.compaction
        # A compaction checkpoint comes in as one row, and the merges before it are a part of it.
        part = (
            0
            if compaction is None
            else sum(head.kind == MERGE and head.sequence <= compaction.last_sequence for head in self.rows) - 1
        )
        total = len(self.rows) - part
        for quantity in self.quantities:
            append_row(memory, ours, DECLARE, quantity.name, attributes=declaration(quantity))
        for material, description in self.descriptions.items():
            append_row(memory, ours, DESCRIBE, material, attributes={"constituents": description})
        sums = self._sums(memory)
        for done, (kind, label, key, attributes, arrays, time) in enumerate(self._rows_to_append(compaction), start=1):
            if sums is None:
                append_row(memory, ours, kind, label, key, attributes=attributes, arrays=arrays, time=time)
            else:
                head = ours.append(kind, label, key, attributes=attributes, arrays=arrays, time=time)
                if memory.exemplars is not None and "nbytes" in attributes:
                    memory.exemplars.add(label, key, head.sequence)
                memory.sequence = head.sequence
            progress(done, total)
        if sums is not None:
            memory.join(sums, exemplars=False)
        return sum(head.kind in (OBSERVE, MEMBER) for head in self.rows)

    def _sums(self, memory: Memory) -> Memory | None:
        """The sums of the rows that come in, from the packed memory's own; None where the rows must be replayed."""
        source = self.source
        if self.newest is None or source.compacted:
            return None
        if memory.kept is not None and Identity.read(source).kept_touches != memory.kept.capacity:
            return None
        return sums_without(source, self.newest, memory, self.left_out)

    def _rows_to_append(
        self, compaction: Checkpoint | None
    ) -> Iterator[tuple[str, str, bytes, Any, Any, float | None]]:
        if compaction is not None:
            left_out = ("tuned", "corrections", "descriptions")  # these stay there, and descriptions come as rows
            attributes = {name: value for name, value in compaction.attributes.items() if not name.startswith(left_out)}
            arrays = {name: array for name, array in compaction.arrays.items() if not name.startswith("tuned")}
            yield MERGE, "", b"", attributes, arrays, self.rows[0].time if self.rows else None
        for head in self.rows:
            if compaction is not None and head.sequence <= compaction.last_sequence:
                if head.kind != MERGE:  # a merge before the compaction checkpoint is a part of it
                    attributes = self._attributes_of(head)
                    kept = {name: value for name, value in attributes.items() if name in (SOURCE, VALUES, LABELS)}
                    yield MEMBER, head.label, head.key, kept, None, head.time
            else:
                record = self.source.record(head.sequence)
                yield head.kind, head.label, head.key, self._attributes_of(head), record.arrays, head.time

    def _attributes_of(self, head: Head) -> dict[str, Any]:
        touch = head.kind in (OBSERVE, MEMBER) and self.default_source is not None
        return {**({SOURCE: self.default_source} if touch else {}), **head.attributes}


def _quantities(
    ours: Store, memory: Memory, theirs: MemoryStore, compaction: Checkpoint | None, heads: Sequence[Head]
) -> list[Quantity]:
    """Their quantities that ours lacks. Raises MismatchError where one is another under the same name."""
    declared = quantities_of({} if compaction is None else compaction.attributes)
    for wrong in wrong_values(theirs.path, (head for head in heads if head.sequence > theirs.compacted), declared):
        raise wrong
    both = dict(memory.quantities)
    for name, quantity in sorted(declared.items()):
        try:
            require_declarable(both, quantity)
        except AnnotationError as error:
            raise MismatchError(f"{theirs.path} cannot be merged into {ours.path}: {error}") from None
        both[name] = quantity
    return [quantity for name, quantity in both.items() if name not in memory.quantities]


def _already_there(
    incoming: Sequence[Head],
    contents: ListedContents | StoredContents,
    where: Path,
    compacted: int,
    rules: MergeRules,
    declared: Mapping[str, Quantity],
) -> tuple[dict[int, int], list[tuple[Head, str]]]:
    """The touches that our memory, or an earlier row of theirs, has under the same name: their row → ours, 0 of theirs.

    Also those that are refused, each with the reason: these have other values or labels there, or by `one_name`
    another name. where: our memory. compacted: rows of theirs that cannot be left out.
    """
    came: dict[bytes, Rows] = {}
    known: dict[int, int] = {}
    refused: list[tuple[Head, str]] = []
    for head in (head for head in incoming if head.kind != MERGE):
        ours, theirs = contents.rows(head.key), came.setdefault(head.key, {})
        there, annotation = ours.get(head.label) or theirs.get(head.label), annotation_of(head.attributes)
        why = refusal(list(ours or theirs), head.label, head.key in rules.clipped) if rules.one_name else None
        if why is None and annotation and there is not None and annotation != there[1]:
            why = (
                f"row {there[0]} of {where if head.label in ours else 'the same memory'} has this touch of "
                f"{head.label!r} with {there[1].shown(declared)}; row {head.sequence} comes with "
                f"{annotation.shown(declared)}: retract one of them"
            )
        if why is not None:
            refused.append((head, why))
        elif head.label in ours:
            known[head.sequence] = ours[head.label][0]
        elif there is None:
            theirs[head.label] = head.sequence, annotation
        elif head.kind == OBSERVE and head.sequence > compacted:
            known[head.sequence] = 0
    return known, refused


def _cannot_be_left_out(
    ours: Store, theirs: MemoryStore, fixed: Sequence[Head], refused: Sequence[tuple[Head, str]]
) -> ObservationError:
    named = {head.sequence: why for head, why in refused}
    if why := named.get(fixed[0].sequence):
        more = f" (and {len(fixed) - 1} more of its touches)" if len(fixed) > 1 else ""
        return ObservationError(f"{why}{more}; {theirs.path} was compacted, and none of them can be left out")
    return ObservationError(
        f"{len(fixed)} streams that both observed, such as one of {fixed[0].label!r}, cannot be left out: "
        f"{theirs.path} was compacted, and their features given up there. Merge the other way round, if {ours.path} "
        "was not compacted"
    )


def _descriptions(
    ours: Store, memory: Memory, theirs: MemoryStore, compaction: Checkpoint | None, choice: Choice
) -> dict[str, Description]:
    """Their descriptions that are taken over."""
    told: Mapping[str, Any] = {} if compaction is None else compaction.attributes
    theirs_now: dict[str, Description] = dict(told.get("descriptions", {}))
    for head in theirs.heads(0 if compaction is None else compaction.last_sequence):
        if head.kind in (DESCRIBE, RETRACT):
            describe(theirs_now, head.label, head.attributes.get("constituents"))
    ours_now = memory.descriptions
    new = {name: theirs_now[name] for name in sorted(theirs_now) if repr(ours_now.get(name)) != repr(theirs_now[name])}
    differing = [name for name in new if name in ours_now]
    if differing and choice == "same":
        name = differing[0]
        raise MismatchError(
            f"{len(differing)} materials are described differently in {ours.path} and {theirs.path}, such as {name!r}: "
            f"here it is {ours_now[name]}, there {new[name]}. Choose with descriptions='ours' or 'theirs'"
        )
    taken = {name: new[name] for name in new if choice != "ours" or name not in ours_now}
    for name, description in taken.items():
        try:
            require_units({**ours_now, **taken}, name, description)
        except DescriptionError as error:
            raise MismatchError(f"{theirs.path} cannot be merged into {ours.path}: {error}") from None
    return taken


def _require_mergeable(ours: Store, memory: Memory, theirs: MemoryStore) -> None:
    if same_folder(ours.path, theirs.path):
        raise MismatchError(f"{ours.path} cannot be merged into itself: it has all of it already")
    mine, other = Identity.read(ours), Identity.read(theirs)
    for part in ("sensor", "embedding", "reading", "views", "grid"):
        own, incoming = (_without_configuration(getattr(identity, part)) for identity in (mine, other))
        if own != incoming:
            raise MismatchError(
                f"{theirs.path} cannot be merged into {ours.path}: their {part.removesuffix('s')}s differ. Here it is "
                f"{_formatted(own)}, there {_formatted(incoming)}. Merge memories of one sensor and one embedding"
            )
    whole = theirs.compacted or any(True for _ in theirs.heads(kind=MERGE))
    if whole and memory.exemplars is not None and mine.exemplars != other.exemplars:
        raise MismatchError(
            f"{theirs.path} was compacted and keeps exemplars {other.exemplars}; "
            f"{ours.path} keeps {mine.exemplars}, and the readings for the others are gone"
        )
    if whole and memory.kept is not None and mine.kept_touches != other.kept_touches:
        raise MismatchError(
            f"{theirs.path} was compacted and keeps {other.kept_touches} touches to match with; {ours.path} keeps "
            f"{mine.kept_touches}, and the readings for the others are gone"
        )


def _require_sound(theirs: MemoryStore, heads: Sequence[Head], coming: Set[int]) -> Checkpoint | None:
    """Their newest checkpoint. Verifies the rows that stay behind, too: raises DamageError where one fails the gate."""
    for wrong in wrong_retractions(theirs.path, heads):
        raise wrong
    for head in heads:
        if head.kind in (OBSERVE, MERGE) and head.sequence > theirs.compacted and head.sequence not in coming:
            theirs.record(head.sequence)
    return theirs.latest()


def _without_configuration(part: Any) -> Any:
    """A part of an identity; an embedding's without its configuration, as its weights' file may have any name."""
    return part.model_copy(update={"configuration": None}) if isinstance(part, EmbeddingIdentity) else part


def _formatted(part: Any) -> str:
    if not isinstance(part, BaseModel):
        return repr(part)
    fields = ((name, getattr(part, name)) for name in type(part).model_fields)
    shown = ((name, value[:12] if name == "fingerprint" else value) for name, value in fields)
    return ", ".join(f"{name} {value!r}" for name, value in shown if value is not None)
