"""Stores to be harmed, how to harm them, and what they must hold; shared by the tests of this folder."""

import errno
import os
import shutil

import numpy as np
import pytest
from forging import frames_of, get_current, group_of, log_of, read_log, spoil_row, write_log
from scroll_tactile_store import CompactedError, DamageError, Store, check_store

LAST = 20
IDENTITY = {"for": ["tests", 1]}


def values(number):
    """The array of a row: of two lengths, so that some heads are read with their arrays and some are not."""
    return np.random.default_rng(number).integers(0, 2**40, 900 if number % 5 == 0 else 200)


def state(last_sequence):
    """The arrays of a checkpoint."""
    rows = np.arange(400.0).reshape(100, 4) + last_sequence
    return {"sum": np.array(last_sequence), "rows": rows, "names": np.arange(last_sequence).astype(np.uint8)}


def add(opened, number):
    return opened.append(
        "a", f"row {number}", bytes([number % 256]), arrays={"x": values(number)}, attributes={"n": number}
    )


def commit(call, last_sequence, **options):
    return call(state(last_sequence), last_sequence=last_sequence, attributes={"n": last_sequence}, **options)


def build(path, *, compacted=False, last=LAST):
    """Twenty rows, a checkpoint up to row 15, and, where compacted, a compaction checkpoint up to row 6 beside it."""
    with Store.open(path, identity=IDENTITY) as opened:
        for number in range(1, last + 1):
            add(opened, number)
            if number == 15:
                if compacted:
                    commit(opened.compact, 6, newest=(state(15), {"n": 15}))
                else:
                    commit(opened.commit, 15)
    return path


def as_after_a_crash(opened, copy):
    """Copy an open store as its process would leave it if it died now."""
    return shutil.copytree(opened.path, copy, ignore=shutil.ignore_patterns("lock", "holder.json"))


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def folders(path):
    return sorted(entry.name for entry in (path / "checkpoints").iterdir())


def newest(path):
    return group_of(path, get_current(path)["newest"]["number"])


def compaction(path):
    return group_of(path, get_current(path)["compaction"]["number"])


def sequences(rows):
    return [row.sequence for row in rows]


def fails(code=errno.EIO):
    """A call that the disk refuses."""

    def fail(*_, **__):
        raise OSError(code, os.strerror(code))

    return fail


def flip(file, place=-9, bit=2):
    data = bytearray(file.read_bytes())
    data[place] ^= 1 << bit
    file.write_bytes(data)


def spoil(folder):
    """Damage a checkpoint's rows."""
    flip(folder / "rows" / "c" / "0" / "0")


def flip_row(path, number, *, arrays=False):
    """Damage a row's head, or no more than its arrays."""
    spoil_row(path, number, head=not arrays)


def change_rows(path, change):
    """Change the bytes of the rows, a dictionary by sequence; all checksums are right."""
    found = {int.from_bytes(row[:8], "little"): row for row in read_log(path)[1]}
    change(found)
    write_log(path, list(found.values()))


def lose_rows(path, *numbers):
    """Take rows out, as nothing that damages a disk does: what is left verifies."""
    change_rows(path, lambda found: [found.pop(number) for number in numbers])


def cut_rows(path, first):
    """Cut the log off before a row."""
    os.truncate(log_of(path), frames_of(path)[first].offset)


def in_turns(table):
    """The values of a table for `which`: what is done to the plain store, and what to the compacted one."""
    return [(bool(i % 2), *(one if isinstance(one, tuple) else (one,))) for i, one in enumerate(table.values())]


def damage(path):
    return [problem for problem in check_store(path) if problem.kind != "leftover"]


def is_refused(path, match="repair", **options):
    """Nobody opens it, and each is told why; the last error."""
    for mode in ("read", "write"):
        with pytest.raises(DamageError, match=match) as caught:
            Store.open(path, mode=mode, **options)
    return caught.value


def same_arrays(found, given):
    return {name: (array.dtype, array.shape, array.tobytes()) for name, array in found.items()} == {
        name: (array.dtype, array.shape, array.tobytes()) for name, array in given.items()
    }


def holds(opened, *, kept=LAST, compacted=0, latest=None, lost=()):
    """An open store of rows 1 to `kept`, of which those up to `compacted` have no arrays and `lost` are not there."""
    assert (opened.identity, opened.last, opened.compacted) == (IDENTITY, kept, compacted)
    rows = [(row.sequence, row.label, row.key, row.attributes) for row in opened.heads()]
    expected = [n for n in range(1, kept + 1) if n not in lost]
    assert rows == [(n, f"row {n}", bytes([n]), {"n": n}) for n in expected]
    rows = [(row.sequence, row.arrays["x"].tobytes()) for row in opened.records(compacted)]
    assert rows == [(n, values(n).tobytes()) for n in range(compacted + 1, kept + 1)]
    for number in range(1, compacted + 1):
        for read in (lambda number: opened.records(number - 1), opened.record):
            with pytest.raises(CompactedError, match=f"records 1 to {compacted}"):
                read(number)
    for found, last_sequence in ((opened.latest(), latest), (opened.compaction(), compacted or None)):
        assert (found and found.last_sequence) == last_sequence
        if found:
            assert found.attributes == {"n": last_sequence}
            assert same_arrays(found.arrays, state(last_sequence))
    return True


def agrees(path, **expected):
    """An undamaged store that `holds` this, whoever opens it."""
    assert damage(path) == []
    for mode in ("read", "write"):
        with Store.open(path, mode=mode) as opened:
            assert holds(opened, **expected)
    return True
