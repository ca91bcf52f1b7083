"""Data sets of arrays: LeRobot, robomimic, Zarr replay buffers, `.npy`; and addresses."""

import shutil
from pathlib import Path

import fsspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zarr
from made import PAD, RNG, TIP, lerobot, robomimic

from scroll_tactile.errors import ChannelCountError, FieldError, InputError, RecordingError
from scroll_tactile.recordings import describe, iterate, read, resampled
from scroll_tactile.sensors import BIOTAC, CONTACTILE

SHARED = Path(__file__).parents[3] / "shared" / "data" / "recordings"


def test_lerobot_of_others_is_read_to_the_bit():
    if not SHARED.exists():
        pytest.skip(f"no recordings of others: {SHARED} does not exist, and the project ships none")
    recording = read(SHARED / "lerobot_v3_tactile", field="observation.tactile.tip")
    truth = np.load(SHARED / "lerobot_v3_tactile_truth.npy")
    assert recording.readings.tobytes() == truth.tobytes()
    assert [e.name for e in recording.episodes] == ["slide over felt", "slide over denim", "slide over cork"]


def test_lerobot_episodes_over_several_files(tmp_path):
    folder = lerobot(tmp_path / "set")
    recording = read(folder, field="observation.tactile.tip")
    assert recording.readings.tobytes() == TIP.tobytes()
    assert [(e.begin, e.end, e.name) for e in recording.episodes] == [
        (0, 10, "slide over felt"),
        (10, 20, "slide over cork"),
        (20, 30, "slide over felt"),
    ]
    assert recording.report.backward == 0  # time begins anew in each episode
    assert (recording.report.lost, round(recording.report.rate)) == (0, 100)
    assert read(folder, field="pad").readings.tobytes() == PAD.tobytes()
    assert read(folder, field="tip[0:3]").readings.tobytes() == np.ascontiguousarray(TIP[:, :3]).tobytes()
    assert [len(block) for block in iterate(folder, field="tip")] == [20, 10]
    text = str(describe(folder))
    assert "observation.tactile.pad  [4, 6, 3], 30 readings, 100 Hz" in text
    assert "field='observation.tactile.tip')" in text
    even = resampled(recording, 50)
    assert [(e.begin, e.end) for e in even.episodes] == [(0, 5), (5, 10), (10, 15)]
    np.testing.assert_allclose(even.readings[1], TIP[2], atol=1e-5)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("data/chunk-000/file-001.parquet", None, "file-001.parquet"),
        ("data/chunk-000/file-001.parquet", b"PAR1", "damaged"),
        ("meta/info.json", b"{", "damaged"),
        ("meta/info.json", b"[]", "damaged"),
        ("meta/info.json", b"", r"meta/info\.json is empty"),
        ("meta/info.json", b'{"codebase_version": "v1.6"}', "expected v2 or v3"),
    ],
)
def test_lerobot_sets_that_are_not_whole(tmp_path, file, content, message):
    place = lerobot(tmp_path / "set") / file
    place.unlink() if content is None else place.write_bytes(content)
    with pytest.raises(RecordingError, match=message):
        read(tmp_path / "set", field="tip")


def test_columns_that_a_lerobot_set_does_not_have(tmp_path):
    folder = lerobot(tmp_path / "set")
    for options, message in [
        ({"field": "observation.tactile.tap"}, "nearest is 'observation.tactile.tip'"),
        ({"field": "observation.image"}, "'observation.image' of .* holds video; expected numbers"),
        ({}, "expected a field to read"),
        ({"field": "tip[40]"}, "beyond its 19 columns"),
        ({"field": "tip", "clock": "when"}, "no field 'when'; there are episode_index"),
    ]:
        with pytest.raises(FieldError, match=message):
            read(folder, **options)


def test_lerobot_tasks_may_be_missing_and_rows_may_not_differ(tmp_path):
    folder = lerobot(tmp_path / "set")
    (folder / "meta/tasks.parquet").unlink()
    recording = read(folder, field="tip")
    assert {e.name for e in recording.episodes} == {None}
    assert "tasks are missing" in str(recording.report)
    path = folder / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    rows = table["observation.tactile.pad"].to_pylist()
    rows[3][1] = rows[3][1][:5]
    for broken in (rows, [None, *rows[1:]]):
        column = pa.array(broken, pa.list_(pa.list_(pa.list_(pa.float32()))))
        pq.write_table(table.set_column(1, "observation.tactile.pad", column), path)
        with pytest.raises(RecordingError, match=r"ragged|without a value"):
            read(folder, field="pad")


