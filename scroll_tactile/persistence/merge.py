"""Memories that travel: merging another into ours, whose rows come in, are left out or refused; and packing one."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from copy import copy
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from scroll_tactile_store import Head, Store
from scroll_tactile_store.archive import write_archive
from scroll_tactile_store.exceptions import reported
from scroll_tactile_store.files import same_folder

from scroll_tactile.errors import MismatchError, ObservationError
from scroll_tactile.memory.descriptions import Description
from scroll_tactile.memory.identity import Identity, differences
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import Kind, active_rows, annotation_of
from scroll_tactile.persistence.observations import TouchRows, refusal, rows_with
from scroll_tactile.persistence.ram_store import AnyStore
from scroll_tactile.persistence.replaying import exemplar_candidates, load, refill
from scroll_tactile.statistics.annotations import MOST_AXES

__all__ = ["Choice", "Merge", "pack_memory"]

# Attributes of an observation that stay where it comes in without its features.
MEMBERS = "source", "values", "labels"
Choice = Literal["same", "ours", "theirs"]
"""Whose description of a material is kept where two memories describe it; "same": they must agree."""


class Merge:
    """A merge of another memory into ours: what it will append to our journal, in order.

    ours, memory: our journal and what it holds. theirs: the journal of the other. choice: of descriptions. one_name: as
    in learning from files, a content has one name, the first in either memory: touches under another name are refused.
    clipped: contents that clipping produced; their refusals mention it. source: for touches without one.

    total: how many rows come in. added: how many of them are observations. shared: how many streams both observed, or
    the other has twice; they do not come in. refused: nor do touches that have another name already, each with the
    reason. quantities: theirs. descriptions: material → the description that is taken over. sums: those of the rows
    that come in; None where the rows must be applied one by one.

    Raises MismatchError where the two recipes differ, a quantity's unit or range, the annotation of a shared stream, or
    their descriptions and `descriptions` is "same"; ObservationError where a touch that must be left out was compacted;
    DamageError for a damaged row of theirs.
    """

    def __init__(
        self,
        ours: AnyStore,
        memory: Memory,
        theirs: AnyStore,
        *,
        choice: Choice,
        one_name: bool = False,
        clipped: Collection[bytes] = (),
        source: str | None = None,
    ) -> None:
        self._ours, self._memory, self._theirs, self._source = ours, memory, theirs, source
        self._one_name, self._clipped = one_name, clipped
        self._compacted, self._compaction, heads = theirs.compacted, theirs.compaction(), list(theirs.heads())
        incoming = active_rows(heads)
        whole = bool(self._compacted) or any(head.kind == Kind.MERGE for head in heads)
        self._require_same_making(whole)
        said = load(memory, theirs)
        self.quantities = list(said.quantities.values())
        known, self.refused = self._there(incoming)
        self.shared = len(known)
        if self.refused and not one_name:
            raise self.refusing(self.refused[0][1])
        self._left_out = {*known, *(head.sequence for head, _ in self.refused)}
        self._require_able_to_leave_out([head for head in incoming if head.sequence in self._left_out])
        # A merge before the compaction checkpoint is a part of it.
        within = {head.sequence for head in incoming if head.kind == Kind.MERGE and head.sequence <= self._compacted}
        self._rows = [head for head in incoming if head.sequence not in self._left_out | within]
        self.added = sum(head.kind != Kind.MERGE for head in self._rows)
        self.total = (self._compaction is not None) + len(self._rows)
        bare = any(head.kind == Kind.OBSERVE and "nbytes" not in head.attributes for head in self._rows)
        if bare and memory.exemplars is not None:
            raise MismatchError(
                f"{theirs.path} kept no readings of what it observed (exemplars=0), of which {ours.path} keeps "
                "exemplars: touch it again, or merge into a memory made with exemplars=0"
            )
        self.descriptions = self._chosen_descriptions(said.descriptions, choice)
        theirs_too = {axis for head in self._rows for axis, _ in annotation_of(head.attributes).labels}
        if len(axes := {*memory.targets.axes, *said.targets.axes, *theirs_too}) > MOST_AXES:
            raise MismatchError(
                f"expected labels on at most {MOST_AXES} axes in both memories together; came {len(axes)}: forget the "
                "touches with labels on some in one of them first"
            )
        # Rows are applied one by one where that is less, with what was compacted, and if their writer has gone on.
        read = [head.sequence for head in heads[-1:]] == [said.sequence] and not whole
        self.sums = self._summed(said) if read and len(self._left_out) <= len(self._rows) else None

    def _summed(self, whole: Memory) -> Memory:
        """The sums of the rows that come in, from those of the whole other memory. Raises DamageError."""
        for sequence in self._left_out:
            whole.retract(self._theirs.record(sequence))
        kept = self._memory.kept
        whole.stale |= kept is not None and Identity.read(self._theirs).kept_touches != kept.capacity
        refill(whole, self._theirs)
        return whole

    def rows(self) -> Iterator[dict[str, Any]]:
        """The rows that it appends, each as the arguments of `Ledger`'s append."""
        if (compaction := self._compaction) is not None:
            left_out = ("tuned", "corrections", "descriptions")  # these stay there, and descriptions come as rows
            attributes = {name: value for name, value in compaction.attributes.items() if not name.startswith(left_out)}
            arrays = {name: array for name, array in compaction.arrays.items() if not name.startswith("tuned")}
            row: dict[str, Any] = {"kind": Kind.MERGE, "label": "", "attributes": attributes, "arrays": arrays}
            yield row | {"time": self._rows[0].time if self._rows else None}
        for head in self._rows:
            named = {} if self._source is None or head.kind == Kind.MERGE else {"source": self._source}
            attributes = named | dict(head.attributes)
            row = {"kind": head.kind, "label": head.label, "key": head.key, "time": head.time}
            if head.sequence > self._compacted:
                yield row | {"attributes": attributes, "arrays": dict(self._theirs.record(head.sequence).arrays)}
            else:
                kept = {name: value for name, value in attributes.items() if name in MEMBERS}
                yield row | {"kind": Kind.MEMBER, "attributes": kept}

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
            if differing := differences(part, getattr(other, part), getattr(mine, part)):
                raise self.refusing(
                    f"their {part.removesuffix('s')}s differ: {differing}. Merge those of one sensor and one embedding"
                )
        for what, kept in (("exemplars", self._memory.exemplars), ("kept_touches", self._memory.kept)):
            if whole and kept is not None and getattr(mine, what) != getattr(other, what):
                raise MismatchError(
                    f"{theirs} was compacted and keeps {what} {getattr(other, what)}; {ours} keeps "
                    f"{getattr(mine, what)}, and the readings for the others are gone"
                )

    def _there(self, incoming: Sequence[Head]) -> tuple[set[int], list[tuple[Head, str]]]:
        """Their rows of touches that are there, in ours or earlier in theirs; those refused, each with the reason."""
        declared = {quantity.name: quantity for quantity in self.quantities} | self._memory.quantities
        came: dict[bytes, TouchRows] = {}
        known: set[int] = set()
        refused: list[tuple[Head, str]] = []
        for head in (head for head in incoming if head.kind != Kind.MERGE):
            ours, theirs = rows_with(self._ours, self._memory, head.key), came.setdefault(head.key, {})
            there, annotation = ours.get(head.label) or theirs.get(head.label), annotation_of(head.attributes)
            names = list(ours or theirs) if self._one_name else []
            why = refusal(names, head.label, head.key in self._clipped)
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
            elif head.label in ours or (head.kind == Kind.OBSERVE and head.sequence > self._compacted):
                known.add(head.sequence)
        return known, refused

    def _require_able_to_leave_out(self, rows: Sequence[Head]) -> None:
        fixed = [head for head in rows if head.sequence <= self._compacted or head.kind == Kind.MEMBER]
        if fixed:
            both = "both have it; merge the other way round, if ours was not compacted"
            why = {head.sequence: why for head, why in self.refused}.get(fixed[0].sequence, both)
            raise ObservationError(
                f"{len(fixed)} touches, such as one of {fixed[0].label!r}, cannot be left out of "
                f"{self._theirs.path}, which was compacted, and their features given up: {why}"
            )

    def _chosen_descriptions(self, theirs: Mapping[str, Description], choice: Choice) -> dict[str, Description]:
        """Their descriptions that are taken over."""
        ours = self._memory.descriptions
        new = {name: theirs[name] for name in sorted(theirs) if repr(ours.get(name)) != repr(theirs[name])}
        differing = [name for name in new if name in ours]
        if differing and choice == "same":
            name = differing[0]
            raise MismatchError(
                f"{len(differing)} materials are described differently in {self._ours.path} and {self._theirs.path}, "
                f"such as {name!r}: here it is {ours[name]}, there {new[name]}. Choose with descriptions='ours' or "
                "'theirs'"
            )
        return {name: new[name] for name in new if choice != "ours" or name not in ours}


