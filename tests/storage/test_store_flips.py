"""Any single bit, in any file: harmless, or found; and repaired to a state that there has been."""

import os
import random
import shutil

import pytest
from store_builds import IDENTITY, LAST, damage, flip, frames, log_of, same_arrays, state, values

from store import Store, repair_store

BATCH = 25


def content(path):
    """All that the store gives."""
    with Store.open(path, mode="read") as opened:
        return {
            "identity": opened.identity,
            "last": opened.last,
            "compacted": opened.compacted,
            "heads": list(opened.heads()),
            "rows": [(row.sequence, row.label, row.arrays["x"].tobytes()) for row in opened.records(opened.compacted)],
            "latest": sound(opened.latest()),
            "compaction": sound(opened.compaction()),
        }


def sound(found):
    """The last row that a checkpoint contains, if it is as it was committed."""
    if found is None:
        return 0
    assert same_arrays(found.arrays, state(found.last_sequence))
    assert found.attributes == {"n": found.last_sequence}
    return found.last_sequence


def is_a_state_there_has_been(found, whole, kept):
    assert (found["identity"], found["last"]) == (IDENTITY, kept)
    before = {head.sequence: head for head in whole["heads"]}
    assert all(before[head.sequence] == head for head in found["heads"])
    # A head is lost only where a compaction checkpoint stands for it.
    behind = [head.sequence for head in found["heads"] if head.sequence > found["compacted"]]
    assert behind == list(range(found["compacted"] + 1, kept + 1))
    rows = [(number, f"row {number}", values(number).tobytes()) for number in range(found["compacted"] + 1, kept + 1)]
    assert found["rows"] == rows
    assert found["compaction"] == found["compacted"]
    return True


def flipped(path, rng):
    """Flip a bit; by turns of a file, whatever its size, and of all bytes alike."""
    files = [file for file in sorted(path.rglob("*")) if file.is_file() and file.stat().st_size]
    weights = [file.stat().st_size for file in files] if rng.random() < 0.5 else None
    (file,) = rng.choices(files, weights)
    place, bit = rng.randrange(file.stat().st_size), rng.randrange(8)
    flip(file, place, bit)
    return f"bit {bit} of byte {place} of {file.relative_to(path)}"


def is_in_last(where, path):
    """Whether a flipped byte is of the last row's batch."""
    return f"of {log_of(path).name}" in where and int(where.split()[4]) >= frames(path)[LAST].offset


@pytest.mark.parametrize("seed", range(2))
def test_any_flipped_bit_is_harmless_or_found_and_then_repaired(stores, either, tmp_path, monkeypatch, which, seed):
    monkeypatch.setattr(os, "fsync", lambda _: None)  # only what is written matters here
    rng, whole = random.Random(1000 * which + seed), content(either)
    for number in range(BATCH):
        path = shutil.copytree(stores[which], tmp_path / str(number))
        where = flipped(path, rng)
        if not damage(path):
            found = content(path)
            # Damage of the last batch looks as a torn one does: its row is not there.
            assert found == whole or (is_in_last(where, either) and is_a_state_there_has_been(found, whole, LAST - 1))
            continue
        kept = repair_store(path).kept
        assert damage(path) == [], where
        Store.open(path).close()
        assert is_a_state_there_has_been(content(path), whole, kept), where
        shutil.rmtree(path)


@pytest.mark.parametrize("places", [(0.3,), (0.1, 0.6), (0.5, 0.55), (0.2, 0.5, 0.8)])
def test_whole_pages_of_rubbish_are_found_and_then_repaired(either, places):
    """More than one at a time: rows on both sides of a page that cannot be read are found one by one."""
    whole, file = content(either), log_of(either)
    data = bytearray(file.read_bytes())
    for place in places:
        begin = int(len(data) * place) // 4096 * 4096
        data[begin : begin + 4096] = random.Random(begin).randbytes(4096)
    file.write_bytes(data)
    assert damage(either)
    kept = repair_store(either).kept
    assert damage(either) == []
    assert is_a_state_there_has_been(content(either), whole, kept)
