"""Bags of ROS 1 and ROS 2: the numbers to the bit, the clocks, and what goes wrong with them."""

import io
import math
import re
import shutil
import sqlite3
import struct
import zlib
from pathlib import Path
from types import SimpleNamespace

import bags
import numpy as np
import pytest
from PIL import Image
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import get_types_from_msg

from scroll_tactile.errors import ChannelCountError, FieldError, InputError, RecordingError
from scroll_tactile.recordings import describe, find, iterate, read, resampled
from scroll_tactile.recordings.blocks import Block
from scroll_tactile.recordings.reader import assemble
from scroll_tactile.sensors import BIOTAC
from scroll_tactile.signals.stream import validate

SHARED = Path(__file__).parents[3] / "shared" / "data" / "recordings"
RNG = np.random.default_rng(7)


@pytest.fixture(scope="module")
def store2():
    return bags.typestore(2)


@pytest.fixture(scope="module")
def store1():
    return bags.typestore(1)


def floats(store, count=50, width=19, start=float(bags.START)):
    values = RNG.standard_normal((count, width)).astype(np.float32)
    return values, [(start + i / 100, bags.array(store, row)) for i, row in enumerate(values)]


def by_other(path, topic, numbers):
    """The truth as rosbags gives it."""
    with AnyReader([path]) as reader:
        wanted = [c for c in reader.connections if c.topic == topic]
        return np.array([numbers(reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages(wanted)])


@pytest.mark.parametrize(
    ("name", "options", "numbers"),
    [
        ("biotac", {"topic": "/rh/tactile", "field": "tactiles[0].electrodes"}, lambda m: m.tactiles[0].electrodes),
        ("biotac", {"preset": "biotac"}, lambda m: m.tactiles[0].electrodes),
        ("multiarray", {"topic": "/skin", "field": "data"}, lambda m: m.data),
        ("papillarray", {"preset": "papillarray"}, lambda m: [v for p in m.pillars for v in (p.fx, p.fy, p.fz)]),
    ],
)
def test_files_of_others_read_with_one_line_as_rosbags_reads_them(name, options, numbers):
    if not SHARED.exists():
        pytest.skip(f"no recordings of others: {SHARED} does not exist, and the project ships none")
    path = SHARED / f"{name}.mcap"
    recording = read(path, **options)
    np.testing.assert_array_equal(recording.readings, by_other(path, recording.topic, numbers))
    assert recording.report.lost == 2
    assert not recording.report.cut_off
    if recording.report.clock != "device":
        assert [gap.seconds > 1.9 for gap in recording.report.gaps] == [True]
    assert f"field={recording.field!r}" in str(describe(path))


@pytest.mark.parametrize(
    ("form", "compress"),
    [
        ("bag", ""),
        ("bag", "bz2"),
        ("bag", "lz4"),
        ("db3", ""),
        ("db3", "FILE ZSTD"),
        ("db3", "MESSAGE ZSTD"),
        ("mcap", ""),
        ("mcap", "STORAGE ZSTD"),
    ],
)
def test_every_container_gives_the_same_numbers_and_times(tmp_path, store1, store2, form, compress):
    store = store1 if form == "bag" else store2
    values = RNG.integers(0, 4096, (300, 19)).astype(np.int16)
    stamps = bags.START + np.cumsum(RNG.uniform(0.005, 0.015, 300)).round(6)
    messages = [
        (stamp + 0.001, bags.biotac(store, row, stamp, i))
        for i, (stamp, row) in enumerate(zip(stamps, values, strict=True))
    ]
    other = [(bags.START + i, bags.text(store, "hm")) for i in range(3)]
    path = tmp_path / ("b.bag" if form == "bag" else "b")
    bags.write(path, store, {"/rh/tactile": messages, "/other": other}, form=form, compress=compress)
    files = [path] if path.is_file() or compress in ("FILE ZSTD", "MESSAGE ZSTD") else [path, *path.glob(f"*.{form}")]
    for file in files:
        recording = read(file, topic="/rh/tactile", field="tactiles[0].electrodes")
        assert recording.readings.dtype == np.float32
        np.testing.assert_array_equal(recording.readings, values)
        np.testing.assert_allclose(recording.times, stamps, rtol=0, atol=3e-7)
        assert recording.report.clock == "header"
        logged = read(file, topic="/rh/tactile", field="tactiles[0].electrodes", clock="log")
        np.testing.assert_allclose(logged.times - recording.times, 0.001, atol=1e-6)
        together = np.concatenate([block.readings for block in iterate(file, preset="biotac")])
        np.testing.assert_array_equal(together, values)


def test_the_parts_of_a_split_bag_are_one_recording(tmp_path, store2):
    values, messages = floats(store2, 60)
    for i in range(3):
        bags.write(tmp_path / f"p{i}", store2, {"/skin": messages[20 * i : 20 * i + 20]}, form="mcap")
        next((tmp_path / f"p{i}").glob("*.mcap")).rename(tmp_path / f"p_{i if i < 2 else 10}.mcap")
        shutil.rmtree(tmp_path / f"p{i}")
    np.testing.assert_array_equal(read(tmp_path, topic="/skin", field="data").readings, values)


def test_xela_has_a_clock_and_a_count_of_its_own(tmp_path, store2):
    taxels = RNG.integers(0, 65536, (40, 16, 3))
    counts = [*range(65520, 65536), *range(3, 27)]  # of 16 bits, here: three are lost as it wraps
    messages = [
        (bags.START + i * 0.011, bags.uskin(store2, row, count, 100 + i * 0.01))
        for i, (row, count) in enumerate(zip(taxels, counts, strict=True))
    ]
    path = bags.write(tmp_path / "x", store2, {"/x_taxel/sensor_0": messages}, form="mcap")
    recording = read(path, topic="/x_taxel/sensor_0", field="sensors[0].taxels[*].{x,y,z}")
    np.testing.assert_array_equal(recording.readings, taxels.reshape(40, 48))
    np.testing.assert_array_equal(recording.times, [100 + i * 0.01 for i in range(40)])
    assert (recording.report.clock, recording.report.lost) == ("device", 3)
    assert read(path, preset="xela-uskin", clock="publish").report.clock == "publish"
    one = bags.write(tmp_path / "one", store2, {"/x_taxel/sensor_0": messages[:1]}, form="mcap")
    assert read(one, preset="xela-uskin").times.tolist() == [100]
    assert read(path, field="sensors[0].forces[*].{x,y,z}").topic == "/x_taxel/sensor_0"


def test_papillarray_counts_microseconds_and_ros_2_writes_in_lower_case(tmp_path, store1):
    forces = RNG.standard_normal((30, 9, 3)).astype(np.float32)
    messages = [
        (bags.START + i * 0.002, bags.papillarray(store1, row, 2000 * i, bags.START + i * 0.002))
        for i, row in enumerate(forces)
    ]
    path = bags.write(tmp_path / "p.bag", store1, {"/hub_0/sensor_0": messages}, form="bag")
    for field in ("pillars[*].{fX,fY,fZ}", "pillars[*].{fx,fy,fz}"):
        recording = read(path, topic="/hub_0/sensor_0", field=field)
        np.testing.assert_array_equal(recording.readings, forces.reshape(30, 27))
    np.testing.assert_array_equal(recording.times, np.arange(30) * 2000 / 1e6)
    assert read(path, preset="papillarray", clock="header").times[0] == bags.START
    assert "dX" in str(describe(path)) or "fX" in str(describe(path))


def test_other_drivers_messages(tmp_path, store1):
    types = store1.types
    patches = [RNG.standard_normal((20, 12)).astype(np.float32), RNG.standard_normal((20, 16)).astype(np.float32)]
    channel = types["sensor_msgs/msg/ChannelFloat32"]
    states = [
        types["tactile_msgs/msg/TactileState"](
            header=bags.header(store1, bags.START + i / 100, i),
            sensors=[channel(name=f"p{k}", values=patch[i]) for k, patch in enumerate(patches)],
        )
        for i in range(20)
    ]
    pads = RNG.integers(0, 65536, (20, 2, 28)).astype(np.uint16)
    static = [
        types["robotiq_tsf/msg/StaticData"](taxels=[types["robotiq_tsf/msg/Taxels"](values=pad) for pad in both])
        for both in pads
    ]
    topics = {
        "/tactile": [(bags.START + i / 100, state) for i, state in enumerate(states) if i not in (5, 6, 9)],
        "/TactileSensor/StaticData": [(bags.START + i / 60, both) for i, both in enumerate(static)],
    }
    path = bags.write(tmp_path / "b.bag", store1, topics, form="bag")
    recording = read(path, field="sensors[*].values")
    kept = [i for i in range(20) if i not in (5, 6, 9)]
    np.testing.assert_array_equal(recording.readings, np.hstack(patches)[kept])
    assert (recording.report.lost, recording.report.clock) == (3, "header")  # ROS 1 counts in the header
    recording = read(path, preset="robotiq-tsf")
    np.testing.assert_array_equal(recording.readings, pads.reshape(20, 56))
    assert (recording.report.lost, recording.report.clock) == (None, "log")


def test_a_reading_out_of_a_bag_is_the_stream_of_its_array(tmp_path, store1):
    values = RNG.integers(0, 256, (400, 19)).astype(np.int16)
    messages = [(bags.START + i / 100, bags.biotac(store1, row, bags.START + i / 100)) for i, row in enumerate(values)]
    path = bags.write(tmp_path / "b.bag", store1, {"/rh/tactile": messages}, form="bag")
    assert read(path, preset="biotac").stream(BIOTAC).key == validate(values, BIOTAC).key


def test_a_header_of_zeros_and_no_header_fall_back(tmp_path, store2):
    values = np.arange(20 * 19, dtype=np.int16).reshape(20, 19)
    zero = [(bags.START + i / 100, bags.biotac(store2, row, 0.0)) for i, row in enumerate(values)]
    path = bags.write(tmp_path / "z", store2, {"/rh/tactile": zero}, form="mcap")
    report = read(path, preset="biotac").report
    assert (report.clock, report.unset) == ("publish", 20)
    path = bags.write(tmp_path / "d", store2, {"/rh/tactile": zero}, form="db3")
    assert read(path, preset="biotac").report.clock == "log"
    with pytest.raises(InputError, match="expected a clock of this recording, header, log; came 'publish'"):
        read(path, preset="biotac", clock="publish")


def test_time_that_goes_back_and_readings_that_repeat_are_counted(tmp_path, store2):
    stamps = [1.0, 1.1, 1.2, 1.2, 0.5, 0.6, 0.7]
    messages = [
        (bags.START + i / 10, bags.biotac(store2, np.zeros(19, np.int16), stamp)) for i, stamp in enumerate(stamps)
    ]
    recording = read(bags.write(tmp_path / "b", store2, {"/t": messages}, form="db3"), field="tactiles[0].electrodes")
    assert (recording.report.backward, recording.report.repeated) == (1, 1)
    even = resampled(recording, 10.0)  # what goes back is left out
    np.testing.assert_allclose(even.times, [1.0, 1.1, 1.2])
    assert "resampled to 10 Hz" in str(even.report)


def test_messages_that_were_logged_at_the_same_time_stay_in_their_order():
    logged = np.repeat([2.0, 1.0], 50)
    block = Block(np.arange(100.0)[:, None], {"log": logged}, {})
    readings, times, _, _ = assemble(block, "log", SimpleNamespace(marks=[], names={}, continuous=True))
    assert readings.ravel().tolist() == [*range(50, 100), *range(50)]
    assert times.tolist() == sorted(logged)


def test_labels_of_a_topic_become_episodes(tmp_path, store2):
    values, messages = floats(store2, 50)
    said = [(0.1, "felt"), (0.2, " felt"), (0.3, ""), (0.4, " cork "), (0.45, " cork ")]
    labels = [(bags.START + seconds - 1e-4, bags.text(store2, name)) for seconds, name in said]
    path = bags.write(tmp_path / "b", store2, {"/skin": messages, "/material": labels}, form="mcap")
    recording = read(path, topic="/skin", field="data", labels="/material")
    assert [(e.begin, e.end, e.name) for e in recording.episodes] == [(10, 30, "felt"), (40, 50, "cork")]
    with pytest.raises(FieldError, match="no message of topic '/materials'; nearest is '/material'"):
        read(path, topic="/skin", field="data", labels="/materials")
    np.testing.assert_array_equal(recording.readings, values)


def test_big_endian_messages_read_alike(tmp_path, store2):
    values, messages = floats(store2, 5)
    path = next(bags.write(tmp_path / "b", store2, {"/skin": messages}, form="db3").glob("*.db3"))
    base = sqlite3.connect(path)
    for number, row in enumerate(values):
        data = struct.pack(">BBH", 0, 0, 0) + struct.pack(">III19f", 0, 0, 19, *row)
        base.execute("UPDATE messages SET data = ? WHERE id = ?", (data, number + 1))
    base.commit()
    base.close()
    np.testing.assert_array_equal(read(path, topic="/skin", field="data").readings, values)


@pytest.mark.parametrize("compress", ["", "bz2", "lz4", "STORAGE ZSTD"])
def test_a_bag_that_was_cut_anywhere_gives_its_whole_messages(tmp_path, store1, store2, compress):
    """As a power cut leaves it; of MCAP and of ROS 1, whose recorder then closed no index either."""
    ros = 2 if compress == "STORAGE ZSTD" else 1
    for form, store in (("mcap", store2), ("bag", store1)):
        if compress and form != ("mcap" if ros == 2 else "bag"):
            continue
        values, messages = floats(store, 300)
        path = bags.write(tmp_path / f"b.{form}", store, {"/skin": messages}, form=form, compress=compress)
        path = path if path.is_file() else next(path.glob("*.mcap"))
        whole, most = path.read_bytes(), 0
        for end in [*range(0, len(whole), 997), len(whole) - 1]:
            path.write_bytes(whole[:end])
            try:
                recording = read(path, topic="/skin", field="data")
            except RecordingError as error:
                assert not most, error
                assert re.search("does not begin as|holds no message|no numbers", str(error)), error
                continue
            np.testing.assert_array_equal(recording.readings, values[: len(recording)])
            assert len(recording) >= most
            most = len(recording)
            assert recording.report.cut_off or end > 0.9 * len(whole)
        assert most == 300


def test_a_part_of_a_compressed_bag_is_read_alone(tmp_path, store2):
    values, messages = floats(store2, 30)
    for compress in ("MESSAGE ZSTD", "FILE ZSTD"):
        folder = bags.write(tmp_path / compress, store2, {"/skin": messages}, form="db3", compress=compress)
        (part,) = (file for file in folder.iterdir() if file.suffix != ".yaml")
        np.testing.assert_array_equal(read(part, topic="/skin", field="data").readings, values)
    whole = part.read_bytes()
    part.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(RecordingError):
        read(part, topic="/skin", field="data")


def test_messages_that_wait_in_a_write_ahead_log_are_read(tmp_path, store2):
    values, messages = floats(store2, 30)
    path = next(bags.write(tmp_path / "b", store2, {"/skin": messages}, form="db3").glob("*.db3"))
    base = sqlite3.connect(path)
    base.execute("PRAGMA journal_mode=WAL")
    base.execute("PRAGMA wal_autocheckpoint=0")
    base.execute("INSERT INTO messages (topic_id, timestamp, data) SELECT topic_id, timestamp + 10, data FROM messages")
    base.commit()
    (tmp_path / "copy").mkdir()
    for file in path.parent.glob("*.db3*"):  # as a recorder left them that was stopped by force
        shutil.copy(file, tmp_path / "copy")
    base.close()
    readings = read(tmp_path / "copy" / path.name, topic="/skin", field="data").readings
    np.testing.assert_array_equal(np.sort(readings, 0), np.sort(np.repeat(values, 2, 0), 0))


def test_a_bag_that_its_recorder_never_closed_is_read(tmp_path, store1):
    values, messages = floats(store1, 300)
    path = bags.write(tmp_path / "b.bag", store1, {"/skin": messages}, form="bag")
    whole = path.read_bytes()
    begin = whole.index(b"index_pos=") + len(b"index_pos=")
    index = int.from_bytes(whole[begin : begin + 8], "little")
    (tmp_path / "b.bag.active").write_bytes(whole[:begin] + bytes(8) + whole[begin + 8 : index])
    recording = read(tmp_path / "b.bag.active", topic="/skin", field="data")
    np.testing.assert_array_equal(recording.readings, values)
    assert "its recorder did not close it" in str(recording.report)


@pytest.mark.parametrize("form", ["bag", "mcap", "db3"])
def test_a_file_that_was_cut_off_gives_what_comes_before(tmp_path, store1, store2, form):
    store = store1 if form == "bag" else store2
    values, messages = floats(store, 4000)
    path = bags.write(tmp_path / ("b.bag" if form == "bag" else "b"), store, {"/skin": messages}, form=form)
    path = path if path.is_file() else next(path.glob(f"*.{form}"))
    whole, seen = path.read_bytes(), 0
    for share in (0.3, 0.6, 0.9):
        path.write_bytes(whole[: int(len(whole) * share)])
        recording = read(path, topic="/skin", field="data")
        assert recording.report.cut_off
        assert "cut off" in str(recording.report)
        assert len(recording) > max(seen, 0.5 * share * 4000 * (form != "db3"))
        seen = len(recording)
        np.testing.assert_array_equal(recording.readings, values[:seen])
    path.write_bytes(whole[:600])
    with pytest.raises(RecordingError):
        read(path, topic="/skin", field="data")


def test_a_damaged_chunk_is_left_out_and_said(tmp_path, store2):
    _, messages = floats(store2, 12_000)
    path = next(
        bags.write(tmp_path / "b", store2, {"/skin": messages}, form="mcap", compress="STORAGE ZSTD").glob("*.mcap")
    )
    whole = bytearray(path.read_bytes())
    first = whole.index(b"\x28\xb5\x2f\xfd")  # as what is compressed by zstd begins
    whole[first] ^= 1
    path.write_bytes(whole)
    recording = read(path, topic="/skin", field="data")
    assert 0 < len(recording) < 12_000
    assert "damaged chunk" in str(recording.report)


def test_a_message_that_does_not_fit_its_type_is_left_out_and_said(tmp_path, store2):
    values, messages = floats(store2, 5)
    path = next(bags.write(tmp_path / "b", store2, {"/skin": messages}, form="db3").glob("*.db3"))
    base = sqlite3.connect(path)
    base.execute("UPDATE messages SET data = ? WHERE id IN (1, 3)", (b"\0\1\0\0\xff",))
    base.commit()
    for options in ({"topic": "/skin", "field": "data"}, {"field": "data"}):
        recording = read(path, **options)
        np.testing.assert_array_equal(recording.readings, values[[1, 3, 4]])
        assert "2 messages do not fit" in str(recording.report)
    base.execute("UPDATE messages SET data = ?", (b"\0\1\0\0\xff",))
    base.commit()
    base.close()
    with pytest.raises(RecordingError, match="does not fit its type std_msgs/msg/Float32MultiArray"):
        read(path, topic="/skin", field="data")


def test_a_wrong_topic_or_field_names_what_there_is(tmp_path, store2):
    _, messages = floats(store2, 5)
    other = [(bags.START, bags.biotac(store2, np.zeros(19, np.int16), 1.0))]
    names = [(bags.START, bags.text(store2, "felt"))]
    path = bags.write(tmp_path / "b", store2, {"/skin": messages, "/rh/tactile": other, "/name": names}, form="mcap")
    for options, message in [
        ({"topic": "/skn", "field": "data"}, "no message of topic '/skn'; nearest is '/skin'"),
        ({"topic": "/skin", "field": "dta"}, r"no 'dta'; nearest is 'data' \(of layout, data\)"),
        ({"topic": "/name", "field": "data"}, "leads to text, 'felt'"),
        ({"topic": "/rh/tactile", "field": "tactiles"}, "leads to a message, not to numbers; inside it are pac0"),
        ({"topic": "/rh/tactile", "field": "tactiles[7].electrodes"}, r"\[7\] is wanted of an array of 5"),
        ({"topic": "/rh/tactile", "field": "tactiles.electrodes"}, r"write \[0\] or \[\*\]"),
        ({"topic": "/skin"}, r"such as topic='/skin' field='data'"),
        ({}, r"/skin  data  \[19\], 5 readings, 100 Hz(?s:.*)/rh/tactile  tactiles\[0\].electrodes  \[19\]"),
        ({"topic": "/skin", "field": "data", "clock": "layout"}, "clock 'layout' leads to"),
    ]:
        with pytest.raises(FieldError, match=message):
            read(path, **options)
    assert read(path, field="data").topic == "/skin"


def test_ragged_empty_and_undefined(tmp_path, store2):
    rows = [np.zeros(19), np.zeros(19), np.zeros(20)]
    messages = [(bags.START + i, bags.array(store2, row)) for i, row in enumerate(rows)]
    path = bags.write(tmp_path / "ragged", store2, {"/skin": messages}, form="db3")
    with pytest.raises(RecordingError, match=r"ragged: of '/skin' in 'data' 2 have 19 values, 1 have 20 values"):
        read(path, topic="/skin", field="data")
    assert read(path, topic="/skin", field="data[0:19]").readings.shape == (3, 19)
    empty = bags.write(tmp_path / "empty", store2, {"/skin": messages[:1]}, form="db3")
    base = sqlite3.connect(next(empty.glob("*.db3")))
    base.execute("DELETE FROM messages")
    base.commit()
    base.close()
    for options in ({}, {"topic": "/skin", "field": "data"}):
        with pytest.raises(RecordingError, match="holds no message"):
            read(empty, **options)
    biotac = [(bags.START + i, bags.biotac(store2, np.arange(24, dtype=np.int16), 1.0 + i)) for i in range(3)]
    path = bags.write(tmp_path / "sp", store2, {"/rh/tactile": biotac}, form="db3")
    with pytest.raises(ChannelCountError, match="as of biotac-sp"):
        read(path, preset="biotac")
    assert read(path, preset="biotac-sp").readings.shape == (3, 24)


def as_humble(path):
    """A bag without definitions, as before ROS 2 Iron."""
    base = sqlite3.connect(next(path.glob("*.db3")))
    base.execute("DROP TABLE message_definitions")
    base.commit()
    base.close()
    return path


PILLARS = {
    "v/msg/PillarState": "int32 id\nfloat32 dx\nfloat32 dy\nfloat32 dz\nfloat32 fx\nfloat32 fy\nfloat32 fz\n"
    "bool in_contact\nint32 slip_state",
    "v/msg/SensorState": "std_msgs/Header header\nint64 tus\nPillarState[] pillars\nfloat32 gfx\nfloat32 gfy\n"
    "float32 gfz\nfloat32 gtx\nfloat32 gty\nfloat32 gtz\n",
}
SLIPS = "float32 friction_est\nfloat32 target_grip_force\nbool is_sd_active\nbool is_ref_loaded\n"


@pytest.mark.parametrize("stamped", [True, False])
@pytest.mark.parametrize("slips", ["", SLIPS, f"{SLIPS}bool is_contact\n"])
def test_a_preset_brings_each_version_of_its_drivers_messages(tmp_path, store2, stamped, slips):
    store = bags.typestore(2)
    pillar, state = PILLARS.values()
    kinds = get_types_from_msg(stamped * "std_msgs/Header header\n" + pillar, "v/msg/PillarState")
    store.register(kinds | get_types_from_msg(state + slips, "v/msg/SensorState"))
    forces, zeros = RNG.standard_normal((9, 3)).astype(np.float32), [0.0] * 3
    head = [bags.header(store, 1.0)] * stamped
    each = [
        store.types["v/msg/PillarState"](*head, i, *zeros, *map(float, row), True, 0) for i, row in enumerate(forces)
    ]
    more = [0.5, 0.5, True, False, True][: slips.count("\n")]
    message = store.types["v/msg/SensorState"](bags.header(store, 1.0), 7, each, *zeros, *zeros, *more)
    path = as_humble(bags.write(tmp_path / "b", store, {"/hub_0/sensor_0": [(bags.START, message)]}, form="db3"))
    np.testing.assert_array_equal(read(path, preset="papillarray").readings[0], forces.ravel())


def test_a_preset_brings_its_drivers_messages(tmp_path, store2):
    static, pads = store2.types["robotiq_tsf/msg/StaticData"], store2.types["robotiq_tsf/msg/Taxels"]
    taxels = RNG.integers(0, 65536, (2, 28)).astype(np.uint16)
    patch = store2.types["sensor_msgs/msg/ChannelFloat32"](name="p", values=np.arange(12, dtype=np.float32))
    skin = store2.types["tactile_msgs/msg/TactileState"](bags.header(store2, 1.0), [patch])
    for name, message, options, numbers in [
        ("shadow", bags.biotac(store2, np.arange(24, dtype=np.int16), 1.0), {"preset": "biotac-sp"}, np.arange(24)),
        ("xela", bags.uskin(store2, np.arange(48).reshape(16, 3), 1, 2.0), {"preset": "xela-uskin"}, np.arange(48)),
        ("robotiq", static([pads(row) for row in taxels]), {"preset": "robotiq-tsf"}, taxels.ravel()),
        ("agni", skin, {"field": "sensors[*].values"}, np.arange(12)),
    ]:
        path = as_humble(bags.write(tmp_path / name, store2, {"/skin": [(bags.START, message)]}, form="db3"))
        np.testing.assert_array_equal(read(path, **options).readings, [numbers])
        assert describe(path).entries


def test_messages_of_other_drivers_take_a_folder_of_definitions(tmp_path, store2):
    store = bags.typestore(2)
    part, whole = "float32[] values", "std_msgs/Header header\nFinger[2] fingers"
    store.register(get_types_from_msg(part, "my/msg/Finger") | get_types_from_msg(whole, "my/msg/Hand"))
    fingers = [store.types["my/msg/Finger"](np.array([i, 2], np.float32)) for i in range(2)]
    hand = store.types["my/msg/Hand"](bags.header(store, 1.0), fingers)
    path = as_humble(bags.write(tmp_path / "b", store, {"/hand": [(bags.START, hand)]}, form="db3"))
    options = {"topic": "/hand", "field": "fingers[*].values"}
    for ask in ({}, options, {"field": "fingers[*].values"}, {"topic": "/hand"}):
        with pytest.raises(RecordingError, match=r"my/msg/Hand .*Give definitions='FOLDER', a folder with Hand.msg"):
            read(path, **ask)
    for place in ("ros/my/msg", "flat", "other-main/msg"):
        (folder := tmp_path / place).mkdir(parents=True)
        with pytest.raises(InputError, match=r"expected a folder with \.msg files in it"):
            read(path, **options, definitions=folder)
        (folder / "Hand.msg").write_text(whole)
        with pytest.raises(RecordingError, match=r"my/msg/Finger .*a folder with Finger.msg"):
            read(path, **options, definitions=folder)
        (folder / "Finger.msg").write_text(part)
        assert read(path, **options, definitions=tmp_path / place.split("/")[0]).readings.tolist() == [[0, 2, 1, 2]]
        assert read(path, **options, definitions=str(folder)).readings.tolist() == [[0, 2, 1, 2]]
    given = {"my/msg/Hand": f"{whole}\n{'=' * 80}\nMSG: my/Finger\n{part}"}
    assert read(path, **options, definitions=given).readings.tolist() == [[0, 2, 1, 2]]
    (tmp_path / "flat" / "Hand.msg").write_text("float32 x")
    with pytest.raises(RecordingError, match="does not fit its type my/msg/Hand"):
        read(path, **options, definitions=tmp_path / "flat")


@pytest.mark.parametrize("bad", [[0], [200], [0, 1, 399]])
@pytest.mark.parametrize("field", ["data", "data[0:4]", "data[*]"])
def test_a_message_whose_array_is_empty_is_left_out_and_said(tmp_path, store2, bad, field):
    rows = [np.zeros(0) if i in bad else np.full(4, i) for i in range(400)]
    messages = [(bags.START + i / 100, bags.array(store2, row)) for i, row in enumerate(rows)]
    path = bags.write(tmp_path / "b", store2, {"/skin": messages}, form="mcap")
    assert [entry.field for entry in describe(path).entries] == ["data"]
    recording = read(path, field=field)
    assert recording.readings[:, 0].tolist() == [i for i in range(400) if i not in bad]
    assert f"{len(bad)} messages have an empty array in {field!r}, and were left out" in str(recording.report)


def test_a_driver_that_was_not_ready_sends_no_sensors_no_taxels_and_nothing(tmp_path, store2):
    values = RNG.integers(0, 65536, (10, 16, 3))
    messages = [(bags.START + i / 100, bags.uskin(store2, row, i, i / 100)) for i, row in enumerate(values)]
    messages[0][1].sensors.clear()
    messages[4][1].sensors[0].taxels.clear()
    path = bags.write(tmp_path / "b", store2, {"/xServTopic": messages}, form="mcap")
    recording = read(path, preset="xela-uskin")
    np.testing.assert_array_equal(recording.readings, np.delete(values, [0, 4], 0).reshape(8, 48))
    assert "2 messages have an empty array" in str(recording.report) and recording.report.clock == "device"
    for _, message in messages:
        message.sensors.clear()
    path = bags.write(tmp_path / "none", store2, {"/xServTopic": messages}, form="mcap")
    with pytest.raises(RecordingError, match="has no numbers in /xServTopic: its arrays are empty"):
        read(path, preset="xela-uskin")
    with pytest.raises(FieldError, match="holds no value: its array is empty in each message"):
        read(path, preset="xela-uskin", topic="/xServTopic")


@pytest.mark.parametrize(
    ("field", "sizes", "cure"),
    [
        ("data", [4, 2, 4], "data[0:2]"),
        ("data[0:4]", [4, 2, 4], "data[0:2]"),
        ("data[1:]", [4, 3, 4], "data[1:3]"),
    ],
)
def test_readings_of_several_sizes_are_refused_with_a_field_that_all_have(tmp_path, store2, field, sizes, cure):
    messages = [(bags.START + i, bags.array(store2, np.ones(size))) for i, size in enumerate(sizes)]
    path = bags.write(tmp_path / "b", store2, {"/skin": messages}, form="mcap")
    with pytest.raises(RecordingError, match=re.escape(f"as in field={cure!r}")):
        read(path, field=field)
    assert len(read(path, field=cure)) == len(sizes)


def test_a_message_with_fewer_taxels_leaves_those_that_all_have(tmp_path, store2):
    messages = [(bags.START + i / 100, bags.uskin(store2, np.ones((4 if i == 2 else 16, 3)), i, 1.0)) for i in range(5)]
    path = bags.write(tmp_path / "b", store2, {"/xServTopic": messages}, form="mcap")
    cure = "sensors[0].taxels[0:4].{x,y,z}"
    with pytest.raises(RecordingError, match=re.escape("1 have 12 values, 4 have 48 values. Name elements that each")):
        read(path, preset="xela-uskin")
    with pytest.raises(RecordingError, match=re.escape(f"as in field={cure!r}")):
        read(path, preset="xela-uskin")
    assert read(path, field=cure).readings.shape == (5, 12)


def test_a_topic_that_begins_late_is_found(tmp_path, store2):
    _, early = floats(store2, 2500)
    late = [(bags.START + 30 + i, bags.biotac(store2, np.arange(19, dtype=np.int16), 1.0 + i)) for i in range(3)]
    path = bags.write(tmp_path / "b", store2, {"/skin": early, "/my/hand": late}, form="mcap")
    assert len(read(path, preset="biotac")) == 3


def test_two_hands_at_two_rates_are_asked_for(tmp_path, store2):
    hands = {
        name: [(bags.START + i / rate, bags.biotac(store2, np.full(19, i, np.int16), 0.0)) for i in range(rate)]
        for name, rate in (("/left/tactile", 100), ("/right/tactile", 50))
    }
    _, other = floats(store2, 5)
    path = bags.write(tmp_path / "b", store2, {**hands, "/skin": other}, form="db3")
    with pytest.raises(FieldError, match=r"several topics have a field(?s:.*)such as topic='/left/tactile'") as error:
        read(path, preset="biotac")
    assert "100 Hz" in str(error.value) and "50 Hz" in str(error.value) and "/skin" not in str(error.value)
    for name, rate in (("/left/tactile", 100), ("/right/tactile", 50)):
        assert read(path, preset="biotac", topic=name).report.rate == pytest.approx(rate, rel=1e-3)
    path = bags.write(tmp_path / "rh", store2, {**hands, "/rh/tactile": hands["/left/tactile"]}, form="db3")
    recording = read(path, preset="biotac")
    assert recording.topic == "/rh/tactile"
    assert recording.report.notes == ("/left/tactile has such readings, too", "/right/tactile has such readings, too")


@pytest.mark.parametrize(("bits", "step", "unit"), [(16, 10, "ms"), (16, 10_000, "us"), (32, 10_000_000, "ns")])
def test_a_devices_clock_that_turns_over_goes_on(tmp_path, bits, step, unit):
    messages = [(1, i, b'{"v": [1, 2], "t_%s": %d}' % (unit.encode(), (i * step + 5) % 2**bits)) for i in range(9000)]
    path = mcap(tmp_path / "m.mcap", [(b"/a", b"json", b"Skin", b"", b"")], messages)
    recording = read(path, topic="/a", field="v", clock=f"t_{unit}")
    np.testing.assert_allclose(np.diff(recording.times), 0.01, atol=1e-6)
    assert (recording.report.backward, recording.report.gaps) == (0, ())


def test_a_devices_clock_that_begins_anew_goes_back(tmp_path):
    counts = [*range(30_000, 50_000, 10), *range(0, 9000, 10)]
    messages = [(1, i, b'{"v": [1, 2], "t_ms": %d}' % count) for i, count in enumerate(counts)]
    path = mcap(tmp_path / "m.mcap", [(b"/a", b"json", b"Skin", b"", b"")], messages)
    assert read(path, topic="/a", field="v", clock="t_ms").report.backward == 1


def test_stamps_of_whole_seconds_are_no_clock(tmp_path, store2):
    messages = [
        (bags.START + i / 100, bags.biotac(store2, np.full(19, i, np.int16), float(bags.START + i // 100)))
        for i in range(300)
    ]
    path = bags.write(tmp_path / "b", store2, {"/t": messages}, form="db3")
    report = read(path, preset="biotac").report
    assert report.clock == "log" and report.rate == pytest.approx(100, rel=1e-3)
    assert "the header's stamps are whole seconds: times are another clock's" in report.notes
    assert read(path, preset="biotac", clock="header").report.repeated == 297
    slow = bags.write(tmp_path / "slow", store2, {"/t": messages[::100]}, form="db3")  # a reading a second
    assert read(slow, preset="biotac").report.clock == "header"


JOINTS = (
    "00010000640000000000000004000000746970000200000006000000696e64657800d0fd060000007468756d6200000002000000000000"
    "000000d03f000000000000f8bf00000000000000000a7f0000b090d0fd"
)
"""By rclpy's serialize_message: a JointState of two joints at 0.25 and -1.5, without velocity and effort."""


def joints(path, store, *messages):
    with Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/joints", "sensor_msgs/msg/JointState", typestore=store)
        for i, message in enumerate(messages):
            writer.write(connection, 10**9 * (i + 1), message)
    return path


def test_empty_lists_leave_bytes_behind_a_message(tmp_path, store2):
    path = joints(tmp_path / "b", store2, bytes.fromhex(JOINTS), bytes.fromhex(JOINTS))
    recording = read(path, topic="/joints", field="position")
    assert recording.readings.tolist() == [[0.25, -1.5]] * 2
    assert not recording.report.notes
    assert "position" in [entry.field for entry in describe(path).entries]


@pytest.mark.parametrize("size", [5, 20, 40, 55, 70, 84 + 12])
def test_messages_of_another_size_stay_errors(tmp_path, store2, size):
    message = (bytes.fromhex(JOINTS) + bytes(12))[:size]
    with pytest.raises(RecordingError, match="does not fit its type"):
        read(joints(tmp_path / "b", store2, message), topic="/joints", field="position")


def test_pictures_come_as_frames(tmp_path, store2):
    types, pixels = store2.types, RNG.integers(0, 256, (3, 4, 5, 3), dtype=np.uint8)
    messages = []
    for i, picture in enumerate(pixels):
        lines = np.zeros((4, 16), np.uint8)  # a line may be longer than its pixels
        lines[:, :15] = picture[:, :, ::-1].reshape(4, 15)
        image = types["sensor_msgs/msg/Image"](
            header=bags.header(store2, 1.0 + i),
            height=4,
            width=5,
            encoding="bgr8",
            is_bigendian=0,
            step=16,
            data=lines.ravel(),
        )
        messages.append((bags.START + i, image))
    path = bags.write(tmp_path / "i", store2, {"/digit": messages}, form="mcap")
    recording = read(path, topic="/digit", field="data")
    np.testing.assert_array_equal(recording.readings, pixels)
    assert recording.readings.dtype == np.uint8


def test_compressed_pictures_come_as_frames(tmp_path, store2):
    pixels = RNG.integers(0, 256, (2, 8, 6, 3), dtype=np.uint8)
    messages = []
    for i, picture in enumerate(pixels):
        buffer = io.BytesIO()
        Image.fromarray(picture).save(buffer, "PNG")
        kind = store2.types["sensor_msgs/msg/CompressedImage"]
        data = np.frombuffer(buffer.getvalue(), np.uint8)
        messages.append((bags.START + i, kind(header=bags.header(store2, 1.0 + i), format="png", data=data)))
    path = bags.write(tmp_path / "i", store2, {"/gel": messages}, form="mcap")
    np.testing.assert_array_equal(read(path, preset="gelsight").readings, pixels)


def test_a_preset_finds_its_field_under_any_topic(tmp_path, store2):
    values = np.arange(3 * 19, dtype=np.int16).reshape(3, 19)
    mine = [(bags.START + i, bags.biotac(store2, row, 1.0 + i)) for i, row in enumerate(values)]
    path = bags.write(tmp_path / "one", store2, {"/my/hand": mine}, form="mcap")
    assert read(path, preset="biotac").topic == "/my/hand"
    path = bags.write(tmp_path / "two", store2, {"/my/hand": mine, "/rh/tactile": mine[:2]}, form="mcap")
    assert len(read(path, preset="biotac")) == 2
    path = bags.write(tmp_path / "three", store2, {"/my/hand": mine, "/my/other": mine[:2]}, form="mcap")
    with pytest.raises(FieldError, match="several topics have"):
        read(path, preset="biotac")
    with pytest.raises(FieldError, match="no topic has"):
        read(path, preset="papillarray")
    with pytest.raises(InputError, match="nearest is 'biotac'"):
        read(path, preset="biotak")


def test_recordings_are_found_in_folders(tmp_path, store2):
    _, messages = floats(store2, 3)
    for name in ("felt/a", "felt/b"):
        (tmp_path / "felt").mkdir(exist_ok=True)
        bags.write(tmp_path / name, store2, {"/skin": messages}, form="mcap")
    (tmp_path / "cork").mkdir()
    for name in ("take.mcap", "other.mcap", "notes.txt", "labels.csv"):
        shutil.copy(next((tmp_path / "felt/a").glob("*.mcap")), tmp_path / "cork" / name)
    found = [path.relative_to(tmp_path).as_posix() for path in find(tmp_path)]
    assert found == ["cork/labels.csv", "cork/other.mcap", "cork/take.mcap", "felt/a", "felt/b"]
    (tmp_path / "wool").mkdir()
    for name in ("1.mcap", "2.mcap"):  # may be two touches as well as a split recording
        shutil.copy(tmp_path / "cork/take.mcap", tmp_path / "wool" / name)
    assert [path.name for path in find(tmp_path / "wool")] == ["1.mcap", "2.mcap"]
    assert len(read(tmp_path / "wool", topic="/skin", field="data")) == 6
    assert find(tmp_path / "felt" / "a") == [tmp_path / "felt" / "a"]
    with pytest.raises(RecordingError, match="a folder that is none of these"):  # two takes are no split recording
        read(tmp_path / "cork", topic="/skin", field="data")
    with pytest.raises(RecordingError, match="not there"):
        find(tmp_path / "none")


def record(kind, data):
    return struct.pack("<BQ", kind, len(data)) + data


def text(value):
    return struct.pack("<I", len(value)) + value


def mcap(path, channels, messages, chunked=False):
    """An MCAP of (topic, encoding, type, form, definition) and (channel, count, data); chunked: in one, verified."""
    body = b""
    for i, (topic, encoding, kind, form, definition) in enumerate(channels, 1):
        body += record(3, struct.pack("<H", i) + text(kind) + text(form) + text(definition))
        body += record(4, struct.pack("<HH", i, i) + text(topic) + text(encoding) + text(b""))
    for n, (i, count, data) in enumerate(messages):
        body += record(5, struct.pack("<HIQQ", i, count, 10**9 + n * 10**7, 10**9 + n * 10**7) + data)
    if chunked:
        head = struct.pack("<QQQI", 0, 0, len(body), zlib.crc32(body)) + text(b"")
        body = record(6, head + struct.pack("<Q", len(body)) + body)
    begin = b"\x89MCAP0\r\n" + record(1, text(b"") + text(b""))
    path.write_bytes(begin + body + record(15, b"\0\0\0\0"))
    return path


def test_a_chunk_that_was_cut_off_is_read_so_far_and_one_that_was_changed_is_not(tmp_path):
    messages = [(1, i, b'{"v": [%d]}' % i) for i in range(100)]
    path = mcap(tmp_path / "m.mcap", [(b"/a", b"json", b"Skin", b"", b"")], messages, chunked=True)
    assert read(path, topic="/a", field="v").readings.ravel().tolist() == list(range(100))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])
    recording = read(path, topic="/a", field="v")
    assert recording.report.cut_off and len(recording) > 50
    assert recording.readings.ravel().tolist() == list(range(len(recording)))
    path.write_bytes(whole.replace(b"[50]", b"[51]"))
    with pytest.raises(RecordingError):
        read(path, topic="/a", field="v")


def test_definitions_in_idl(tmp_path):
    line = b"=" * 80 + b"\n"
    inner = b"IDL: pkg/msg/V\nmodule pkg { module msg { struct V { float x; double y; }; }; };\n"
    outer = b"IDL: pkg/msg/Skin\nmodule pkg { module msg { struct Skin { pkg::msg::V v; float e[3]; }; }; };\n"
    data = struct.pack("<BBHf4xd3f", 0, 1, 0, 0.5, 0.25, 1, 2, 3)
    for definition in (line + inner + line + outer, line + outer + line + inner):
        channels = [(b"/skin", b"cdr", b"pkg/msg/Skin", b"ros2idl", definition)]
        path = mcap(tmp_path / "m.mcap", channels, [(1, i, data) for i in range(3)])
        assert read(path, topic="/skin", field="{v.{x,y},e}").readings.tolist() == [[0.5, 0.25, 1, 2, 3]] * 3


IDL = """
// generated from rosidl_adapter/resource/msg.idl.em
// with input from pkg/msg/Skin.msg (an array)
module pkg {
  module msg {
    typedef float float__3[3];
    module Skin_Constants {
      @verbatim (language="comment", text=
        "what (perhaps) \\"it\\" is << 1 * 2" "\\n" "((")
      const int16 LOW = -1;
      const string NAME = "a (b) // c @d(e)";
      const double REST = 0.5;
    };
    @verbatim (language="comment", text="a skin")
    struct Skin {
      /* its count (of touches) */
      @default (value=7)
      @unit(value="mm (each)")
      int32 count;
      @default (value="x @ (y)") string<8> name;
      @key float__3 e; float a, b[2];
      sequence<double, 4> rest;
    };
  };
};
"""


def test_definitions_in_idl_as_ros_2_makes_them(tmp_path):
    data = struct.pack("<BBHiI4s3f3fI2d", 0, 1, 0, 7, 4, b"abc\0", 1, 2, 3, 4, 5, 6, 2, 8, 9)
    definition = IDL.encode()
    path = mcap(tmp_path / "m.mcap", [(b"/skin", b"cdr", b"pkg/msg/Skin", b"ros2idl", definition)], [(1, 0, data)] * 3)
    assert read(path, topic="/skin", field="{count,e,a,b}").readings.tolist() == [[7, 1, 2, 3, 4, 5, 6]] * 3


def test_arrays_in_json_are_described_as_they_are_read(tmp_path):
    data = b'{"v": [1, 2.5], "m": [[1, 2, 3], [4, 5, 6]], "n": 7, "s": ["a"], "r": [[1], [2, 3]], "e": [],'
    data += b' "o": [{"x": [1]}]}'
    path = mcap(tmp_path / "m.mcap", [(b"/j", b"json", b"J", b"", b"")], [(1, i, data) for i in range(3)])
    found = {entry.field: entry.shape for entry in describe(path).entries}
    assert found == {"v": (2,), "m": (2, 3), "o[*].x": (1, 1), "n": (1,)}
    for field, shape in found.items():
        assert read(path, topic="/j", field=field).readings.shape == (3, math.prod(shape))


def test_a_definition_in_idl_that_is_refused_is_given_as_msg(tmp_path):
    definition = b"module pkg { module msg { struct Skin { float e[(2)]; }; }; };"
    data = struct.pack("<BBH2f", 0, 1, 0, 1, 2)
    path = mcap(tmp_path / "m.mcap", [(b"/skin", b"cdr", b"pkg/msg/Skin", b"ros2idl", definition)], [(1, 0, data)] * 3)
    with pytest.raises(RecordingError, match=r"give definitions='FOLDER' with the type's \.msg"):
        read(path, topic="/skin", field="e")
    assert re.search(r"has no numbers in it: a definition in IDL has '\('.*definitions=", str(describe(path)))
    both = [(b"/skin", b"cdr", b"pkg/msg/Skin", b"ros2idl", definition), (b"/j", b"json", b"J", b"", b"")]
    path = mcap(tmp_path / "both.mcap", both, [(1, 0, data), (2, 0, b'{"v": [1, 2]}')])
    *_, why, line = str(describe(path)).splitlines()
    assert "  not read: a definition in IDL has" in why and line.startswith("read(") and "topic='/j'" in line
    path = tmp_path / "m.mcap"
    given = {"pkg/msg/Skin": "float32[2] e"}
    assert read(path, topic="/skin", field="e", definitions=given).readings.tolist() == [[1, 2]] * 3


@pytest.mark.parametrize(
    ("counts", "lost"),
    [
        ([(1, 0), (1, 1), (2, 0), (1, 4), (1, 5), (2, 1), (1, 6)], 2),  # each topic alone
        ([(1, 0), (1, 1), (2, 2), (1, 3), (1, 4), (2, 5), (1, 6)], None),  # all topics together
        ([(1, 0), (1, 0), (1, 0)], None),  # nobody counts
        ([(1, 2**32 - 2), (1, 2**32 - 1), (1, 1), (1, 2)], 1),
    ],
)
def test_a_recorders_counter_is_believed_where_it_counts_a_topic(tmp_path, counts, lost):
    channels = [(topic, b"json", b"Skin", b"", b"") for topic in (b"/a", b"/b")]
    path = mcap(tmp_path / "m.mcap", channels, [(i, count, b'{"v": [1, 2]}') for i, count in counts])
    report = read(path, topic="/a", field="v").report
    assert (report.lost, report.cut_off) == (lost, False)


def test_messages_in_json_and_of_ros_1_in_mcap(tmp_path, store1):
    def file(encoding, kind, definition, payloads):
        channels = [(b"/skin", encoding, kind, b"", definition)]
        return mcap(tmp_path / "m.mcap", channels, [(1, i, payload) for i, payload in enumerate(payloads)])

    path = file(b"json", b"Skin", b"", [b'{"skin": [{"v": [1, 2]}, {"v": [3.5, 4]}], "name": "a"}'] * 2)
    assert read(path, topic="/skin", field="skin[*].v").readings.tolist() == [[1, 2, 3.5, 4]] * 2
    with pytest.raises(FieldError, match="leads to text"):
        read(path, field="name", topic="/skin")
    message = bags.array(store1, np.arange(3))
    definition, _ = store1.generate_msgdef(message.__msgtype__)
    data = bytes(store1.serialize_ros1(message, message.__msgtype__))
    path = file(b"ros1", b"std_msgs/Float32MultiArray", definition.encode(), [data])
    assert read(path, topic="/skin", field="data").readings.tolist() == [[0, 1, 2]]
    path = file(b"protobuf", b"Skin", b"", [b"x"])
    with pytest.raises(RecordingError, match="encoded as 'protobuf'; expected cdr, ros1 or json"):
        read(path, topic="/skin", field="data")


STYLES = {
    "rosbags": "relative_file_paths:\n  - one.mcap\n  - 'two: 2.mcap'\n",
    "rosbag2": "relative_file_paths:\n    - one.mcap\n    - 'two: 2.mcap'\n",
    "in brackets": "relative_file_paths: [one.mcap, 'two: 2.mcap']\n",
    "in lines": "relative_file_paths: [one.mcap,\n    'two: 2.mcap']\n",
}


@pytest.mark.parametrize("deep", ["  ", "    "])
@pytest.mark.parametrize("style", STYLES)
def test_the_parts_of_a_bag_are_those_it_lists(tmp_path, store2, style, deep):
    """However its metadata is written. deep: what each line begins with; rosbag2 has two spaces."""
    folder = tmp_path / "b"
    folder.mkdir()
    listed = STYLES[style].replace("\n", f"\n{deep}").rstrip(" ")
    about = f"compression_format: zstd\n{deep}compression_mode: FILE\n{deep}message_count: 2\n{deep}{listed}"
    text = f"rosbag2_bagfile_information:\n{deep}version: 9\n{deep}{about}{deep}custom_data: ~\n"
    (folder / "metadata.yaml").write_text(text)
    with pytest.raises(RecordingError, match=r"lists one.mcap, two: 2.mcap, which are not there"):
        read(folder)
    for i, name in enumerate(("one.mcap", "two: 2.mcap")):
        values = np.full((1, 3), i, np.float32)
        made = bags.write(tmp_path / str(i), store2, {"/skin": [(1.0 + i, bags.array(store2, values[0]))]}, form="mcap")
        shutil.copy(next(made.glob("*.mcap")), folder / name)
    assert read(folder, topic="/skin", field="data").readings[:, 0].tolist() == [0, 1]
