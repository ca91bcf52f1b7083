"""What is ordinary is read, whatever its codec, and costs what its size allows; what harms is refused by name.

What a recording from somebody else may not do stands in tests/test_strangers.py.
"""

import os
import shutil
import sys
import tracemalloc

import bags
import fsspec
import h5py
import numpy as np
import pytest
import zarr
from made import CODECS, FORMATS, SKIN, TIP, buffer, hdf5, lerobot, ros
from numcodecs import BZ2, Blosc

from scroll_tactile.errors import FieldError, MissingLibraryError, RecordingError
from scroll_tactile.recordings import bounds, decoding, describe, find, iterate, read, zarrfile


@pytest.mark.parametrize("name", FORMATS)
def test_what_is_ordinary_is_read(tmp_path, name):
    make, options = FORMATS[name]
    path = make(tmp_path)
    recording = read(path, **options)
    if recording.readings.shape == TIP.shape:
        np.testing.assert_array_equal(recording.readings, TIP)
    assert sum(len(block) for block in iterate(path, **options)) == len(recording) > 0
    assert describe(path).entries


class TestZarr:
    @pytest.mark.parametrize("codec", CODECS)
    @pytest.mark.parametrize("kind", ["f4", ">f8", "i2", "u1", "?", "f2", "<u8"])
    def test_every_codec_gives_what_zarr_reads(self, tmp_path, codec, kind):
        values = np.random.default_rng(5).integers(0, 100, (531, 6, 2)).astype(kind)
        group = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=2)
        for i, (chunks, order) in enumerate([((100, 6, 2), "C"), ((531, 4, 1), "F"), ((7, 5, 2), "C")]):
            array = group.create_array(
                f"a{i}", shape=values.shape, chunks=chunks, dtype=kind, compressors=CODECS[codec], order=order
            )
            array[:] = values
            np.testing.assert_array_equal(
                read(tmp_path / "a.zarr", field=f"a{i}").readings, values.reshape(531, 12).astype(float)
            )

    def test_a_frame_of_zstd_need_not_say_its_size(self, tmp_path):
        from backports import zstd

        array = zarr.create_array(
            tmp_path / "a.zarr", shape=(500, 4), chunks=(500, 4), dtype="f4", compressors=zarr.codecs.ZstdCodec()
        )
        array[:] = values = np.random.default_rng(5).normal(size=(500, 4)).astype("f4")
        for data in (values.tobytes(), values.tobytes() * 2):
            streaming = zstd.ZstdCompressor()
            (tmp_path / "a.zarr/c/0/0").write_bytes(streaming.compress(data) + streaming.flush())
            if len(data) > values.nbytes:
                with pytest.raises(RecordingError):
                    read(tmp_path / "a.zarr")
            else:
                np.testing.assert_array_equal(read(tmp_path / "a.zarr").readings, values)

    def test_other_codecs_are_named(self, tmp_path):
        path = buffer(tmp_path, 2, compressors=BZ2())
        with pytest.raises(FieldError, match=r"not read: data/tactile: it has the codecs \['bz2'\]; expected some of"):
            read(path, field="tactile")
        shutil.rmtree(path)
        with pytest.raises(FieldError, match="sharding_indexed"):
            read(buffer(tmp_path, 3, shards=(14, 20)), field="tactile")

    def test_what_was_never_written_is_its_fill_value(self, tmp_path):
        for version, fill in ((2, 7.5), (3, float("nan")), (3, float("-inf"))):
            array = zarr.create_array(
                tmp_path / f"{version}{fill}.zarr",
                shape=(50, 3),
                chunks=(20, 2),
                dtype="f4",
                zarr_format=version,
                fill_value=fill,
            )
            array[25:30] = 1
            expected = np.full((50, 3), fill)
            expected[25:30] = 1
            np.testing.assert_array_equal(read(tmp_path / f"{version}{fill}.zarr").readings, expected)

    def test_a_chunk_is_decompressed_once(self, tmp_path, monkeypatch):
        """A file as people have it: one chunk of all."""
        values = np.tile(np.arange(19, dtype="f4"), (20_000, 1))
        buffer(tmp_path, 2)
        array = zarr.open_group(tmp_path / "b.zarr", mode="a")
        del array["data/tactile"], array["data/timestamp"]
        array.create_array("data/tactile", data=values, chunks=values.shape)
        calls = []
        looked = zarrfile._require_chunk
        monkeypatch.setattr(zarrfile, "_require_chunk", lambda *a: calls.append(a[2]) or looked(*a))
        blocks = list(iterate(tmp_path / "b.zarr", field="tactile"))
        assert calls.count(values.nbytes) == 1
        assert [len(block) for block in blocks] == [4096] * 4 + [20_000 - 4 * 4096]
        np.testing.assert_array_equal(np.concatenate([block.readings for block in blocks]), values)

    def test_arrays_of_texts_stand_beside_those_that_are_read(self, tmp_path):
        path = buffer(tmp_path, 2)
        group = zarr.open_group(path, mode="a")
        group.create_array("data/task", shape=(30,), dtype="U9")
        np.testing.assert_array_equal(read(path, field="tactile").readings, TIP)
        assert [entry.field for entry in describe(path).entries] == ["data/tactile"]
        with pytest.raises(FieldError, match=r"not read: data/task: its data type is '<U9'; expected numbers"):
            read(path, field="task")


