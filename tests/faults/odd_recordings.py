"""Recordings that are odd by their content and right by their bytes, as a hostile hand or a faulty program makes them.

Every choice is a random generator's; see `recorded`.
"""

from __future__ import annotations

import random
import sqlite3
from pathlib import Path
from typing import Any

from made import SKIN, ros

from faults.bag_attacks import FLOATS, mcap, mcap_chunk, message
from faults.mutants import NUMBERS, TEXTS, VALUES, mutated_bytes

WORDS = ("|O", "<M8[s]", "<U9", "|V4", "float16", "<c16", "vlen-utf8", "pickle", "blosc", "sharding_indexed", "crc32c")
JSON = (*VALUES, *WORDS, *({"id": name} for name in WORDS[6:]), *({"name": name} for name in WORDS[6:]), [10**12, 19])


def spiced(rng: random.Random, value: Any) -> Any:
    """A JSON value in which, often, one place holds something of the formats' own."""
    if not isinstance(value, dict) or not value or rng.random() < 0.5:
        return value
    at, key = value, rng.choice(sorted(value))
    while isinstance(at[key], dict) and at[key] and rng.random() < 0.7:
        at = at[key]
        key = rng.choice(sorted(at))
    at[key] = [rng.choice(JSON)] if isinstance(at[key], list) and rng.random() < 0.5 else rng.choice(JSON)
    return value


def mutated_lines(rng: random.Random, text: str) -> tuple[str, str]:
    """Lines of text of which one is another, and what was done."""
    lines = text.split("\n")
    i, how = rng.randrange(len(lines)), rng.choice(("word", "drop", "twice", "swap", "alias", "long"))
    if how == "drop":
        del lines[i]
    elif how == "twice":
        lines[i:i] = [lines[i]] * rng.choice((1, 100, 10_000))
    elif how == "swap":
        j = rng.randrange(len(lines))
        lines[i], lines[j] = lines[j], lines[i]
    elif how == "long":
        lines[i] += rng.choice((" ", ",", "[", '"', "1,")) * rng.choice((100, 10_000, 100_000))
    else:
        word = rng.choice(
            ("&a [x]", "*a", "!!python/object/apply:os.system [ls]", "../x", "[]", "{}", *map(str, NUMBERS))
        )
        words = lines[i].split(",")
        words[rng.randrange(len(words))] = rng.choice((word, rng.choice(TEXTS)))
        lines[i] = ",".join(words) if how == "word" else f"{lines[i].partition(':')[0]}: {word}"
    return f"{how} in line {i}", "\n".join(lines)


def made(rng: random.Random, folder: Path) -> tuple[Path, dict[str, Any], str]:
    """A recording that its own library would write, or that is right byte by byte, of what nobody would put in it."""
    maker = rng.choice((_made_mcap, _made_definition, _made_db3))
    path, options, about = maker(rng, folder)
    return path, options, f"{maker.__name__[6:]}: {about}"[:300]


def _body(rng: random.Random) -> bytes:
    """A message of floats whose count or bytes may be others."""
    count = rng.choice((0, 1, 19, 19, 19, *NUMBERS[:16])) % 2**32
    head = rng.choice((b"\0\1\0\0", b"\0\1\0\0", b"\0\0\0\0", b"\0\3\0\0", b""))
    return head + count.to_bytes(4, "little") + rng.randbytes(rng.choice((0, 4, 76, 76, 76, 77, 1000)))


def _made_mcap(rng: random.Random, folder: Path) -> tuple[Path, dict[str, Any], str]:
    form = rng.choice(("zstd", ""))
    inside = b""
    for _ in range(rng.choice((1, 3, 30))):
        kind, data = rng.choice(
            ((5, message(_body(rng))[9:]), (4, rng.randbytes(20)), (3, rng.randbytes(30)), (9, b""))
        )
        length = len(data) if rng.random() < 0.9 else rng.choice(NUMBERS) % 2**64
        inside += bytes([kind]) + length.to_bytes(8, "little") + data
    inside *= rng.choice((1, 1, 1, 100, 30_000))
    chunk = mcap_chunk(inside, form)
    if rng.random() < 0.3:
        _, chunk = mutated_bytes(rng, chunk, ())
    path, options = mcap(lambda: [chunk] * rng.choice((1, 1, 20)))(folder, folder)
    return path, options, f"{len(inside)} bytes by {form!r}"


