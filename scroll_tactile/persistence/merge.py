"""Merging another memory into ours: which of its rows are appended, which are left out, and which are refused."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
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
    declared_by,
)
from scroll_tactile.persistence.observations import TouchRows, refusal, rows_with
from scroll_tactile.persistence.packing import sums_without
from scroll_tactile.persistence.ram_store import AnyStore
from scroll_tactile.quantities import Quantity, require_declarable
from scroll_tactile.validation.expected import quantities_of

__all__ = ["Choice", "MergePlan", "MergeRules"]

MEMBERS = SOURCE, VALUES, LABELS  # attributes of an observation that stay where it comes in without its features
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

    source: the other memory. compaction: its compaction checkpoint, which stands for the rows that it compacted. heads:
    all of its rows. rows: those that come in. shared: how many streams both observed, or the other has twice. left_out:
    rows that do not come in: shared streams, and refused ones. refused: touches that have another name already, each
    with the reason. descriptions: material → the description that is taken over. quantities: that ours lacks.
    default_source: see `MergeRules`.
    """

    source: AnyStore
    compaction: Checkpoint | None
    heads: list[Head]
    rows: list[Head]
    shared: int
    left_out: set[int]
    refused: list[tuple[Head, str]]
    descriptions: dict[str, Description]
    quantities: list[Quantity]
    default_source: str | None

    @classmethod
    def of(cls, ours: AnyStore, memory: Memory, theirs: AnyStore, rules: MergeRules) -> Self:
        """Plan a merge from both journals.

        Raises MismatchError where the two recipes differ, a quantity's unit or range, the annotation of a shared
        stream, or their descriptions and `descriptions` is "same"; ObservationError where a touch that must be
        left out was compacted; DamageError for a damaged row of theirs.
        """
        _require_mergeable(ours, memory, theirs)
        compacted, found, heads = theirs.compacted, theirs.compaction(), list(theirs.heads())
        quantities = _quantities(ours, memory, theirs, found, heads)
        incoming = active_rows(heads)
        declared = memory.quantities | {quantity.name: quantity for quantity in quantities}
        known, refused = _already_there(incoming, ours, memory, compacted, rules, declared)
        if refused and not rules.one_name:
            raise MismatchError(f"{theirs.path} cannot be merged into {ours.path}: {refused[0][1]}")
        left_out = {*known, *(head.sequence for head, _ in refused)}
        out = [head for head in incoming if head.sequence in left_out]
        if fixed := [head for head in out if head.sequence <= compacted or head.kind == MEMBER]:
            raise _cannot_be_left_out(ours, theirs, fixed, refused)
        # A merge before the compaction checkpoint is a part of it.
        within = [head.sequence for head in incoming if head.kind == MERGE and head.sequence <= compacted]
        rows = [head for head in incoming if head.sequence not in left_out.union(within)]
        bare = [head for head in rows if head.kind == OBSERVE and "nbytes" not in head.attributes]
        if bare and memory.exemplars is not None:
            raise MismatchError(
                f"{theirs.path} kept no readings of what it observed (exemplars=0), of which {ours.path} keeps "
                "exemplars: touch it again, or merge into a memory made with exemplars=0"
            )
        described = _descriptions(ours, memory, theirs, found, heads, rules.descriptions)
        source = rules.default_source
        return cls(theirs, found, heads, rows, len(known), left_out, refused, described, quantities, source)

    @property
    def added(self) -> int:
        """How many observations come in."""
        return sum(head.kind in (OBSERVE, MEMBER) for head in self.rows)

    def sums(self, memory: Memory) -> Memory | None:
        """The sums of the rows that come in, from those of the other memory; None where the rows must be replayed.

        Raises DamageError.
        """
        if self.compaction is not None or len(self.left_out) > len(self.rows):
            return None
        if memory.kept is not None and Identity.read(self.source).kept_touches != memory.kept.capacity:
            return None
        return sums_without(self.source, self.heads, memory, self.left_out)

    @property
    def total(self) -> int:
        """How many rows `rows_to_append` gives."""
        return len(self.quantities) + len(self.descriptions) + (self.compaction is not None) + len(self.rows)

    def rows_to_append(self) -> Iterator[dict[str, Any]]:
        """The rows that come in, each as the arguments of `Ledger`'s append."""
        for quantity in self.quantities:
            yield {"kind": DECLARE, "label": quantity.name, "attributes": declaration(quantity)}
        for material, description in self.descriptions.items():
            yield {"kind": DESCRIBE, "label": material, "attributes": {"constituents": description}}
        if (compaction := self.compaction) is not None:
            left_out = ("tuned", "corrections", "descriptions")  # these stay there, and descriptions come as rows
            attributes = {name: value for name, value in compaction.attributes.items() if not name.startswith(left_out)}
            arrays = {name: array for name, array in compaction.arrays.items() if not name.startswith("tuned")}
            time = self.rows[0].time if self.rows else None
            yield {"kind": MERGE, "label": "", "attributes": attributes, "arrays": arrays, "time": time}
        for head in self.rows:
            row = {"label": head.label, "key": head.key, "time": head.time}
            attributes = self._attributes_of(head)
            if compaction is None or head.sequence > compaction.last_sequence:
                arrays = dict(self.source.record(head.sequence).arrays)
                yield row | {"kind": head.kind, "attributes": attributes, "arrays": arrays}
            else:
                kept = {name: value for name, value in attributes.items() if name in MEMBERS}
                yield row | {"kind": MEMBER, "attributes": kept}

    def _attributes_of(self, head: Head) -> dict[str, Any]:
        touch = head.kind in (OBSERVE, MEMBER) and self.default_source is not None
        return {**({SOURCE: self.default_source} if touch else {}), **head.attributes}


