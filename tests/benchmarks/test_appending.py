"""The costs of a durable row: a small run fills its table, and each way kept the rows."""

import json
import sqlite3
from contextlib import closing

from commands import run

from examples.benchmarks import appending
from store.log import LogReader
from store.row_encoding import decode_row


def test_a_small_run_keeps_the_rows_each_way_and_fills_its_table(tmp_path, monkeypatch):
    monkeypatch.setattr(appending, "ROWS", 5)
    result = appending.run_appending(tmp_path, rounds=3, seed=1, note=lambda _: None)
    cases = [record["case"].split(",")[0] for record in result["records"]]
    assert cases == ["SQLite", "the log", "a bare file that grows"]
    assert result["rows"] == 15 and result["records"][0]["times_sqlite"] == 1.0
    with closing(sqlite3.connect(tmp_path / "rows.sqlite")) as database:
        kept = [data for (data,) in database.execute("SELECT bytes FROM row ORDER BY sequence")]
    with LogReader(tmp_path / "log") as log:
        rows = [log.read(frame.offset, frame.size)[1] for batch in log.refresh() for frame in batch]
    assert kept == rows and [decode_row(row).head.sequence for row in rows] == list(range(1, 16))
    assert (tmp_path / "bare").stat().st_size == 15 * appending.ROW_BYTES


def test_its_command_prints_its_table(tmp_path, monkeypatch):
    monkeypatch.setattr(appending, "ROWS", 5)
    result = run("bench", "log", "--rounds", 1, "--folder", tmp_path, "--json", tmp_path / "r.json")
    assert result.exit_code == 0, result.output
    assert "times SQLite's" in result.output and json.loads((tmp_path / "r.json").read_text())["rows"] == 5