def _made_definition(rng: random.Random, folder: Path) -> tuple[Path, dict[str, Any], str]:
    types = ("float32", "string", "a/C", "bool", "Header", "uint8", "string<=5", "a/B", "time", "wstring", "float128")
    sizes = ("", "[]", "[3]", "[<=4]", *(f"[{number}]" for number in NUMBERS))
    names = ("data", "data", "x", "__class__", "a b", "import", "1x", "x\n\n", "é", "x=1", "self", "Exception")
    lines = [f"{rng.choice(types)}{rng.choice(sizes)} {rng.choice(names)}" for _ in range(rng.choice((1, 2, 5)))]
    text = "\n".join([*lines, "=" * 80, "MSG: a/C", f"{rng.choice(types)}{rng.choice(sizes)} y"])
    if rng.random() < 0.2:
        _, data = mutated_bytes(rng, text.encode(), ())
        text = data.decode(errors="replace")
    text = text if rng.random() < 0.8 else FLOATS + "\n" + text
    path, options = mcap(lambda: [message(_body(rng), 3)], text, rng.choice(("a/msg/B", "a/B", "a/msg/../B")))(
        folder, folder
    )
    return path, options, text


def _made_db3(rng: random.Random, folder: Path) -> tuple[Path, dict[str, Any], str]:
    path = next(ros(folder, "db3").glob("*.db3"))
    table, columns = rng.choice(
        (
            ("messages", ("id", "topic_id", "timestamp", "data")),
            ("topics", ("id", "name", "type", "serialization_format")),
            ("message_definitions", ("topic_type", "encoding", "encoded_message_definition")),
        )
    )
    column = rng.choice(columns)
    value = rng.choice((*(v for v in VALUES if isinstance(v, int | float | str) or v is None), rng.randbytes(40)))
    statement, values = rng.choice(
        (
            (f"UPDATE {table} SET {column} = ? WHERE rowid = {rng.choice((1, 2, 9))}", (value,)),
            (f"UPDATE {table} SET {column} = ?", (value,)),
            (f"UPDATE {table} SET {column} = zeroblob({rng.choice((100, 10**6))})", ()),
            (f"ALTER TABLE {table} RENAME COLUMN {column} TO x", ()),
            (f"ALTER TABLE {table} ADD COLUMN y BLOB AS (zeroblob(900000000))", ()),
            (f"DROP TABLE {table}", ()),
            (f"UPDATE sqlite_master SET sql = ? WHERE name = '{table}'", (rng.choice(SQL).format(table),)),
            (f"UPDATE sqlite_master SET rootpage = {rng.randrange(8)} WHERE name = '{table}'", ()),
            (f"INSERT INTO {table} SELECT * FROM {table}", ()),
        )
    )
    base = sqlite3.connect(path, isolation_level=None)
    try:
        base.execute("PRAGMA writable_schema = ON")
        base.execute(statement, values)
    finally:
        base.close()
    return path, SKIN, f"{statement} {str(values)[:60]}"


SQL = (
    "CREATE VIEW {0} AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) SELECT * FROM n",
    "CREATE TABLE {0}(id INTEGER PRIMARY KEY, topic_id, timestamp, data AS (randomblob(1000000)), name, type)",
    "CREATE VIRTUAL TABLE {0} USING fts5(id)",
    "CREATE TABLE {0}(id INT, topic_id INT DEFAULT (load_extension('x')), timestamp INT, data BLOB)",
    "CREATE TABLE {0}(id, name, type, serialization_format) WITHOUT ROWID",
    "garbage",
)
