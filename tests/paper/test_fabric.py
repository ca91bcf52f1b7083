"""Compositions are scored as the paper does, and the fabric pipelines run from the data to the figures."""

import json

import numpy as np
import pytest
from commands import run

from examples.paper.fabric.fabric_protocol import score, score_compositions
from examples.paper.fabric.fabric_study import Letters, SlideTransfer, directions, summary
from examples.paper.readers.fabric_slide import CPM_FINGER, Slides
from examples.paper.readers.labelled import Recordings
from examples.paper.readers.letter_spike import DOTS, GRID, NUSKIN, dots_of
from scroll_tactile.errors import InputError
from scroll_tactile.results import Composition, Constituent, Prediction
from scroll_tactile.signals.stream import validate

SIX = [f"part{number}" for number in range(6)]


class TestScore:
    def test_each_false_positive_or_negative_costs_a_sixth(self):
        truth = [[1, 0, 0, 1, 0, 0]] * 2
        predicted = [[0.9, 0.2, 0.1, 0.8, 0.4, 0.0], [0.9, 0.7, 0.1, 0.3, 0.4, 0.0]]
        figures = score(SIX, truth, predicted)
        assert figures["score"] == pytest.approx((1 + 4 / 6) / 2)
        assert figures["exact"] == 0.5
        assert figures["always"] == 1.0
        assert figures["constituents"]["part1"] == {
            "there": 0.0,
            "correct": 0.5,
            "precision": 0.0,
            "recall": None,
            "unanswered": 0,
        }
        assert figures["share_error"] is None

    def test_it_agrees_with_scikit_learn(self):
        metrics = pytest.importorskip("sklearn.metrics")
        rng = np.random.default_rng(0)
        truth, predicted = rng.uniform(size=(40, 3)) < 0.4, rng.uniform(size=(40, 3))
        shares = rng.uniform(size=(2, 40, 3))
        figures = score("abc", truth, predicted, (shares[0], shares[1]))
        assert figures["score"] == pytest.approx(1 - metrics.hamming_loss(truth, predicted > 0.5))
        assert figures["exact"] == pytest.approx(metrics.accuracy_score(truth, predicted > 0.5))
        assert figures["share_error"] == pytest.approx(metrics.mean_absolute_error(shares[0], shares[1]))
        precision, recall, *_ = metrics.precision_recall_fscore_support(truth, predicted > 0.5, average=None)
        for i, name in enumerate("abc"):
            assert figures["constituents"][name]["precision"] == pytest.approx(precision[i])
            assert figures["constituents"][name]["recall"] == pytest.approx(recall[i])

    def test_what_was_not_predicted_counts_as_absent_and_is_counted(self):
        figures = score(["a", "b"], [[1, 0]] * 4, [[np.nan, 0.1]] * 4)
        assert (figures["score"], figures["constituents"]["a"]["unanswered"]) == (0.5, 4)
        assert figures["calibration_error"] == pytest.approx(0.1)
        assert score(["a"], [[1]], [[np.nan]])["calibration_error"] is None

    @pytest.mark.parametrize(("truth", "presence"), [([[1, 0]], [[0.5]]), ([], []), ([1, 0], [0.5, 0.5])])
    def test_other_shapes_are_refused(self, truth, presence):
        with pytest.raises(InputError):
            score(["a", "b"], truth, presence)

    def test_of_compositions_shares_are_compared_where_there_are_any(self):
        feels = Prediction("x", 1.0, (("x", 1.0),), 0.0, True, 1.0)

        def predicted(*values):
            return Composition(tuple(Constituent(*value, ()) for value in values), 0.1, feels)

        answers = [
            predicted(("silk", 0.9, 0.5), ("wool", 0.8, 0.5)),
            predicted(("silk", None, None), ("wool", 0.2, 0.9)),
        ]
        figures = score_compositions(["silk", "wool"], [{"silk": 0.25, "wool": 0.75}, {"wool": True}], answers)
        assert figures["share_error"] == pytest.approx(0.25)
        assert figures["score"] == pytest.approx(3 / 4)
        with pytest.raises(InputError):
            score_compositions(["silk"], [{}], answers)


