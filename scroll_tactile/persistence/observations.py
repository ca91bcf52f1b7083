"""The observations in a journal: their state, which of them can be retracted, and which have some readings.

Equal readings are one touch. One that the memory has under the same name is never learned twice. One that it has under
another name is refused in learning from files, by one process or a fleet; `observe` and `merge` accept it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import takewhile
from typing import cast

from scroll_tactile_store import Head, Record

from scroll_tactile.errors import InputError, ObservationError, UnknownMaterialError
from scroll_tactile.memory.state import MOST_CORRECTIONS, Memory
from scroll_tactile.memory.touch_rows import Kind, active_rows, annotation_of, declared_by, retracted_by
from scroll_tactile.persistence.ram_store import AnyStore
from scroll_tactile.results import Adaptation, Observation, Receipt
from scroll_tactile.signals.facts import CURE
from scroll_tactile.statistics.annotations import Annotation

__all__ = [
    "TouchRows",
    "adaptation_of",
    "compaction_end",
    "is_from",
    "observation_of",
    "observations",
    "refusal",
    "rows_with",
    "to_forget",
]

TouchRows = dict[str, tuple[int, Annotation]]
"""Material → the row that has some readings under this name, and its annotation; the oldest first."""


def rows_with(store: AnyStore, memory: Memory, key: bytes) -> TouchRows:
    """The rows of observations that count and have readings with this hash; of each name the first."""
    found: TouchRows = {}
    for head in takewhile(lambda head: head.sequence <= memory.sequence, store.with_key(key)):
        if head.kind in (Kind.OBSERVE, Kind.MEMBER) and head.sequence not in memory.retracted:
            found.setdefault(head.label, (head.sequence, annotation_of(head.attributes)))
    return found


def refusal(names: Sequence[str], material: str, clipped: bool = False) -> str | None:
    """Why a touch that is there under these names cannot be learned as a material; None where it can.

    clipped: whether all its values lay outside the sensor's range, so that clipping may have made it equal another.
    """
    if not names or material in names:
        return None
    if clipped:
        return (
            f"all its values lie outside the sensor's range, and the memory has what clipping leaves of them already, "
            f"as {names[0]!r} and not as {material!r}: {CURE}"
        )
    return f"the memory has this touch already, as {names[0]!r} and not as {material!r}: relabel one of them"


def observation_of(store: AnyStore, memory: Memory, receipt: Receipt | Adaptation | int) -> Record:
    """The journal's row of an observation that can be retracted.

    Raises ObservationError where there is none, it was retracted before, or compacted.
    """
    sequence = receipt.sequence if isinstance(receipt, Receipt) else receipt
    if isinstance(sequence, bool) or not isinstance(sequence, int) or not 1 <= sequence <= store.last:
        raise ObservationError(f"{store.path} has rows 1 to {store.last}; there is no observation {sequence!r}")
    if sequence in memory.retracted:
        raise ObservationError(f"observation {sequence} of {store.path} was retracted already")
    if sequence <= memory.compacted:
        raise ObservationError(
            f"observation {sequence} of {store.path} cannot be retracted: rows 1 to {memory.compacted} were compacted, "
            "and their features given up"
        )
    record = store.record(sequence)
    if record.kind != Kind.OBSERVE:
        raise ObservationError(
            f"row {sequence} of {store.path} is no observation, and no adaptation that counts, but of kind "
            f"{record.kind!r}"
        )
    if isinstance(receipt, Receipt) and (receipt.material, receipt.key) != (record.label, record.key):
        raise ObservationError(
            f"the receipt is of another memory: it says that observation {sequence} is of {receipt.material!r} "
            f"({receipt.key.hex()[:12]}); in {store.path} it is of {record.label!r} ({record.key.hex()[:12]})"
        )
    return record


def adaptation_of(memory: Memory, receipt: Receipt | Adaptation | int) -> int | None:
    """The row of an adaptation that counts; None where the receipt is of anything else.

    Raises ObservationError for an adaptation that counts no more, or is one of another memory.
    """
    sequence = receipt.sequence if isinstance(receipt, Adaptation) else receipt
    if type(sequence) is int and sequence in memory.corrections:
        return sequence
    if isinstance(receipt, Adaptation):
        raise ObservationError(
            f"there is no adaptation that counts in row {sequence}: it was not kept, was retracted already, "
            f"{MOST_CORRECTIONS} came after it, or it is one of another memory"
        )
    return None


def to_forget(store: AnyStore, memory: Memory, material: str | None, source: str | None) -> list[int]:
    """The sequences of all observations of a material, or from a source: a file, or all in a folder or address.

    Raises UnknownMaterialError for a material never observed, ObservationError where a source has none, and where some
    were compacted, and DamageError where a damaged row may be one of them.
    """
    if material is not None and material not in memory.statistics.materials:
        raise UnknownMaterialError(
            f"{material!r} was never observed; observed were {list(memory.statistics.materials)[:30]}"
        )
    mine = [
        head
        for head in active_rows(store.heads())
        if head.kind != Kind.MERGE and (is_from(_source(head), source) if material is None else head.label == material)
    ]
    if not mine:
        raise ObservationError(
            f"no observation of {store.path} comes from {source!r}; observations() lists their sources"
        )
    if gone := [head for head in mine if head.kind == Kind.MEMBER or head.sequence <= memory.compacted]:
        what = f"what comes from {source!r}" if material is None else f"{material!r}"
        raise ObservationError(
            f"{what} cannot be forgotten: {len(gone)} of its {len(mine)} observations in {store.path} were compacted, "
            "there or before they were merged, and their features given up. Retract the others one by one, by their "
            "receipts"
        )
    return [head.sequence for head in mine]


def _source(head: Head) -> str | None:
    return cast("str | None", head.attributes.get("source"))


def is_from(recorded: str | None, source: str | None) -> bool:
    """Whether an observation's recorded source is this one: the same file, or a file in this folder or address."""
    place = (source or "").rstrip("/")
    # A file's name is followed by an interval in brackets or a topic, a folder's by a file.
    ends = "/[ " if "." in place.rpartition("/")[2] else "/"
    return recorded is not None and (recorded == source or recorded.startswith(tuple(place + end for end in ends)))


def observations(store: AnyStore) -> list[Observation]:
    """All observations of a journal, in order, and the state of each."""
    heads, compacted = list(store.heads()), store.compacted
    retracted = retracted_by(heads)
    quantities = {head.label: declared_by(head) for head in heads if head.kind == Kind.DECLARE}

    def observation(head: Head) -> Observation:
        annotation = annotation_of(head.attributes)
        gone = head.sequence <= compacted or head.kind == Kind.MEMBER
        return Observation(
            sequence=head.sequence,
            material=head.label,
            key=head.key,
            time=head.time,
            state="retracted" if head.sequence in retracted else "compacted" if gone else "kept",
            source=_source(head),
            values=annotation.measured(quantities),
            labels=dict(annotation.labels),
        )

    return [observation(head) for head in heads if head.kind in (Kind.OBSERVE, Kind.MEMBER)]


def compaction_end(store: AnyStore, memory: Memory, keep: int) -> int:
    """The last row to be compacted, so that the newest `keep` observations can still be retracted."""
    if isinstance(keep, bool) or not isinstance(keep, int) or keep < 0:
        raise InputError(f"expected keep as a whole number of 0 or more; came {keep!r}")
    kept = [
        head.sequence
        for head in store.heads(memory.compacted, kind=Kind.OBSERVE)
        if head.sequence not in memory.retracted
    ]
    return [*kept, store.last + 1][-keep - 1] - 1 if len(kept) > keep or not keep else memory.compacted
