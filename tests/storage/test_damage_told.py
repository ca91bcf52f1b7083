"""Damage among rows that are passed over, for one kind or one key is asked for, is not passed over in silence."""

import logging

import numpy as np
import pytest
from store_builds import log_of

from store import Store
from store.log import LogReader


@pytest.mark.parametrize("ask", ["heads", "with_key"])
@pytest.mark.parametrize("harm", ["swapped", "a head"])
def test_what_is_passed_over_is_told(tmp_path, caplog, ask, harm):
    with Store.open(tmp_path / "s", identity={"of": "rows"}) as kept:
        for number in range(8):
            kept.append("observe", "a", bytes([number]) * 32, arrays={"x": np.full(64, number, np.uint8)})
        kept.commit({"sum": np.arange(3)}, last_sequence=kept.last)
    log = log_of(tmp_path / "s")
    with LogReader(log) as reader:
        rows = [frame for batch in reader.refresh() for frame in batch]
    whole = bytearray(log.read_bytes())
    if harm == "swapped":
        first, second = (slice(rows[i].offset, rows[i].end) for i in (2, 4))
        whole[first], whole[second] = whole[second], whole[first]
    else:
        whole[rows[2].payload_offset + 60] ^= 1
    log.write_bytes(whole)
    with Store.open(tmp_path / "s", mode="read") as kept, caplog.at_level(logging.WARNING):
        found = list(kept.heads(kind="observe") if ask == "heads" else kept.with_key(bytes([2]) * 32))
    assert len(found) < (8 if ask == "heads" else 1)
    assert "log-" in caplog.text
