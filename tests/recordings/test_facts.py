"""What is odd is said, refused or cut by one table: of touches, of recordings, and by every way in."""

import json
import warnings

import numpy as np
import pytest
from commands import run

from scroll_tactile import Kernels, Sensor, TactileLearner
from scroll_tactile.clients.learning.fleet import learn
from scroll_tactile.clients.learning.learning import evaluate_sources
from scroll_tactile.clients.learning.sources import Refused, SourceOptions, source_touches
from scroll_tactile.errors import FactWarning, InputError, RangeWarning, RecordingError
from scroll_tactile.recordings import read, resampled
from scroll_tactile.signals.facts import RULES, Fact, merged, name_fact, touch_facts
from scroll_tactile.signals.stream import validate

PAD = Sensor(name="pad", channels=3, rate=100, low=0, high=255, unit="counts", duration=1)
RNG = np.random.default_rng(0)
TOUCH = RNG.uniform(20, 200, (150, 3))
AT = np.arange(150) / 100


def with_channel(column, values):
    return np.where(np.arange(3) == column, np.asarray(values).reshape(-1, 1), TOUCH)


@pytest.mark.parametrize(
    ("readings", "said"),
    [
        (TOUCH, {}),
        (TOUCH / 10, {}),
        (RNG.uniform(0, 1500, (50, 3)), {"range": "8. % of the values lie outside the range of sensor 'pad'"}),
        (with_channel(1, 900), {"range": "100 % of the values of channel 1 lie outside"}),
        (with_channel(1, np.where(AT < 0.7, 300, 100)), {}),  # less than half of one channel
        (TOUCH / 255, {"corner": "all readings lie in 0.2. % of the range"}),
        (np.full((100, 3), 7), {"constant": "nothing moves: all 100 readings are the same"}),
        (np.repeat(TOUCH[:40], [*[1] * 39, 100], axis=0), {"frozen": "100 readings in a row, 1 s, are the same"}),
        (np.repeat(TOUCH[:40], [*[1] * 39, 99], axis=0), {}),
        (with_channel(2, 255), {"top": "channel 2 never leaves the top of its range"}),
        (with_channel(2, 0), {"still": "channel 2 never moves while all others do"}),
        (TOUCH * [1, 0, 0], {}),  # a skin that is touched in one place
        (np.tile(TOUCH, (7, 1)), {"long": "it lasts 10.5 s, and a touch of sensor 'pad' usually 1 s"}),
    ],
)
def test_of_touches(readings, said):
    found = touch_facts(validate(readings, PAD), "t.npy")
    assert {fact.kind for fact in found} == set(said)
    for fact in found:
        assert fact.source == "t.npy" and fact.then == "said" and fact.size >= RULES[fact.kind].said
        with pytest.raises(RecordingError, match=said[fact.kind]):
            raise fact.error()


def test_each_channel_counts_by_its_own_range_and_by_its_name():
    hand = Sensor(
        name="hand", channels=2, rate=50, low=(0, -4), high=(1, 4), unit=("N", "rad/s"), duration=1, columns=("f", "w")
    )
    corner = RNG.uniform(0, 1, (50, 2))
    (fact,) = touch_facts(validate(corner * [1, 0], hand))
    assert (fact.kind, fact.text.split(" never")[0]) == ("still", "channel 1 (w)")
    (fact,) = touch_facts(validate(corner / [500, 100] + [0.5, 0], hand))
    assert fact.kind == "corner" and "of sensor 'hand' (each channel by its own)" in fact.text


def test_names_that_differ_by_case_and_blanks_are_near():
    for near in ("Felt", "fe lt", "FELT_", "ｆｅｌｔ"):
        assert "beside 'felt'" in str(*name_fact(near, ["oak", "felt"]))
    for other in ("felt", "felt 2", "oak1", "pelt"):
        assert name_fact(other, ["oak", "felt"]) == []


def test_many_are_said_once_with_their_number_and_the_first():
    facts = [Fact("long", size, f"{size}.csv", "it is long") for size in (20, 30, 10)]
    (one,) = merged([*facts, Fact("top", 1, "x", "y")])[:1]
    assert (str(one), one.size, one.count) == ("20.csv and 2 more: it is long", 30, 3)
    assert merged([one, facts[0]])[0].count == 4


