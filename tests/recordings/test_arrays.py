"""Arrays as other programs write them: numpy, scipy, h5py, pandas, pyarrow and LeRobot's layout of old."""

import json
import subprocess
import sys
import zipfile

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet as pq
import pytest
import zarr
from commands import run
from confined import REFUSED, ending
from made import TIP, lerobot
from scipy.io import savemat

from scroll_tactile import Sensor
from scroll_tactile.errors import FieldError, InputError, RecordingError
from scroll_tactile.recordings import describe, read, touches

ROWS = TIP[:, :4].astype(np.float64)
TIMES = np.arange(30) / 50
STACK = np.arange(3 * 30 * 4.0).reshape(3, 30, 4)
FRAME = pd.DataFrame(ROWS, columns=["a", "b", "c", "d"])
NANOSECONDS = pd.date_range("2026-01-01", periods=30, freq="20ms")


def npz(path, **arrays):
    np.savez_compressed(path, **arrays)


def mat(path, **arrays):
    savemat(path, arrays, do_compression=True)


def matlab(path, **arrays):
    """As MATLAB writes version 7.3: HDF5 behind 512 bytes, axes the other way round."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            file[name.replace(".", "/")] = np.asarray(array).T
            file[name.replace(".", "/")].attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file")


def hdf5(path, **arrays):
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name.replace(".", "/")] = array


def parquet(path, **arrays):
    columns = {name: pa.array(list(array)) for name, array in arrays.items()}
    pq.write_table(pa.table(columns), path)


def fixed(array):
    return pa.FixedSizeListArray.from_arrays(pa.array(np.ravel(array)), np.shape(array)[-1])


def feather(path, **arrays):
    columns = {name: fixed(array) if array.ndim > 1 else pa.array(array) for name, array in arrays.items()}
    pyarrow.feather.write_feather(pa.table(columns), str(path))


def structured(path, **arrays):
    table = np.zeros(30, [(name, array.dtype, array.shape[1:]) for name, array in arrays.items()])
    for name, array in arrays.items():
        table[name] = array
    np.save(path, table)


def compound(path, **arrays):
    structured(path.with_suffix(".npy"), **arrays)
    with h5py.File(path, "w") as file:
        file["log/table"] = np.load(path.with_suffix(".npy"))


def buffer(path, **arrays):
    group = zarr.open_group(path, mode="w")
    for name, array in arrays.items():
        group.create_array(name, data=array)


WRITERS = {
    "x.npz": npz,
    "x.mat": mat,
    "new.mat": matlab,
    "x.h5": hdf5,
    "x.parquet": parquet,
    "x.feather": feather,
    "x.npy": structured,
    "c.h5": compound,
    "x.zarr": buffer,
}


@pytest.mark.parametrize("name", WRITERS)
def test_an_array_with_its_times_beside_it(tmp_path, name):
    WRITERS[name](tmp_path / name, tactile=ROWS, time=TIMES, force=ROWS[:, 0])
    recording = read(tmp_path / name, field="tactile")
    np.testing.assert_array_equal(recording.readings, ROWS)
    np.testing.assert_allclose(recording.times, TIMES)
    assert recording.report.clock == "time"
    np.testing.assert_array_equal(read(tmp_path / name, field="tactile[1:3]").readings, ROWS[:, 1:3])
    text = str(describe(tmp_path / name))
    assert "tactile  [4], 30 readings" in text and "force" in text and "time  " not in text
    with pytest.raises(FieldError, match="expected a field to read"):
        read(tmp_path / name)
    with pytest.raises(FieldError, match=r"no field 'tactole'; nearest is '.*tactile'"):
        read(tmp_path / name, field="tactole")


@pytest.mark.parametrize("name", WRITERS)
def test_columns_of_one_number_a_row_stand_beside_each_other(tmp_path, name):
    WRITERS[name](tmp_path / name, **{key: ROWS[:, i] for i, key in enumerate("abcd")}, t_ms=TIMES * 1000)
    for field in (None, "a:d", "a,b,c,d", "a,b:d"):
        recording = read(tmp_path / name, field=field)
        np.testing.assert_array_equal(recording.readings, ROWS)
        np.testing.assert_allclose(recording.times, TIMES)
        assert [name.rpartition(".")[2] for name in recording.field.split(",")] == list("abcd")
    prefix = "log/table." if name == "c.h5" else ""  # a pattern is of the whole path
    np.testing.assert_array_equal(read(tmp_path / name, field=f"{prefix}?").readings, ROWS)
    np.testing.assert_array_equal(read(tmp_path / name, field="d,a").readings, ROWS[:, [3, 0]])


STACKS = {name: WRITERS[name] for name in ("x.npz", "x.mat", "new.mat", "x.h5", "x.zarr")}
STACKS["x.npy"] = lambda path, **arrays: np.save(path, *arrays.values())


@pytest.mark.parametrize("name", STACKS)
def test_a_stack_is_asked_about_and_each_of_the_answers_works(tmp_path, name):
    STACKS[name](tmp_path / name, tactile=STACK)
    with pytest.raises(FieldError, match=r"has the shape \(3, 30, 4\): say what its first axis counts") as raised:
        read(tmp_path / name)
    stem = "" if name == "x.npy" else "tactile"
    for way, shape in {"[*]": (90, 4), "[:]": (3, 120), "[+]": (90, 4)}.items():
        assert f"field='{stem}{way}'" in str(raised.value)
        recording = read(tmp_path / name, field=stem + way, rate=10)
        np.testing.assert_array_equal(recording.readings, STACK.reshape(shape))
        if way == "[*]":
            assert [(e.begin, e.end) for e in recording.episodes] == [(0, 30), (30, 60), (60, 90)]
            assert recording.times[[29, 30]].tolist() == [2.9, 0]
    np.testing.assert_array_equal(read(tmp_path / name, field=f"{stem}[*][1:3]").readings, STACK.reshape(90, 4)[:, 1:3])


def test_times_and_labels_of_a_stack(tmp_path):
    npz(tmp_path / "a.npz", x=STACK, y=np.array(["felt", "oak", "felt"]), t=TIMES, each=np.arange(90) // 45)
    recording = read(tmp_path / "a.npz", field="x[*]", labels="y")
    assert [e.name for e in recording.episodes] == ["felt", "oak", "felt"]
    np.testing.assert_allclose(recording.times, np.tile(TIMES, 3))
    with pytest.raises(FieldError, match=r"'t' of .* holds float64"):
        read(tmp_path / "a.npz", field="x[*]", labels="t")
    npz(tmp_path / "b.npz", x=ROWS, t=TIMES, what=np.repeat(["felt 1.0", "", "oak"], 10), number=np.repeat([7, 8], 15))
    recording = read(tmp_path / "b.npz", field="x", labels="what")
    assert [(e.begin, e.name) for e in recording.episodes] == [(0, "felt 1.0"), (10, None), (20, "oak")]
    assert recording.report.backward == 0
    assert [e.name for e in read(tmp_path / "b.npz", field="x", labels="number").episodes] == ["7", "8"]
    with pytest.raises(RecordingError, match="no field 'when'"):
        read(tmp_path / "b.npz", field="x", clock="when")


def test_blocks_of_samples_have_times_between_those_of_their_rows(tmp_path):
    npz(tmp_path / "a.npz", daq=STACK, time=np.array([10.0, 10.3, 10.6]))
    recording = read(tmp_path / "a.npz", field="daq[+]")
    np.testing.assert_allclose(recording.times, 10 + np.arange(90) / 100)
    parquet(tmp_path / "a.parquet", left=STACK[..., 0], right=STACK[..., 1], time=[10.0, 10.3, 10.6])
    recording = read(tmp_path / "a.parquet", field="left,right[+]")
    np.testing.assert_allclose(recording.times, 10 + np.arange(90) / 100)
    np.testing.assert_array_equal(recording.readings, STACK.reshape(90, 4)[:, :2])


def test_structs_and_cells_of_matlab(tmp_path):
    trials = np.empty((1, 2), [("tactile", object), ("t", object), ("name", object)])
    for i in range(2):
        trials[0, i] = (ROWS[: 10 + i], TIMES[None, : 10 + i], ["felt", "oak"][i])
    cells = np.empty((2, 1), object)
    cells[:, 0] = [ROWS[:5], ROWS[:6]]
    savemat(tmp_path / "a.mat", {"d": {"trial": trials, "deep": {"skin": ROWS}}, "cells": cells, "f": "text"})
    np.testing.assert_array_equal(read(tmp_path / "a.mat", field="d.deep.skin").readings, ROWS)
    recording = read(tmp_path / "a.mat", field="d.trial.tactile", labels="name")
    assert [(e.begin, e.end, e.name) for e in recording.episodes] == [(0, 10, "felt"), (10, 21, "oak")]
    np.testing.assert_allclose(recording.times[10:], TIMES[:11])
    assert len(read(tmp_path / "a.mat", field="d.trial[1].tactile")) == 11
    assert [e.begin for e in read(tmp_path / "a.mat", field="cells").episodes] == [0, 5]
    matlab(tmp_path / "b.mat", **{"d.skin": ROWS, "d.t": TIMES[:, None], "d.name": np.array([[*b"felt"]], np.uint16)})
    with h5py.File(tmp_path / "b.mat", "a") as file:
        file["d/name"].attrs["MATLAB_class"] = np.bytes_("char")
        file.create_dataset("cells", data=[file["d/skin"].ref], dtype=h5py.ref_dtype)
    recording = read(tmp_path / "b.mat", labels="name")
    np.testing.assert_allclose(recording.times, TIMES)
    assert (recording.field, recording.episodes[0].name) == ("d/skin", "felt")
    with pytest.raises(FieldError, match=r"not read: cells holds references to others, as cells of MATLAB 7.3 do"):
        read(tmp_path / "b.mat", field="cells")


@pytest.fixture
def groups(tmp_path):
    with h5py.File(tmp_path / "g.h5", "w") as file:
        for i, name in enumerate(("felt/1", "felt/2", "oak/1", "oak/10", "oak/2")):
            file[f"run/{name}/tactile"] = ROWS + i
            file[f"run/{name}/time"] = TIMES
    return tmp_path / "g.h5"


def test_experiments_in_groups_are_episodes_named_by_a_part_of_their_path(groups):
    with pytest.raises(
        FieldError, match=r"may be any of run/felt/1/tactile, .* as episodes by field='run/\*/\*/tactile'"
    ):
        read(groups, field="tactile")
    recording = read(groups, field="run/*/*/tactile")
    assert [e.path.removeprefix("run/") for e in recording.episodes] == [
        f"{name}/tactile" for name in ("felt/1", "felt/2", "oak/1", "oak/2", "oak/10")
    ]
    assert [touch.material for touch in touches(recording, "episodes")] == [None] * 5
    for by in ("group:2", "folder"):
        assert [touch.material for touch in touches(recording, "episodes", by)] == ["felt"] * 2 + ["oak"] * 3
    within = touches(recording, lambda whole: [(35, 50), (65, 85)], "group:2")
    assert [touch.material for touch in within] == ["felt", "oak"]
    for by in ("group:0", "group:5"):
        with pytest.raises(InputError, match=f"has no {by} to be named by: readings 0 to 30 lie in run/felt/1/tactile"):
            touches(recording, "episodes", by)
    numbers = read(groups, field="run/oak/*/tactile")
    with pytest.raises(
        InputError, match=r"has no folder to be named by: .* expected by='group:1', run, by='group:2', oak"
    ):
        touches(numbers, "episodes", "folder")
    assert {touch.material for touch in touches(numbers, "episodes", "group:2")} == {"oak"}
    with pytest.raises(InputError, match="lie in no groups that a pattern as"):
        touches(read(groups, field="run/oak/1/tactile"), "whole", "group:2")
    with pytest.raises(FieldError, match=r"no field 'run/\*/skin'"):
        read(groups, field="run/*/skin")


def test_the_command_line_learns_groups(groups):
    sensor = Sensor(name="tip", channels=4, rate=50, low=-5, high=9, unit="1", duration=0.4)
    (groups.parent / "tip.json").write_text(sensor.model_dump_json())
    how = ("--sensor", groups.parent / "tip.json", "--field", "run/*/*/tactile", "--label-by", "group:2", "--json")
    assert json.loads(run("learn", groups.parent / "m", groups, *how).stdout)["learned"] == {"felt": 2, "oak": 3}


def test_compound_tables_as_pytables_writes_them(tmp_path):
    rows = np.zeros(30, [("index", "<i8"), ("values_block_0", "<f8", (4,)), ("t", "<f8")])
    rows["values_block_0"], rows["t"] = ROWS, TIMES
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["skin/table"] = rows
        file["other/nested"] = np.zeros(30, [("wrench", [("f", "<f8", (3,)), ("t", "<f8", (3,))])])
    assert "skin/table.values_block_0  [4], 30 readings" in str(describe(tmp_path / "a.h5"))
    recording = read(tmp_path / "a.h5", field="values_block_0")
    np.testing.assert_array_equal(recording.readings, ROWS)
    np.testing.assert_allclose(recording.times, TIMES)
    assert read(tmp_path / "a.h5", field="other/nested.wrench.f").readings.shape == (30, 3)


@pytest.mark.parametrize("write", [FRAME.to_parquet, lambda p: FRAME.to_feather(p.with_suffix(".feather"))])
def test_tables_of_pandas_and_their_stamps(tmp_path, write):
    write(tmp_path / "a.parquet")
    (path,) = tmp_path.iterdir()
    np.testing.assert_array_equal(read(path).readings, ROWS)
    frame = FRAME.assign(stamp=NANOSECONDS, what=["felt"] * 15 + ["oak"] * 15)
    frame.to_parquet(tmp_path / "b.parquet")
    recording = read(tmp_path / "b.parquet", labels="what")
    np.testing.assert_allclose(recording.times - recording.times[0], TIMES, atol=1e-6)
    assert [e.name for e in recording.episodes] == ["felt", "oak"]
    frame.assign(stamp=NANOSECONDS.as_unit("ns").asi8, force=ROWS[:, 0]).to_parquet(tmp_path / "c.parquet")
    recording = read(tmp_path / "c.parquet", field="a:d", annotate=["force [N]", "what [label]"])
    np.testing.assert_allclose(recording.times - recording.times[0], TIMES, atol=1e-6)
    np.testing.assert_array_equal(recording.annotations["force [N]"], ROWS[:, 0])
    assert recording.annotations["what [label]"][20] == "oak"
    parquet(tmp_path / "d.parquet", x=[[1.0, 2.0], [1.0]])
    with pytest.raises(RecordingError, match="is ragged"):
        read(tmp_path / "d.parquet")


def lerobot_2(folder, count=3):
    """A LeRobotDataset v2.1, as its writer lays it out: a file an episode, lines of JSON."""
    (folder / "data/chunk-000").mkdir(parents=True)
    (folder / "data/chunk-001").mkdir()
    (folder / "meta").mkdir()
    tasks = ["slide over felt", "slide over cork"]
    for i in range(count):
        span = slice(10 * i, 10 * i + 10)
        columns = {
            "observation.tactile": pa.array(TIP[span].tolist(), pa.list_(pa.float32())),
            "timestamp": pa.array(np.arange(10, dtype=np.float32) / 100),
            "frame_index": pa.array(np.arange(10)),
            "episode_index": pa.array(np.full(10, i)),
            "index": pa.array(np.arange(10 * i, 10 * i + 10)),
            "task_index": pa.array(np.full(10, i % 2)),
        }
        pq.write_table(pa.table(columns), folder / f"data/chunk-{i // 2:03d}/episode_{i:06d}.parquet")
    lines = {
        "episodes": [{"episode_index": i, "tasks": [tasks[i % 2]], "length": 10} for i in range(count)],
        "tasks": [{"task_index": i, "task": task} for i, task in enumerate(tasks)],
    }
    for name, rows in lines.items():
        (folder / f"meta/{name}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    features = {"observation.tactile": {"dtype": "float32", "shape": [19]}}
    features |= {name: {"dtype": "int64", "shape": [1]} for name in list(columns)[1:]}
    about = {"codebase_version": "v2.1", "fps": 100, "total_frames": 30, "chunks_size": 2, "features": features}
    about["data_path"] = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    (folder / "meta/info.json").write_text(json.dumps(about))
    return folder


def test_lerobot_of_version_2(tmp_path):
    folder = lerobot_2(tmp_path / "set")
    recording = read(folder)
    assert recording.readings.tobytes() == TIP.tobytes()
    assert [(e.begin, e.end, e.name) for e in recording.episodes] == [
        (0, 10, "slide over felt"),
        (10, 20, "slide over cork"),
        (20, 30, "slide over felt"),
    ]
    assert (recording.report.backward, recording.report.lost, round(recording.report.rate)) == (0, 0, 100)
    one = folder / "data/chunk-000/episode_000001.parquet"
    assert [(e.begin, e.name) for e in read(one, field="observation.tactile").episodes] == [(0, None)]
    one.unlink()
    with pytest.raises(RecordingError, match=r"not whole: data/chunk-000/episode_000001\.parquet missing"):
        read(folder)


def test_a_rate_that_is_no_number_is_none(tmp_path):
    path = lerobot(tmp_path / "set")
    about = json.loads((path / "meta/info.json").read_text())
    for rate in ("ü", [5], True):
        (path / "meta/info.json").write_text(json.dumps(about | {"fps": rate}))
        assert "Hz" not in str(describe(path))


# What is only unusual is named as what it is.

POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:" + "0" * 64 + "\nsize 41105856\n"


@pytest.mark.parametrize(
    "end", ["csv", "npy", "npz", "mat", "h5", "parquet", "feather", "bag", "mcap", "db3", "zarr.zip"]
)
def test_a_pointer_of_git_lfs_is_one(tmp_path, end):
    (tmp_path / f"a.{end}").write_text(POINTER)
    with pytest.raises(RecordingError, match=rf"a\.{end} is a pointer of Git LFS, .* git lfs pull"):
        read(tmp_path / f"a.{end}")


@pytest.mark.parametrize("file", ["data/chunk-000/file-000.parquet", "meta/info.json"])
def test_a_pointer_of_git_lfs_within_a_data_set(tmp_path, file):
    (lerobot(tmp_path / "set") / file).write_text(POINTER)
    with pytest.raises(RecordingError, match=r"is a pointer of Git LFS"):
        read(tmp_path / "set", field="tip")


def test_a_file_that_its_writer_holds_is_being_written(tmp_path):
    writing = (
        "import h5py,sys; f=h5py.File(sys.argv[1],'w'); f['x']=[[1.,2.]]*50; f.flush(); print(flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", writing, tmp_path / "a.h5"], stdout=subprocess.PIPE, stdin=subprocess.PIPE
    ) as writer:
        writer.stdout.readline()
        with pytest.raises(RecordingError, match="is being written: another program has it open"):
            read(tmp_path / "a.h5")
        writer.communicate(b"\n")
    assert len(read(tmp_path / "a.h5")) == 50


# No claimed size is believed: half a gigabyte of zeros in a megabyte and less, by each format's own writer.

ZEROS = np.zeros((1 << 26, 1))


def bomb_npz(path):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as file, file.open("x.npy", "w") as member:
        np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": ZEROS.shape})
        for _ in range(1 << 5):
            member.write(bytes(1 << 24))


BOMBS = {
    "a.npz": bomb_npz,
    "a.mat": lambda path: savemat(path, {"x": ZEROS}, do_compression=True),
    "a.h5": lambda path: h5py.File(path, "w").create_dataset(
        "x", shape=ZEROS.shape, dtype="f8", chunks=(1 << 20, 1), compression="gzip"
    ),
    "a.parquet": lambda path: pq.write_table(pa.table({"x": ZEROS[:, 0]}), path, compression="zstd"),
    "a.feather": lambda path: pyarrow.feather.write_feather(
        pa.table({"x": ZEROS[:, 0]}), str(path), compression="zstd"
    ),
    "a.zarr": lambda path: zarr.create_array(path, data=ZEROS, chunks=(1 << 20, 1), fill_value=1),
}


@pytest.mark.parametrize("name", BOMBS)
def test_half_a_gigabyte_in_a_small_file_is_refused(tmp_path, name):
    BOMBS[name](tmp_path / name)
    (tmp_path / "outside").mkdir()

    def refused():
        with pytest.raises(RecordingError, match=r"claims to hold \d+ bytes in|becomes more than") as raised:
            read(tmp_path / name)
        raise raised.value

    assert ending(refused, tmp_path / "outside") == REFUSED
