"""The benchmark of observing and asking in turns measures what it says."""

import json

import pytest
from commands import run

from examples.benchmarks.interleaved import AsIs
from scroll_tactile.testing import check_embedding


def test_its_embedding_keeps_the_promises_of_one():
    check_embedding(AsIs(), columns=(8,))


def test_every_learner_is_trained_and_timed(tmp_path):
    pytest.importorskip("sklearn")
    result = run("bench", "interleaved", "--streams", 120, "--pairs", 10, "--json", tmp_path / "r")
    assert result.exit_code == 0, result.output
    found = json.loads((tmp_path / "r").read_text())
    assert [record["measured"] for record in found["records"]] == [True] * 5
    for record in found["records"]:
        assert 0 < record["median_milliseconds"] <= record["p99_milliseconds"]
        assert record["observe_median_milliseconds"] + record["predict_median_milliseconds"] > 0
        assert record["times_ours"] > 0
    for i, name in enumerate(("times_ours", "times_ours_in_memory")):
        assert found["records"][i][name] == pytest.approx(1)
    assert {"date", "versions", "machine", "seed"} <= found.keys()
    assert "pseudo-inverse" in result.output
