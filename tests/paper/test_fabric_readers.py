"""Readers of letter-spike and FabricSlide, on made-up folders; on the real ones where they are at hand."""

import logging

import numpy as np
import pytest
from real_sets import CACHE

from examples.paper.readers import fabric_slide, letter_spike
from examples.paper.readers.fabric_slide import CPM_FINGER, CPM_RATIOS, FABRICS
from examples.paper.readers.letter_spike import DOTS, LETTERS, NUSKIN, dots_of, letter_folds, read_events, stream_of
from scroll_tactile.errors import DatasetError, InputError, SensorMismatchError
from scroll_tactile.signals.stream import validate

HEADER = "timestamp,isNeg,taxel_id,adc\n"
CHANNELS = ", ".join(f"channel{number}" for number in range(1, 17))


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


class TestLetters:
    def test_every_press_is_a_stream_and_an_empty_file_is_named(self, letters, caplog):
        with caplog.at_level(logging.WARNING):
            recordings = letter_spike.load(letters, seconds=1.0)
        assert "K_44.csv holds no events, and is left out" in caplog.text
        assert (len(recordings), recordings.sensor, recordings.name) == (27 * 50 - 1, NUSKIN, "letter-spike")
        assert {stream.readings.shape for stream in recordings.streams} == {(62, 80)}
        assert recordings.materials.count("K") == 49
        assert recordings.repetition[
            recordings.materials.index("L") - 6 : recordings.materials.index("L")
        ].tolist() == [
            43,
            45,
            46,
            47,
            48,
            49,
        ]

    def test_folds_are_dealt_letter_by_letter_and_seeded(self, letters):
        ours, again = (letter_spike.load(letters / "letter-spike", seed=2, seconds=0.2) for _ in range(2))
        assert np.array_equal(ours.fold, again.fold)
        names = np.array(ours.materials)
        counts = {
            (name, fold): np.count_nonzero((names == name) & (ours.fold == fold)) for name in "ABK" for fold in range(5)
        }
        assert set(counts.values()) == {9, 10}
        assert counts["A", 0] == 10

    def test_between_two_events_a_taxel_stays_as_it_was(self):
        events = np.array([[5.0, 36, 1000], [5.1, 36, 800], [5.1001, 36, 700], [5.2, 1, 23], [9.0, 36, 1]])
        readings = stream_of(events, 0.4).readings
        assert readings.shape == (25, 80)
        first, second = readings[:, 5], readings[:, 4 * 10 + 5 + 4]  # taxel 36, then taxel 1
        assert first[0] == 23
        assert set(first[1:6]) == {23}
        assert set(first[6:]) == {323}  # of two in a bin the later
        assert set(second[:12]) == {0}
        assert set(second[12:]) == {1000}
        assert not np.delete(readings, [5, 49], axis=1).any()

    def test_taxels_lie_in_blocks_and_each_once(self):
        places = letter_spike._places()
        assert sorted(places) == list(range(80))
        assert places[[35, 39, 20, 4, 0, 19]].tolist() == [5, 9, 35, 45, 49, 75]
        assert places[[55, 59, 64, 60, 75]].tolist() == [0, 4, 40, 44, 74]

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
            (HEADER + "1.0,0,81,5\n", "taxels 1 to 80"),
            (HEADER + "nan,0,3,5\n", "finite numbers"),
        ],
    )
    def test_a_damaged_file_is_named(self, tmp_path, text, said):
        path = tmp_path / "A_0.csv"
        path.write_text(text)
        with pytest.raises(DatasetError, match=said) as caught:
            read_events(path)
        assert str(path) in str(caught.value)

    def test_what_is_missing_is_named_with_where_to_get_it(self, letters, tmp_path):
        with pytest.raises(DatasetError, match=r"Q_7.csv; there is no such file.*github.com/tasbolat1/letter-spike"):
            read_events(letters / "letter-spike" / "data" / "Q" / "nothing" / "Q_7.csv")
        with pytest.raises(DatasetError, match=r"there is no such folder.*github.com"):
            letter_spike.load(tmp_path / "none")
        with pytest.raises(InputError):
            letter_spike.load(letters, seed=-1)

    def test_the_dots_are_those_of_braille(self):
        dots = {letter: "".join(dot[-1] for dot, there in dots_of(letter).items() if there) for letter in LETTERS}
        assert dots["A"] == "1"
        assert dots["J"] == "245"
        assert dots["T"] == "2345"
        assert dots["W"] == "2456"
        assert dots["Z"] == "1356"
        assert dots["space"] == ""
        assert len(set(dots.values())) == 27
        assert tuple(dots_of("G")) == DOTS
        with pytest.raises(InputError):
            dots_of("Ä")

    def test_letters_are_dealt_into_groups(self):
        groups = letter_folds(9, seed=4)
        assert sorted(letter for group in groups for letter in group) == sorted(LETTERS)
        assert {len(group) for group in groups} == {3}
        assert groups == letter_folds(9, seed=4) != letter_folds(9, seed=5)
        for wrong in (1, 28):
            with pytest.raises(InputError):
                letter_folds(wrong)


def slide(folder, name, readings=200, fill=100):
    folder.mkdir(parents=True, exist_ok=True)
    rows = [f"{28 * at},0,65535," + ",".join([str(fill + at % 7)] * 16) for at in range(readings)]
    (folder / name).write_text(f"timestamp, proximity1, proximity2, {CHANNELS}\n" + "\n".join(rows) + "\n")


class TestSlides:
    @pytest.fixture
    def folder(self, tmp_path):
        folder = tmp_path / "FabricSlide" / "data" / "fabric"
        for fabric in ("Canvas", "Linen"):
            for force in (120, 250):
                for speed in (-150, 10):
                    slide(folder, f"{fabric}_F{force}_V{speed}mmps_0.csv", 150 if speed < 0 else 400)
        return folder

    def test_force_and_speed_are_in_the_name(self, folder, tmp_path):
        slides = fabric_slide.load(tmp_path, ["Canvas", "Linen"])
        assert slides.recordings.sensor == CPM_FINGER
        assert slides.recordings.materials == ["Canvas"] * 4 + ["Linen"] * 4
        assert sorted(zip(slides.force.tolist(), slides.speed.tolist(), strict=True)) == sorted(
            [(force, speed) for force in (120, 250) for speed in (-150, 10)] * 2
        )
        lengths = [len(stream) for stream in slides.recordings.streams]
        assert [lengths[at] for at in np.flatnonzero(slides.speed == 10)] == [400] * 4

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
        assert shares.sensor == CPM_RATIOS
        assert shares.readings.shape == (144, 16)
        np.testing.assert_allclose(shares.readings, fabric_slide.ratios(fast).readings, atol=0.02)
        harder = validate(pattern * 2.5, CPM_FINGER)
        np.testing.assert_allclose(shares.readings, fabric_slide.ratios(harder).readings, atol=1e-5)
        np.testing.assert_allclose(shares.readings.mean(axis=1), 0, atol=1e-6)
        with pytest.raises(SensorMismatchError):
            fabric_slide.ratios(shares)


class TestReal:
    def test_letter_spike(self):
        if not (CACHE / "letter-spike").is_dir():
            pytest.skip("letter-spike is not at hand")
        recordings = letter_spike.load(CACHE, seconds=0.5)
        assert len(recordings) == 1348

    def test_fabric_slide(self):
        if not (CACHE / "FabricSlide").is_dir():
            pytest.skip("FabricSlide is not at hand")
        slides = fabric_slide.load(CACHE, FABRICS[4:5])
        assert len(slides.recordings) == 72
        assert not any(stream.clipped for stream in slides.recordings.streams)
