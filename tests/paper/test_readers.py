"""Readers of published sets, on small made-up folders in their layouts; on the real ones where they are at hand."""

import logging
import re

import numpy as np
import pytest
import torch

from examples.paper.readers import fabric_slide, letter_spike, physiclear
from examples.paper.readers.biotac_slide import MATERIALS, all_channels, load
from examples.paper.readers.fabric_slide import CPM_FINGER, CPM_RATIOS
from examples.paper.readers.grades import read_grades
from examples.paper.readers.labelled import Recordings, hold_out
from examples.paper.readers.letter_spike import DOTS, LETTERS, NUSKIN, dots_of, letter_folds, read_events, stream_of
from scroll_tactile.errors import DatasetError, InputError, SensorMismatchError
from scroll_tactile.sensors import BIOTAC, BIOTAC_ALL, ROBOSKIN
from scroll_tactile.signals.stream import validate

HEADER = "timestamp,isNeg,taxel_id,adc\n"
CHANNELS = ", ".join(f"channel{number}" for number in range(1, 17))


def counts(recordings, folds):
    """Streams of each material in each fold."""
    materials = np.array(recordings.materials)
    return {(m, f): np.count_nonzero((materials == m) & (folds == f)) for m in MATERIALS for f in range(5)}


def named(path, reader, message):
    """The reader must name the file, and say what was expected of it."""
    with pytest.raises(DatasetError, match=rf"(?s){re.escape(str(path))}.*{message}"):
        reader()


