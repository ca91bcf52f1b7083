"""Any single bit, in any file: harmless, or found; and repaired to a state that there has been."""

import os
import random
import shutil
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from store import NotAStoreError, Store, StoreError, VersionError, check_store, repair_store

LAST = 24
IDENTITY = {"for": "flips"}
BATCH = 25


def values(number):
    # Of two lengths: some payloads share a page with others, some fill several.
    return np.random.default_rng(number).integers(0, 2**40, 900 if number % 5 == 0 else 40)


def state(upto):
    return {"sum": np.arange(upto), "rows": np.arange(400.0).reshape(100, 4) + upto, "words": np.array([f"to {upto}"])}


def build(path, *, compacted):
    with Store.open(path, identity=IDENTITY) as opened:
        for number in range(1, LAST + 1):
            opened.append(
                "a", f"row {number}", bytes([number] * 9), attributes={"n": number}, arrays={"x": values(number)}
            )
            if number in (12, 20):
                opened.commit(state(number), upto=number, attributes={"n": number}, chunks={"rows": 25})
        if compacted:
            opened.commit(state(LAST - 2), upto=LAST - 2, attributes={"n": LAST - 2}, chunks={"rows": 25})
            opened.append("a", f"row {LAST + 1}", b"", arrays={"x": values(LAST + 1)})
            opened.commit(state(LAST + 1), upto=LAST + 1, attributes={"n": LAST + 1}, chunks={"rows": 25})
            opened.compact(state(8), upto=8, attributes={"n": 8}, chunks={"rows": 25})
            opened.append("a", f"row {LAST + 2}", b"", arrays={"x": values(LAST + 2)})
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    home = tmp_path_factory.mktemp("flips")
    return {compacted: build(home / str(compacted), compacted=compacted) for compacted in (False, True)}


def contents(path):
    """All that the store gives."""
    with Store.open(path, mode="read") as opened:
        base, latest = opened.base(), opened.latest()
        return {
            "identity": opened.identity,
            "last": opened.last,
            "compacted": opened.compacted,
            "heads": list(opened.heads()),
            "rows": [(row.sequence, row.label, row.arrays["x"].tobytes()) for row in opened.records(opened.compacted)],
            "latest": latest
            and (latest.upto, latest.attributes, [array.tobytes() for array in latest.arrays.values()]),
            "base": base and (base.upto, base.attributes, [array.tobytes() for array in base.arrays.values()]),
        }


def is_a_state_there_has_been(found, whole, kept):
    assert (found["identity"], found["last"]) == (IDENTITY, kept)
    before = {head.sequence: head for head in whole["heads"]}
    assert all(before[head.sequence] == head for head in found["heads"])
    # A head is lost only where a base stands for it.
    behind = [head.sequence for head in found["heads"] if head.sequence > found["compacted"]]
    assert behind == list(range(found["compacted"] + 1, kept + 1))
    rows = [(number, f"row {number}", values(number).tobytes()) for number in range(found["compacted"] + 1, kept + 1)]
    assert found["rows"] == rows
    assert (found["base"][0] if found["base"] else 0) == found["compacted"]
    for one in (found["latest"], found["base"]):
        if one is not None:
            arrays = [state(one[0])[name].tobytes() for name in ("sum", "rows", "words")]
            assert one == (one[0], {"n": one[0]}, arrays)
    return True


def flipped(path, rng):
    """Flip a bit; by turns of a file, whatever its size, and of all bytes alike."""
    files = [file for file in sorted(path.rglob("*")) if file.is_file() and file.stat().st_size]
    weights = [file.stat().st_size for file in files] if rng.random() < 0.5 else None
    (file,) = rng.choices(files, weights)
    data = bytearray(file.read_bytes())
    place, bit = rng.randrange(len(data)), rng.randrange(8)
    data[place] ^= 1 << bit
    file.write_bytes(data)
    return f"bit {bit} of byte {place} of {file.relative_to(path)}"


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("compacted", [False, True])
def test_any_flipped_bit_is_harmless_or_found_and_then_repaired(made, tmp_path, monkeypatch, compacted, seed):
    monkeypatch.setattr(os, "fsync", lambda _: None)  # only what is written matters here
    rng, source = random.Random(1000 * compacted + seed), made[compacted]
    whole = contents(source)
    for number in range(BATCH):
        path = shutil.copytree(source, tmp_path / str(number))
        where = flipped(path, rng)
        problems = [one for one in check_store(path) if one.kind != "leftover"]
        if not problems:
            assert contents(path) == whole, where
            continue
        kept = repair_store(path).kept
        assert [one for one in check_store(path) if one.kind != "leftover"] == [], where
        Store.open(path).close()
        assert is_a_state_there_has_been(contents(path), whole, kept), where
        shutil.rmtree(path)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("compacted", [False, True])
