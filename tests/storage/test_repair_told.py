"""What a repair says of rows that are kept, and no longer do what they did."""

import pytest
from store_builds import build, flip_row

from store import Store, repair_store


@pytest.mark.parametrize(
    ("behind", "said"),
    [((), "any more"), (("retract",), "row 16 (1 retract)"), (("b", "c", "b"), "rows 16 to 18 (2 b, 1 c)")],
)
def test_rows_behind_a_new_compaction_checkpoint_that_took_back_one_before_it_are_named(tmp_path, behind, said):
    path = build(tmp_path / "s", last=15)
    with Store.open(path) as opened:
        for kind in behind:
            opened.append(kind, "", b"")
    flip_row(path, 3)
    assert said in repair_store(path).lost[-1]
