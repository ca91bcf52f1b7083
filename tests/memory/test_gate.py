"""Rows, identities and checkpoints that verify, and are none that a memory writes: each is damage at its place.

Nobody is asked whether a stranger's numbers fit each other; what their files may not do stands in
tests/test_strangers.py.
"""

import shutil
from functools import partial

import numpy as np
import pytest
from forging import (
    checkpoint_of,
    get_identity,
    observation,
    put_checkpoint,
    put_row,
    set_configuration,
    set_identity,
)
from scroll_tactile_store import DamageError, StoreError
from touches import PAD, filled, held, stream

from scroll_tactile import Quantity, TactileLearner
from scroll_tactile.errors import EmbeddingError, MismatchError, ScrollTactileError
from scroll_tactile.memory.gate import check_memory
from scroll_tactile.memory.touch_rows import pack_readings
from scroll_tactile.signals.stream import validate

QUANTITY = {"unit": "N", "low": 0.0, "high": 1.0, "resolution": 0.01}
OTHER = [("d", (9, 60)), ("e", (10, 60)), ("d", (11, 60))]
TOUCH = validate(stream((20, 60)), PAD)
SAID = {"columns": 60, "nbytes": 480}
PACKED = {
    "readings-shape": np.array([60, 2]),
    "readings-zero": np.full(15, 255, np.uint8),
    "readings-rest": np.zeros(0, np.float32),
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A memory with all that a memory can hold, a compacted one, and one into which others are merged."""
    folder = tmp_path_factory.mktemp("made")
    for name, observed in (("whole", OTHER[:0]), ("compacted", OTHER[:0]), ("other", OTHER)):
        learner, _ = filled(folder / name, *([observed] if observed else []))
        if name == "whole":
            learner.declare(Quantity(name="force", **QUANTITY))
            learner.observe("a", stream((8, 60)), values={"force": 0.5}, labels={"slip": "north"})
            learner.describe("a", {"wool": 0.5, "silk": 0.5})
        if name == "compacted":
            learner.compact()
        learner.close()
    return folder


@pytest.fixture
def path(made, tmp_path):
    return shutil.copytree(made / "whole", tmp_path / "m")


opened = TactileLearner.open


def row(payload=None, **changes):
    """A touch's row with changes; payload: in place of its readings."""
    payload = pack_readings(TOUCH.readings) if payload is None else payload
    return partial(put_row, **{"key": TOUCH.key, "attributes": SAID, "payload": payload} | changes)


def said(**changes):
    return row(attributes=SAID | changes)


def checkpoint(change):
    """Another newest checkpoint; change: of its attributes and arrays, of which None goes."""

    def put(path):
        attributes, arrays = checkpoint_of(path)
        change(attributes, arrays)
        put_checkpoint(path, attributes, {name: one for name, one in arrays.items() if one is not None})

    return put


def spoilt(name, change):
    return checkpoint(lambda _, arrays: arrays.update({name: change(arrays[name])}))


def identified(field, value):
    return lambda path: set_identity(path, get_identity(path) | {field: value})


def table(make, values_of):
    """What is done, by name, for each of several values of each name."""
    return {f"{name} {i}": make(name, value) for name, values in values_of.items() for i, value in enumerate(values)}


ROWS = {
    "no attributes": row(attributes={}),
    "bytes of none": row({}),
    "another shape": row({"readings-2e0": np.zeros(3, np.int8)}),
    "not finite": row(pack_readings(np.full((60, 2), np.nan, np.float32))),
    "out of range": row(pack_readings(np.full((60, 2), 1.5, np.float32))),
    "another touch's key": row(key=validate(stream(OTHER[0][1]), PAD).key),
    "no name": row(label=""),
    "an escape for a name": row(label="\x1b]0;pwned\x07\x1b[2J"),
    "an escape for a source": said(source="\x1b[2J"),
    "a large shape": row(PACKED | {"readings-shape": np.array([2**40, 2])}),
    "no rest": row({name: one for name, one in PACKED.items() if name != "readings-rest"}),
    **table(lambda name, value: said(**{name: value}), {"values": [[], {"force": 1.5}], "labels": [[], {"slip": 3}]}),
}
SPANS = ["x", [[1]], [[1, 10**12]], [[1, 10**12], [10**12, 1]]]
ROWS |= {f"retracts {one}": row({}, kind="retract", label="", key=b"", attributes={"sequences": one}) for one in SPANS}
CHECKPOINTS = table(
    spoilt,
    {
        "statistics-observations": [lambda a: a.astype(float), lambda a: a[:-1]],
        "statistics-sums-15": [lambda a: a[:, :-1], lambda _: None],
        "sample-keys": [lambda a: a[:, :3]],
        "kept-levels": [lambda a: a.astype(np.int16)],
        "targets-axes-0-statistics-sums-15": [lambda a: a[:, :-1], lambda _: None],
    },
) | table(
    lambda name, value: checkpoint(lambda attributes, _: attributes.update({name: value})),
    {
        "statistics": [None, {"materials": ["a", "b", "\n"]}, {"materials": ["a"]}],
        "descriptions": [[]],
        "quantities": [[], {"force": 3}],
        "targets": [{}],
        "tuned": [{}],
    },
)
IDENTITIES = table(
    identified,
    {"sensor": ["x", {"name": "pad"}], "embedding": [{}], "grid": [{}, {"bits": True, "scales": [15]}]}
    | {"exemplars": [-1], "kept_touches": [True], "views": [1], "reading": [None]},
)
FORGED = {
    "row [0-9]+ of .* is not what is written there": ROWS,
    "checkpoint 2 of .* is not what is written there": CHECKPOINTS,
    "the identity of .* is not what is written there": IDENTITIES,
}
CASES = [pytest.param(do, match, id=name) for match, cases in FORGED.items() for name, do in cases.items()]


@pytest.mark.parametrize(("do", "match"), CASES)
def test_what_no_memory_writes_is_refused_by_whoever_reads_or_merges_it(made, path, tmp_path, do, match):
    do(path)
    shutil.copytree(made / "other", tmp_path / "other")
    with pytest.raises((ScrollTactileError, StoreError), match=match), opened(path, mode="read") as learner:
        learner.settle()  # reads what opening does not
    with opened(tmp_path / "other") as target:
        before = held(target)
        with pytest.raises((ScrollTactileError, StoreError)):
            target.merge(path)
        assert held(target) == before
    assert check_memory(path)


def test_a_sound_memory_has_nothing_that_is_found_and_a_forged_row_that_fits_is_a_row(made, path):
    row()(path)
    for one in (path, made / "compacted", made / "other"):
        assert check_memory(one) == []
    with opened(path) as learner:
        assert learner.materials["silk"] == 1


def test_a_row_of_a_later_version_is_told_from_damage(path):
    row({}, kind="exec", label="", key=b"")(path)
    with pytest.raises(MismatchError, match=r"of kind 'exec'.*newer"):
        opened(path)


def test_what_is_left_out_as_shared_must_be_there(path, tmp_path):
    """Row 1 lies under a checkpoint: opening does not read it, but a touch is left out for its key."""
    theirs, (receipt,) = filled(tmp_path / "theirs", [("a", (9, 60))])
    attributes, payload = observation(path)
    put_row(path, sequence=1, label="a", key=receipt.key, attributes=attributes, payload=payload)
    assert any("content hash" in found for found in check_memory(path))
    with theirs as learner:
        before = held(learner)
        with pytest.raises(DamageError, match=f"row 1 of {path} .* content hash"):
            learner.merge(path)
        assert held(learner) == before


def test_what_a_compaction_checkpoint_brings_is_a_row_that_is_looked_at(made, tmp_path):
    other = shutil.copytree(made / "other", tmp_path / "other")
    with opened(other) as target:
        target.merge(made / "compacted")
        assert target.materials == {"a": 4, "b": 4, "c": 4, "d": 2, "e": 1}
    assert check_memory(other) == []
    attributes, arrays = checkpoint_of(made / "compacted")
    put_row(other, kind="merge", attributes=attributes | {"descriptions": 1}, payload=arrays)
    with pytest.raises(DamageError, match="is not what is written there"):
        opened(other)


@pytest.mark.parametrize("configuration", [{}, {"kind": "no such"}, {"kind": "kernels", "dimension": 64, "more": 1}])
def test_a_configuration_that_makes_nothing_is_found_before_it_is_opened(path, configuration):
    set_configuration(path, **configuration)
    assert any("configuration" in found for found in check_memory(path))
    with pytest.raises(EmbeddingError):
        opened(path)
