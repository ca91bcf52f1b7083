"""Tables as people have them."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scroll_tactile.errors import FieldError, InputError, RecordingError
from scroll_tactile.recordings import describe, iterate, read
from scroll_tactile.recordings.delimited import is_missing, is_number, missing_cells


def table(folder: Path, text: str, name: str = "t.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


NAN = float("nan")


@pytest.mark.parametrize(
    ("text", "readings", "times"),
    [
        ("1,2\n3,4\n", [[1, 2], [3, 4]], None),
        ("a,b\n1,2\n3,4\n", [[1, 2], [3, 4]], None),
        ("\ufeffa;b\n1;2\n\n3;4", [[1, 2], [3, 4]], None),
        ("1 2\n3  4\n", [[1, 2], [3, 4]], None),
        ("# x y\n1 2\n3 4\n", [[1, 2], [3, 4]], None),
        ("a|b\n1|2\n", [[1, 2]], None),
        ("x\ty\n1\t2\n3\t4", [[1, 2], [3, 4]], None),
        ("0,1,2\n5.5,6.5,7.5\n8,9,1\n", [[5.5, 6.5, 7.5], [8, 9, 1]], None),  # pandas without an index
        ("0,1,2\n5,6,7\n", [[5, 6, 7]], None),
        (",0,1,2\n0,5.5,6.5,7.5\n1,8,9,1\n", [[5.5, 6.5, 7.5], [8, 9, 1]], None),  # pandas
        ("0\n0.5\n0.7\n", [[0.5], [0.7]], None),
        ("0\n5\n7\n", [[0], [5], [7]], None),  # may be a reading
        ("0,1\n3,4\n", [[0, 1], [3, 4]], None),
        ("Unnamed: 0,a\n0,5\n1,6\n", [[5], [6]], None),
        ("index,a\n5,5\n9,6\n", [[5, 5], [9, 6]], None),  # counts nothing: numbers like others
        ("time,a,b\n0.5,1,2\n0.6,3,4\n", [[1, 2], [3, 4]], [0.5, 0.6]),
        ("Timestamp (ms),a\n500,1\n600,3\n", [[1], [3]], [0.5, 0.6]),
        ("timestamp,a\n1760000000000000000,1\n1760000001000000000,2\n", [[1], [2]], [1.76e9, 1.760000001e9]),
        ("timestamp,a\n1760000000000,1\n1760000001000,2\n", [[1], [2]], [1.76e9, 1.760000001e9]),
        ("time,a\n2026-01-01T00:00:00.5,1\n2026-01-01 00:00:01+00:00,3\n", [[1], [3]], [1767225600.5, 1767225601]),
        ("a,b,c\n1,,nan\nNA,2,null\n", [[1, NAN, NAN], [NAN, 2, NAN]], None),
        ('"a","b"\n"1","2"\n', [[1, 2]], None),
        ("a,b\n1e3,-.5\n+2.,inf\n", [[1000, -0.5], [2, np.inf]], None),
    ],
)
def test_tables_in_every_form(tmp_path, text, readings, times):
    recording = read(table(tmp_path, text))
    np.testing.assert_array_equal(recording.readings, readings)
    np.testing.assert_array_equal(recording.times, np.full(len(readings), NAN) if times is None else times)
    assert recording.report.clock == (None if times is None else text.partition(",")[0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n3,x\n", r"row 3, column 2 \(b\): expected a number; came 'x'"),
        ("a,b\n1,2\n\n3\n", "row 4: expected 2 cells as in the rows before it; came 1"),
        ("1.5,2,x\n1,2,3\n", "row 1, column 3 .*: expected a number; came 'x'"),
        ("a,b\n1_000,2\n", "expected a number; came '1_000'"),
        ("a,b\n٣,2\n", "expected a number"),
        ("1,5;2,5\n1,5;2,5\n", "row 1, column 1 .*pass decimal=','"),
        ("a;b\n1,5;2,5\n", "row 2, column 1 .*pass decimal=','"),
        ("a,b\n", "holds no readings"),
        ("", "there are none"),
        ("\n \n", "there are none"),
        ('"' + "1,2\n" * 50_000, "expected"),
        ("time\n1\n2\n", "no column of numbers besides"),
    ],
)
def test_what_is_wrong_with_a_table_is_said_where_it_is(tmp_path, text, message):
    with pytest.raises(RecordingError, match=message):
        read(table(tmp_path, text))


def test_a_decimal_comma_is_read_where_it_is_asked_for(tmp_path):
    path = table(tmp_path, "t;a;b\n0,1;1,5;2\n0,2;2,5;1e3\n")
    recording = read(path, decimal=",")
    np.testing.assert_array_equal(recording.readings, [[1.5, 2], [2.5, 1000]])
    np.testing.assert_array_equal(recording.times, [0.1, 0.2])


def test_columns_are_named_by_lists_ranges_and_patterns(tmp_path):
    path = table(tmp_path, "when,e1,e2,e3,pdc,material\n1,2,3,4,5,felt\n2,6,7,8,9,felt\n3,1,1,1,1,\n4,0,0,0,0,cork\n")
    assert read(path, field="e1:e3", clock="when").readings.tolist() == [[2, 3, 4], [6, 7, 8], [1, 1, 1], [0, 0, 0]]
    assert read(path, field="pdc,e1").readings[0].tolist() == [5, 2]
    recording = read(path, field="e*", clock="when", labels="material")
    assert recording.times.tolist() == [1, 2, 3, 4]
    assert [(e.begin, e.end, e.name) for e in recording.episodes] == [(0, 2, "felt"), (2, 3, None), (3, 4, "cork")]
    assert read(path, labels="material").readings.shape == (4, 5)
    assert read(path, labels="material", rate=10).times.tolist() == [0, 0.1, 0.2, 0.3]
    with pytest.raises(FieldError, match="no column 'e9'; nearest is 'e"):
        read(path, field="e9")
    with pytest.raises(RecordingError, match="the column of labels by labels="):
        read(path)
    assert "field='when,e1,e2,e3,pdc,material'" in str(describe(path))


def test_a_rate_counts_times_and_blocks_go_on_with_it(tmp_path):
    values = np.random.default_rng(0).standard_normal((9000, 3)).round(6)
    path = tmp_path / "long.csv"
    np.savetxt(path, values, delimiter=",", fmt="%.6f")
    recording = read(path, rate=50)
    np.testing.assert_array_equal(recording.readings, values)
    np.testing.assert_array_equal(recording.times, np.arange(9000) / 50)
    blocks = list(iterate(path, rate=50))
    assert len(blocks) > 1
    np.testing.assert_array_equal(np.concatenate([block.times for block in blocks]), recording.times)
    with pytest.raises(InputError, match="positive rate"):
        read(path, rate=0)


def test_a_step_of_more_than_twice_the_usual_is_no_jitter(tmp_path):
    times = [*(i / 10 for i in range(9)), 1.05]
    report = read(table(tmp_path, "time,a\n" + "".join(f"{time},1\n" for time in times))).report
    assert report.rate == pytest.approx(10) and report.jitter == pytest.approx(0, abs=1e-9)


def test_the_slow_way_gives_the_same_as_the_fast(tmp_path):
    values = np.random.default_rng(1).standard_normal((500, 4))
    np.savetxt(tmp_path / "fast.csv", values, delimiter=",", fmt="%.17g")
    text = (tmp_path / "fast.csv").read_text()
    (tmp_path / "slow.csv").write_text("\n".join(",".join(f'"{c}"' for c in line.split(",")) for line in text.split()))
    for name in ("fast", "slow"):
        np.testing.assert_array_equal(read(tmp_path / f"{name}.csv").readings, values)


@pytest.mark.parametrize(
    ("cell", "is_one"),
    [
        *((cell, True) for cell in ("1", "1.", ".5", "-1.5e-3", "inf", "1.e5", " 2 ")),
        *((cell, False) for cell in ("", ".", "1_0", "e5", "1.2.3", "1" * 200_000 + "x")),
    ],
    ids=lambda value: str(value)[:12],
)
def test_a_cell_is_a_number_or_not_however_long(cell, is_one):
    assert is_number(cell) is is_one


def test_a_cell_of_many_spaces_is_read(tmp_path):
    spaces = " " * (1 << 20)
    path = table(tmp_path, f"a,b\n1,2\n3,{spaces}4\n5,{spaces}\n")
    assert repr(read(path).readings.tolist()) == repr([[1.0, 2.0], [3.0, 4.0], [5.0, NAN]])


@given(st.lists(st.sampled_from(["1", "n", "na", "N/A", "Null", "none", "nan", "-", "?", " ", "  ", ",", "\t", ";"])))
def test_the_cells_that_are_missing_are_found_in_a_line(parts):
    line = "".join(parts)
    for mark in ",;\t":
        cells = ["nan" if is_missing(cell) else cell for cell in line.split(mark)]
        assert missing_cells(mark).sub("nan", line) == mark.join(cells)
        assert missing_cells(mark).sub("nan", line + "\n").split() == mark.join(cells).split()
