import re

import numpy as np
import pytest
import torch

from examples.paper.readers.biotac_slide import MATERIALS, all_channels, load
from examples.paper.readers.labelled import Recordings
from scroll_tactile.errors import DatasetError, InputError
from scroll_tactile.sensors import BIOTAC, BIOTAC_ALL, ROBOSKIN


@pytest.fixture(scope="module")
def biotac(real_data):
    return load(real_data, "biotac")


@pytest.fixture(scope="module")
def roboskin(real_data):
    return load(real_data.parent, "roboskin")  # the parent does too


def counts(recordings, folds):
    """Streams of each material in each fold."""
    materials = np.array(recordings.materials)
    return {(m, f): np.count_nonzero((materials == m) & (folds == f)) for m in MATERIALS for f in range(5)}


def test_biotac_is_a_thousand_streams_in_seeded_folds(biotac, real_data):
    assert (biotac.name, biotac.sensor, len(biotac)) == ("BioTac-20", BIOTAC, 1000)
    assert {stream.readings.shape for stream in biotac.streams} == {(400, 19)}
    assert len({stream.key for stream in biotac.streams}) == 1000
    assert biotac.materials == [material for material in MATERIALS for _ in range(50)]
    assert biotac.repetition.tolist() == list(range(50)) * 20
    raw = torch.load(real_data / "raw_data" / "mat3" / "mat3_8.pt", weights_only=True)
    assert np.array_equal(biotac.streams[biotac.materials.index("mat3") + 7].readings, raw[:400, 25:].numpy())
    glitches = {
        (name, at): stream.clipped
        for name, at, stream in zip(biotac.materials, biotac.repetition.tolist(), biotac.streams, strict=True)
        if stream.clipped
    }
    assert glitches == {("mat2", 8): 4, ("mat2", 10): 14}
    other = load(real_data, "biotac", seed=1)
    for folds in (biotac.fold, other.fold, biotac.blocked()):
        assert set(counts(biotac, folds).values()) == {10}
    assert not np.array_equal(other.fold, biotac.fold)
    assert not np.array_equal(biotac.fold[:50], biotac.fold[50:100])  # not one permutation for all materials
    assert set(biotac.repetition[biotac.blocked() == 4]) == set(range(40, 50))


def test_all_of_biotac_is_the_same_touches_with_more_channels(biotac, real_data):
    whole = load(real_data, "biotac-all")
    assert (whole.name, whole.sensor, len(whole)) == ("BioTac-20, all channels", BIOTAC_ALL, 1000)
    assert (whole.materials, whole.fold.tolist()) == (biotac.materials, biotac.fold.tolist())
    for stream, electrodes in zip(whole.streams, biotac.streams, strict=True):
        assert stream.readings.shape == (400, 25)
        assert np.array_equal(stream.readings[:, :19], electrodes.readings)
    assert sum(stream.clipped for stream in whole.streams) < 1e-4 * sum(s.readings.size for s in whole.streams)


def test_a_biotacs_words_become_channels():
    words = np.zeros((2, 44), dtype=np.int64)
    words[:, 3:25] = np.arange(22)[::-1] * 186  # to 3906 of 4095
    words[0, :3], words[0, 25:] = (30, 200, 100), np.arange(19)
    words[1, 3:25] = 7
    rows = all_channels(words)
    assert rows[0, :22].tolist() == [*range(19), 30, 200, 100]
    assert rows[0, 22:].tolist() == pytest.approx([1953, 186 * np.std(np.arange(22)), 186])
    assert rows[1].tolist() == [0] * 22 + [7, 0, 0]
    spoilt = words.astype(float)
    spoilt[0, 5], spoilt[1, 30] = np.inf, np.nan
    missing = ~np.isfinite(all_channels(spoilt))
    assert np.argwhere(missing).tolist() == [[0, 22], [0, 23], [0, 24], [1, 5]]
    with pytest.raises(InputError, match=r"shape \(T, 44\); came \(2, 43\)"):
        all_channels(words[:, 1:])


def test_roboskin_is_the_publishers_five_files(roboskin, real_data):
    assert (roboskin.name, roboskin.sensor, len(roboskin)) == ("RoboSkin-20", ROBOSKIN, 1000)
    assert {stream.readings.shape for stream in roboskin.streams} == {(75, 60)}
    assert len({stream.key for stream in roboskin.streams}) == 1000
    assert sum(stream.clipped for stream in roboskin.streams) == 0
    assert set(counts(roboskin, roboskin.fold).values()) == {10}
    raw = np.load(real_data / "compiled_data" / "icub_val_2.npy")
    labels = np.load(real_data / "compiled_data" / "labels_val_2.npy")
    stream = roboskin.streams[400 + 17]
    assert roboskin.fold[400 + 17] == 2
    assert roboskin.materials[400 + 17] == f"mat{labels[17] + 1}"
    assert stream.readings[40, 3 * 10 + 6] == raw[17, 3, 6, 40]
    marks = zip(roboskin.materials, roboskin.fold.tolist(), roboskin.repetition.tolist(), strict=True)
    assert len(set(marks)) == 1000 and set(roboskin.repetition) == set(range(10))
    with pytest.raises(DatasetError, match=r"RoboSkin-20 .* without its order of recording"):
        roboskin.blocked()
    unmixed = load(real_data, "roboskin", unmixed=True)
    assert unmixed.materials == roboskin.materials
    steps = [
        [np.abs(np.diff(stream.readings, axis=0)).mean(axis=1) for stream in recordings.streams[::20]]
        for recordings in (unmixed, roboskin)
    ]
    mean, mixed = np.mean(steps, axis=1)
    assert mean.max() < 0.2 * mixed.min()  # at the ends of published rows, too