class TestHdf5:
    def test_filters_that_only_plugins_know_are_refused(self, tmp_path):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file.create_dataset("tactile", data=TIP.astype("i4"), chunks=(7, 19), scaleoffset=0)
        with pytest.raises(RecordingError, match=r"has the filters \[6\]; expected at most one each of gzip, shuffle"):
            read(tmp_path / "a.h5", field="tactile")

    def test_a_large_chunk_of_random_numbers_is_read(self, tmp_path):
        values = np.random.default_rng(1).standard_normal((70_000, 4))
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file.create_dataset("tactile", data=values, chunks=values.shape, compression="gzip", shuffle=True)
        np.testing.assert_array_equal(read(tmp_path / "a.h5", field="tactile").readings, values)

    def test_links_inside_a_file_are_passed_over(self, tmp_path):
        path = hdf5(tmp_path)
        with h5py.File(path, "a") as file:
            file["soft"] = h5py.SoftLink("/data/demo_0/obs/tactile")
            file["away"] = h5py.ExternalLink("/nowhere.h5", "/tactile")
        assert len(read(path, field="obs/tactile")) == 60
        with pytest.raises(FieldError, match="no field 'away'"):
            read(path, field="away")


class TestPlaces:
    def test_pipes_in_a_folder_are_refused_by_name_and_stop_nothing(self, tmp_path):
        for name in ("a.npy", "b.csv", "c.mcap"):
            os.mkfifo(tmp_path / name)
        np.save(tmp_path / "d.npy", TIP)
        assert [path.name for path in find(tmp_path)] == ["a.npy", "b.csv", "c.mcap", "d.npy"]
        for path in find(tmp_path)[:3]:
            with pytest.raises(RecordingError, match=f"{path.name} is a FIFO; expected a file. It was passed over"):
                read(path)
        assert len(read(tmp_path / "d.npy")) == 30

    @pytest.mark.parametrize(
        ("key", "part"),
        [
            ("../../escaped", "'..'"),
            ("a/../../../escaped", "'..'"),
            ("a\\..\\escaped", r"a\\\\\.\.\\\\escaped"),
        ],
    )
    def test_keys_that_climb_out_of_a_folder_are_refused(self, tmp_path, key, part):
        files, address = fsspec.filesystem("memory"), f"memory://robots{hash(key)}/b.zarr"
        files.put(str(buffer(tmp_path)), address, recursive=True)
        assert len(read(address, field="tactile")) == 30
        name = address.removeprefix("memory:/")
        files.store[f"{name}/{key}"] = files.store[f"{name}/zarr.json"]
        with pytest.raises(RecordingError, match=f"names a file by .?{part}.?, which leads out of its folder"):
            read(address, field="tactile")

    @pytest.mark.parametrize(
        "address", ["dir://x", "ftp://127.0.0.1:1/x.npy", "jupyter://x", "nosuch://x/a.npy", "://"]
    )
    def test_any_address_that_fails_is_refused(self, address):
        with pytest.raises(RecordingError):
            read(address)

    def test_an_address_of_a_file_is_that_file(self, tmp_path):
        np.save(tmp_path / "a.npy", TIP)
        assert len(read(f"file://{tmp_path}/a.npy")) == 30
        with pytest.raises(RecordingError, match="is a device"):
            shutil.copy(tmp_path / "a.npy", tmp_path / "b.npy")
            (tmp_path / "b.npy").unlink()
            (tmp_path / "b.npy").symlink_to("/dev/zero")
            read(f"file://{tmp_path}/b.npy")

    def test_what_is_elsewhere_must_have_room(self, tmp_path, monkeypatch):
        files = fsspec.filesystem("memory")
        np.save(tmp_path / "a.npy", TIP)
        files.put(str(tmp_path / "a.npy"), "/robots/a.npy")
        files.put(str(buffer(tmp_path)), "/robots/room.zarr", recursive=True)
        usage = type("Usage", (), {"free": 1000})
        monkeypatch.setattr("shutil.disk_usage", lambda path: usage)
        for address in ("memory://robots/a.npy", "memory://robots/room.zarr"):
            with pytest.raises(RecordingError, match="bytes, and 1000 are free"):
                read(address)