def press(letter, number):
    """A simulated press: dots of two taxels' distance, anywhere on the skin, each with a force of its own."""
    rng = np.random.default_rng([number, *letter.encode()])
    image = np.zeros((40, *GRID))
    row, column = rng.integers(0, 4), rng.integers(0, 4)
    for i, (dot, there) in enumerate(dots_of(letter).items()):
        if there:
            assert dot == DOTS[i]
            image[8:, row + 2 * (i % 3), column + 3 * (i // 3)] = rng.uniform(500, 900)
    # A taxel that is not pressed sends nothing, and stays at rest.
    noise = rng.uniform(0, 30, image.shape) * (image > 0)
    return validate((image + noise).reshape(40, -1), NUSKIN)


@pytest.fixture(scope="module")
def letters():
    names = [letter for letter in "ABCDEFGHJKLMNOPQRTVXYZ" for _ in range(5)]
    numbers = np.tile(np.arange(5), len(names) // 5)
    streams = [press(name, number) for name, number in zip(names, numbers.tolist(), strict=True)]
    return Recordings("made up", NUSKIN, streams, names, numbers, numbers, ordered=True)


def test_letters_held_out_are_composed_of_their_dots(letters, tmp_path):
    task = Letters(letters, groups=4, cosines=300, folder=tmp_path / "run")
    results = list(task.run([0]))
    assert [result["part"] for result in results] == ["known", *["never touched"] * 4]
    means = summary(results)
    assert means["known"]["score"]["mean"] > 0.9
    assert means["never touched"]["score"]["mean"] > 0.85
    assert means["never touched"]["accuracy"]["mean"] == 0
    tested = [result["tested"] for result in results]
    assert (tested[0], sum(tested[1:])) == (22, 110)
    steps = []
    assert list(task.run([0], lambda *step: steps.append(step))) == results  # noted, and not done again
    assert steps == []
    with pytest.raises(InputError, match="expected folds out of"):
        list(task.run([7]))
    with pytest.raises(InputError, match="belongs to another run"):
        list(Letters(letters, groups=5, cosines=300, folder=tmp_path / "run").run([0]))


@pytest.fixture(scope="module")
def slides():
    rng = np.random.default_rng(0)
    shapes = {name: 1 + 0.3 * rng.standard_normal((50, 16)).cumsum(axis=0) / 7 for name in ("felt", "silk")}
    names, forces, speeds, streams = [], [], [], []
    for name, shape in shapes.items():
        for force in (120, 150, 210, 250):
            for speed in (-150, -10, 20, 120):
                count = 200 if abs(speed) > 50 else 400
                i = np.linspace(0, 49, count)
                values = np.stack([np.interp(i, np.arange(50), column) for column in shape.T], axis=1)
                readings = np.clip(values, 0.2, 2) * force + rng.normal(0, 2, (count, 16))
                names, forces, speeds = [*names, name], [*forces, force], [*speeds, speed]
                streams.append(validate(readings, CPM_FINGER))
    number = np.arange(len(names)) % 16
    recordings = Recordings("made up", CPM_FINGER, streams, names, number, number % 5, ordered=False)
    return Slides(recordings, np.array(forces), np.array(speeds))


def test_slides_are_classified_at_another_force_and_speed(slides, tmp_path):
    assert [(int(a.sum()), int(b.sum())) for a, b in directions(slides).values()] == [(16, 16)] * 4
    task = SlideTransfer(slides, parts=6, folder=tmp_path / "run")
    results = list(task.run())
    assert [result["part"] for result in results[:4]] == list(directions(slides))
    assert len(results) == 9
    assert all(result["accuracy"] == 1 for result in results)
    assert list(task.run()) == results


def test_the_commands_report_write_and_resume(letters, slides, tmp_path, monkeypatch):
    monkeypatch.setattr("examples.paper.readers.letter_spike.load", lambda data, seed: letters)
    monkeypatch.setattr("examples.paper.readers.fabric_slide.load", lambda data, seed: slides)
    common = ["--data", tmp_path, "--run", tmp_path / "run", "--json", tmp_path / "out.json"]
    reported = run("fabric", "letters", *common, "--folds", "1", "--groups", "2", "--cosines", "128")
    assert reported.exit_code == 0, reported.output
    assert "mean score per dot" in reported.output
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["means"]["known"]["score"]["mean"] > 0.7
    assert set(result["parts"][0]["constituents"]) == set(DOTS)
    assert result["command"].startswith("python -m examples.paper fabric letters --data")
    reported = run("fabric", "slide", "--data", tmp_path, "--json", tmp_path / "slide.json")
    assert reported.exit_code == 0, reported.output
    assert "slow → fast" in reported.output
    assert len(json.loads((tmp_path / "slide.json").read_text())["parts"]) == 9