def pack_memory(
    store: AnyStore, memory: Memory, path: Path, *, rows: bool = True, readings: bool = True, source: str | None = None
) -> None:
    """Write all that a memory learned as a packed memory; the arguments are those of `TactileLearner.pack`."""
    found = active_rows(store.heads())
    heads = [head for head in found if head.kind != Kind.MERGE]
    with_arrays = rows and readings and not memory.compacted and len(heads) == len(found)
    identity: dict[str, Any] = Identity.read(store).to_json()
    packed = copy(memory)
    packed.tuned, packed.tuned_last_sequence, packed.retracted = None, 0, set()
    packed.corrections = {}  # they are of this unit; what was read through them is in the touches
    packed.exemplars = memory.empty_like().exemplars  # their rows have other numbers there
    left_out: tuple[str, ...] = ()
    if not readings:
        left_out = "nbytes", "channels"
        identity |= {"exemplars": 0, "kept_touches": 0}
        packed.kept = packed.exemplars = None
    with reported(path, "packing a memory"):
        path.parent.mkdir(parents=True, exist_ok=True)
        # The packed file is whole even where a failing disk does not let its draft be removed.
        made = TemporaryDirectory(
            dir=path.parent, prefix=f"{path.name}.", suffix=".partial", ignore_cleanup_errors=True
        )
    with made as folder:
        with Store.open(folder, identity=identity) as into:
            with into.batch():
                for quantity in memory.quantities.values():
                    into.append(Kind.DECLARE, quantity.name, b"", attributes=quantity.model_dump(exclude={"name"}))
                for head in heads:
                    attributes: dict[str, Any] = {} if source is None else {"source": source}
                    attributes |= {name: value for name, value in head.attributes.items() if name not in left_out}
                    row: Any = {"attributes": attributes, "time": head.time}
                    row["arrays"] = store.record(head.sequence).arrays if with_arrays else None
                    packed.add_exemplar(into.append(head.kind, head.label, head.key, **row))
                for material, constituents in memory.descriptions.items():
                    into.append(Kind.DESCRIBE, material, b"", attributes={"constituents": constituents})
            candidates = exemplar_candidates(memory, store) if readings and not with_arrays else []
            arrays, told = packed.to_arrays(*(() if with_arrays else (into.last, candidates)))
            keep = into.commit if with_arrays else into.compact
            keep(arrays, last_sequence=into.last, attributes=told)
        write_archive(Path(folder), path)