def _quantities(
    ours: AnyStore, memory: Memory, theirs: AnyStore, compaction: Checkpoint | None, heads: Sequence[Head]
) -> list[Quantity]:
    """Their quantities that ours lacks. Raises MismatchError where one is another under the same name."""
    declared = quantities_of({} if compaction is None else compaction.attributes)
    declared |= {head.label: declared_by(head) for head in heads if head.kind == DECLARE}
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
    store: AnyStore,
    memory: Memory,
    compacted: int,
    rules: MergeRules,
    declared: Mapping[str, Quantity],
) -> tuple[dict[int, int], list[tuple[Head, str]]]:
    """The touches that our memory, or an earlier row of theirs, has under the same name: their row → ours, 0 of theirs.

    Also those that are refused, each with the reason: these have other values or labels there, or by `one_name`
    another name. store, memory: ours. compacted: rows of theirs that cannot be left out.
    """
    came: dict[bytes, TouchRows] = {}
    known: dict[int, int] = {}
    refused: list[tuple[Head, str]] = []
    for head in (head for head in incoming if head.kind != MERGE):
        ours, theirs = rows_with(store, memory, head.key), came.setdefault(head.key, {})
        there, annotation = ours.get(head.label) or theirs.get(head.label), annotation_of(head.attributes)
        why = refusal(list(ours or theirs), head.label, head.key in rules.clipped) if rules.one_name else None
        if why is None and annotation and there is not None and annotation != there[1]:
            why = (
                f"row {there[0]} of {store.path if head.label in ours else 'the same memory'} has this touch of "
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
    ours: AnyStore, theirs: AnyStore, fixed: Sequence[Head], refused: Sequence[tuple[Head, str]]
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
    ours: AnyStore,
    memory: Memory,
    theirs: AnyStore,
    compaction: Checkpoint | None,
    heads: Sequence[Head],
    choice: Choice,
) -> dict[str, Description]:
    """Their descriptions that are taken over."""
    told: Mapping[str, Any] = {} if compaction is None else compaction.attributes
    theirs_now: dict[str, Description] = dict(told.get("descriptions", {}))
    for head in heads:
        if head.kind in (DESCRIBE, RETRACT) and head.sequence > theirs.compacted:
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


def _require_mergeable(ours: AnyStore, memory: Memory, theirs: AnyStore) -> None:
    if isinstance(theirs, Store) and same_folder(ours.path, theirs.path):
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


def _without_configuration(part: Any) -> Any:
    """A part of an identity; an embedding's without its configuration, as its weights' file may have any name."""
    return part.model_copy(update={"configuration": None}) if isinstance(part, EmbeddingIdentity) else part


def _formatted(part: Any) -> str:
    if not isinstance(part, BaseModel):
        return repr(part)
    fields = ((name, getattr(part, name)) for name in type(part).model_fields)
    shown = ((name, value[:12] if name == "fingerprint" else value) for name, value in fields)
    return ", ".join(f"{name} {value!r}" for name, value in shown if value is not None)
