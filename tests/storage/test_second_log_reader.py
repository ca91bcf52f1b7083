"""A reader written from store/FORMAT.md alone finds the rows, checkpoints and damage that the store's own finds."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import second_reader
from logs import append, build, writing
from scroll_tactile_store import DamageError, Store
from scroll_tactile_store.encoding import encode_payload
from scroll_tactile_store.log import Log, create_log
from scroll_tactile_store.records import payload_digest
from scroll_tactile_store.rows import ROW, decode_row, encode_row

ARRAYS = {"codes": np.arange(700, dtype=np.int16), "none": np.zeros((0, 3), np.float32)}
PAYLOAD = encode_payload(ARRAYS)
FIELDS = [
    (1, "add", "wool", b"\1" * 32, 1.5, '{"a":[1,null]}', PAYLOAD),
    (2, "", "", b"", -0.25, "{}", b""),
    (7, "forget", "Seide, weiß ✓", b"\0" * 64, 0.0, "{}", None),
    (8, "add", "x" * 900, b"k", 2e9, '{"n":{}}', PAYLOAD),
]


def encoded(*fields):
    return encode_row(*fields, size=len(PAYLOAD) if fields[-1] is None else len(fields[-1]))


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "log"
    create_log(path, b'{"identity":1}')
    with writing(path) as log:
        for fields in FIELDS[:2]:
            log.stage(ROW, encoded(*fields))
            log.commit()
        log.stage(99, b"of a later release")
        log.commit()
        for fields in FIELDS[2:]:
            log.stage(ROW, encoded(*fields))
        log.commit()
    return path


def ours(path):
    frames, damage = [], None

    def stop(error, before):
        frames.extend(before)
        raise error

    with Log(path) as log:
        try:
            for batch in log.scan(stop):
                frames += batch
        except DamageError as error:
            damage = (error.frame, error.offset)
        return [decode_row(log.read(frame.offset, frame.size)) for frame in frames if frame.kind == ROW], damage


def theirs(path):
    _, rows, damage = second_reader.rows(path.read_bytes())
    return rows, damage and (damage.number, damage.offset)


def plain(row):
    head = row.head
    return (head.sequence, head.time, head.key, head.kind, head.label, head.attributes, row.payload, head.size)


def test_both_read_the_rows_to_the_byte(path):
    rows, damage = ours(path)
    assert damage is None
    assert [(*plain(row)[:5], plain(row)[6]) for row in rows] == [
        (sequence, time, key, kind, label, payload) for sequence, kind, label, key, time, _, payload in FIELDS
    ]
    assert [row.head.attributes for row in rows] == [json.loads(fields[5]) for fields in FIELDS]
    found, damage = theirs(path)
    assert [tuple(vars(row).values()) for row in found] == [plain(row) for row in rows] and damage is None
    assert second_reader.rows(path.read_bytes())[0] == b'{"identity":1}'
    read = second_reader.arrays(found[0].arrays)
    assert list(read) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert (read[name].dtype, read[name].shape, read[name].tobytes()) == (array.dtype, array.shape, array.tobytes())


def test_both_read_a_checkpoint(tmp_path):
    with Store.open(tmp_path / "s", identity={"of": "tests"}) as opened:
        opened.append("a", "b", b"key", arrays=ARRAYS)
        opened.commit(ARRAYS, last_sequence=1, attributes={"ü": [1, None]})
        ours = opened.latest()
        log = opened._log.identity
    known, found = second_reader.checkpoint(tmp_path / "s" / "checkpoints" / "00000001")
    assert (known["format"], known["number"], known["last_sequence"]) == (3, 1, 1)
    assert (known["attributes"], known["identity"]) == (ours.attributes, {"of": "tests"})
    index = found.pop(f"log-{log.hex()}")
    assert (index.dtype, index.shape, index[0].tolist()) == (np.uint64, (4, 1), [1])
    assert index[3].tolist() == [int.from_bytes(b"key", "little")]
    assert found.keys() == ours.arrays.keys()
    assert all(found[name].tobytes() == array.tobytes() for name, array in ours.arrays.items())


def test_both_find_the_same_damage(path, tmp_path):
    data, copy = path.read_bytes(), tmp_path / "log"
    for place in range(110, len(data), 7):
        copy.write_bytes(data[:place] + bytes([data[place] ^ 4]) + data[place + 1 :])
        rows, damage = ours(copy)
        found, other = theirs(copy)
        assert other == damage and [row.sequence for row in found] == [row.head.sequence for row in rows]
        copy.write_bytes(data[:place])
        assert [row.sequence for row in theirs(copy)[0]] == [row.head.sequence for row in ours(copy)[0]]
        assert theirs(copy)[1] is None


@pytest.mark.parametrize(("payloads", "lost"), [([b"a" * 700, b"b" * 700, b"c" * 700], 1000), ([b""] * 3, 88)])
def test_it_finds_torn_tails_as_ours_does(tmp_path, payloads, lost):
    path = build(tmp_path / "log")
    size = path.stat().st_size
    with writing(path) as log:
        append(log, payloads)
        data = path.read_bytes()[: log.place.offset]
    path.write_bytes(data[:size] + bytes(lost) + data[size + lost :])
    _, whole, damage = second_reader.frames(path.read_bytes())
    with Log(path) as log:
        assert sum(len(batch) + 1 for batch in log.scan(None)) == len(whole) == 13
    assert damage is None


def test_it_is_a_command(path):
    command = [sys.executable, Path(second_reader.__file__), path]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", check=True)
    assert done.stdout.splitlines()[1].startswith(f"1 add wool {'01' * 32} 1.5 ")
    assert len(done.stdout.splitlines()) == 5


def test_it_reads_nothing_of_the_store():
    lines = Path(second_reader.__file__).read_text().splitlines()
    imports = [line for line in lines if line.startswith(("import", "from"))]
    assert not any("scroll_tactile" in line for line in imports) and len(lines) <= 175


def changed(offset, part, *, digest=True):
    """The bytes of a row, some of them others, with the right digest of its head."""
    data = encoded(*FIELDS[0])
    data = data[:offset] + part + data[offset + len(part) :]
    texts = len(data) - 54 - len(PAYLOAD)
    right = payload_digest(data[:38] + data[54 : 54 + texts])
    return data[:38] + right + data[54:] if digest else data


CHANGED = [
    (0, bytes(8)),
    (16, b"\xff" * 8),
    (24, b"\2"),
    (26, b"\xff" * 4),
    (86, b"\xff"),
]
ROWS = [b"", encoded(*FIELDS[0])[:-1], encoded(*FIELDS[0]) + b"x", changed(54, b"\0", digest=False)]
ROWS += [changed(*part) for part in CHANGED] + [encode_row(1, "", "", b"", 0.0, "[]", b"", 0)]


@pytest.mark.parametrize("data", ROWS)
def test_a_row_that_was_never_made_is_refused(data):
    with pytest.raises(ValueError):
        decode_row(data)
