"""What anybody can write into a store, with right checksums: rows, identities and generations that are none."""

import json
import shutil
import sqlite3
from contextlib import closing

from store import Store
from store.encoding import check_arrays, encode_payload
from store.records import checksum, payload_digest

JOURNAL = "journal.sqlite"


def connected(path):
    """An SQLite connection to the journal in a folder; the log is emptied into the file when it is closed."""
    return closing(sqlite3.connect(path / JOURNAL, isolation_level=None))


def as_text(value):
    """JSON as a store keeps it; text stays as it is."""
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True, separators=(",", ":"))


def put_row(
    path, *, kind="observe", label="silk", key=b"k" * 32, attributes=None, payload=None, time=0.0, sequence=None
):
    """Append a row; payload: bytes, or arrays by name. Returns its sequence."""
    body = payload if isinstance(payload, bytes) else encode_payload(check_arrays(payload or {}))
    text = as_text({} if attributes is None else attributes)
    with connected(path) as connection:
        if sequence is None:
            (last,) = connection.execute("SELECT coalesce(max(sequence), 0) FROM record").fetchone()
            sequence = last + 1
        digest = payload_digest(body)
        sealed = checksum(
            "record", sequence, kind.encode(), label.encode(), key, time, text.encode(), len(body), digest
        )
        row = (sequence, kind, label, key, time, text, len(body), digest, sealed)
        connection.execute("INSERT INTO record VALUES (?,?,?,?,?,?,?,?,?)", row)
        connection.execute("INSERT INTO payload VALUES (?,?)", (sequence, body))
    return sequence


def get_identity(path):
    """The identity in a folder."""
    with connected(path) as connection:
        (value,) = connection.execute("SELECT value FROM meta WHERE key = 'identity'").fetchone()
    return json.loads(value)


def set_identity(path, identity):
    """Put another identity into a folder; identity: JSON, or any text."""
    text = as_text(identity)
    sealed = checksum("meta", b"identity", text.encode())
    with connected(path) as connection:
        connection.execute("UPDATE meta SET value = ?, checksum = ? WHERE key = 'identity'", (text, sealed))


def row_of(path, sequence=1):
    """A row's attributes and arrays, the caller's to change."""
    with Store.open(path, mode="read") as store:
        record = store.record(sequence)
        return dict(record.attributes), dict(record.arrays)


def generation_of(path):
    """The attributes and arrays of the newest generation, the caller's to change."""
    with Store.open(path, mode="read") as store:
        newest = store.latest()
        return dict(newest.attributes), dict(newest.arrays)


def put_generation(path, attributes, arrays, *, base=False):
    """Make this the newest generation, or the base of all rows."""
    with Store.open(path) as store:
        store.commit(arrays, upto=store.last, attributes=attributes)
        if base:
            store.compact(arrays, upto=store.last, attributes=attributes)


def copied(source, target):
    """A copy of a memory's folder."""
    shutil.copytree(source, target)
    return target
