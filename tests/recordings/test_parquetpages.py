"""Pages of parquet files claim no more than their file allows, and pyarrow is asked for none that does."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from faults.parquet_attacks import BINARY, I32, I64, LIST, PARQUETS, STRUCT, parquet, struct, value
from faults.recording_attacks import ATTACKS
from made import lerobot

from scroll_tactile.recordings import describe
from scroll_tactile.recordings.bounds import SPARE, Budget
from scroll_tactile.recordings.lerobot import require_bounded_pages

CHILD = """
import json, sys
import pyarrow.parquet
from scroll_tactile.errors import RecordingError
from scroll_tactile.recordings import read
def peak():  # ru_maxrss would be this process's parent's as well
    return int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]) >> 10
before = peak()
came = {}
for name, (path, options) in json.load(sys.stdin).items():
    try:
        read(path, **options)
        how = "read"
    except RecordingError as error:
        how = "no memory" if isinstance(error.__cause__, MemoryError) else str(error)
    came[name] = how, peak() - before
json.dump(came, sys.stdout)
"""
# How they are refused, where that shows more than that they are.
REFUSED = {
    "R7 lerobot: a page behind its column": "ends at 4072, its column at 92",
    "R7 lerobot: a page of too few": "a column of 1 values has 0 in its pages",
    "R7 lerobot: many row groups": "a list of 1000000 values of kind 12",
    "R7 lerobot: texts for numbers": "holds string; expected numbers",
}


def test_memory_is_bounded_whatever_pages_claim(tmp_path):
    made = {}
    for name in (f"R7 lerobot: {name}" for name in PARQUETS):
        folder = tmp_path / str(len(made))
        folder.mkdir()
        path, options = ATTACKS[name](folder, tmp_path / "secret")
        made[name] = str(path), options
    root = Path(__file__).resolve().parents[2]
    environment = os.environ | {"PYTHONPATH": f"{root}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    child = subprocess.run(
        [sys.executable, "-c", CHILD],
        input=json.dumps(made),
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    for name, (how, grown) in json.loads(child.stdout).items():
        assert how not in ("read", "no memory") and re.search(REFUSED.get(name, ""), how), (name, how)
        assert grown << 20 < 4 * SPARE, name  # as `faults/recorded.py` has it


@pytest.mark.parametrize("codec", ["zstd", "snappy", "gzip", "lz4", "none"])
@pytest.mark.parametrize("version", ["1.0", "2.0"])
@pytest.mark.parametrize("dictionary", [True, False])
def test_every_page_of_the_columns_that_are_read_is_counted(tmp_path, codec, version, dictionary):
    rows = np.random.default_rng(2).integers(0, 99, (5000, 3)).astype("f4")
    columns = {
        "a": pa.array(rows.tolist()),
        "a.b": pa.array([{"c": i, "d": [i] * 2} for i in range(5000)]),
        "e": pa.FixedSizeListArray.from_arrays(pa.array(rows.ravel()), 3),
        "text": pa.array([f"x{i}" * 20 for i in range(5000)]),
        "gaps": pa.array([None if i % 3 else i for i in range(5000)]),
    }
    within = {"a": "list."}  # not of "a.b"
    options = {"compression": codec, "data_page_version": version, "use_dictionary": dictionary}
    path = tmp_path / "a.parquet"
    pq.write_table(pa.table(columns), path, data_page_size=2000, row_group_size=2000, **options)
    counted = {}
    for name in columns:
        budget = Budget("a.parquet", path.stat().st_size)
        require_bounded_pages(path, [name, "other"], budget)
        counted[name] = budget.bytes
    with pq.ParquetFile(path) as file:
        chunks = [file.metadata.row_group(i).column(j) for i in range(3) for j in range(file.metadata.num_columns)]
    for name in columns:
        own = [chunk for chunk in chunks if f"{chunk.path_in_schema}.".startswith(f"{name}.{within.get(name, '')}")]
        values, whole = (sum(getattr(c, about) for c in own) for about in ("num_values", "total_uncompressed_size"))
        assert 8 * values <= counted[name] <= 8 * values + whole
    budget = Budget("a.parquet", path.stat().st_size)
    require_bounded_pages(path, None, budget)
    assert budget.bytes == sum(counted.values())


COLUMN = {1: (I32, 4), 2: (LIST, (I32, [0])), 3: (LIST, (BINARY, [b"x"])), 4: (I32, 0), 5: (I64, 0), 6: (I64, 0)}
COLUMN |= {7: (I64, 0), 9: (I64, 4)}


@pytest.mark.parametrize(
    ("column", "said"),
    [
        (struct(COLUMN), None),
        (struct(COLUMN | {2: (LIST, (BINARY, [b"x"]))}), "a list of 1 values of kind 8"),
        (struct(COLUMN)[:-1] + struct({9: (I64, 8)}), "field 9 of a structure, twice"),
        (struct(COLUMN | {30: (11, b"\1\x88\1a\1b")}), "a value of kind 11"),
        (struct(COLUMN | {4: (I32, 2**40)}), "a number of more than 32 bits"),
        (struct(COLUMN | {30: (LIST, (STRUCT, [b"\x1c" * 80]))}), "more than 32 structures within each other"),
        (struct(COLUMN | {5: (I64, 7)}), "a column of 7 values has 0 in its pages"),
        (struct(COLUMN | {9: (I64, 10**9)}), "a column ends at byte 1000000000"),
    ],
)
def test_footers_that_another_reader_could_read_otherwise_are_refused(tmp_path, column, said):
    group = struct({1: (LIST, (STRUCT, [struct({2: (I64, 4), 3: (STRUCT, column)})] * 2)), 2: (I64, 0), 3: (I64, 0)})
    path = tmp_path / "a.parquet"
    path.write_bytes(b"".join(parquet(b"", groups=value(LIST, (STRUCT, [group])))))
    if said is None:
        require_bounded_pages(path, None, Budget("a"))
    else:
        with pytest.raises(ValueError, match=said):
            require_bounded_pages(path, None, Budget("a"))


def test_what_is_cut_off_anywhere_is_refused(tmp_path):
    begin, end = parquet(b"")
    footer, path = end[:-8], tmp_path / "a.parquet"
    for length in range(len(footer)):
        path.write_bytes(begin + footer[:length] + length.to_bytes(4, "little") + b"PAR1")
        with pytest.raises((IndexError, KeyError, ValueError)):
            require_bounded_pages(path, None, Budget("a"))


def test_a_rate_that_is_no_number_is_none(tmp_path):
    path = lerobot(tmp_path / "set")
    about = json.loads((path / "meta/info.json").read_text())
    for rate in ("ü", [5], True):
        (path / "meta/info.json").write_text(json.dumps(about | {"fps": rate}))
        assert "Hz" not in str(describe(path))