def test_what_a_reader_gets_of_a_store_with_a_flipped_bit_is_right_or_a_typed_error(
    made, tmp_path, compacted, seed, caplog
):
    """Without a check or a repair: every call by itself."""
    rng, source = random.Random(5000 + 1000 * compacted + seed), made[compacted]
    whole = contents(source)
    heads = {head.sequence: head for head in whole["heads"]}
    for number in range(BATCH):
        path = shutil.copytree(source, tmp_path / str(number))
        where = flipped(path, rng)
        try:
            with Store.open(path, mode="read") as opened:
                assert opened.identity == IDENTITY
                found = opened.latest()
                assert found is None or [array.tobytes() for array in found.arrays.values()] == [
                    array.tobytes() for array in state(found.upto).values()
                ]
                for row in opened.records(opened.compacted):
                    assert row.arrays["x"].tobytes() == values(row.sequence).tobytes()
                assert opened.last == whole["last"], where
                for head in opened.heads():
                    assert head == heads[head.sequence], where
        except (NotAStoreError, VersionError):
            assert "journal.sqlite" in where
        except StoreError:
            pass
        shutil.rmtree(path)


def test_a_folder_copied_file_by_file_under_a_writer_gives_what_was_acknowledged_or_an_error(tmp_path, caplog):
    rng, source, acknowledged, stop = random.Random(0), tmp_path / "s", [0], threading.Event()

    def write():
        with Store.open(source, identity=IDENTITY) as opened:
            while not stop.is_set() and opened.last < 4000:
                number = opened.last + 1
                opened.append("a", f"row {number}", b"", arrays={"x": values(number % 7)})
                acknowledged[0] = number
                if number % 20 == 0:
                    opened.commit({"sum": np.array(number), "bulk": np.full(3000, number)}, upto=number)
                if number % 100 == 0:
                    opened.compact({"sum": np.array(number - 9), "bulk": np.full(3000, number - 9)}, upto=number - 9)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        outcomes = [one for number in range(25) for one in copied(source, tmp_path / str(number), rng, acknowledged)]
    finally:
        stop.set()
        writer.join()
    assert outcomes.count("right") > 10


def copied(source, copy, rng, acknowledged):
    """Copy the files in any order, while they change; what becomes of opening the copy, and of repairing it."""
    while not acknowledged[0]:
        time.sleep(0.001)
    files = [Path(folder, name).relative_to(source) for folder, _, names in os.walk(source) for name in names]
    rng.shuffle(files)
    for file in files:
        (copy / file).parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            shutil.copyfile(source / file, copy / file)
    yield opens_right(copy, acknowledged, "read")
    yield opens_right(copy, acknowledged, "write")
    try:
        repair_store(copy)
    except StoreError as error:
        yield f"not repaired: {error}"
    else:
        assert [one for one in check_store(copy) if one.kind != "leftover"] == []
        assert opens_right(copy, acknowledged, "write") == "right"
    shutil.rmtree(copy)


def opens_right(copy, acknowledged, mode):
    try:
        with Store.open(copy, mode=mode) as opened:
            assert opened.identity == IDENTITY
            found = opened.latest()
            if found is not None:
                assert found.arrays["sum"] == found.upto
                assert found.arrays["bulk"].tolist() == [found.upto] * 3000
            after = opened.compacted
            for row in opened.records(after):
                assert row.sequence == after + 1
                assert row.label == f"row {row.sequence}"
                assert row.arrays["x"].tobytes() == values(row.sequence % 7).tobytes()
                after = row.sequence
            # One more may have been on its way.
            assert after == opened.last <= acknowledged[0] + 1
    except StoreError as error:
        return type(error).__name__
    return "right"
