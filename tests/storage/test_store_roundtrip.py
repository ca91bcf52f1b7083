"""What goes into the store comes back with the same bytes; what could not is refused."""

import json
import string
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scroll_tactile_store
from forging import describe_again
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scroll_tactile_store import Head, Record, RecordError, Store, VersionError, checkpoint_files

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
several = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def same(found, given):
    assert list(found) == list(given)
    for name, array in given.items():
        assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape)
        assert found[name].tobytes() == array.tobytes()
        assert found[name].flags.writeable
    return True


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    with Store.open(tmp_path_factory.mktemp("kept") / "s", identity={}) as opened:
        yield opened


@several
@example("", "", b"", -0.0, {}, {})
@given(texts, texts, st.binary(max_size=64), st.floats(allow_nan=False, allow_infinity=False), attributes, arrays)
def test_a_record_comes_back_with_the_same_bytes(kept, kind, label, key, time, attributes, arrays):
    before = kept.last
    given = kept.append(kind, label, key, time=time, attributes=attributes, arrays=arrays)
    with Store.open(kept.path, mode="read") as reader:
        (found,) = reader.records(before)
    again = kept.record(given.sequence)
    assert (type(given), type(found), type(again)) == (Head, Record, Record)
    assert given == next(kept.heads(before))
    for record in (given, found, again):
        assert record.sequence == before + 1
        assert (record.kind, record.label, record.key) == (kind, label, key)
        assert np.float64(record.time).tobytes() == np.float64(time).tobytes()
        assert json.dumps(record.attributes, sort_keys=True) == json.dumps(attributes, sort_keys=True)
    assert same(found.arrays, arrays)
    assert same(again.arrays, arrays)


@several
@given(attributes, arrays)
def test_a_checkpoint_comes_back_with_the_same_bytes(kept, attributes, arrays):
    number = kept.commit(arrays, last_sequence=kept.last, attributes=attributes)
    found = kept.latest()
    assert (found.number, found.last_sequence, found.attributes) == (number, kept.last, attributes)
    assert same(found.arrays, arrays)


SPECIAL = {
    "signed_zeros": np.array([-0.0, 0.0]),
    "nan_payload": np.array([0x7FF8DEADBEEF0001, 0xFFF0000000000000], "<u8").view("<f8"),
    "scalar": np.array(7, "<i2"),
    "no_rows": np.empty((0, 4), "<f4"),
    "transposed": np.arange(6).reshape(2, 3).T,
    "strided": np.arange(20)[::3],
    "frozen": np.frombuffer(b"abcdefgh", "<i4"),
}


def test_awkward_arrays_come_back_in_both_places(kept):
    head = kept.append("a", "b", b"", arrays=SPECIAL)
    kept.commit(SPECIAL, last_sequence=head.sequence)
    assert same(kept.record(head.sequence).arrays, SPECIAL)
    assert same(kept.latest().arrays, SPECIAL)


def test_large_arrays_are_chunked_along_the_first_axis(kept, monkeypatch):
    monkeypatch.setattr(checkpoint_files, "CHUNK_BYTES", 2**16)
    rows = np.arange(3 * 11_000, dtype=np.float64).reshape(3, 11_000)
    arrays = {"rows": rows, "flat": rows.reshape(-1), "one": rows.reshape(1, -1), "whole": rows.astype(np.int64)}
    kept.commit(arrays, last_sequence=kept.last)
    assert same(kept.latest().arrays, arrays)
    folder = kept.path / "checkpoints" / f"{kept.latest().number:08d}" / "rows" / "c"
    assert sorted(chunk.name for chunk in folder.iterdir()) == ["0", "1", "2"]


REFUSED = {
    "half a character": {"label": "a\ud800b"},
    "label not text": {"label": 3},
    "key too long": {"key": bytes(256)},
    "key not bytes": {"key": "text"},
    "time not a number": {"time": float("nan")},
    "attribute NaN": {"attributes": {"a": {"b": [float("nan")]}}},
    "attribute of NumPy": {"attributes": {"a": np.int64(1)}},
    "objects": {"arrays": {"x": np.array([None, 1])}},
    "text": {"arrays": {"x": np.array(["wool"])}},
    "truths": {"arrays": {"x": np.array([True])}},
    "structured": {"arrays": {"x": np.zeros(2, [("a", "<i4")])}},
    "big-endian": {"arrays": {"x": np.zeros(2, ">i4")}},
    "a list": {"arrays": {"x": [1, 2]}},
    "a name that climbs": {"arrays": {"../x": np.zeros(2)}},
    "a file of zarr's": {"arrays": {"zarr.json": np.zeros(2)}},
}