class TestBounds:
    def test_a_recording_may_become_as_much_as_its_size_allows(self):
        bounds.require_bounded(bounds.SPARE + 10 * bounds.RATIO, 10, "x")
        with pytest.raises(RecordingError, match=r"claims to hold .* bytes in 10 bytes on the disk"):
            bounds.require_bounded(bounds.SPARE + 10 * bounds.RATIO + 1, 10, "x")

    def test_a_long_recording_of_a_sensor_at_rest_is_read(self, tmp_path, monkeypatch):
        """19 channels of zeros at 100 Hz, compressed, beyond what any file may cost; and 10^6 rows in one chunk."""
        store = bags.typestore(2)
        kind = "std_msgs/msg/Float32MultiArray"
        one = bytes(store.serialize_cdr(bags.array(store, np.zeros(19)), kind))
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        writer = Writer(tmp_path / "b", version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            connection = writer.add_connection("/skin", kind, typestore=store)
            for i in range(15_000):
                writer.write(connection, 10**18 + i * 10**7 + i * i % 4999, one)
        assert len(read(tmp_path / "b", **SKIN)) == 15_000
        array = zarr.create_array(
            tmp_path / "a.zarr", shape=(10**6, 19), chunks=(10**6, 19), dtype="f4", zarr_format=2, compressors=Blosc()
        )
        array[::1000] = 1
        assert sum(len(block) for block in iterate(tmp_path / "a.zarr")) == 10**6

    @pytest.mark.parametrize("form", ["bag", "mcap", "db3"])
    def test_a_long_file_is_read_in_little_memory(self, tmp_path, form):
        store = bags.typestore(1 if form == "bag" else 2)
        kind = store.types["std_msgs/msg/UInt8MultiArray"]
        layout = store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
        pictures = [(bags.START + i / 10, kind(layout=layout, data=np.full(1 << 20, i, np.uint8))) for i in range(48)]
        messages = [(bags.START + i / 100, bags.array(store, np.full(19, i))) for i in range(480)]
        path = tmp_path / ("b.bag" if form == "bag" else "b")
        bags.write(path, store, {"/camera": pictures, "/skin": messages}, form=form)
        del pictures
        tracemalloc.start()
        try:
            count = sum(len(block) for block in iterate(path, topic="/skin", field="data"))
            width = [block.readings.shape for block in iterate(path, topic="/camera", field="data")]
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert count == 480
        assert sum(shape[0] for shape in width) == 48
        assert peak < 2**26  # blocks of 16 MB, and what they are made of


@pytest.mark.parametrize(
    ("name", "lacks", "named", "extra"),
    [
        ("mcap STORAGE ZSTD", "backports", "a file compressed by zstd needs backports.zstd", "ros"),
        ("bag lz4", "lz4", "a file compressed by lz4 needs lz4", "ros"),
        ("mcap", "rosbags", "a ROS recording needs rosbags", "ros"),
        ("db3", "rosbags", "a ROS recording needs rosbags", "ros"),
        ("lerobot", "pyarrow", "a LeRobot data set needs pyarrow", "lerobot"),
        ("hdf5", "h5py", "an HDF5 file needs h5py", "hdf5"),
    ],
)
def test_a_library_that_is_not_installed_is_named_and_no_file_called_damaged(
    tmp_path, monkeypatch, name, lacks, named, extra
):
    if extra == "ros":
        form, _, compress = name.partition(" ")
        path = ros(tmp_path, form, compress)
        path = path if path.is_file() else next(path.glob(f"*.{form}"))
    else:
        path = lerobot(tmp_path / "set") if name == "lerobot" else hdf5(tmp_path)
    for module in [module for module in sys.modules if module.startswith(f"{lacks}.")]:
        monkeypatch.delitem(sys.modules, module)
    for module in (lacks, "compression"):
        monkeypatch.setitem(sys.modules, module, None)
    decoding._readers.cache_clear()
    for look in (lambda: read(path, field="data", topic="/skin" if extra == "ros" else None), lambda: describe(path)):
        with pytest.raises(MissingLibraryError, match=named) as raised:
            look()
        assert "damaged" not in str(raised.value)
        if lacks != "backports":  # which is installed, as anybody sees who looks, and only hidden here
            assert f"[{extra}]" in str(raised.value) and " -m pip install " in str(raised.value)