class TestBioTacSlide:
    def test_the_real_biotac_is_a_thousand_streams_in_seeded_folds(self, real_data):
        biotac, whole = load(real_data, "biotac"), load(real_data.parent, "biotac-all")  # the parent does too
        assert (biotac.name, biotac.sensor, len(biotac)) == ("BioTac-20", BIOTAC, 1000)
        assert {stream.readings.shape for stream in biotac.streams} == {(400, 19)}
        assert len({stream.key for stream in biotac.streams}) == 1000
        assert biotac.materials == [material for material in MATERIALS for _ in range(50)]
        assert biotac.repetition.tolist() == list(range(50)) * 20
        raw = torch.load(real_data / "raw_data" / "mat3" / "mat3_8.pt", weights_only=True)
        assert np.array_equal(biotac.streams[biotac.materials.index("mat3") + 7].readings, raw[:400, 25:].numpy())
        marks = zip(biotac.materials, biotac.repetition.tolist(), biotac.streams, strict=True)
        clipped = {(name, at): stream.clipped for name, at, stream in marks if stream.clipped}
        assert clipped == {("mat2", 8): 4, ("mat2", 10): 14}
        for folds in (biotac.fold, biotac.blocked()):
            assert set(counts(biotac, folds).values()) == {10}
        assert not np.array_equal(biotac.fold[:50], biotac.fold[50:100])  # not one permutation for all materials
        assert set(biotac.repetition[biotac.blocked() == 4]) == set(range(40, 50))
        # All of it: the same touches and folds, with more channels.
        assert (whole.name, whole.sensor, len(whole)) == ("BioTac-20, all channels", BIOTAC_ALL, 1000)
        assert (whole.materials, whole.fold.tolist()) == (biotac.materials, biotac.fold.tolist())
        for stream, electrodes in zip(whole.streams, biotac.streams, strict=True):
            assert stream.readings.shape == (400, 25)
            assert np.array_equal(stream.readings[:, :19], electrodes.readings)

    def test_the_real_roboskin_is_the_publishers_five_files(self, real_data):
        roboskin, unmixed = load(real_data, "roboskin"), load(real_data, "roboskin", unmixed=True)
        assert (roboskin.name, roboskin.sensor, len(roboskin)) == ("RoboSkin-20", ROBOSKIN, 1000)
        assert {stream.readings.shape for stream in roboskin.streams} == {(75, 60)}
        assert sum(stream.clipped for stream in roboskin.streams) == 0
        assert set(counts(roboskin, roboskin.fold).values()) == {10}
        marks = zip(roboskin.materials, roboskin.fold.tolist(), roboskin.repetition.tolist(), strict=True)
        assert len(set(marks)) == 1000 and set(roboskin.repetition) == set(range(10))
        with pytest.raises(DatasetError, match=r"RoboSkin-20 .* without its order of recording"):
            roboskin.blocked()
        assert unmixed.materials == roboskin.materials
        steps = [
            [np.abs(np.diff(stream.readings, axis=0)).mean(axis=1) for stream in recordings.streams[::20]]
            for recordings in (unmixed, roboskin)
        ]
        mean, mixed = np.mean(steps, axis=1)
        assert mean.max() < 0.2 * mixed.min()  # at the ends of published rows, too

    def test_a_biotacs_words_become_channels(self):
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

    def test_readings_are_put_back_where_they_were_mixed_up(self, tmp_path):
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
    def folder(self, tmp_path):
        """A small imitation of the layout: enough to fail in."""
        folder = tmp_path / "biotac_slide_20_50"
        (folder / "raw_data" / "mat1").mkdir(parents=True)
        (folder / "compiled_data").mkdir()
        torch.save(torch.zeros(400, 44, dtype=torch.int64), folder / "raw_data" / "mat1" / "mat1_1.pt")
        np.save(folder / "compiled_data" / "icub_val_0.npy", np.zeros((200, 6, 10, 75), np.float32))
        np.save(folder / "compiled_data" / "labels_val_0.npy", np.repeat(np.arange(20), 10))
        return folder

    def test_what_is_missing_is_named_with_what_it_should_be(self, folder, tmp_path):
        named(tmp_path / "raw_data", lambda: load(tmp_path / "raw_data", "biotac"), "there is no such folder.*dexrob")
        named(folder / "raw_data", lambda: load(folder / "raw_data", "biotac"), "raw_data.* it is and does not")
        with pytest.raises(DatasetError, match=r"tensor of shape \(≥ 400, 44\) in .*mat1_2.pt; there is no such"):
            load(folder, "biotac")
        with pytest.raises(DatasetError, match=r"array of shape \(200, 6, 10, 75\) in .*icub_val_1.npy"):
            load(folder.parent, "roboskin")
        with pytest.raises(InputError, match="'biotac', 'biotac-all' or 'roboskin'; came 'gelsight'"):
            load(folder, "gelsight")
        with pytest.raises(InputError, match="seed of 0 or more; came -1"):
            load(folder, "biotac", seed=-1)

    @pytest.mark.parametrize(
        ("file", "content", "message"),
        [
            ("mat1_1.pt", torch.zeros(399, 44), r"its shape is \(399, 44\)"),
            ("mat1_1.pt", torch.zeros(400, 19), r"its shape is \(400, 19\)"),
            ("mat1_1.pt", torch.zeros(400), r"its shape is \(400,\)"),
            ("mat1_1.pt", [1, 2], "it holds a list"),
            ("mat1_1.pt", torch.full((400, 44), torch.nan), "no sound readings: .*reading 0, channel 0 is nan"),
            ("mat1_1.pt", b"not a tensor at all", "cannot be read, and may be damaged"),
            ("mat1_1.pt", b"", "cannot be read, and may be damaged"),
            ("icub_val_0.npy", np.zeros((200, 60, 75)), r"it holds \(200, 60, 75\)"),
            ("labels_val_0.npy", np.arange(200), "labels 0 to 19"),
            ("labels_val_0.npy", np.full(200, 0.5), "labels 0 to 19"),
            ("labels_val_0.npy", np.zeros((200, 1), int), r"it holds \(200, 1\)"),
            ("icub_val_0.npy", np.full((200, 6, 10, 75), np.nan), "holds no sound readings"),
            ("icub_val_0.npy", np.array([None]), "cannot be read"),
        ],
    )
    def test_a_file_that_is_not_as_published_is_named(self, folder, file, content, message):
        (path,) = folder.rglob(file)
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            torch.save(content, path) if path.suffix == ".pt" else np.save(path, content)
        named(path, lambda: load(folder, "biotac" if path.suffix == ".pt" else "roboskin"), message)

    def test_a_file_that_would_run_code_is_refused(self, folder, capsys):
        torch.save(Planted(), folder / "raw_data" / "mat1" / "mat1_1.pt")
        named(folder / "raw_data" / "mat1" / "mat1_1.pt", lambda: load(folder, "biotac"), "cannot be read")
        assert "ran code" not in capsys.readouterr().out


class Planted:
    def __reduce__(self):
        return print, ("a pickle ran code",)