@pytest.mark.parametrize("wrong", REFUSED.values(), ids=REFUSED.keys())
def test_what_cannot_be_kept_is_refused_and_nothing_changes(kept, wrong):
    before = kept.last
    with pytest.raises(RecordError):
        kept.append(**({"kind": "a", "label": "b", "key": b""} | wrong))
    if "arrays" in wrong or "attributes" in wrong:
        for commit in (kept.commit, kept.commit_later):
            with pytest.raises(RecordError):
                commit(**({"arrays": {}, "last_sequence": 0} | wrong))
    assert kept.last == before
    kept.flush()


@pytest.mark.parametrize("last_sequence", [-1, 10**9, True, 1.0])
def test_a_checkpoint_may_not_claim_rows_that_are_not_there(kept, last_sequence):
    with pytest.raises(RecordError, match="last_sequence"):
        kept.commit({}, last_sequence=last_sequence)


def test_the_public_names_are_sorted_and_none_leaks():
    # As ruff sorts them: constants, classes, then the rest.
    assert (
        sorted(scroll_tactile_store.__all__, key=lambda name: (not name.isupper(), name.islower(), name))
        == scroll_tactile_store.__all__
    )
    modules = {path.stem for path in Path(scroll_tactile_store.__file__).parent.glob("*.py")}
    assert {name for name in vars(scroll_tactile_store) if not name.startswith("_")} - modules == set(
        scroll_tactile_store.__all__
    )


def test_the_exception_tree_is_the_one_in_the_docstring():
    lines = scroll_tactile_store.exceptions.__doc__.splitlines()
    drawn = {line.split("── ")[1].split()[0] for line in lines if "── " in line}
    assert drawn == {name for name in scroll_tactile_store.exceptions.__all__ if name.endswith("Error")}
    for name in drawn - {"StoreError"}:
        bases = getattr(scroll_tactile_store, name).__bases__
        assert bases == (
            (scroll_tactile_store.StoreError, ValueError)
            if name == "RecordError"
            else (scroll_tactile_store.StoreError,)
        )
    assert scroll_tactile_store.StoreError.__bases__ == (Exception,)


def test_importing_is_light_and_rows_are_read_without_zarr(tmp_path):
    with Store.open(tmp_path, identity={}) as opened:
        opened.append("a", "b", b"", arrays={"x": np.arange(300)})
    code = (
        "import sys, scroll_tactile_store as store; print({'zarr', 'numcodecs', 'filelock'} & set(sys.modules))\n"
        "with store.Store.open(sys.argv[1], mode='read') as opened: print(len(list(opened.records())))\n"
        "print({'zarr'} & set(sys.modules))"
    )
    command, where = [sys.executable, "-c", code, str(tmp_path)], Path(scroll_tactile_store.__file__).parents[1]
    found = subprocess.run(command, cwd=where, capture_output=True, text=True, check=True)
    assert found.stdout.splitlines() == ["set()", "1", "set()"]


def test_some_arrays_of_a_checkpoint_are_read_without_the_others(tmp_path, caplog):
    arrays = {"a": np.arange(3), "b": np.arange(4.0), "c": np.arange(2, dtype=np.int8)}
    with Store.open(tmp_path, identity={}) as opened:
        opened.commit(arrays, last_sequence=0)
        folder = tmp_path / "checkpoints" / "00000001"
        (folder / "b" / "zarr.json").unlink()
        reader = checkpoint_files.CheckpointReader(folder)
        assert same(reader.arrays(["c", "none such", "a"]), {"a": arrays["a"], "c": arrays["c"]})
        assert opened.latest() is None
        assert "array 'b' of checkpoint 1" in caplog.text


@pytest.mark.parametrize("version", [1, 2, 4])
def test_a_checkpoint_of_another_format_is_refused(tmp_path, version):
    with Store.open(tmp_path, identity={}) as opened:
        opened.commit({"x": np.arange(3)}, last_sequence=0)
    describe_again(tmp_path, format=version)
    with (
        Store.open(tmp_path, mode="read") as opened,
        pytest.raises(VersionError, match=rf"format {version}[;,] "),
    ):
        opened.latest()