def test_observe_warns_of_each_kind_once_and_learns():
    with TactileLearner(sensor=PAD, embedding=Kernels(dimension=64)) as learner:
        for word, category in (
            ("range", RangeWarning),
            ("learned as 'oak'", FactWarning),
            ("beside 'oak'", FactWarning),
        ):
            name = {"range": "oak", "learned as 'oak'": "felt", "beside 'oak'": "Oak"}[word]
            with pytest.warns(category, match=word) as met:
                learner.observe(name, TOUCH * 8 + (word[0] == "b"))
            assert met[0].filename == __file__
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            learner.observe("felt", TOUCH * 8 + 2)
        assert learner.materials == {"Oak": 1, "felt": 2, "oak": 1}


def table(path, readings, names="a,b,c", times=None):
    head, rows = (names, readings) if times is None else (f"time,{names}", np.column_stack([times, readings]))
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, rows, delimiter=",", header=head, comments="", fmt="%.17g")
    return path


@pytest.mark.parametrize(
    ("times", "kind", "then", "pieces"),
    [
        (None, None, None, [150]),
        (AT, None, None, [150]),
        (AT / 0.96, None, None, [150]),
        (AT / 0.94, "rate", "said", [150]),
        (AT / 0.8, "rate", "refused", []),
        (AT * 2, "rate", "refused", []),
        (AT + 0.09 * (AT > 0.5), None, None, [150]),  # nine readings are lost
        (AT + 0.12 * (AT > 0.5), "gap", "cut", [51, 99]),
        (AT + 86400.0 * (AT > 0.5), "gap", "cut", [51, 99]),
        (AT + 86400.0 * (AT > 0.1), "gap", "cut", [139]),  # 11 readings are no touch
        (AT + 86400.0 * np.floor(AT * 10), "gap", "cut", []),  # nor are parts of 0.1 s
        (AT - 0.05 * (AT > 0.5), "back", "said", [150]),
        (AT - 3600.0 * (AT > 0.5), "back", "cut", [51, 99]),
        (65.0 + AT - 65.536 * (AT >= 0.536), None, None, [150]),  # milliseconds in 16 bits
        (np.round(AT * 0.25, 3) * 4, None, None, [150]),  # stamps that are coarse
        (np.floor(AT) + 1e9, "repeated", "said", [150]),  # whole seconds
        (np.floor(AT * 10) / 10 + np.arange(150) % 10 / 1e4, None, None, [150]),  # ten at once, each 0.1 s
    ],
)
def test_times_count(tmp_path, times, kind, then, pieces):
    path = table(tmp_path / "t.csv", TOUCH, times=times)
    facts = read(path, rate=100).facts(PAD)
    assert [(fact.kind, fact.then) for fact in facts] == ([] if kind is None else [(kind, then)])
    with TactileLearner(sensor=PAD, embedding=Kernels(dimension=64)) as learner:
        found = list(source_touches(learner, str(path), SourceOptions(material="felt")))
        assert [len(touch.stream) for touch in found if not isinstance(touch, Refused)] == pieces
        for touch in found[:1] if pieces or then == "refused" else ():
            told = [touch.why] if isinstance(touch, Refused) else [fact.sentence for fact in touch.facts]
            assert told == [fact.sentence for fact in facts]


@pytest.mark.parametrize(("rate", "lengths"), [("keep", [150]), ("resample", [101, 197])])
def test_another_rate_is_kept_or_resampled_in_each_piece(tmp_path, rate, lengths):
    path = table(tmp_path / "t.csv", TOUCH, times=2 * AT + 86400.0 * (AT > 0.5))
    with TactileLearner(sensor=PAD, embedding=Kernels(dimension=64)) as learner:
        found = list(source_touches(learner, str(path), SourceOptions(material="felt", rate=rate)))
        assert [len(touch.stream) for touch in found] == lengths
    with pytest.raises(InputError, match="expected rate='keep' or 'resample'"):
        SourceOptions(rate="fast")