class TestRecordings:
    def test_those_of_unequal_lengths_are_refused(self):
        with pytest.raises(InputError, match="came 0, 1, 2, 2"):
            Recordings("x", BIOTAC, [], ["a"], np.arange(2), np.arange(2), ordered=True)

    def test_what_is_held_out_is_not_learned(self):
        streams = [validate(np.full((2, 27), i), CPM_LIKE) for i in range(4)]
        recordings = Recordings("x", CPM_LIKE, streams, [*"abab"], np.arange(4), np.array([0, 0, 1, 1]), ordered=True)
        learned, tested = hold_out(recordings, recordings.fold == 1)
        assert learned == [("a", streams[0]), ("b", streams[1])] and tested == [("a", streams[2]), ("b", streams[3])]


CPM_LIKE = CPM_FINGER.model_copy(update={"channels": 27})


@pytest.fixture(scope="module")
def letters(tmp_path_factory):
    """A folder laid out as letter-spike, one file of which is empty."""
    tmp_path = tmp_path_factory.mktemp("letters")
    for letter in LETTERS:
        folder = tmp_path / "letter-spike" / "data" / letter
        folder.mkdir(parents=True)
        for press in range(50):
            rows = "" if (letter, press) == ("K", 44) else f"{press}.0,0,36,900\n{press}.5,0,36,{press}\n"
            (folder / f"{letter}_{press}.csv").write_text(HEADER + rows)
    return tmp_path


class TestLetterSpike:
    def test_every_press_is_a_stream_in_seeded_folds_and_an_empty_file_is_named(self, letters, caplog):
        with caplog.at_level(logging.WARNING):
            recordings = letter_spike.load(letters, seconds=0.2)
        assert "K_44.csv holds no events, and is left out" in caplog.text
        assert (len(recordings), recordings.sensor, recordings.name) == (27 * 50 - 1, NUSKIN, "letter-spike")
        assert {stream.readings.shape for stream in recordings.streams} == {(12, 80)}
        after = recordings.materials.index("L")
        assert recordings.repetition[after - 6 : after].tolist() == [43, 45, 46, 47, 48, 49]
        names = np.array(recordings.materials)
        dealt = [np.bincount(recordings.fold[names == name]).tolist() for name in "ABK"]
        assert dealt[:2] == [[10] * 5] * 2 and sorted(dealt[2]) == [9, 10, 10, 10, 10]
        for wrong in (lambda: letter_spike.load(letters, seed=-1), lambda: letter_folds(1), lambda: letter_folds(28)):
            with pytest.raises(InputError):
                wrong()

    def test_between_two_events_a_taxel_stays_as_it_was(self):
        events = np.array([[5.0, 36, 1000], [5.1, 36, 800], [5.1001, 36, 700], [5.2, 1, 23], [9.0, 36, 1]])
        readings = stream_of(events, 0.4).readings
        assert readings.shape == (25, 80)
        first, second = readings[:, 5], readings[:, 4 * 10 + 5 + 4]  # taxel 36, then taxel 1
        assert set(first[:6]) == {23} and set(first[6:]) == {323}  # of two in a bin the later
        assert set(second[:12]) == {0} and set(second[12:]) == {1000}
        assert not np.delete(readings, [5, 49], axis=1).any()

    def test_events_without_a_taxel_are_left_out_and_time_is_put_in_order(self, tmp_path):
        path = tmp_path / "A_0.csv"
        path.write_text(HEADER + "2.0,0,3,5\n1.0,-1,-1,-1\n1.5,0,4,6\n")
        assert read_events(path).tolist() == [[1.5, 4, 6], [2.0, 3, 5]]

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("a,b\n1,2\n", "begin with the columns"),
            (HEADER + "1.0,0,3\n", "may be damaged"),
            (HEADER + "1.0,0,3,x\n", "may be damaged"),
            (HEADER + "1.0,0,81,5\n", "finite numbers|taxels"),
            (HEADER + "nan,0,3,5\n", "finite numbers|taxels"),
            (None, "there is no such file.*github.com/tasbolat1/letter-spike"),
        ],
    )
    def test_a_damaged_file_is_named(self, tmp_path, text, said):
        path = tmp_path / "A_0.csv"
        if text is not None:
            path.write_text(text)
        with pytest.raises(DatasetError, match=said) as caught:
            read_events(path)
        assert str(path) in str(caught.value)
        named(tmp_path / "none", lambda: letter_spike.load(tmp_path / "none"), "there is no such folder.*github.com")

    def test_the_dots_are_those_of_braille_and_letters_are_dealt_into_groups(self):
        dots = {letter: "".join(dot[-1] for dot, there in dots_of(letter).items() if there) for letter in LETTERS}
        chosen = {letter: dots[letter] for letter in ("A", "J", "T", "W", "Z", "space")}
        assert chosen == {"A": "1", "J": "245", "T": "2345", "W": "2456", "Z": "1356", "space": ""}
        assert len(set(dots.values())) == 27 and tuple(dots_of("G")) == DOTS
        with pytest.raises(InputError):
            dots_of("Ä")
        groups = letter_folds(9, seed=4)
        assert sorted(letter for group in groups for letter in group) == sorted(LETTERS)
        assert {len(group) for group in groups} == {3}
        assert groups == letter_folds(9, seed=4) != letter_folds(9, seed=5)


