"""Tables as people have them."""

from pathlib import Path

import numpy as np
import pytest

from scroll_tactile import Sensor
from scroll_tactile.errors import ChannelCountError, FieldError, InputError, RecordingError
from scroll_tactile.recordings import describe, iterate, read
from scroll_tactile.recordings.text import number


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
        ("sep=;\na;b\n1;2\n", [[1, 2]], None),
        ("a;b\n1,5;2\n-0,25;1e3\n", [[1.5, 2], [-0.25, 1000]], None),
        ("1,5 2,5\n3 4\n", [[1.5, 2.5], [3, 4]], None),
        ("1, 2, 3\n4, 5, 6\n", [[1, 2, 3], [4, 5, 6]], None),
        ("a,b,\n1,2,\n3,4,\n", [[1, 2], [3, 4]], None),
        ("a,b\n1,2,\n3,4,\n", [[1, 2], [3, 4]], None),
        ("1\t2\t\n3\t4\t\n", [[1, 2], [3, 4]], None),
        ("time,a\nms,N\n500,1\n600,3\n", [[1], [3]], [0.5, 0.6]),
        ("ms,N\ntime,a\n500,1\n600,3\n", [[1], [3]], [0.5, 0.6]),
        ("a,b\n[N],[N]\n1,2\n", [[1, 2]], None),
        ("Device: pad\nRate,100\n\ntime,a,b\n0.5,1,2\n0.6,3,4\n", [[1, 2], [3, 4]], [0.5, 0.6]),
        ("Date\t1\nEnd\nSamples\t150\t150\nEnd\nx\ta\tb\n.5\t1\t2\n1\t3\t5\n", [[0.5, 1, 2], [1, 3, 5]], None),
        ("a,b\n#N/A,2\n-nan(ind),4\n", [[NAN, 2], [NAN, 4]], None),
        ("# made by hand\n1,2\n# a pause\n3,4\n", [[1, 2], [3, 4]], None),
        ('"a\nx",b\n1,2\n', [[1, 2]], None),
        ("frame,a\n7,1\n8,2\n", [[1], [2]], None),
        ('"1,5","2,5"\n"3","4,25"\n', [[1.5, 2.5], [3, 4.25]], None),
        ("time,a\n2026/01/01 00:00:00.5,1\n2026-01-01T00:00:01Z,3\n", [[1], [3]], [1767225600.5, 1767225601]),
        ("__time,a\n0.5,1\n0.6,3\n", [[1], [3]], [0.5, 0.6]),
        ("Time [s],a\n0.5,1\n0.6,3\n", [[1], [3]], [0.5, 0.6]),
        ("timestamp_ns,a\n500000000,1\n600000000,3\n", [[1], [3]], [0.5, 0.6]),
        ("rosbag_timestamp,a\n0.5,1\n0.6,3\n", [[1], [3]], [0.5, 0.6]),
        ("time,a\n00:01:00.5,1\n00:01:01,3\n", [[1], [3]], [60.5, 61]),
    ],
)
def test_tables_in_every_form(tmp_path, text, readings, times):
    recording = read(table(tmp_path, text))
    np.testing.assert_array_equal(recording.readings, readings)
    np.testing.assert_array_equal(recording.times, np.full(len(readings), NAN) if times is None else times)
    assert recording.report.clock is None if times is None else recording.report.clock in text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n3,x\n", r"row 3, column 2 \(b\): expected a number; came 'x'"),
        ("a,b\n1,2\n\n3\n", "row 4: expected 2 cells as the others have; came 1"),
        ("1.5,2,x\n1,2,3\n", "row 1, column 3 .*: expected a number; came 'x'"),
        ("a,b\n1_000,2\n", "expected a number; came '1_000'"),
        ("a,b\n٣,2\n", "expected a number"),
        ("a;b\n1,500;2,125\n", "before thousands: if it is before decimals, pass decimal=','"),
        ("a;b\n1.234,5;2\n", "row 2, column 1 .*came '1.234,5'"),
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


def test_a_decimal_comma_is_read_where_it_is_sure_or_asked_for(tmp_path):
    path = table(tmp_path, "t;a;b\n0,100;1,500;2\n0,200;2,500;1e3\n")
    for recording in (read(path), read(path, decimal=",")):
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


def test_a_cell_is_a_number_missing_or_text_however_long():
    assert [number(cell) for cell in ("1", "1.", ".5", "-1.5e-3", " 2 ", "1.e5")] == [1, 1, 0.5, -0.0015, 2, 1e5]
    assert [number(cell) for cell in ("inf", "-1.#INF", "1.#INF")] == [np.inf, -np.inf, np.inf]
    for cell in (
        "",
        " ",
        "nan",
        "-NaN",
        "NA",
        "n/a",
        "#N/A",
        "null",
        "-",
        "-nan(ind)",
        "1.#QNAN",
        "-1.#IND00",
        "#DIV/0!",
    ):
        assert np.isnan(number(cell))
    for cell in (".", "1_0", "e5", "1.2.3", "1" * 200_000 + "x", "٣", "1,5", "nano", "#"):
        assert number(cell) is None
    assert [number(cell, ",") for cell in ("1,5", "2", "1.5", "1.234,5")] == [1.5, 2, None, None]


