"""Pages of parquet files claim no more than their file allows, and pyarrow is asked for none that does."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made import lerobot

from scroll_tactile.recordings import describe
from scroll_tactile.recordings.bounds import Budget
from scroll_tactile.recordings.lerobot import require_bounded_pages


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


def test_a_rate_that_is_no_number_is_none(tmp_path):
    path = lerobot(tmp_path / "set")
    about = json.loads((path / "meta/info.json").read_text())
    for rate in ("ü", [5], True):
        (path / "meta/info.json").write_text(json.dumps(about | {"fps": rate}))
        assert "Hz" not in str(describe(path))
