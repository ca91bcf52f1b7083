"""Studies test systems that were trained on clean touches on perturbed ones, and resume where they were."""

import json

import numpy as np
import pytest
from commands import run
from paper_touches import PAD, untimed

from examples.paper import drawing as plots
from examples.paper.plots import draw_robustness, robustness_curves
from examples.paper.readers.labelled import Recordings
from examples.paper.studies.strengths_study import Strengths, ours, summary
from scroll_tactile.errors import DatasetError, InputError
from scroll_tactile.signals.stream import validate
from scroll_tactile.simulation.gel import Gel

MATERIALS = ("dull", "loud", "lost")


def recordings(*, ordered=True):
    rng = np.random.default_rng(0)
    streams, names = [], []
    for i, name in enumerate(MATERIALS):
        for _ in range(20):
            rhythm = np.sin(np.arange(100)[:, None] * (i + 1) / 5 + rng.uniform(0, 6, (1, 10)))
            streams.append(validate(2 + rhythm + 0.1 * rng.standard_normal((100, 10)), PAD))
            names.append(name)
    repetition = np.tile(np.arange(20), 3)
    return Recordings("made up", PAD, streams, names, repetition, repetition % 2, ordered)


class Loudest:
    """Knows the material by the spread of its readings; `made` counts how often one was trained."""

    made = 0

    def __init__(self, train, augmented, progress):
        type(self).made += 1
        self.means = {name: np.mean([s.readings.std() for m, s in train if m == name]) for name in MATERIALS}

    def predict(self, streams):
        return [min(self.means, key=lambda m: abs(self.means[m] - s.readings.std())) for s in streams]


def study(folder=None, **settings):
    Loudest.made = 0
    return Strengths(recordings(), {"loudest": Loudest}, quick=True, folder=folder, **settings)


def test_a_system_is_trained_once_a_fold_for_all_studies_and_once_for_another_session():
    task = study(augmented=(False,))
    (records,) = task.run([0])
    assert Loudest.made == 2
    assert [item["study"] for item in records if item["strength"] == 0] == ["noise", "dead", "drift", "session"]
    assert {item["tested"] for item in records} == {30}
    assert all(0 <= item["accuracy"] <= 1 for item in records)


def test_records_are_of_the_perturbed_touches_of_their_fold():
    task = study(studies=["noise"], augmented=(False,))
    (records,) = task.run([1])
    train, test = task._split(1, False)
    assert len(train) + len(test) == 60
    system = Loudest(train, False, print)
    for record in records:
        evaluated = task._perturbed(test, "noise", record["strength"])
        predicted = system.predict([stream for _, stream in evaluated])
        right = np.mean([name == item for (name, _), item in zip(evaluated, predicted, strict=True)])
        assert record["accuracy"] == right
    assert task._perturbed(test, "noise", 0.5)[0][1] != test[0][1]


def test_an_interrupted_run_goes_on(tmp_path):
    def stop(what, done, of):
        if "dead" in what:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(study(tmp_path / "run").run([0], stop))
    kept = json.loads((tmp_path / "run" / "strengths.json").read_text())["notes"]
    assert 0 < len(kept) < len(study().cells(0))
    reported = []
    whole = list(study(tmp_path / "run").run([0], lambda what, done, of: reported.append(what)))
    assert untimed(whole) == untimed(list(study().run([0])))
    again = study(tmp_path / "run")
    assert list(again.run([0])) == whole
    assert Loudest.made == 0  # all was read back
    with pytest.raises(InputError, match="another run"):
        list(study(tmp_path / "run", seed=1).run([0]))


def test_a_cameras_frames_are_refused():
    gel = Gel()
    streams = [gel.touch(name, i) for name in gel.materials[:2] for i in range(4)]
    within = np.tile(np.arange(4), 2)
    frames = Recordings("gel", streams[0].sensor, streams, [*"aaaabbbb"], within, within % 2, ordered=False)
    with pytest.raises(InputError, match="of camera 'gelsight'"):
        Strengths(frames, {"loudest": Loudest}, studies=["noise"])


def test_what_cannot_be_is_refused():
    with pytest.raises(InputError, match=r"came \['weather'"):
        study(studies=["weather"])
    with pytest.raises(InputError, match=r"folds out of \[0, 1\]"):
        list(study().run([5]))
    with pytest.raises(DatasetError, match="blocked"):
        Strengths(recordings(ordered=False), {"loudest": Loudest})


def test_ours_learns_as_it_is_and_others_with_augmentation_too():
    make, settings = ours(PAD)
    assert "Kernels" in settings["embedding"]
    systems = {"ours": make, "loudest": Loudest}
    task = Strengths(recordings(), systems, {"ours": settings}, studies=["dead"], plain=["ours"], quick=True)
    (records,) = task.run([0])
    found = {(item["system"], item["strength"], item["augmented"]): item["accuracy"] for item in records}
    assert found["ours", 0.0, False] == 1
    assert {key[2] for key in found if key[0] == "ours"} == {False}
    assert {key[2] for key in found if key[0] == "loudest"} == {False, True}


def test_the_picture(tmp_path):
    rows = summary([record for fold in study().run([0, 1]) for record in fold])
    assert all(row["mean"] == pytest.approx(sum(row["by_fold"]) / 2) and len(row["by_fold"]) == 2 for row in rows)
    lines = robustness_curves(rows)
    assert list(lines) == ["length", "speed", "noise", "dead", "drift", "session"]
    assert [strength for strength, *_ in lines["speed"]["loudest", True]] == [0.5, 1, 2]
    if plots.available():
        draw_robustness(tmp_path / "p.png", rows, title="made up")
        assert (tmp_path / "p.png").stat().st_size > 10_000
    with pytest.raises(InputError):
        draw_robustness(tmp_path / "p.png", [], title="nothing")


def test_the_command_on_real_touches(real_data, tmp_path):
    words = [
        "strengths",
        "dead",
        "--sets",
        "roboskin-20",
        "--data",
        real_data,
        "--quick",
        "--every",
        1,
        "--materials",
        2,
        "--folds",
        0,
    ]
    result = run(*words, "--json", tmp_path / "r.json", "--plot", tmp_path / "r.png", "--run", tmp_path / "run")
    assert result.exit_code == 0, result.output
    reported = json.loads((tmp_path / "r.json").read_text())
    assert {row["strength"] for row in reported["means"]} == {0.0, 0.2}
    assert min(row["mean"] for row in reported["means"]) > 0.8
    assert reported["seconds"] > 0
    assert run(*words, "--run", tmp_path / "run").exit_code == 0
