"""What goes into the store comes back with the same bytes; what could not is refused."""

import json
import string
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scroll_tactile_store
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scroll_tactile_store import Head, Record, RecordError, Store, checkpoint_files, encoding, records
from store_builds import damage, newest, same_arrays, sequences

DTYPES = ["|i1", "|u1", "<i2", "<i4", "<i8", "<u2", "<u4", "<u8", "<f2", "<f4", "<f8"]
arrays = st.dictionaries(
    st.text(string.ascii_lowercase + "_0.", min_size=1, max_size=6).filter(
        lambda name: not name.startswith(("__", ".")) and not name.endswith(".")
    ),
    st.sampled_from(DTYPES).flatmap(
        lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=5))
    ),
    max_size=3,
)
texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"))
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=6,
)
attributes = st.dictionaries(texts, values, max_size=3)


def same(found, given):
    assert same_arrays(found, given)
    return list(found) == list(given) and all(array.flags.writeable for array in found.values())


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    with Store.open(tmp_path_factory.mktemp("kept") / "s", identity={}) as opened:
        yield opened


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example("", "", b"", -0.0, {}, {})
@given(texts, texts, st.binary(max_size=64), st.floats(allow_nan=False, allow_infinity=False), attributes, arrays)
def test_a_record_and_a_checkpoint_come_back_with_the_same_bytes(kept, kind, label, key, time, attributes, arrays):
    before = kept.last
    given = kept.append(kind, label, key, time=time, attributes=attributes, arrays=arrays)
    number = kept.commit(arrays, last_sequence=kept.last, attributes=attributes)
    with Store.open(kept.path, mode="read") as reader:
        (found,) = reader.records(before)
        made = reader.latest()
    again = kept.record(given.sequence)
    assert (type(given), type(found), type(again)) == (Head, Record, Record)
    assert given == next(kept.heads(before))
    for record in (given, found, again):
        assert record.sequence == before + 1
        assert (record.kind, record.label, record.key) == (kind, label, key)
        assert np.float64(record.time).tobytes() == np.float64(time).tobytes()
        assert json.dumps(record.attributes, sort_keys=True) == json.dumps(attributes, sort_keys=True)
    assert same(found.arrays, arrays) and same(again.arrays, arrays) and same(made.arrays, arrays)
    assert (made.number, made.last_sequence, made.attributes) == (number, kept.last, attributes)


SPECIAL = {
    "signed_zeros": np.array([-0.0, 0.0]),
    "nan_payload": np.array([0x7FF8DEADBEEF0001, 0xFFF0000000000000], "<u8").view("<f8"),
    "scalar": np.array(7, "<i2"),
    "no_rows": np.empty((0, 4), "<f4"),
    "transposed": np.arange(6).reshape(2, 3).T,
    "strided": np.arange(20)[::3],
    "frozen": np.frombuffer(b"abcdefgh", "<i4"),
    # zstd says a size in one, two or four bytes
    **{f"compressed_{size}": np.zeros(size, "|u1") for size in (70, 255, 256, 65_791, 65_792, 300_000)},
    "in_chunks": np.arange(3 * 11_000, dtype=np.float64).reshape(3, 11_000),
    "in_one": np.arange(11_000).reshape(1, -1),
}


@pytest.mark.parametrize("spare", [None, 2**18])
def test_awkward_arrays_come_back_in_both_places_and_bombs_are_written_as_they_are(kept, monkeypatch, spare):
    monkeypatch.setattr(checkpoint_files, "CHUNK_BYTES", 2**16)
    given = dict(SPECIAL)
    if spare is not None:  # so little would stand for so much that readers made no room for it
        given["bomb"] = np.zeros(2**22, np.uint8)
        for module in (encoding, checkpoint_files):
            monkeypatch.setattr(module, "SPARE", spare)
    head = kept.append("a", "b", b"", arrays=given)
    kept.commit(given, last_sequence=head.sequence)
    assert same(kept.record(head.sequence).arrays, given)
    assert same(kept.latest().arrays, given)
    assert damage(kept.path) == []
    assert (head.size > 2**22) == (spare is not None)
    assert sorted(chunk.name for chunk in (newest(kept.path) / "in_chunks" / "c").iterdir()) == ["0", "1", "2"]


