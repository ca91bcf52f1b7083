"""A process killed, or a machine unplugged, at any instant loses nothing that was acknowledged."""

import random
import shutil

import numpy as np
import pytest
from store_builds import as_after_a_crash

from store import Store


def check(path, acknowledged):
    with Store.open(path, mode="read") as reader:
        assert reader.last >= acknowledged
    with Store.open(path) as opened:
        last = opened.last
        for expected, row in enumerate(opened.records(), start=1):
            assert (row.sequence, row.label) == (expected, f"row {expected}")
            assert row.arrays["x"].tobytes() == np.arange(expected, expected + 700).tobytes()
        assert acknowledged <= last <= acknowledged + 1
        found = opened.latest()
        if found is not None:
            assert found.upto <= last
            assert found.arrays["total"] == found.upto * (found.upto + 1) // 2
            assert found.arrays["bulk"].tolist() == [found.upto] * 3000
        assert len(list((path / "generations").iterdir())) <= 2
    return last


@pytest.mark.parametrize("tail", [b"", bytes(5000), b"\xa5" * 5000], ids=["cut", "zeros", "garbage"])
def test_a_log_cut_at_any_byte_keeps_what_was_acknowledged_before_it(tmp_path, tail):
    """As after a power cut: what was synced is there; of what came later any part, or rubbish."""
    path, sizes = tmp_path / "s", [0]
    log = path / "journal.sqlite-wal"
    with Store.open(path, identity={}) as opened:
        for number in range(1, 31):
            opened.append("a", f"row {number}", b"k", arrays={"x": np.arange(number, number + 700)})
            sizes.append(log.stat().st_size)
            if number == 15:
                opened.commit({"total": np.array(120), "bulk": np.full(3000, 15)}, upto=15)
        as_after_a_crash(opened, tmp_path / "copy")
    rng = random.Random(1)
    copy = tmp_path / "copy"
    data = (copy / "journal.sqlite-wal").read_bytes()
    main = (copy / "journal.sqlite").read_bytes()
    shutil.copytree(copy / "generations", tmp_path / "generations")
    for place in [*rng.sample(range(len(data)), 12), *rng.sample(sizes[1:], 6)]:
        shutil.rmtree(copy)
        copy.mkdir()
        shutil.copytree(tmp_path / "generations", copy / "generations")
        (copy / "journal.sqlite").write_bytes(main)
        (copy / "journal.sqlite-wal").write_bytes(data[:place] + tail)
        check(copy, max(number for number, size in enumerate(sizes) if size <= place))
