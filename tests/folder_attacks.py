"""What somebody can do to a memory's folder, with right checksums: name → a function of the folder.

Nobody may take any of it in. tests/storage does it to stores, tests/validation to memories.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from forging import get_current, get_identity, log_of, put_row, set_current, set_identity
from scroll_tactile_store.log import Log, refuse
from touches import PAD, stream

from scroll_tactile.memory.touch_rows import pack_readings
from scroll_tactile.signals.stream import validate

Attack = Callable[[Path], Any]

# `CURRENT`: what it says of the log, of checkpoints and of their places.


def newest_is(path: Path, **changes: Any) -> dict[str, Any]:
    """What `CURRENT` says of the newest checkpoint, with changes."""
    return dict(get_current(path)["newest"]) | changes


def placed(path: Path, **changes: Any) -> dict[str, Any]:
    """The newest checkpoint at another place in the log."""
    offset, number, previous = get_current(path)["newest"]["place"]
    place = {"offset": offset, "number": number, "previous": previous} | changes
    return {"newest": newest_is(path, place=list(place.values()))}


def behind_all(path: Path) -> dict[str, Any]:
    """The newest checkpoint at the end of the log."""
    with Log(log_of(path)) as log:
        for _ in log.scan(refuse):
            pass
        return placed(path, offset=log.place.offset, number=log.place.number, previous=log.place.previous.hex())


def _current(change: Callable[[Path], Mapping[str, Any]]) -> Attack:
    return lambda path: set_current(path, **change(path))


CURRENTS: dict[str, Attack] = {
    name: _current(change)
    for name, change in {
        "no log": lambda path: {"log": None},
        "a log in words": lambda path: {"log": ["../../log", get_current(path)["log"][1]]},
        "a log that is not there": lambda path: {"log": [7, get_current(path)["log"][1]]},
        "a log of the last number": lambda path: {"log": [2**63 - 1, get_current(path)["log"][1]]},
        "a log of another identity": lambda path: {"log": [get_current(path)["log"][0], "00" * 8]},
        "a format below 0": lambda path: {"format": -1},
        "a text for a checkpoint": lambda path: {"newest": "x"},
        "a checkpoint without a place": lambda path: {"newest": newest_is(path, place=None)},
        "a last row in words": lambda path: {"newest": newest_is(path, last_sequence="15")},
        "a number above any": lambda path: {"newest": newest_is(path, number=2**64)},
        "a sha256 in capitals": lambda path: {"newest": newest_is(path, sha256="AB" * 32)},
        "a compaction checkpoint without a newest": lambda path: {"newest": None, "compaction": newest_is(path)},
        "a compaction checkpoint newer than the newest": lambda path: {
            "compaction": newest_is(path, last_sequence=get_current(path)["newest"]["last_sequence"] + 1)
        },
        "a place in no frame": lambda path: placed(path, offset=newest_is(path)["place"][0] + 1),
        "a place beyond the end": lambda path: placed(path, offset=2**40),
        "a place of another number": lambda path: placed(path, number=3),
        "a place of another checksum": lambda path: placed(path, previous="00" * 16),
    }.items()
}

# A row: what is other in it than in a sound one.

NAN = np.full((60, 2), np.nan, np.float32)
TOUCH = validate(stream((20, 60)), PAD)
ROW = {"attributes": {"columns": 60, "nbytes": 480}, "payload": pack_readings(TOUCH.readings)}
SAID: dict[str, dict[str, Any]] = {
    "no attributes": {},
    "columns beyond all": {"columns": 10**9, "nbytes": 480},
    "columns of others": {"columns": 59, "nbytes": 480},
    "bytes in words": {"columns": 60, "nbytes": "a"},
    "bytes of others": {"columns": 60, "nbytes": 488},
    **{
        f"{which} {told}"[:40]: {"columns": 60, "nbytes": 480, which: told}
        for which, several in {
            "source": ["\x1b[2J", "x" * 10**6, ["x"]],
            "values": [None, [], {}, {"force": 1.5}, {"force": True}, {"force": -1}, {"force": 2**20 + 1}, {"": 1}],
            "labels": [None, {}, {"slip": 3}, {"slip": ""}, {"\x1b[2J": "x"}, {str(i): "x" for i in range(17)}],
        }.items()
        for told in several
    },
}
ROWS: dict[str, dict[str, Any]] = {
    **{name: {"attributes": attributes} for name, attributes in SAID.items()},
    "bytes of none": {"payload": {}},
    "another shape": {"payload": {"readings-2e0": np.zeros(3, np.int8)}},
    "not finite": {"payload": pack_readings(NAN)},
    "out of range": {"payload": pack_readings(np.full((60, 2), 1.5, np.float32))},
    "a power beyond all": {"payload": {"readings-2e200": np.ones((2, 60), np.int8)}},
    "a short key": {"key": b"abc"},
    "no name": {"label": ""},
    "a long name": {"label": "x" * 10**6},
    "an escape for a name": {"label": "\x1b]0;pwned\x07\x1b[2J"},
}
# Of a row that declares a quantity: its name and attributes.
QUANTITY: dict[str, Any] = {"unit": "N", "low": 0.0, "high": 1.0, "resolution": 0.01}
QUANTITIES: list[tuple[str, Any]] = [(label, QUANTITY) for label in ("", "\x1b[2J", "x" * 201)]
QUANTITIES += [("force", QUANTITY | {"unit": told}) for told in (3, "")]
QUANTITIES += [("force", QUANTITY | {"low": 1.0}), ("force", QUANTITY | {"resolution": "x"}), ("force", {})]
CONSTITUENTS = ["x", [], {}, {"wool": "x"}, {"wool": 2.0}, {"": 1.0}, {"wool": 0.1}]


def row(**changes: Any) -> Attack:
    """One more row, with changes."""
    return lambda path: put_row(path, **ROW | changes)


def description(constituents: Any) -> Attack:
    """One more row, which says what a material is made of."""
    said = {"constituents": constituents}
    return lambda path: put_row(path, kind="describe", label="a", key=b"", attributes=said)


# An identity: field → values that it never has, of itself, of its embedding and of its sensor.

IDENTITIES: dict[str, dict[str, list[Any]]] = {
    "": {
        "sensor": ["x", None, {"name": "pad"}],
        "embedding": ["x", {}],
        "grid": [None, {}, {"bits": 20, "scales": ["a"]}, {"bits": True, "scales": [15]}],
        "exemplars": ["abc", -1, 10**30],
        "kept_touches": ["x", True, 10**30],
        "views": [1, None],
        "reading": [[1, "all"], None],
    },
    "embedding": {"dimension": [0, 10**9, ""], "bound": [10**400, None], "name": [0, ""], "fingerprint": [-5, []]}
    | {"configuration": [0, []]},
    "sensor": {"channels": ["x", -1, 10**400], "rate": [-1, None], "low": ["x", 1e308], "high": [-1, None]}
    | {"duration": ["x", 10**400], "name": [-1, None], "layout": ["x", [1e308]]},
}


def _identity(part: str, field: str, value: Any) -> Attack:
    def change(path: Path) -> None:
        known = get_identity(path)
        (known[part] if part else known)[field] = value
        set_identity(path, known)

    return change


def deep(depth: int) -> Attack:
    """A configuration so deep."""

    def change(path: Path) -> None:
        known = get_identity(path)
        known["embedding"]["configuration"]["parts"] = json.loads("[" * depth + "]" * depth)
        set_identity(path, known)

    return change


def identities() -> Iterator[tuple[str, str, str, Attack]]:
    """The part of the identity, its field, a name, and what does it."""
    for part, fields in IDENTITIES.items():
        for field, values in fields.items():
            for value in values:
                yield part, field, f"{part} {field} {str(value)[:40]}".strip(), _identity(part, field, value)
    for depth in (17, 400):
        yield "", "embedding", f"{depth} deep", deep(depth)