class TestFabricSlide:
    @pytest.fixture
    def folder(self, tmp_path):
        folder = tmp_path / "FabricSlide" / "data" / "fabric"
        folder.mkdir(parents=True)
        for fabric in ("Canvas", "Linen"):
            for force in (120, 250):
                for speed, readings in ((-150, 150), (10, 400)):
                    rows = [f"{28 * i},0,65535," + ",".join([str(100 + i % 7)] * 16) for i in range(readings)]
                    text = f"timestamp, proximity1, proximity2, {CHANNELS}\n" + "\n".join(rows) + "\n"
                    (folder / f"{fabric}_F{force}_V{speed}mmps_0.csv").write_text(text)
        return folder

    def test_force_and_speed_are_in_the_name(self, folder, tmp_path):
        slides = fabric_slide.load(tmp_path, ["Canvas", "Linen"])
        assert slides.recordings.sensor == CPM_FINGER
        assert slides.recordings.materials == ["Canvas"] * 4 + ["Linen"] * 4
        found = sorted(zip(slides.force.tolist(), slides.speed.tolist(), strict=True))
        assert found == sorted([(force, speed) for force in (120, 250) for speed in (-150, 10)] * 2)
        lengths = [len(stream) for stream in slides.recordings.streams]
        assert [lengths[i] for i in np.flatnonzero(slides.speed == 10)] == [400] * 4

    @pytest.mark.parametrize(
        ("name", "text", "said"),
        [
            ("Canvas_F1.csv", "", "expected a name such as"),
            ("Canvas_F120_V10mmps_9.csv", "", "cannot be read"),
            ("Canvas_F120_V10mmps_9.csv", "a,b\n1,2\n", "expected 19 columns"),
            ("Canvas_F120_V10mmps_9.csv", f"t, p, q, {CHANNELS}\n" + "1," * 18 + "x\n", "may be damaged"),
            ("Canvas_F120_V10mmps_9.csv", f"t, p, q, {CHANNELS}\n" + "1," * 18 + "1\n", "no sound readings"),
        ],
    )
    def test_a_damaged_file_is_named(self, folder, name, text, said):
        (folder / name).write_text(text)
        with pytest.raises(DatasetError, match=said) as caught:
            fabric_slide.load(folder.parents[1], ["Canvas"])
        assert name in str(caught.value)

    def test_what_is_missing_is_named_with_where_to_get_it(self, folder, tmp_path):
        with pytest.raises(DatasetError, match=r"slides over \['BeigeCotton', 'BrownCotton'\].*github.com/wngfra"):
            fabric_slide.load(tmp_path)
        with pytest.raises(DatasetError, match="there is no such folder"):
            fabric_slide.load(tmp_path / "none")
        for wrong in ({"fabrics": ["Silk"]}, {"fabrics": []}, {"seed": -1}):
            with pytest.raises(InputError):
                fabric_slide.load(tmp_path, **wrong)

    def test_ratios_leave_out_force_and_speed(self):
        places = np.linspace(0, 1, 2000)[:, None]
        pattern = 100 + 40 * np.sin(2 * np.pi * (places + np.arange(16) / 16))
        slow, fast = validate(pattern, CPM_FINGER), validate(pattern[::13], CPM_FINGER)
        shares = fabric_slide.ratios(slow)
        assert (shares.sensor, shares.readings.shape) == (CPM_RATIOS, (144, 16))
        np.testing.assert_allclose(shares.readings, fabric_slide.ratios(fast).readings, atol=0.02)
        harder = validate(pattern * 2.5, CPM_FINGER)
        np.testing.assert_allclose(shares.readings, fabric_slide.ratios(harder).readings, atol=1e-5)
        np.testing.assert_allclose(shares.readings.mean(axis=1), 0, atol=1e-6)
        with pytest.raises(SensorMismatchError):
            fabric_slide.ratios(shares)