REFUSED = {
    "label not text": {"label": 3},
    "key not bytes": {"key": "text"},
    "time not a number": {"time": float("nan")},
    "attribute NaN": {"attributes": {"a": [1, float("nan")]}},
    "attribute of NumPy": {"attributes": {"a": np.int64(1)}},
    "attributes of more values than are read": {"attributes": {"many": [0] * 2**10}},
    "attributes of more bytes than are read": {"attributes": {"long": "x" * 2**14}},
    "objects": {"arrays": {"x": np.array([None, 1])}},
    "text": {"arrays": {"x": np.array(["wool"])}},
    "truths": {"arrays": {"x": np.array([True])}},
    "structured": {"arrays": {"x": np.zeros(2, [("a", "<i4")])}},
    "big-endian": {"arrays": {"x": np.zeros(2, ">i4")}},
    "a list": {"arrays": {"x": [1, 2]}},
    "a name that climbs": {"arrays": {"../x": np.zeros(2)}},
    "a file of zarr's": {"arrays": {"zarr.json": np.zeros(2)}},
    "no array may be called 'log-x'": {"arrays": {"log-x": np.arange(2)}, "last_sequence": 0},
    **{f"last_sequence must be .*{wrong}": {"last_sequence": wrong} for wrong in (-1, 10**9, True, 1.0)},
}


@pytest.mark.parametrize(("said", "wrong"), REFUSED.items(), ids=REFUSED)
def test_what_cannot_be_kept_is_refused_and_nothing_changes(kept, said, wrong, monkeypatch):
    monkeypatch.setattr(records, "MOST_VALUES", 2**10)
    monkeypatch.setattr(records, "LARGEST_JSON", 2**14)
    before, match = kept.state(), said if "must" in said or "called" in said else None
    if "last_sequence" not in wrong:
        with pytest.raises(RecordError, match=match) as caught:
            kept.append(**({"kind": "a", "label": "b", "key": b""} | wrong))
        assert isinstance(caught.value, ValueError)
    if wrong.keys() & {"arrays", "attributes", "last_sequence"}:
        for commit in (kept.commit, kept.commit_later):
            with pytest.raises(RecordError, match=match):
                commit(**({"arrays": {}, "last_sequence": 0} | wrong))
    kept.flush()
    assert kept.state() == before


def test_rows_are_found_behind_one_by_kind_and_by_their_number(opened):
    for number in range(1, 11):
        kind, label = ("add", "take")[number % 3 == 0], ("wool", "é'\"\U0001f9f6")[number % 2]
        opened.append(kind, label, bytes([number]), arrays={"x": np.arange(number)}, attributes={"n": number})
    heads = opened.heads(8)
    assert next(heads).sequence == 9
    opened.append("add", "late", b"")
    assert sequences(heads) == [10]  # up to the last when the first was asked for
    for asked, expected in (
        ({"after": 7}, [8, 9, 10, 11]),
        ({"after": 99}, []),
        ({"kind": "take"}, [3, 6, 9]),
        ({"after": 3, "kind": "take"}, [6, 9]),
        ({"kind": "wool"}, []),
    ):
        assert sequences(opened.heads(**asked)) == expected
    record = opened.record(7)
    assert (record.sequence, record.attributes, record.arrays["x"].tolist()) == (7, {"n": 7}, list(range(7)))
    for wrong in (0, -1, 12, True, 1.0, "1", None):
        with pytest.raises(RecordError, match="has records 1 to 11, not"):
            opened.record(wrong)


def test_importing_is_light_and_rows_are_read_without_zarr(opened):
    opened.append("a", "b", b"", arrays={"x": np.arange(300)})
    code = (
        "import sys, scroll_tactile_store as store; print({'zarr', 'numcodecs', 'filelock'} & set(sys.modules))\n"
        "with store.Store.open(sys.argv[1], mode='read') as opened: print(len(list(opened.records())))\n"
        "print({'zarr'} & set(sys.modules))"
    )
    command, where = [sys.executable, "-c", code, str(opened.path)], Path(scroll_tactile_store.__file__).parents[1]
    found = subprocess.run(command, cwd=where, capture_output=True, text=True, check=True)
    assert found.stdout.splitlines() == ["set()", "1", "set()"]
