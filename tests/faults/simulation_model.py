"""The dumb model of a simulated memory: the rows that were acknowledged, and what they must come to.

A row is ("observe", material, touch), ("retract", sequences, material or ""), ("describe", material, constituents),
("merge", pairs), what a compacted memory brought, or ("member", material, touch), a touch that it had. All in all they
are a multiset of (material, touch), and what a memory without a path keeps of that is what must be seen.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from scroll_tactile import TactileLearner

Touch = int
Pair = tuple[str, Touch]
Row = tuple[Any, ...]
LISTED = ("observe", "member")


@dataclass(frozen=True)
class Rows:
    """The rows of a memory. compacted: those up to it were compacted; stands: what was left of these, as pairs.

    embedding: its name. unlisted: rows whose heads a repair left out.
    """

    rows: tuple[Row, ...] = ()
    compacted: int = 0
    stands: tuple[Pair, ...] = ()
    embedding: str = "own"
    unlisted: frozenset[int] = frozenset()

    @functools.cached_property
    def retracted(self) -> set[int]:
        """The sequences that were taken back."""
        return {sequence for row in self.rows if row[0] == "retract" for sequence in row[1]}

    @functools.cached_property
    def standing(self) -> list[tuple[int, Row]]:
        """The rows that something was learned from, compacted ones too."""
        kinds = (*LISTED, "merge")
        numbered = enumerate(self.rows, 1)
        gone = self.retracted | self.unlisted
        return [(sequence, row) for sequence, row in numbered if row[0] in kinds and sequence not in gone]

    @functools.cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """All that counts."""
        found = list(self.stands)
        for sequence, row in self.standing:
            if sequence > self.compacted:
                found += row[1] if row[0] == "merge" else [row[1:]] if row[0] == "observe" else []
        return tuple(sorted(found))

    @functools.cached_property
    def said(self) -> dict[str, Any]:
        """What is said of materials."""
        said: dict[str, Any] = {}
        for row in self.rows:
            if row[0] == "retract" and row[2]:
                said.pop(row[2], None)
            elif row[0] == "describe":
                said.pop(row[1], None)
                if row[2] is not None:
                    said[row[1]] = dict(row[2])
        return said

    @property
    def loose(self) -> list[int]:
        """What can still be retracted."""
        return [sequence for sequence, row in self.standing if row[0] == "observe" and sequence > self.compacted]

    @property
    def listed(self) -> list[tuple[int, Pair]]:
        """The touches that a memory can name, with their rows."""
        return [(sequence, row[1:]) for sequence, row in self.standing if row[0] in LISTED]

    @property
    def whole(self) -> bool:
        """Whether every touch has its row, with its arrays."""
        return not self.compacted and all(row[0] != "merge" for row in self.rows)

    def plus(self, *rows: Row) -> Rows:
        """With these rows behind."""
        return replace(self, rows=(*self.rows, *rows))

    def cut(self, count: int) -> Rows:
        """The first rows alone."""
        return replace(self, rows=self.rows[:count])

    def compact(self, last_sequence: int) -> Rows:
        """Compacted up to a row."""
        pairs = list(self.stands)
        for sequence, row in self.standing:
            if self.compacted < sequence <= last_sequence:
                pairs += row[1] if row[0] == "merge" else [row[1:]] if row[0] == "observe" else []
        return replace(self, compacted=last_sequence, stands=tuple(sorted(pairs)))


Then = tuple[Rows, Any]


def observe(ours: Rows, material: str, touch: Touch, again: bool) -> Then:
    """What it makes of a memory, and what it returns: as those below."""
    there = [sequence for sequence, pair in ours.listed if pair == (material, touch)]
    if there and not again:
        return ours, min(there)
    return ours.plus(("observe", material, touch)), len(ours.rows) + 1


def retract(ours: Rows, sequence: int) -> Then:
    """As `TactileLearner.retract`."""
    if sequence not in ours.loose:
        return ours, "ObservationError"
    return ours.plus(("retract", (sequence,), "")), None


def forget(ours: Rows, material: str) -> Then:
    """As `TactileLearner.forget`."""
    count = Counter(name for name, _ in ours.pairs)[material]
    found = [sequence for sequence in ours.loose if ours.rows[sequence - 1][1] == material]
    if not count:
        return ours, "UnknownMaterialError"
    if len(found) != count:
        return ours, "ObservationError"
    return ours.plus(("retract", tuple(found), material)), count


def relabel(ours: Rows, sequence: int, material: str) -> Then:
    """As `TactileLearner.relabel`."""
    if sequence not in ours.loose:
        return ours, "ObservationError"
    if ours.rows[sequence - 1][1] == material:
        return ours, "InputError"
    touch = ours.rows[sequence - 1][2]
    then = ours.plus(("retract", (sequence,), ""), ("observe", material, touch))
    return then, len(then.rows)


def describe(ours: Rows, material: str, said: Any) -> Then:
    """As `TactileLearner.describe`; said: pairs, in order, or None."""
    if repr(ours.said.get(material)) == repr(None if said is None else dict(said)):
        return ours, None
    return ours.plus(("describe", material, said)), None


def compact(ours: Rows, keep: int) -> Then:
    """As `TactileLearner.compact`."""
    loose = ours.loose
    last_sequence = len(ours.rows) if keep == 0 else loose[-keep] - 1 if len(loose) > keep else ours.compacted
    last_sequence = max(last_sequence, ours.compacted)
    return (ours.compact(last_sequence) if last_sequence > ours.compacted else ours), last_sequence


def packed(ours: Rows, rows: bool) -> Rows:
    """The packed memory that `TactileLearner.pack` makes."""
    told = tuple(ours.rows[sequence - 1] for sequence, _ in ours.listed)
    told += tuple(("describe", material, tuple(said.items())) for material, said in ours.said.items())
    if rows and ours.whole:
        return Rows(told, embedding=ours.embedding)
    return Rows(told, len(told), ours.pairs, ours.embedding)


def merge(ours: Rows, theirs: Rows, once: bool, choice: str, one_name: bool) -> Then:
    """As `Ledger.merge`, by rules of this once and one_name: a touch that came twice there is counted once."""
    if ours.embedding != theirs.embedding:
        return ours, "MismatchError"
    have = {pair for _, pair in ours.listed}
    names: dict[Touch, list[str]] = {}
    for _, (material, touch) in ours.listed:
        names.setdefault(touch, []).append(material)
    both = {sequence for sequence, pair in theirs.listed if pair in have}
    refused, again, came = set[int](), set[int](), dict[Touch, str]()
    for sequence, (material, touch) in theirs.listed if one_name else ():
        before = touch in came
        if material not in (names.get(touch) or [came.setdefault(touch, material)]):
            refused.add(sequence)
        elif before and sequence > theirs.compacted and theirs.rows[sequence - 1][0] == "observe":
            again.add(sequence)
    out = (both if once else set()) | refused | again
    if any(sequence <= theirs.compacted or theirs.rows[sequence - 1][0] == "member" for sequence in out):
        return ours, "ObservationError"
    new = {name: said for name, said in theirs.said.items() if repr(ours.said.get(name)) != repr(said)}
    if choice == "same" and new.keys() & ours.said.keys():
        return ours, "MismatchError"
    new = {name: said for name, said in sorted(new.items()) if choice != "ours" or name not in ours.said}
    added: list[Row] = [("describe", name, tuple(said.items())) for name, said in new.items()]
    added += [("merge", theirs.stands)] if theirs.compacted else []
    coming = [(sequence, row) for sequence, row in theirs.standing if sequence not in out]
    for sequence, row in coming:
        if sequence > theirs.compacted:
            added.append(row)
        elif row[0] != "merge":
            added.append(("member", *row[1:]))
    count = sum(row[0] in LISTED for _, row in coming)
    return ours.plus(*added), [count, len(both) + len(again), len(new), len(refused)]


def seen(learner: TactileLearner) -> dict[str, Any]:
    """What can be seen of a memory in a folder."""
    ledger = learner._ledger
    store = ledger.store
    assert store is not None
    return {
        "last": ledger.memory.sequence,
        "compacted": store.compacted,
        "listed": [(each.sequence, each.material, each.key, each.state) for each in learner.observations()],
        "materials": learner.materials,
        "descriptions": repr(sorted(learner.descriptions.items())),
        **held(learner),
    }


def held(learner: TactileLearner) -> dict[str, Any]:
    """What a memory keeps of the touches themselves."""
    memory = learner.memory
    kept, materials = ({}, []) if memory.kept is None else memory.kept.to_arrays()
    pool = sorted((name, key, touch.rows.tobytes(), touch.pairs.tobytes()) for name, key, touch in memory.sample)
    return {
        "digest": learner.digest(),
        "kept": (materials, [(name, kept[name].tobytes()) for name in sorted(kept)]),
        "pool": pool,
        "exemplars": learner.exemplars,
    }


class Expected:
    """What must be seen of rows. fed: a memory without a path of these pairs; key: of a touch."""

    def __init__(self, fed: Callable[[tuple[Pair, ...], str], TactileLearner], key: Callable[[Touch], bytes]) -> None:
        self._key = key
        self._held = functools.lru_cache(maxsize=2048)(lambda pairs, embedding: held(fed(pairs, embedding)))

    def __call__(self, ours: Rows) -> dict[str, Any]:
        """All of it."""
        listed = []
        for sequence, row in enumerate(ours.rows, 1):
            if row[0] in LISTED and sequence not in ours.unlisted:
                fixed = sequence <= ours.compacted or row[0] == "member"
                state = "retracted" if sequence in ours.retracted else "compacted" if fixed else "kept"
                listed.append((sequence, row[1], self._key(row[2]), state))
        return {
            "last": len(ours.rows),
            "compacted": ours.compacted,
            "listed": listed,
            "materials": dict(sorted(Counter(name for name, _ in ours.pairs).items())),
            "descriptions": repr(sorted(ours.said.items())),
            **self._held(ours.pairs, ours.embedding),
        }
