"""A system of one's own in every study: touches that come, go and are changed, by `--system module:factory`."""

import json

import pytest
from commands import refused, run
from paper_touches import PAD, recorded

from examples.paper.runs.cells import Cell, silent
from examples.paper.runs.options import SETS
from examples.paper.studies.metrics import ContinualMetrics, _MetricsFold
from examples.paper.studies.unlearning import Unlearning
from examples.paper.systems import catalogue
from examples.paper.systems.coming import Coming, require_systems
from scroll_tactile.errors import InputError, MissingLibraryError

OWN = "examples.own_system:NearestMean"


class Counting:
    """Names the material that it has most of; learns touch by touch, and gives touches up."""

    name = "counting"

    def __init__(self):
        self.counts = {}

    def fit(self, streams, materials, validation, seed, progress=None, watch=None):
        for name, stream in zip(materials, streams, strict=True):
            self.observe(name, stream)

    def observe(self, material, stream):
        self.counts[material] = self.counts.get(material, 0) + 1

    def retract(self, material, stream):
        self.counts[material] -= 1

    def predict(self, streams):
        return [max(sorted(self.counts), key=self.counts.get)] * len(streams)


class Stubborn(Counting):
    """It gives nothing up."""

    retract = None


@pytest.fixture(scope="module")
def recordings():
    return recorded(PAD, name="RoboSkin-20", materials=3, each=12, folds=3)


@pytest.fixture
def made(recordings, monkeypatch):
    monkeypatch.setitem(SETS, "roboskin-20", lambda data, seed: recordings)


@pytest.mark.parametrize("name", ["Counting", "Stubborn"])
def test_touches_come_and_go_one_by_one_where_a_system_can(recordings, name):
    system = Coming(f"{__name__}:{name}", 0)
    assert system.one_pass
    streams = recordings.streams[:2]
    assert system.predict(streams) == []
    for number, material in enumerate(["a", "b", "b"]):
        system.observe(number, (material, recordings.streams[number]))
    assert system.predict(streams) == ["b", "b"]
    system.observe(3, ("a", recordings.streams[3]))
    system.retract(1)
    system.retract(2)
    assert system.predict(streams) == ["a", "a"]


def test_any_other_is_fitted_anew_before_it_is_asked(recordings):
    system = Coming(OWN, 0)
    assert not system.one_pass
    labelled = list(zip(recordings.materials, recordings.streams, strict=True))
    for number, touch in enumerate(labelled):
        system.observe(number, touch)
    right = sum(a == b for a, b in zip(system.predict(recordings.streams), recordings.materials, strict=True))
    assert right > 0.8 * len(labelled)
    for number, (material, _) in enumerate(labelled):
        if material == labelled[0][0]:
            system.retract(number)
    assert labelled[0][0] not in system.predict(recordings.streams)


def test_continual_and_robustness_have_its_rows(made, tmp_path):
    words = "--data", tmp_path, "--system", OWN, "--quick", "--json", tmp_path / "r.json"
    result = run("continual", "roboskin-20", "--no-peers", "--sizes", "0", "--features", "64", "--curve", "2", *words)
    assert result.exit_code == 0, result.output
    found = json.loads((tmp_path / "r.json").read_text())
    row = next(row for row in found["means"] if row["method"] == OWN)
    assert row["size"] is None and row["accuracy"]["mean"] > 0.5 and len(row["curve"]) == 2
    result = run("robustness", "--set", "roboskin-20", *words)
    assert result.exit_code == 0, result.output
    found = json.loads((tmp_path / "r.json").read_text())
    assert set(found[OWN]["roboskin-20"]["clean"]) == {"accuracy"}


def test_metrics_and_unlearning_measure_it(recordings):
    task = ContinualMetrics(recordings, every=12, systems=(OWN,))
    fold = _MetricsFold(task, 0)
    found = fold.measure(Cell("RoboSkin-20", 0, f"class by class, {OWN}"), silent)
    assert found["last"] > 0.5 and len(found["ends"]) == len(found["peak_bytes"]) == 3
    for key, expected in ((OWN, 1.0), (f"{__name__}:Counting", 1.0)):
        study = Unlearning(recordings, (1, 10), systems=(key,))
        cells = study._measure(Cell("RoboSkin-20", 0, key), silent)
        assert cells["same_answers_after"] == {"1": expected, "10": expected}


def test_what_is_no_system_is_refused_before_anything_is_read():
    with pytest.raises(InputError, match="without a readout"):
        require_systems([f"{OWN}-lda"])
    assert "has no Nothing" in refused(
        "unlearning", "roboskin-20", "--data", ".", "--system", "examples.own_system:Nothing"
    )
    assert require_systems([OWN, OWN]) == (OWN,)


def test_a_library_that_is_missing_is_said_before_anything_is_measured(made, monkeypatch, tmp_path):
    monkeypatch.setattr(catalogue, "find_spec", lambda name: None if name == "snntorch" else name)
    words = "table1", "--sets", "roboskin-20", "--data", tmp_path, "--quick"
    assert "snntorch" in refused(*words, "--systems", "svm,snn")
    assert catalogue.lacking(["svm", "snn"]) == ["snn"]
    with pytest.raises(MissingLibraryError, match="spiking"):
        catalogue.require_libraries(["snn"])


def test_rows_that_are_done_are_shown_and_quick_ones_are_not_compared(made, monkeypatch, tmp_path):
    def fail(*_, **__):
        raise InputError("it cannot be fitted")

    words = "table1", "--sets", "roboskin-20", "--data", tmp_path, "--quick", "--systems", "svm", "--system", OWN
    result = run(*words)
    assert result.exit_code == 0, result.output
    assert "paper" in result.output and "apart" not in result.output
    monkeypatch.setattr("examples.own_system.NearestMean.fit", fail)
    result = run(*words)
    assert result.exit_code == 1
    assert "SVM" in result.output and "what was done until then" in result.output
    assert "it cannot be fitted" in result.output
