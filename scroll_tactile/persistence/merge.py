"""Merging another memory into ours: which of its rows are appended, which are left out, and which are refused."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from scroll_tactile_store import Head, Store
from scroll_tactile_store.files import same_folder

from scroll_tactile.errors import MismatchError, ObservationError
from scroll_tactile.memory.descriptions import Description
from scroll_tactile.memory.identity import EmbeddingIdentity, Identity
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import (
    LABELS,
    MEMBER,
    MERGE,
    OBSERVE,
    SOURCE,
    VALUES,
    active_rows,
    annotation_of,
)
from scroll_tactile.persistence.observations import TouchRows, refusal, rows_with
from scroll_tactile.persistence.ram_store import AnyStore
from scroll_tactile.persistence.replaying import load, note, refill
from scroll_tactile.statistics.annotations import MOST_AXES

__all__ = ["Choice", "Merge", "MergeRules"]

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


class Merge:
    """A merge of another memory into ours: what it will append to our journal, in order.

    ours, memory: our journal and what it holds. theirs: the journal of the other.

    shared: how many streams both observed, or the other has twice; they do not come in. refused: nor do touches that
    have another name already, each with the reason. quantities: theirs. descriptions: material → the description that
    is taken over.

    Raises MismatchError where the two recipes differ, a quantity's unit or range, the annotation of a shared stream, or
    their descriptions and `descriptions` is "same"; ObservationError where a touch that must be left out was compacted;
    DamageError for a damaged row of theirs.
    """

    def __init__(self, ours: AnyStore, memory: Memory, theirs: AnyStore, rules: MergeRules) -> None:
        self._ours, self._memory, self._theirs, self._rules = ours, memory, theirs, rules
        self._compacted, self._compaction, self._heads = theirs.compacted, theirs.compaction(), list(theirs.heads())
        incoming = active_rows(self._heads)
        self._require_same_making(whole=bool(self._compacted) or any(head.kind == MERGE for head in self._heads))
        said = memory.empty_like()
        if self._compaction is not None:
            said.fill(self._compaction, theirs.path)
        for head in self._heads:
            if head.sequence > self._compacted:
                note(said, head)
        self.quantities = list(said.quantities.values())
        known, self.refused = self._there(incoming)
        self.shared = len(known)
        if self.refused and not rules.one_name:
            raise self.refusing(self.refused[0][1])
        self._left_out = {*known, *(head.sequence for head, _ in self.refused)}
        self._require_able_to_leave_out([head for head in incoming if head.sequence in self._left_out])
        # A merge before the compaction checkpoint is a part of it.
        within = {head.sequence for head in incoming if head.kind == MERGE and head.sequence <= self._compacted}
        self._rows = [head for head in incoming if head.sequence not in self._left_out | within]
        if memory.exemplars is not None and any(
            head.kind == OBSERVE and "nbytes" not in head.attributes for head in self._rows
        ):
            raise MismatchError(
                f"{theirs.path} kept no readings of what it observed (exemplars=0), of which {ours.path} keeps "
                "exemplars: touch it again, or merge into a memory made with exemplars=0"
            )
        self.descriptions = self._chosen_descriptions(said.descriptions)
        theirs_too = {axis for head in self._rows for axis, _ in annotation_of(head.attributes).labels}
        if len(axes := {*memory.targets.axes, *said.targets.axes, *theirs_too}) > MOST_AXES:
            raise MismatchError(
                f"expected labels on at most {MOST_AXES} axes in both memories together; came {len(axes)}: forget the "
                "touches with labels on some in one of them first"
            )

    @property
    def added(self) -> int:
        """How many observations come in."""
        return sum(head.kind in (OBSERVE, MEMBER) for head in self._rows)

    @property
    def total(self) -> int:
        """How many rows it appends."""
        return (self._compaction is not None) + len(self._rows)

    def rows(self) -> Iterator[dict[str, Any]]:
        """The rows that it appends, each as the arguments of `Ledger`'s append."""
        if (compaction := self._compaction) is not None:
            left_out = ("tuned", "corrections", "descriptions")  # these stay there, and descriptions come as rows
            attributes = {name: value for name, value in compaction.attributes.items() if not name.startswith(left_out)}
            arrays = {name: array for name, array in compaction.arrays.items() if not name.startswith("tuned")}
            time = self._rows[0].time if self._rows else None
            yield {"kind": MERGE, "label": "", "attributes": attributes, "arrays": arrays, "time": time}
        for head in self._rows:
            row = {"label": head.label, "key": head.key, "time": head.time}
            attributes, source = dict(head.attributes), self._rules.default_source
            if head.kind != MERGE and source is not None:
                attributes = {SOURCE: source} | attributes
            if head.sequence > self._compacted:
                arrays = dict(self._theirs.record(head.sequence).arrays)
                yield row | {"kind": head.kind, "attributes": attributes, "arrays": arrays}
            else:
                kept = {name: value for name, value in attributes.items() if name in MEMBERS}
                yield row | {"kind": MEMBER, "attributes": kept}

    def sums(self) -> Memory | None:
        """The sums of the rows that come in, from those of the other memory; None where the rows must be replayed.

        Raises DamageError.
        """
        kept = self._memory.kept
        fewer = kept is not None and Identity.read(self._theirs).kept_touches != kept.capacity
        if fewer or self._compaction is not None or len(self._left_out) > len(self._rows):
            return None
        sums = load(self._memory, self._theirs)
        for sequence in self._left_out:
            sums.retract(self._theirs.record(sequence))
        refill(sums, self._theirs)
        return sums

    def refusing(self, why: object) -> MismatchError:
        """The error that says why the other memory cannot be merged."""
        return MismatchError(f"{self._theirs.path} cannot be merged into {self._ours.path}: {why}")

    def _require_same_making(self, whole: bool) -> None:
        """whole: whether memories that were compacted come in."""
        ours, theirs = self._ours.path, self._theirs.path
        if isinstance(self._theirs, Store) and same_folder(ours, theirs):
            raise MismatchError(f"{ours} cannot be merged into itself: it has all of it already")
        mine, other = Identity.read(self._ours), Identity.read(self._theirs)
        for part in ("sensor", "embedding", "reading", "views", "grid"):
            own, incoming = (_without_configuration(getattr(identity, part)) for identity in (mine, other))
            if own != incoming:
                raise self.refusing(
                    f"their {part.removesuffix('s')}s differ. Here it is {own}, there {incoming}. Merge memories of "
                    "one sensor and one embedding"
                )
        for what, kept in (("exemplars", self._memory.exemplars), ("kept_touches", self._memory.kept)):
            if whole and kept is not None and getattr(mine, what) != getattr(other, what):
                raise MismatchError(
                    f"{theirs} was compacted and keeps {what} {getattr(other, what)}; {ours} keeps "
                    f"{getattr(mine, what)}, and the readings for the others are gone"
                )

    def _there(self, incoming: Sequence[Head]) -> tuple[set[int], list[tuple[Head, str]]]:
        """Their rows of touches that ours has under the same name, or an earlier row of theirs.

        Also those that are refused, each with the reason: these have other values or labels there, or by `one_name`
        another name.
        """
        declared = {quantity.name: quantity for quantity in self.quantities} | self._memory.quantities
        came: dict[bytes, TouchRows] = {}
        known: set[int] = set()
        refused: list[tuple[Head, str]] = []
        for head in (head for head in incoming if head.kind != MERGE):
            ours, theirs = rows_with(self._ours, self._memory, head.key), came.setdefault(head.key, {})
            there, annotation = ours.get(head.label) or theirs.get(head.label), annotation_of(head.attributes)
            why = None
            if self._rules.one_name:
                why = refusal(list(ours or theirs), head.label, head.key in self._rules.clipped)
            if why is None and annotation and there is not None and annotation != there[1]:
                why = (
                    f"row {there[0]} of {self._ours.path if head.label in ours else 'the same memory'} has this touch "
                    f"of {head.label!r} with {there[1].shown(declared)}; row {head.sequence} comes with "
                    f"{annotation.shown(declared)}: retract one of them"
                )
            if why is not None:
                refused.append((head, why))
            elif there is None:
                theirs[head.label] = head.sequence, annotation
            elif head.label in ours or (head.kind == OBSERVE and head.sequence > self._compacted):
                known.add(head.sequence)
        return known, refused

    def _require_able_to_leave_out(self, rows: Sequence[Head]) -> None:
        fixed = [head for head in rows if head.sequence <= self._compacted or head.kind == MEMBER]
        if fixed:
            both = "both have it; merge the other way round, if ours was not compacted"
            why = {head.sequence: why for head, why in self.refused}.get(fixed[0].sequence, both)
            raise ObservationError(
                f"{len(fixed)} touches, such as one of {fixed[0].label!r}, cannot be left out of "
                f"{self._theirs.path}, which was compacted, and their features given up: {why}"
            )

    def _chosen_descriptions(self, theirs: Mapping[str, Description]) -> dict[str, Description]:
        """Their descriptions that are taken over."""
        ours = self._memory.descriptions
        new = {name: theirs[name] for name in sorted(theirs) if repr(ours.get(name)) != repr(theirs[name])}
        differing = [name for name in new if name in ours]
        if differing and self._rules.descriptions == "same":
            name = differing[0]
            raise MismatchError(
                f"{len(differing)} materials are described differently in {self._ours.path} and {self._theirs.path}, "
                f"such as {name!r}: here it is {ours[name]}, there {new[name]}. Choose with descriptions='ours' or "
                "'theirs'"
            )
        return {name: new[name] for name in new if self._rules.descriptions != "ours" or name not in ours}


def _without_configuration(part: Any) -> Any:
    """A part of an identity; an embedding's without its configuration, as its weights' file may have any name."""
    return part.model_copy(update={"configuration": None}) if isinstance(part, EmbeddingIdentity) else part