@pytest.mark.parametrize("code", ["utf-8", "utf-8-sig", "latin-1", "utf-16", "utf-16-le", "utf-16-be"])
def test_every_encoding_is_read_and_a_guess_is_said(tmp_path, code):
    path = tmp_path / "t.csv"
    path.write_bytes("Kraft [N],Wärme [°C]\r\n1,2\r\n3,4\r\n".encode(code))
    recording = read(path)
    assert recording.readings.tolist() == [[1, 2], [3, 4]]
    assert recording.field == "Kraft [N],Wärme [°C]"
    guessed = code in ("latin-1", "utf-16-le", "utf-16-be")
    assert recording.report.notes == ((f"its encoding is guessed: {code}",) if guessed else ())


ROWS = [f"{i / 100:.2f},{i}.5,{2 * i}.25" for i in range(300)]


@pytest.mark.parametrize("behind", [b"", b"2.9", b"2.99,299.5,", bytes(5), b"2.9" + bytes(5000), b"2.99,299.5,7"])
def test_a_table_that_was_cut_off_is_read_to_its_last_whole_row(tmp_path, behind):
    path = tmp_path / "t.csv"
    path.write_bytes("\n".join(["time,a,b", *ROWS[:299], ""]).encode() + behind)
    recording = read(path)
    assert len(recording) == 299
    assert recording.report.cut_off == bool(behind)
    assert len(recording.report.notes) == bool(behind)


@pytest.mark.parametrize("row", ["1.2,3", "1.2,3,4,5", "1.2,x,4", "time,a,b", "Booting v1.2"])
def test_a_row_in_a_hundred_may_be_left_out_and_that_is_said(tmp_path, row):
    rows = [*ROWS[:80], row, *ROWS[80:]]
    recording = read(table(tmp_path, "\n".join(["time,a,b", *rows, ""])))
    assert len(recording) == 300
    (note,) = recording.report.notes
    assert note.startswith("1 of 301 rows are left out") and "row 82" in note
    with pytest.raises(RecordingError, match=r"row 4[,:]"):
        read(table(tmp_path, "\n".join(["time,a,b", *ROWS[:2], row, *ROWS[2:50], ""])))


def test_a_row_of_the_tables_width_is_data_however_it_begins(tmp_path):
    path = table(tmp_path, "\n".join(["a,b,c", *ROWS[:40], "#N/A,1,2", *ROWS[40:], "# end", "%"]))
    recording = read(path)
    assert len(recording) == 301 and np.isnan(recording.readings[40, 0])
    assert read(table(tmp_path, "a,b\n,\n1,2\n")).report.notes == ("1 rows have no number at all",)


def test_further_times_and_counters_are_no_taxels(tmp_path):
    """As rostopic and bagpy write them."""
    head = "%time,field.header.seq,field.header.stamp,secs,nsecs,field.data0,field.data1"
    rows = [f"{10**18 + i * 10**7},{7 + i},{10**18 + i * 10**7},1000000000,{i * 10**7},{i}.5,2" for i in range(30)]
    recording = read(table(tmp_path, "\n".join([head, *rows, ""])))
    assert recording.field == "field.data0,field.data1" and recording.report.clock == "time"
    assert recording.report.rate == pytest.approx(100, rel=1e-3)
    assert "field.header.seq, field.header.stamp, secs, nsecs" in recording.report.notes[0]
    recording = read(table(tmp_path, "time,a\n01.02.2026 10:00,1\n01.02.2026 10:01,2\n"))
    assert recording.readings.tolist() == [[1], [2]] and recording.report.clock is None


def test_a_file_that_changes_while_it_is_read_is_said_or_refused(tmp_path):
    path = table(tmp_path, "\n".join(["time,a,b", *ROWS * 20, ""]))
    blocks = iterate(path)
    next(blocks)
    with path.open("a") as file:
        file.write("7,8,9\n")
    assert "it grew while it was read" in list(blocks)[-1].report.notes[-1]
    blocks = iterate(path)
    next(blocks)
    path.write_text("1,2,3\n")
    with pytest.raises(RecordingError, match="was changed while it was read"):
        list(blocks)


@pytest.mark.parametrize("begin", [b"PK\x03\x04", b"\x1f\x8b\x08"])
def test_other_files_are_called_what_they_are(tmp_path, begin):
    (tmp_path / "t.csv").write_bytes(begin + bytes(range(256)))
    with pytest.raises(RecordingError, match="expected text"):
        read(tmp_path / "t.csv")


@pytest.mark.parametrize("name", ["", "__time,", "%time,", "Time [s],", "Zeit,"])
def test_what_an_error_proposes_gives_the_touch_and_no_time(tmp_path, name):
    path = tmp_path / "t.csv"
    path.write_text((f"{name}a,b,c,d\n" if name else "") + "".join(f"{i / 100},{i % 40}.5,2,3,1\n" for i in range(150)))
    sensor = Sensor(name="pad", channels=4, rate=100.0, low=0.0, high=200.0, unit="counts", duration=1.0)
    recording = read(path)
    if name in ("", "Zeit,"):
        with pytest.raises(ChannelCountError, match="columns='1:5'"):
            recording.stream(sensor)
        recording = read(path, columns="1:5")
    assert recording.stream(sensor).readings[:, 0].tolist() == [i % 40 + 0.5 for i in range(150)]


def test_a_cell_of_many_spaces_is_read(tmp_path):
    spaces = " " * (1 << 20)
    path = table(tmp_path, f"a,b\n1,2\n3,{spaces}4\n5,{spaces}\n")
    assert repr(read(path).readings.tolist()) == repr([[1.0, 2.0], [3.0, 4.0], [5.0, NAN]])