class TestPhysiclear:
    def test_frames_are_streams_and_videos_are_not_parted(self, gelsight):
        read = physiclear.load(gelsight)
        assert len(read) == 36 and set(read.materials) == {"apple", "pen", "rug"}
        assert read.streams[0].readings.shape == (1, 120, 160, 3)
        assert abs(float(read.streams[0].readings[0, 60, 6, 0]) - 100) < 20
        marks = set(zip(read.materials, read.repetition.tolist(), read.fold.tolist(), strict=True))
        assert {mark[:2] for mark in marks} == {
            (name, video) for name in ("apple", "pen", "rug") for video in (0, 3, 5)
        }
        assert len(marks) == 9  # each video in one fold
        assert physiclear.load(gelsight / "physiclear", seed=1).fold.tolist() != read.fold.tolist()
        videos = physiclear.videos(read)
        assert len(videos) == 9 and {stream.readings.shape for stream in videos.streams} == {(4, 120, 160, 3)}
        assert physiclear.read_attributes(gelsight)["pen"] == {"hardness": 1, "roughness": 1, "texture": 2}

    @pytest.mark.parametrize("reported", ["", "{}", '{"hardness": {"apple": 5}, "roughness": {}, "texture": {}}'])
    def test_attributes_that_cannot_be_read_are_named(self, tmp_path, reported):
        (tmp_path / "physiclear" / "a").mkdir(parents=True)
        (tmp_path / "physiclear" / "a" / "a_0_0.jpg").touch()
        path = tmp_path / "physiclear" / "attributes.json"
        path.write_text(reported)
        named(path, lambda: physiclear.read_attributes(tmp_path), "")

    def test_what_is_missing_or_damaged_is_named(self, gelsight):
        apple = gelsight / "physiclear" / "apple"
        (apple / "apple_3_2.jpg").rename(apple / "kept")
        with pytest.raises(DatasetError, match="it also holds kept"):
            physiclear.load(gelsight)
        kept = (apple / "kept").read_bytes()
        (apple / "kept").unlink()
        named(apple / "apple_3_2.jpg", lambda: physiclear.load(gelsight), "it is missing.*octopi")
        pytest.importorskip("PIL.Image").new("RGB", (64, 48)).save(apple / "apple_3_2.jpg")
        named(apple / "apple_3_2.jpg", lambda: physiclear.load(gelsight), "320 × 240.*64 × 48")
        (apple / "apple_3_2.jpg").write_bytes(kept[:200])
        named(apple / "apple_3_2.jpg", lambda: physiclear.load(gelsight), "it cannot be read")
        for path in apple.glob("apple_[35]_*.jpg"):
            path.unlink()
        with pytest.raises(DatasetError, match="two videos or more"):
            physiclear.load(gelsight)


def test_a_table_of_grades_is_read(tmp_path):
    table = tmp_path / "grades.csv"
    table.write_text("\ufeffmaterial, stiffness,foam\nmat1,2,0\n\nmat2, 0 ,1\n", encoding="utf-8")
    assert read_grades(table) == {"stiffness": {"mat1": 2, "mat2": 0}, "foam": {"mat1": 0, "mat2": 1}}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "cannot be read"),
        ("", "a line for each material"),
        ("material\nmat1\n", "two or more"),
        ("material,foam,foam\nmat1,1,1\n", "different names"),
        ("material,foam\nmat1,1\nmat1,0\n", "line 3"),
        ("material,foam\n,1\n", "came ''"),
        ("material,foam\nmat1,soft\n", "'soft'"),
        ("material,foam\nmat1,-1\n", "'-1'"),
        ("material,thickness\nmat1,1200\n", "from 0 to 20"),
        ("material,foam,wood\nmat1,1\n", "each of 2 columns"),
    ],
)
def test_a_table_that_says_no_grades_is_named(text, said, tmp_path):
    table = tmp_path / "grades.csv"
    if text is not None:
        table.write_text(text)
    with pytest.raises(DatasetError, match=r"grades\.csv") as raised:
        read_grades(table)
    assert said in str(raised.value)