def test_robomimic_demos_are_episodes_in_the_order_of_their_numbers(tmp_path):
    path = robomimic(tmp_path / "demo.hdf5")
    recording = read(path, field="obs/tactile")
    np.testing.assert_array_equal(recording.readings, np.concatenate([TIP[:3], TIP[:5], TIP[:13]]))
    assert [(e.begin, e.end) for e in recording.episodes] == [(0, 3), (3, 8), (8, 21)]
    np.testing.assert_array_equal(recording.times[3:8], np.arange(5) / 20)
    assert (round(recording.report.rate), recording.report.backward) == (20, 0)
    assert read(path, field="actions", rate=10).times[3:6].tolist() == [0, 0.1, 0.2]
    assert read(path, field="pad").readings.shape == (21, 72)
    assert "obs/tactile  [19], 21 readings" in str(describe(path))
    for field, message in [
        ("tactil", "nearest is 'obs/tactile'"),
        (None, "expected a field"),
        ("name", "expected numbers"),
    ]:
        with pytest.raises(FieldError, match=message):
            read(path, field=field)
    with pytest.raises(RecordingError, match="ragged"):
        read(robomimic(tmp_path / "odd.h5", odd=True), field="obs/tactile")


def test_zarr_replay_buffers_have_episodes(tmp_path):
    for version in (2, 3):
        group = zarr.open_group(tmp_path / f"b{version}.zarr", mode="w", zarr_format=version)
        group.create_array("data/tactile", data=TIP.astype(np.float64), chunks=(7, 19))
        group.create_array("data/camera", data=RNG.integers(0, 255, (30, 8, 6, 3), dtype=np.uint8))
        ends = group.create_array("meta/episode_ends", data=np.array([5, 12, 30]))
        path = tmp_path / f"b{version}.zarr"
        recording = read(path, field="data/tactile", rate=10)
        np.testing.assert_array_equal(recording.readings, TIP.astype(np.float64))
        assert [(e.begin, e.end) for e in recording.episodes] == [(0, 5), (5, 12), (12, 30)]
        assert recording.times[[4, 5, 11, 12]].tolist() == [0.4, 0, 0.6, 0]
        assert read(path, field="camera").readings.shape == (30, 8, 6, 3)
        assert "data/tactile  [19], 30 readings" in str(describe(path))
        shutil.make_archive(str(tmp_path / f"z{version}.zarr"), "zip", path)
        np.testing.assert_array_equal(
            read(tmp_path / f"z{version}.zarr.zip", field="tactile").readings, recording.readings
        )
        ends[:] = [5, 3, 30]
        with pytest.raises(RecordingError, match="does not rise"):
            read(path, field="tactile")
        with pytest.raises(FieldError, match="nearest"):
            read(path, field="tactole")


def test_npy_of_any_shape(tmp_path):
    path = tmp_path / "a.npy"
    for array, shape in [
        (TIP, (30, 19)),
        (PAD, (30, 72)),
        (np.arange(5), (5, 1)),
        (RNG.integers(0, 255, (2, 4, 5, 3), dtype=np.uint8), (2, 4, 5, 3)),
        (np.array([[True, False]]), (1, 2)),
    ]:
        np.save(path, array)
        recording = read(path, rate=100.0)
        assert recording.readings.shape == shape
        np.testing.assert_array_equal(recording.readings.ravel(), array.ravel())
    np.save(path, TIP)
    assert read(path, field="[2:4]").readings.tobytes() == np.ascontiguousarray(TIP[:, 2:4]).tobytes()
    assert str(describe(path)).endswith(f"read({str(path)!r})")
    for options, match in [
        ({"topic": "/skin"}, "has no topic"),
        ({"labels": "/material"}, "one array without a name, and no '/material'"),
    ]:
        with pytest.raises(InputError, match=match):
            read(path, **options)
    assert read(path).stream(BIOTAC).readings.shape == (30, 19)
    with pytest.raises(ChannelCountError, match="another sensor's recording"):
        read(path).stream(CONTACTILE)
    for array, message in [
        (np.array(5.0), "expected numbers"),
        (np.array(["a"]), "expected numbers"),
        (np.zeros((0, 3)), "no readings"),
        (np.zeros(3, complex), "expected numbers"),
    ]:
        np.save(path, array)
        with pytest.raises(RecordingError, match=message):
            read(path)


@pytest.mark.parametrize("shape", [(3000, 19), (3000, 4, 5, 3), (3000,)])
def test_npy_of_columns_one_after_another(tmp_path, shape):
    array = np.asfortranarray(RNG.normal(size=shape))
    np.save(tmp_path / "a.npy", array)
    expected = np.ascontiguousarray(array if array.ndim > 1 else array[:, None])
    assert read(tmp_path / "a.npy").readings.tobytes() == expected.tobytes()


def test_addresses_of_file_systems(tmp_path):
    files = fsspec.filesystem("memory")
    np.save(tmp_path / "a.npy", TIP)
    files.put(str(tmp_path / "a.npy"), "/robots/a.npy")
    files.put(str(lerobot(tmp_path / "set")), "/robots/set", recursive=True)
    assert read("memory://robots/a.npy").readings.tobytes() == TIP.tobytes()
    assert read("memory://robots/set", field="tip").readings.tobytes() == TIP.tobytes()
    for address, message in [
        ("memory://robots/b.npy", "is not there"),
        ("nosuch://x/a.npy", "cannot be reached"),
        (str(tmp_path / "none.npy"), "is not there"),
        (str(tmp_path), "a folder that is none of these"),
        (str(lerobot(tmp_path / "again") / "meta/info.json"), "expected a field to read"),
    ]:
        with pytest.raises(InputError, match=message):
            read(address)