def test_readings_are_put_back_where_they_were_mixed_up(tmp_path):
    in_order = np.arange(10 * 75 * 6).reshape(10, 75, 6) % 190  # taxels, readings, patches
    folder = tmp_path / "compiled_data"
    folder.mkdir()
    published = np.stack([in_order.reshape(10, 6, 75).transpose(1, 0, 2)] * 200).astype(np.float32)
    for name in ("val_0", "val_1", "val_2", "val_3", "test"):
        np.save(folder / f"icub_{name}.npy", published)
        np.save(folder / f"labels_{name}.npy", np.arange(200) % 20)
    stream = load(tmp_path, "roboskin", unmixed=True).streams[0]
    assert stream.readings[40, 3 * 10 + 6] == in_order[6, 40, 3]
    assert load(tmp_path, "roboskin").streams[0].readings[40, 3 * 10 + 6] == published[0, 3, 6, 40]
    with pytest.raises(InputError, match="published in order"):
        load(tmp_path, "biotac", unmixed=True)


@pytest.fixture
def folder(tmp_path):
    """A small imitation of the layout: enough to fail in."""
    folder = tmp_path / "biotac_slide_20_50"
    (folder / "raw_data" / "mat1").mkdir(parents=True)
    (folder / "compiled_data").mkdir()
    torch.save(torch.zeros(400, 44, dtype=torch.int64), folder / "raw_data" / "mat1" / "mat1_1.pt")
    np.save(folder / "compiled_data" / "icub_val_0.npy", np.zeros((200, 6, 10, 75), np.float32))
    np.save(folder / "compiled_data" / "labels_val_0.npy", np.repeat(np.arange(20), 10))
    return folder


def test_a_folder_of_something_else_is_named(tmp_path):
    with pytest.raises(
        DatasetError, match=rf"expected {re.escape(str(tmp_path))} to be .*raw_data.* it is and does not"
    ):
        load(tmp_path, "biotac")
    with pytest.raises(DatasetError, match=r"there is no such folder. Get it from github.com/dexrob"):
        load(tmp_path / "none", "roboskin")


def test_a_missing_file_is_named_with_what_it_should_hold(folder):
    with pytest.raises(
        DatasetError, match=r"expected a tensor of shape \(≥ 400, 44\) in .*mat1_2.pt; there is no such"
    ):
        load(folder, "biotac")
    with pytest.raises(DatasetError, match=r"expected an array of shape \(200, 6, 10, 75\) in .*icub_val_1.npy"):
        load(folder.parent, "roboskin")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (torch.zeros(399, 44), r"its shape is \(399, 44\)"),
        (torch.zeros(400, 19), r"its shape is \(400, 19\)"),
        (torch.zeros(400), r"its shape is \(400,\)"),
        ([1, 2], "it holds a list"),
        (torch.full((400, 44), torch.nan), "holds no sound readings: .*reading 0, channel 0 is nan"),
        (b"not a tensor at all", "cannot be read, and may be damaged"),
        (b"", "cannot be read, and may be damaged"),
    ],
)
def test_a_biotac_file_that_is_not_as_published_is_named(folder, content, message):
    path = folder / "raw_data" / "mat1" / "mat1_1.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(DatasetError, match=rf"(?s){re.escape(str(path))}.*{message}"):
        load(folder, "biotac")


class Planted:
    def __reduce__(self):
        return print, ("a pickle ran code",)


def test_a_file_that_would_run_code_is_refused(folder, capsys):
    torch.save(Planted(), folder / "raw_data" / "mat1" / "mat1_1.pt")
    with pytest.raises(DatasetError, match="cannot be read"):
        load(folder, "biotac")
    assert "ran code" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("icub_val_0", np.zeros((200, 60, 75)), r"it holds \(200, 60, 75\)"),
        ("labels_val_0", np.arange(200), "labels 0 to 19"),
        ("labels_val_0", np.full(200, 0.5), "labels 0 to 19"),
        ("labels_val_0", np.zeros((200, 1), int), r"it holds \(200, 1\)"),
        ("icub_val_0", np.full((200, 6, 10, 75), np.nan), "holds no sound readings"),
        ("icub_val_0", np.array([None]), "cannot be read"),
    ],
)
def test_a_roboskin_file_that_is_not_as_published_is_named(folder, file, content, message):
    np.save(folder / "compiled_data" / f"{file}.npy", content)
    with pytest.raises(DatasetError, match=f"{file}.npy.*{message}"):
        load(folder, "roboskin")


def test_other_sensors_and_seeds_are_refused(folder):
    with pytest.raises(InputError, match="expected sensor 'biotac', 'biotac-all' or 'roboskin'; came 'gelsight'"):
        load(folder, "gelsight")
    with pytest.raises(InputError, match="seed of 0 or more; came -1"):
        load(folder, "biotac", seed=-1)


def test_recordings_of_unequal_lengths_are_refused():
    with pytest.raises(InputError, match="came 0, 1, 2, 2"):
        Recordings("x", BIOTAC, [], ["a"], np.arange(2), np.arange(2), ordered=True)
