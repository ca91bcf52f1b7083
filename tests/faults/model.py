"""The dumb model of a memory: the rows that were acknowledged, which cannot go wrong, and what operations make of them.

A row is ("observe", material, touch), ("retract", sequences, material or ""), ("describe", material, constituents),
("merge", pairs), what a compacted memory brought, ("member", material, touch), a touch that it had, or ("declare",), of
the quantity that some touches have a value of. All in all they are a set of (material, touch), but where damage hid one
that was then learned again; what is noted of a touch follows from it.

An operation is a tuple: ("observe", material, touch), ("batch", operations), ("retract", sequence),
("forget", material), ("relabel", sequence, material), ("describe", material, constituents or None),
("merge", name, descriptions, of sources), ("compact", keep), ("fine_tune",), ("backup",), ("open",),
("close",), ("pack", name, rows), ("reembed", embedding), ("fleet", pairs). `after` says what it makes of a `State` and
what the call returns; `learners.perform` does it.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

Touch = Any
Pair = tuple[str, Touch]
Pairs = tuple[Pair, ...]
Row = tuple[Any, ...]
Operation = tuple[Any, ...]
Constituents = tuple[tuple[str, float | bool | None], ...]
LISTED = ("observe", "member")


@dataclass(frozen=True)
class State:
    """The rows of a memory. compacted: those up to it were compacted; stands: what was left of these.

    embedding: its name. unlisted: rows whose heads a repair left out. tuned: what f* was made from, when there were
    `tuned_at` rows. packed: what it was packed as, by the name of the file.
    """

    rows: tuple[Row, ...] = ()
    compacted: int = 0
    stands: Pairs = ()
    embedding: str = "own"
    unlisted: frozenset[int] = frozenset()
    tuned: Pairs | None = None
    tuned_at: int = 0
    packed: tuple[tuple[str, State], ...] = ()

    @property
    def last(self) -> int:
        """The sequence of the last row."""
        return len(self.rows)

    @functools.cached_property
    def retracted(self) -> set[int]:
        """The sequences that were taken back."""
        return {sequence for row in self.rows if row[0] == "retract" for sequence in row[1]}

    @functools.cached_property
    def standing(self) -> list[tuple[int, Row]]:
        """The rows that something was learned from, compacted ones too."""
        gone = self.retracted | self.unlisted
        numbered = enumerate(self.rows, 1)
        return [(at, row) for at, row in numbered if row[0] in (*LISTED, "merge") and at not in gone]

    def _learned(self, first: int, last: int) -> list[Pair]:
        """What was learned from standing rows behind `first`, up to `last`."""
        found: list[Pair] = []
        for sequence, row in self.standing:
            if first < sequence <= last:
                found += row[1] if row[0] == "merge" else [row[1:]] if row[0] == "observe" else []
        return found

    @functools.cached_property
    def pairs(self) -> Pairs:
        """All that counts, in an order of its own."""
        return tuple(sorted([*self.stands, *self._learned(self.compacted, self.last)]))

    @property
    def materials(self) -> dict[str, int]:
        """Material → touches."""
        return dict(sorted(Counter(material for material, _ in self.pairs).items()))

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
    def declared(self) -> bool:
        """Whether the quantity was declared."""
        return ("declare",) in self.rows

    @property
    def loose(self) -> list[int]:
        """The observations that can still be retracted."""
        return [at for at, row in self.standing if row[0] == "observe" and at > self.compacted]

    @property
    def listed(self) -> list[tuple[int, Pair]]:
        """The touches that a memory can name, with their rows."""
        return [(sequence, row[1:]) for sequence, row in self.standing if row[0] in LISTED]

    def there(self, material: str, touch: Touch) -> int:
        """The row that has a touch under this name; 0 without one."""
        return min((sequence for sequence, pair in self.listed if pair == (material, touch)), default=0)

    @property
    def whole(self) -> bool:
        """Whether every touch has its row, with its arrays."""
        return not self.compacted and all(row[0] != "merge" for row in self.rows)

    def plus(self, *rows: Row) -> State:
        """With these rows behind; an f* of what is taken back is gone."""
        late = any(at <= self.tuned_at for row in rows if row[0] == "retract" for at in row[1])
        return replace(self, rows=(*self.rows, *rows), tuned=None if late else self.tuned)

    def cut(self, count: int) -> State:
        """The first rows alone."""
        return replace(self, rows=self.rows[:count])

    def compact(self, last: int) -> State:
        """Compacted up to a row."""
        return replace(self, compacted=last, stands=tuple(sorted([*self.stands, *self._learned(self.compacted, last)])))

    def pack(self, *, rows: bool) -> State:
        """The packed memory that is made of it; its rows stay behind where any are missing."""
        told = (("declare",),) if self.declared else ()
        told += tuple(self.rows[sequence - 1] for sequence, _ in self.listed)
        told += tuple(("describe", material, tuple(said.items())) for material, said in self.said.items())
        if rows and self.whole:
            return State(told, embedding=self.embedding)
        return State(told, max(1, len(told)), self.pairs, self.embedding)


Then = tuple[State, Any]
Others = Mapping[str, State]


def after(state: State, operation: Operation, others: Others) -> Then:
    """What an operation makes of a state, and what the call returns: JSON, or the name of the error that it raises."""
    kind, *rest = operation
    return _AFTER[kind](state, others, *rest)


def _observe(state: State, _: Others, material: str, touch: Touch) -> Then:
    if there := state.there(material, touch):
        return state, there
    from faults.learners import KIT

    if KIT.noted(touch)[0] and not state.declared:
        state = state.plus(("declare",))
    return state.plus(("observe", material, touch)), state.last + 1


def _batch(state: State, others: Others, operations: tuple[Operation, ...]) -> Then:
    results = []
    for one in operations:
        state, result = after(state, one, others)
        results.append(result)
    return state, results


def _retract(state: State, _: Others, sequence: int) -> Then:
    if sequence not in state.loose:
        return state, "ObservationError"
    return state.plus(("retract", (sequence,), "")), None


def _forget(state: State, _: Others, material: str) -> Then:
    count = state.materials.get(material, 0)
    found = [sequence for sequence in state.loose if state.rows[sequence - 1][1] == material]
    if not count:
        return state, "UnknownMaterialError"
    if len(found) != count:
        return state, "ObservationError"
    return state.plus(("retract", tuple(found), material)), count


def _relabel(state: State, _: Others, sequence: int, material: str) -> Then:
    if sequence not in state.loose:
        return state, "ObservationError"
    _, before, touch = state.rows[sequence - 1]
    if before == material:
        return state, "InputError"
    then = state.plus(("retract", (sequence,), ""))
    if there := state.there(material, touch):
        return then, there
    then = then.plus(("observe", material, touch))
    return then, then.last


def _describe(state: State, _: Others, material: str, constituents: Constituents | None) -> Then:
    if repr(state.said.get(material)) == repr(None if constituents is None else dict(constituents)):
        return state, None
    return state.plus(("describe", material, constituents)), None


def _there(ours: State, theirs: State, *, one_name: bool) -> tuple[set[int], set[int]]:
    """Rows of theirs that ours, or an earlier row, has; and those that are refused, since a touch has another name."""
    names: dict[Touch, list[str]] = {}
    for _, (material, touch) in ours.listed:
        names.setdefault(touch, []).append(material)
    known, refused, came = set[int](), set[int](), dict[Touch, list[str]]()
    for sequence, (material, touch) in theirs.listed:
        mine, own = names.get(touch, []), came.setdefault(touch, [])
        if one_name and (mine or own) and material not in (mine or own):
            refused.add(sequence)
        elif material in mine:
            known.add(sequence)
        elif material not in own:
            own.append(material)
        elif sequence > theirs.compacted and theirs.rows[sequence - 1][0] == "observe":
            known.add(sequence)
    return known, refused


def _merge(ours: State, others: Others, name: str, descriptions: str = "same", of_sources: bool = False) -> Then:
    """of_sources: by the rules for memories of sources, of which a touch has one name."""
    theirs = (dict(others) | dict(ours.packed))[name]
    if ours.embedding != theirs.embedding:
        return ours, "MismatchError"
    known, refused = _there(ours, theirs, one_name=of_sources)
    out = known | refused
    if any(sequence <= theirs.compacted or theirs.rows[sequence - 1][0] == "member" for sequence in out):
        return ours, "ObservationError"
    new = {name: said for name, said in sorted(theirs.said.items()) if repr(ours.said.get(name)) != repr(said)}
    if descriptions == "same" and new.keys() & ours.said.keys():
        return ours, "MismatchError"
    new = {name: said for name, said in new.items() if descriptions != "ours" or name not in ours.said}
    coming = [(sequence, row) for sequence, row in theirs.standing if sequence not in out]
    added: list[Row] = [("declare",)] if theirs.declared and not ours.declared else []
    added += [("describe", name, tuple(said.items())) for name, said in new.items()]
    added += [("merge", theirs.stands)] if theirs.compacted else []
    for sequence, row in coming:
        if sequence > theirs.compacted:
            added.append(row)
        elif row[0] != "merge":
            added.append(("member", *row[1:]))
    count = sum(row[0] in LISTED for _, row in coming)
    return ours.plus(*added), [count, len(known), len(new), len(refused)]


def _compact(state: State, _: Others, keep: int) -> Then:
    loose = state.loose
    last = state.last if keep == 0 else loose[-keep] - 1 if len(loose) > keep else 0
    last = max(last, state.compacted)
    return (state.compact(last) if last > state.compacted else state), last


def _pack(state: State, _: Others, name: str, rows: bool) -> Then:
    return replace(state, packed=(*state.packed, (name, state.pack(rows=rows)))), None


def _reembed(state: State, _: Others, embedding: str) -> Then:
    """Nothing is lost but f*."""
    if not state.whole:
        return state, "MismatchError"
    return replace(state, embedding=embedding, tuned=None, tuned_at=0), None


def _fleet(state: State, _: Others, touches: Pairs) -> Then:
    there = {pair for _, pair in state.listed}
    coming = [pair for pair in dict.fromkeys(touches) if pair not in there]
    return state.plus(*(("observe", *pair) for pair in coming)), len(coming)


def _fine_tune(state: State, _: Others) -> Then:
    from faults.learners import tuned_digest

    digest = tuned_digest(state.pairs, state.embedding)
    if digest is None:
        return state, "InputError"
    return replace(state, tuned=state.pairs, tuned_at=state.last), digest


def _nothing(state: State, _: Others) -> Then:
    return state, None


_AFTER: dict[str, Callable[..., Then]] = {
    "observe": _observe,
    "batch": _batch,
    "retract": _retract,
    "forget": _forget,
    "relabel": _relabel,
    "describe": _describe,
    "merge": _merge,
    "compact": _compact,
    "fine_tune": _fine_tune,
    "pack": _pack,
    "reembed": _reembed,
    "fleet": _fleet,
    **dict.fromkeys(("backup", "open", "close"), _nothing),
}
