"""Replays: one pass by a schedule, fold by fold, on simulated touches."""

import json
import math
from pathlib import Path

import pytest
from paper_touches import recorded, untimed

from examples.paper.readers.labelled import Recordings
from examples.paper.studies.replay import Replay, subset, summary
from scroll_tactile import Kernels, TactileLearner, sensors
from scroll_tactile.errors import DatasetError, InputError


@pytest.fixture(scope="module")
def recordings() -> Recordings:
    """Five materials under a simulated RoboSkin, ten touches each, in two folds."""
    return recorded(sensors.ROBOSKIN, materials=5, each=10, folds=2, name="simulated")


class TestReplay:
    def test_a_fold_has_all_figures(self, recordings: Recordings) -> None:
        (fold,) = Replay(recordings, novelty=True, features=128).run([1])
        assert (fold["fold"], fold["learned"], fold["tested"]) == (1, 25, 25)
        assert fold["equals_offline"]
        assert sum(fold["tested_of"].values()) == 25
        assert fold["accuracy"] > 0.9
        assert 0 <= fold["calibration_error"] <= 1
        assert 0.5 < fold["novelty_auroc"] <= 1
        assert json.loads(json.dumps(fold)) is not None

    def test_an_interrupted_replay_goes_on(self, recordings: Recordings, tmp_path: Path) -> None:
        whole = list(Replay(recordings, "shuffled", readout="ridge", features=128).run([0, 1]))
        task = Replay(recordings, "shuffled", readout="ridge", features=128, folder=tmp_path / "kept")

        def stop(what: str, done: int, of: int) -> None:
            if what == "learning" and done == 15 and (tmp_path / "kept" / "fold-1").exists():
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            list(task.run([0, 1], stop))
        memory = TactileLearner.open(tmp_path / "kept" / "fold-1", embedding=Kernels(dimension=128), mode="read")
        with memory as learner:
            assert sum(learner.materials.values()) == 15
        resumed = list(task.run([0, 1]))
        assert untimed(resumed) == untimed(whole)

    def test_what_cannot_be_is_refused(self, recordings: Recordings) -> None:
        with pytest.raises(InputError, match="folds out of"):
            list(Replay(recordings).run([2]))
        with pytest.raises(DatasetError, match="blocked"):
            list(Replay(recordings, blocked=True).run([0]))
        with pytest.raises(InputError, match="materials"):
            subset(recordings, 6)

    def test_a_summary_leaves_out_what_was_not_measured(self) -> None:
        folds = [{"accuracy": 0.5, "first": None}, {"accuracy": 1.0, "first": 0.2}]
        names = ("half", "twice", "calibration_error", "false_alarms", "wrong_known", "novelty_auroc")
        means = summary([fold | dict.fromkeys(names) for fold in folds])
        assert means == {"accuracy": {"mean": 0.75, "sd": pytest.approx(math.sqrt(0.125)), "folds": 2}}
