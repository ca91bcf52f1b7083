"""A reader written from store/FORMAT.md alone finds the rows and checkpoints that the store's own finds.

That both find the same damage shows test_log.py.
"""

import runpy
import sys
from pathlib import Path

import numpy as np
import second_reader
from forging import get_current, log_of
from scroll_tactile_store import Store, check_store
from second_reader import HEAD, digest
from store_builds import same_arrays

ARRAYS = {"codes": np.arange(700, dtype=np.int16), "none": np.zeros((0, 3), np.float32)}
ROWS = [
    # kind, label, key, time, attributes, arrays
    ("add", "wool", b"\1" * 32, 1.5, {"a": [1, None]}, ARRAYS),
    ("", "", b"", -0.25, {}, {}),
    ("forget", "Seide, weiß ✓", b"\0" * 64, 0.0, {}, ARRAYS),
    ("add", "x" * 900, b"k", 2e9, {"n": {}}, ARRAYS),
]


def put_in_frame_of_kind(path, kind):
    """Append a batch with a frame that this release does not know."""
    data = log_of(path).read_bytes()
    last = second_reader.frames(data)[1][-1]
    before, number = last.checksum, last.number + 1
    for own, payload in ((kind, b"of a later release"), (second_reader.COMMIT, b"")):
        fields = HEAD.pack(
            last.mark, last.identity, number, last.number + 1, own, len(payload), before, digest(payload), b""
        )[:-16]
        before, number = digest(fields), number + 1
        data += fields + before + payload
    log_of(path).write_bytes(data)


def test_both_read_the_rows_to_the_byte_and_pass_over_what_is_new(tmp_path, monkeypatch, capsys):
    path = tmp_path / "s"
    for kind, label, key, time, attributes, arrays in ROWS:
        with Store.open(path, identity={"identity": 1}) as opened:
            opened.append(kind, label, key, time=time, attributes=attributes, arrays=arrays)
            if opened.last == 2:
                opened.compact({}, last_sequence=1)
        put_in_frame_of_kind(path, 99)
    assert check_store(path) == []
    about, found, damage = second_reader.rows(log_of(path).read_bytes())
    with Store.open(path, mode="read") as opened:
        heads, records = list(opened.heads()), list(opened.records(1))
    assert (about, damage) == (b'{"identity":1}', None)
    told = [(row.kind, row.label, row.key, row.time, row.attributes) for row in found]
    assert told == [(head.kind, head.label, head.key, head.time, head.attributes) for head in heads]
    assert told == [row[:5] for row in ROWS]
    assert [(row.sequence, row.size) for row in found] == [(head.sequence, head.size) for head in heads]
    assert found[0].arrays is None
    for row, record, given in zip(found[1:], records, ROWS[1:], strict=True):
        arrays = second_reader.arrays(row.arrays)
        assert list(arrays) == list(given[5])
        assert same_arrays(arrays, given[5]) and same_arrays(record.arrays, given[5])
    monkeypatch.setattr(sys, "argv", ["second_reader.py", str(log_of(path))])
    try:
        runpy.run_path(second_reader.__file__, run_name="__main__")
    except SystemExit as ended:
        assert ended.code == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 5 and lines[1].startswith(f"1 add wool {'01' * 32} 1.5 ")


def test_both_read_a_checkpoint(opened):
    opened.append("a", "b", b"key", arrays=ARRAYS)
    opened.commit(ARRAYS, last_sequence=1, attributes={"ü": [1, None]})
    ours = opened.latest()
    known, found = second_reader.checkpoint(opened.path / "checkpoints" / "00000001")
    assert (known["format"], known["number"], known["last_sequence"]) == (3, 1, 1)
    assert (known["attributes"], known["identity"]) == (ours.attributes, {}) == ({"ü": [1, None]}, {})
    index = found.pop(f"log-{get_current(opened.path)['log'][1]}")
    assert (index.dtype, index.shape, index[0].tolist()) == (np.uint64, (4, 1), [1])
    assert index[3].tolist() == [int.from_bytes(b"key", "little")]
    assert same_arrays(found, ours.arrays) and same_arrays(found, ARRAYS)


def test_it_reads_nothing_of_the_store():
    lines = Path(second_reader.__file__).read_text().splitlines()
    imports = [line for line in lines if line.startswith(("import", "from"))]
    assert not any("scroll_tactile" in line for line in imports) and len(lines) <= 155
