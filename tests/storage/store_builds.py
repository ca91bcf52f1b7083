"""Stores to be harmed, how to harm them, and what they must hold; shared by the tests of this folder."""

import shutil
import sqlite3
from contextlib import closing, contextmanager

import numpy as np
from store.generations import Generations

from store import Store, check_store

LAST = 20
IDENTITY = {"for": ["tests", 1]}


def values(number):
    """The array of a row: of two lengths, so that some payloads share a page and some fill several."""
    return np.random.default_rng(number).integers(0, 2**40, 900 if number % 5 == 0 else 200)


def state(upto):
    """The arrays of a generation."""
    rows = np.arange(400.0).reshape(100, 4) + upto
    return {"sum": np.array(upto), "rows": rows, "names": np.array([f"to {upto}", "é"])}


def add(opened, number):
    return opened.append(
        "a", f"row {number}", bytes([number % 256]), arrays={"x": values(number)}, attributes={"n": number}
    )


def commit(call, upto):
    return call(state(upto), upto=upto, attributes={"n": upto})


@contextmanager
def two_kept():
    """While it lasts a commit keeps the generation before it, as releases up to 0.2 did: stores may have two."""
    real = Generations._kept

    def kept(earlier, draft, *, base):
        return earlier[:1] if base else [*earlier[:1], *(row for row in earlier[1:] if row.base)]

    Generations._kept = staticmethod(kept)
    try:
        yield
    finally:
        Generations._kept = staticmethod(real)


def build(path, *, compacted=False, last=LAST):
    """Twenty rows, generations up to rows 10 and 15, and, where compacted, a base up to row 6 in place of the first."""
    with two_kept(), Store.open(path, identity=IDENTITY) as opened:
        for number in range(1, last + 1):
            add(opened, number)
            if number in (10, 15):
                commit(opened.commit, number)
            if number == 15 and compacted:
                commit(opened.compact, 6)
    return path


def as_after_a_crash(opened, copy):
    """Copy an open store as its process would leave it if it died now."""
    return shutil.copytree(opened.path, copy, ignore=shutil.ignore_patterns("*-shm", "lock", "holder.json"))


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def folders(path):
    return sorted(entry.name for entry in (path / "generations").iterdir())


def query(path, statement):
    with closing(sqlite3.connect(path / "journal.sqlite")) as connection:
        return connection.execute(statement).fetchall()


def change(path, *statements):
    with closing(sqlite3.connect(path / "journal.sqlite")) as connection, connection:
        for statement in statements:
            connection.execute(statement)


def flip(file, place=-9, bit=2):
    data = bytearray(file.read_bytes())
    data[place] ^= 1 << bit
    file.write_bytes(data)


def spoil(path, number):
    """Damage a generation's rows."""
    flip(path / "generations" / f"{number:08d}" / "rows" / "c" / "0" / "0")


def damage(path):
    return [problem for problem in check_store(path) if problem.kind != "leftover"]


def same_arrays(found, given):
    return {name: (array.dtype, array.shape, array.tobytes()) for name, array in found.items()} == {
        name: (array.dtype, array.shape, array.tobytes()) for name, array in given.items()
    }