def test_a_recording_as_one_stream(tmp_path):
    recording = read(table(tmp_path / "t.csv", TOUCH, times=2 * AT))
    with pytest.raises(RecordingError, match="it has 50 readings a second, and sensor 'pad' has 100") as met:
        recording.stream(PAD)
    assert met.value.argument == "rate"
    assert len(recording.stream(PAD, rate="keep")) == 150
    assert len(resampled(recording, 100).stream(PAD)) == 299
    with pytest.warns(FactWarning, match="94 readings a second"):
        read(table(tmp_path / "t.csv", TOUCH, times=AT / 0.94)).stream(PAD)
    named = PAD.model_copy(update={"columns": ("c", "a", "b")})
    with pytest.warns(FactWarning, match="in another order than those of sensor 'pad'"):
        stream = read(table(tmp_path / "t.csv", TOUCH)).stream(named)
    assert stream == validate(TOUCH[:, [2, 0, 1]], named)


class TestColumns:
    @pytest.fixture
    def files(self, tmp_path):
        table(tmp_path / "in" / "felt" / "0.csv", TOUCH)
        table(tmp_path / "in" / "felt" / "1.csv", TOUCH[:, ::-1] + 1, names="c,b,a")
        table(tmp_path / "in" / "felt" / "2.csv", np.column_stack([TOUCH + 2, AT]), names="b, a,c,d")
        return tmp_path

    def test_go_by_name_within_a_command_and_are_kept_with_a_new_memory(self, files):
        with pytest.warns(
            FactWarning, match=r"1\.csv and 1 more: its columns are in another order than those of .*0\.csv"
        ):
            done = learn([files / "in"], files / "m", SourceOptions(by="folder"), sensor=PAD, kept_touches=0)
        assert done.learned == {"felt": 3} and done.facts[0].kind == "columns"
        with TactileLearner.open(files / "m", sensor=PAD) as learner:  # a sensor is the same whatever its columns
            assert learner.sensor.columns == ("a", "b", "c")
            assert learner.names_of(TOUCH + 1) == ["felt"]
            found = evaluate_sources(learner, [str(files / "in" / "felt" / "1.csv")], SourceOptions(by="folder"))
            assert (found.seen, [fact.kind for fact in found.facts]) == (1, ["columns"])
            assert "than those of sensor 'pad'" in found.facts[0].text

    def test_others_are_refused_and_the_cure_works(self, files):
        (files / "pad.json").write_text(PAD.model_dump_json())
        table(files / "in" / "felt" / "3.csv", TOUCH + 3, names="a,b,x")
        words = ("learn", files / "m", files / "in", "--sensor", files / "pad.json", "--label-by", "folder")
        result = run(*words)
        assert result.exit_code == 1 and "it has no columns 'c', as" in result.stderr
        assert "--columns '0:3'" in result.stderr
        assert run(*words, "--columns", "0:3").exit_code == 0


def test_the_command_line_says_it_and_json_has_it(tmp_path):
    (tmp_path / "pad.json").write_text(PAD.model_dump_json())
    path = table(tmp_path / "t.csv", TOUCH, times=AT + 86400.0 * (AT > 0.5))
    words = (tmp_path / "m", path, "--label", "felt")
    learned = run("learn", *words, "--sensor", tmp_path / "pad.json", "--json")
    assert "Warning: " in learned.stderr and "1 gap in its times, the longest 8.64e+04 s" in learned.stderr
    facts = json.loads(learned.stdout)["facts"]
    assert [(each["kind"], each["source"], each["count"]) for each in facts] == [("gap", str(path), 1)]
    assert json.loads(run("evaluate", *words, "--json").stdout)["facts"] == facts
    lines = [json.loads(line) for line in run("predict", *words[:2], "--json").stdout.splitlines()]
    assert [each["facts"] for each in lines] == [facts, []]
    assert "1 gap" in run("predict", *words[:2]).stderr
    one = run("observe", tmp_path / "m", "oak", path)
    assert one.exit_code == 1 and "expected one touch; these are 2" in one.stderr
    slow = table(tmp_path / "slow.csv", TOUCH + 1, times=2 * AT)
    for command, *more in (("learn", slow, "--label", "oak"), ("observe", "oak", slow), ("predict", slow)):
        typed = (command, tmp_path / "m", *more)
        assert run(*typed).exit_code == 1 and "--rate 'keep'" in run(*typed).stderr
        assert run(*typed, "--rate", "keep").exit_code == 0
