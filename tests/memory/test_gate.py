"""Folders from somebody else: rows, identities and checkpoints that verify, and are none of a memory's."""

import itertools
import json
import math

import numpy as np
import pytest
from folder_attacks import CONSTITUENTS, QUANTITIES, QUANTITY, ROW, ROWS, description, identities, row
from forging import checkpoint_of, copied, get_identity, observation, put_arrays, put_row, row_of, seal, set_identity
from scroll_tactile_store import DamageError, StoreError
from touches import PAD, SETTINGS, filled, held, stream

from scroll_tactile import Kernels, Quantity, TactileLearner
from scroll_tactile.clients.learning.plain_export import export_plain
from scroll_tactile.errors import EmbeddingError, MismatchError, ScrollTactileError
from scroll_tactile.memory.gate import check_memory
from scroll_tactile.memory.touch_rows import pack_readings
from scroll_tactile.signals.stream import validate

TYPED = (ScrollTactileError, StoreError)
OTHER = [("d", (9, 60)), ("e", (10, 60)), ("d", (11, 60))]


class Inexact(Kernels):
    """Kernels whose codes are kept in the rows."""

    name = "inexact"
    capabilities = Kernels.capabilities.__class__(embeds_windows=True, reads_whole_touches=True)


STORED = SETTINGS | {"embedding": Inexact(seed=0, dimension=64)}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A memory with a checkpoint, one as if its power had failed, one with codes in its rows, and a compacted one."""
    folder = tmp_path_factory.mktemp("made")
    kinds = (("whole", {}), ("coded", STORED), ("compacted", {}), ("other", {}), ("noted", {}))
    for name, settings_ in kinds:
        learner, _ = (
            filled(folder / name, OTHER, **settings_) if name == "other" else filled(folder / name, **settings_)
        )
        if name == "noted":
            learner.declare(Quantity(name="force", **QUANTITY))
            learner.observe("a", stream((8, 60)), values={"force": 0.5}, labels={"slip": "north"})
            learner.observe("b", stream((9, 60)), labels={"slip": "south"})
        learner.describe("a", {"wool": 0.5, "silk": 0.5})
        if name == "compacted":
            learner.compact()
        learner.close()
    return folder


@pytest.fixture(scope="module")
def others(made, tmp_path_factory):
    """A memory into which no merge of what is refused brings anything, and what it holds."""
    path = copied(made / "other", tmp_path_factory.mktemp("others") / "m")
    with opened(path) as learner:
        return path, held(learner)


@pytest.fixture
def path(made, tmp_path):
    return copied(made / "whole", tmp_path / "m")


def opened(path, **settings_):
    return TactileLearner.open(path, **settings_)


def require_refused(path, match, expected=DamageError, others=None, modes=("read", "write"), **settings_):
    """Whoever reads it is told what is wrong, a merge of it changes nothing, and a check finds it."""
    for mode in modes:
        with pytest.raises(expected, match=match), opened(path, mode=mode, **settings_) as learner:
            learner.settle()  # reads what opening does not
    if others is not None:
        target_path, before = others
        with opened(target_path) as target:
            with pytest.raises(expected, match=match) as error:
                target.merge(path)
            assert str(path) in str(error.value)
            assert held(target) == before
    assert any(found for found in check_memory(path))


def readings_row(path, values=None, **changes):
    """A row of readings, and of values, with some of its arrays changed; None leaves one out."""
    touch = validate(stream((20, 60)), PAD)
    arrays = {**pack_readings(touch.readings), **changes}
    arrays = {name: array for name, array in arrays.items() if array is not None}
    attributes = {"columns": 60, "nbytes": 480} | ({} if values is None else {"values": values})
    return put_row(path, key=touch.key, attributes=attributes, payload=arrays)


def test_a_sound_memory_has_nothing_that_is_found(made):
    for name in ("whole", "coded", "compacted", "other", "noted"):
        assert check_memory(made / name) == []


def test_a_forged_row_that_fits_is_a_row(path):
    readings_row(path)
    with opened(path) as learner:
        assert learner.materials["silk"] == 1
    assert check_memory(path) == []


SEQUENCES = [None, [], "x", [3], [[1]], [[1, 10**12]], [[1, 14]], [[0, 1]], [[2, 1]], [[True, 1]], [[1.0, 1.0]]]
SEQUENCES += [[[3, 4], [1, 2]], [[1, 2], [2, 3]]]
ZEROS = {
    "readings-shape": np.array([60, 2]),
    "readings-zero": np.full(15, 255, np.uint8),
    "readings-rest": np.zeros(0, np.float32),
}
UNFIT = {
    "a large shape": {"readings-shape": np.array([2**40, 2])},
    "three axes": {"readings-shape": np.array([60, 2, 1])},
    "a shape of floats": {"readings-shape": np.array([60.0, 2.0])},
    "few zeros": {"readings-zero": np.full(14, 255, np.uint8)},
    "zeros of int16": {"readings-zero": np.full(15, 255, np.int16)},
    "more than zeros": {"readings-rest": np.zeros(1, np.float32)},
    "no rest": {"readings-rest": None},
}
LARGE = 2**20 + 1
CODES = {
    "large": lambda codes: codes + LARGE,
    "least": lambda codes: np.full_like(codes, np.iinfo(np.int32).min),
    "not a number": lambda codes: codes.astype(np.float32) * np.nan,
    "of int64": lambda codes: codes.astype(np.int64),
    "of fewer features": lambda codes: codes[:, :-1],
    "of fewer rows": lambda codes: codes[:-1],
    "of more rows": lambda codes: np.concatenate([codes, codes]),
}


def retraction(sequences):
    attributes = {} if sequences is None else {"sequences": sequences}
    return lambda path: put_row(path, kind="retract", label="", key=b"", attributes=attributes)


def codes(name, of, change):
    """The first row again, with other codes: one of its arrays is made of one that there is."""

    def put(path):
        attributes, arrays = row_of(path)
        arrays[name] = change(arrays[of])
        put_row(path, attributes=attributes, payload={name: one for name, one in arrays.items() if one is not None})

    return put


def packed_row(**changes):
    return lambda path: readings_row(path, **changes)


CHECKPOINTS = {}


def checkpoint(change):
    """Another checkpoint where the newest lies; what there was is read once."""

    def put(path):
        current = (path / "CURRENT").read_bytes()
        if current not in CHECKPOINTS:
            CHECKPOINTS[current] = checkpoint_of(path)
        before = CHECKPOINTS[current][1]
        attributes, arrays = map(dict, CHECKPOINTS[current])
        change(attributes, arrays)
        arrays = {name: one for name, one in arrays.items() if one is not None}
        changed = {name: one for name, one in arrays.items() if one is not before.get(name)}
        known = put_arrays(path, 1, changed, gone=before.keys() - arrays.keys())
        seal(path, 1, known | {"attributes": attributes})

    return put


def summed(name, spoil):
    def change(attributes, arrays):
        what, _, scale = name.partition("second")
        if scale and name not in arrays:  # as of more rows
            rows = arrays.pop(f"{what}codes{scale}").astype(np.int64)
            arrays[name] = (rows @ rows.T)[np.tril_indices(len(rows))]
        arrays[name] = spoil(arrays[name])

    return checkpoint(change)


def attributed(name, value):
    return checkpoint(lambda attributes, arrays: attributes.update({name: value}))


def targeted(name, value):
    return checkpoint(lambda attributes, _: attributes.update(targets=attributes["targets"] | {name: value}))


def pairs(values_by_name):
    return ((name, value) for name, values in values_by_name.items() for value in values)


def one_after_another(*changes):
    return lambda path: [change(path) for change in changes]


def under_anothers_key(path):
    """Other readings under the key of a touch."""
    put_row(path, **ROW | {"key": validate(stream(OTHER[0][1]), PAD).key, "label": OTHER[0][0]})


SUMS = {
    "statistics-observations": [lambda a: a - 10, lambda a: a.astype(float), lambda a: a[:-1]],
    "statistics-lengths": [lambda a: -a, lambda a: a[:, :1], lambda a: a + 2**30],
    "statistics-rows-15": [lambda a: -a, lambda a: a + 2**62, lambda a: None],
    "statistics-sums-15": [lambda a: a[:, :-1], lambda a: a.astype(np.int32), lambda a: None],
    "statistics-second-15": [lambda a: a[:-1], lambda a: a.astype(float)],
    "statistics-codes-15": [lambda a: a + LARGE, lambda a: a[:-1]],
    "statistics-codes-1048576": [lambda a: a.astype(np.int64), lambda a: None],
    "sample-keys": [lambda a: a[:-1], lambda a: a[:, :3]],
    "sample-sizes": [lambda a: a * 0, lambda a: -a, lambda a: None],
    "sample-pairs": [lambda a: -a, lambda a: a + 2**40, lambda a: a[:, :2]],
    "sample-rows": [lambda a: a + LARGE, lambda a: a[:, :-1], lambda a: a.astype(np.int64)],
    "kept-keys": [lambda a: a[:-1]],
    "kept-columns": [lambda a: -a, lambda a: None],
    "kept-levels": [lambda a: a.astype(np.int16)],
    "exemplars-keys": [lambda a: a[:-1]],
    "exemplars-sources": [lambda a: -a - 1, lambda a: a.astype(float)],
    "retracted": [lambda a: np.array([0]), lambda a: np.array([1.5])],
}
ABOUT = {
    "statistics": [None, [], {"materials": ["a", "b", "\n"]}, {"materials": ["a", "b", 3]}, {"materials": ["a"]}],
    "sample": [None, {"materials": ["a"], "annotations": []}, {"materials": ["a"] * 12, "annotations": [3] * 12}],
    "kept": [[], {"materials": ["a"] * 12}, {"materials": ["a"] * 12, "annotations": [{"values": [["force"]]}] * 12}],
    "exemplars": [[], {}, {"materials": "a"}],
    "descriptions": [[], {"a": None}, {"a": {"wool": "x"}}, {"": {"wool": 1.0}}],
    "quantities": [[], {"force": 3}, {"speed": {"unit": "N"}}],
    "corrections": [3, [[1, "x"]], [[1]]],
    "weighings": [[], {"": 1}],
    "tuned_last_sequence": ["x"],
    "tuned": [{}, {"names": ["a"], "mode": "head", "kept": True, "report": {}}],
}
AXIS = {
    "targets-axes-0-statistics-observations": [lambda a: a - 1, lambda a: None],
    "targets-axes-0-statistics-rows-15": [lambda a: a[:1], lambda a: a - 10**6],
    "targets-axes-0-statistics-sums-15": [lambda a: a[:1], lambda a: None],
    "targets-sums": [lambda a: a[:0], lambda a: a.astype(float)],
}
TOLD = {
    "touches": [None, "x"],
    "total": [None, "", "x" * 64],
    "of": [None, [3], [["force"]]],
    "axes": [None, {}, [3], [["slip"]]],
}
IN_ROW, IN_CHECKPOINT = (f"{what} of .* is not what is written there" for what in ("row [0-9]+", "checkpoint 1"))


def forged_rows():
    """What somebody put into the log of a whole memory: its name, what does it, what is said of it, and how."""
    for name, changes in ROWS.items():
        yield f"a row: {name}", row(**changes), IN_ROW, DamageError
    for kind in ("exec", "", "OBSERVE"):
        yield f"a kind {kind!r}", row(kind=kind, label="", key=b""), f"row 14 .* of kind {kind!r}", MismatchError
    for spans in SEQUENCES:
        yield f"a retraction of {spans}", retraction(spans), IN_ROW, DamageError
    for said in CONSTITUENTS:
        yield f"a description {said}", description(said), IN_ROW, DamageError
    for label, said in QUANTITIES:
        declaring = row(kind="declare", label=label, attributes=said)
        yield f"a quantity {label[:9]} {said}"[:60], declaring, IN_ROW, DamageError


def forged_memories():
    """What else somebody made of a memory: its name and which, what does it, what is said of it, and how."""
    yield (
        "another touch's key",
        "whole",
        under_anothers_key,
        "key: expected the content hash of its readings",
        DamageError,
    )
    nothing = row(attributes={"columns": 60}, payload={})
    yield "a row of nothing", "whole", nothing, "codes or readings", DamageError
    later, said = packed_row(dreams=np.zeros(3)), r"arrays \['dreams'\], which this version does not know"
    yield "arrays of a later version", "whole", later, said, MismatchError
    for name, changes in UNFIT.items():
        yield f"packed readings: {name}", "whole", packed_row(**ZEROS | changes), IN_ROW, DamageError
    for scale, (name, spoil) in itertools.product((15, 1048576), CODES.items()):
        yield f"codes-{scale} {name}", "coded", codes(f"codes-{scale}", f"codes-{scale}", spoil), IN_ROW, DamageError
    yield "a scale less", "coded", codes("codes-37", "codes-37", lambda _: None), IN_ROW, DamageError
    yield "a scale more", "coded", codes("codes-38", "codes-37", np.copy), IN_ROW, DamageError
    for part, field, name, do in identities():
        match, expected = ("identity|range", TYPED) if part else (f"identity of .*{field}", DamageError)
        yield f"identity: {name}", "whole", do, match, expected
    for i, (name, spoil) in enumerate(pairs(SUMS)):
        yield f"{name} {i}", "whole", summed(name, spoil), IN_CHECKPOINT, DamageError
    for i, (name, spoil) in enumerate(pairs(AXIS)):
        yield f"{name} {i}", "noted", summed(name, spoil), IN_CHECKPOINT, DamageError
    for name, value in pairs(TOLD):
        yield f"{name} {value}"[:60], "noted", targeted(name, value), IN_CHECKPOINT, DamageError
    for name, value in pairs(ABOUT):
        yield f"{name} {str(value)[:40]}", "whole", attributed(name, value), IN_CHECKPOINT, DamageError


@pytest.mark.parametrize(("do", "match", "expected"), [pytest.param(*one, id=name) for name, *one in forged_rows()])
def test_what_no_memory_writes_is_refused_by_whoever_reads_or_merges_it(path, others, do, match, expected):
    do(path)
    require_refused(path, match, expected, others, modes=["read"])


@pytest.mark.parametrize(
    ("source", "do", "match", "expected"), [pytest.param(*one, id=name) for name, *one in forged_memories()]
)
def test_what_no_memory_holds_is_refused(made, tmp_path, source, do, match, expected):
    path = copied(made / source, tmp_path / "m")
    do(path)
    settings_ = {"embedding": STORED["embedding"]} if source == "coded" else {}
    require_refused(path, match, expected, modes=["write"], **settings_)  # a check is a reader


def test_what_is_left_out_as_shared_must_be_there(path, tmp_path):
    """Row 1 lies under a checkpoint: opening does not read it, but a touch is left out for its key."""
    theirs, (receipt,) = filled(tmp_path / "theirs", [("a", (9, 60))])
    theirs.close()
    attributes, payload = observation(path)
    put_row(path, sequence=1, label="a", key=receipt.key, attributes=attributes, payload=payload)
    assert any("content hash" in found for found in check_memory(path))
    with opened(tmp_path / "theirs") as learner:
        before = learner.digest(), len(learner.observations())
        with pytest.raises(DamageError, match=f"row 1 of {path} .* content hash"):
            learner.merge(path)
        assert (learner.digest(), len(learner.observations())) == before


def test_a_time_beyond_the_calendar_is_exported(path, tmp_path):
    for time in (-1e14, 1e300):
        readings = validate(stream((int(abs(math.log(abs(time)))), 60)), PAD)
        put_row(
            path,
            key=readings.key,
            attributes={"columns": 60, "nbytes": 480},
            payload=pack_readings(readings.readings),
            time=time,
        )
    with opened(path, mode="read") as learner:
        assert [row.time for row in learner.observations()][-2:] == [-1e14, 1e300]
        export_plain(learner, tmp_path / "plain")
    assert "-100000000000000.0" in (tmp_path / "plain" / "observations.csv").read_text()


@pytest.mark.parametrize("changed", [{"descriptions": 1}, {"descriptions": {"a": {"x": 2.0}}}, {"tuned": 1}])
def test_what_a_merge_leaves_out_is_looked_at_where_it_is_there(made, tmp_path, changed):
    path = copied(made / "whole", tmp_path / "m")
    attributes, arrays = checkpoint_of(made / "compacted")
    put_row(path, kind="merge", attributes=attributes | changed, payload=arrays)
    require_refused(path, IN_ROW)


def test_what_a_compaction_checkpoint_brings_is_looked_at_again_when_it_is_read(made, tmp_path):
    others = copied(made / "other", tmp_path / "other")
    with opened(others) as target:
        target.merge(made / "compacted")
    assert check_memory(others) == []
    with opened(others, mode="read") as learner:
        assert learner.materials == {"a": 4, "b": 4, "c": 4, "d": 2, "e": 1}


@pytest.mark.parametrize("configuration", [{}, {"kind": "no such"}, {"kind": "kernels", "dimension": 64, "more": 1}])
def test_a_configuration_that_makes_nothing_is_found_before_it_is_opened(path, configuration):
    identity = get_identity(path)
    identity["embedding"]["configuration"] = configuration
    set_identity(path, json.dumps(identity))
    assert any("configuration" in found for found in check_memory(path))
    with pytest.raises(EmbeddingError):
        opened(path)
