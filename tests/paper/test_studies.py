"""Every study of the paper by its command: a quick run ends, these are its columns, and it is not done again."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from commands import refused, run
from paper_touches import untimed

from examples.paper.fabric.attributes import FIGURES as GRADED
from examples.paper.fabric.letters import FIGURES as OF_LETTERS
from examples.paper.runs.study import SystemStudy
from examples.paper.studies.metrics import METHODS, STREAMS
from examples.paper.studies.replay import FIGURES as OF_REPLAY
from examples.paper.studies.robustness import PERTURBED

HERE = Path(__file__).resolve().parents[2]
NOTED = {"command", "date", "seed", "versions", "machine", "load_average"}


class Study(NamedTuple):
    """A command, and what its result has: a place in the JSON (keys, or places in lists) → the keys there, after "; ".

    says: words of its output. shows: whether a result has what the tables rest on, of figures that others only list.
    """

    words: str
    holds: dict[str, str]
    says: tuple[str, ...] = ()
    shows: Callable[[Any], bool] = bool


METRICS = [f"{stream}, {method}" for stream in STREAMS for method in METHODS]


def _equals_offline(result: Any) -> bool:
    (fold,) = result["folds"]
    return bool(fold["equals_offline"] and fold["accuracy"] >= 0.8)


def _leaves_no_trace(result: Any) -> bool:
    means = result["means"]
    return {*means["same_bytes"].values()} == {True} and {*means["ours"].values()} == {0.0} and means["same_answers"]


STUDIES = {
    "table1": Study(
        "table1 --sets biotac-20,roboskin-20 --systems svm,kernels-lda,conv-lstm --epochs 2",
        {
            "rows/0": "key; system; sets",
            "rows/0/sets/BioTac-20": "mean; sd; folds; paper; difference; seconds",
            "cells/RoboSkin-20, fold 0, conv-lstm": "learned; validation; tested; right; epochs; seconds",
            "systems/svm": "name; library",
        },
        ("94.2", "2 epochs where the paper has 100", "quick:"),
    ),
    "table1 of frames": Study(
        "table1 --sets gelsight --systems svm,kernels-lda",
        {"rows/0/sets/GelSight frames": "mean; sd; folds; paper; difference; seconds; vote"},
        ("GelSight frames",),
    ),
    "one's own": Study(
        "table1 --sets roboskin-20 --systems svm-spikes --system examples.own_system:NearestMean "
        "--embedding examples.own_system:Strengths",
        {"rows/1/sets/RoboSkin-20": "mean; sd; folds; paper; difference; seconds"},
        ("examples.own_system:NearestMean",),
    ),
    "efficiency": Study(
        "efficiency --systems conv-lstm,kernels-lda --epochs 2 --plot P.png",
        {"curves/0": "dataset; key; system; by; folds; points; seconds"},
        ("after so many streams", "plot:"),
    ),
    "activation": Study(
        "activation --weights W --epochs 1 --plot P.png",
        {"likeness/0": "one; two; filters; moved; blocks"},
        ("fine-tuned on RoboSkin-20",),
    ),
    "robustness": Study(
        f"robustness --set roboskin-20 --series S.npz --before {HERE}",
        {
            "now/roboskin-20": "; ".join(PERTURBED),
            "now/roboskin-20/clean": "accuracy; calibration_error; known; wrong_known",
            "before/series/Waves": "accuracy; calibration_error; known; wrong_known",
        },
        ("noise-half", "right, before"),
    ),
    "strengths": Study(
        "strengths all --sets biotac-20 --systems ours,svm --plot P.png",
        {
            "means/0": "mean; sd; folds; dataset; study; strength; system; augmented; by_fold",
            "sets/BioTac-20/settings/svm": "augmentation; columns; seed",
        },
        ("svm, augmented", "session"),
    ),
    "replay": Study(
        "replay roboskin-20 --novelty",
        {
            "means": "; ".join(OF_REPLAY),
            "folds/0": "; ".join(["fold; learned; tested; confusions; equals_offline; digest; seconds", *OF_REPLAY]),
        },
        ("published: ridge", "True"),
        _equals_offline,
    ),
    "continual": Study(
        "continual roboskin-20 --features 64 --sizes 0,8,all --epochs 1 --curve 4 --tuned-curve --plot P.png",
        {
            "means/0": "method; size; accuracy; forgetting; curve",
            "means/4": "method; size; accuracy; forgetting; curve; kept; seconds; exemplars; bytes_per_exemplar",
        },
        ("streaming LDA", "published: ResNet", "plot:"),
    ),
    "metrics": Study(
        "metrics roboskin-20 --robots 3 --buffer 4 --every 20",
        {
            "means": "; ".join(["fleet of 1, alpha 1; fleet of 3, alpha 0.1", *METRICS]),
            "means/fleet of 3, alpha 0.1/accuracy": "mean; sd; folds",
            "cells/RoboSkin-20, fold 0, class by class, ACIL": "ends; tested; last; average; anytime; forgetting; "
            "backward_transfer; curve; learning_seconds; answering_seconds; peak_bytes; seconds",
        },
        ("Si-Blurry", "memories merged"),
    ),
    "unlearning": Study(
        "unlearning roboskin-20",
        {
            "means": "folds; same_bytes; ours; same_answers; peer; ours_ms; peer_ms",
            "means/peer/0.001": "weights; inverse; sums; anew",
        },
        ("ours: the same bytes", "10 requests"),
        _leaves_no_trace,
    ),
    "letters": Study(
        "fabric letters --groups 4 --cosines 128",
        {"means": "known; never touched", "means/known": "; ".join(OF_LETTERS)},
        ("dot6",),
    ),
    "slide": Study(
        "fabric slide",
        {"parts/0": "part; learned; tested; accuracy; of each; unknown; digest; seconds"},
        ("slow → fast",),
    ),
    "quantities": Study(
        "fabric quantities --no-peers",
        {
            "parts/0": "part; learned; tested; ours; ours, 64; ours, 128; ours, 1024; seconds",
            "parts/0/ours/4 s/force": "squares; spread; off; covers; width",
            "means/0": "held out; system; from; of; off; covers; width; r2; least",
        },
        ("a fabric", "ours, 128", "0.3 s"),
    ),
    "attributes": Study(
        "fabric attributes --grades G.csv --sets roboskin-20 --dimension 64",
        {"sets/roboskin-20/means/shaking": "; ".join(GRADED)},
        ("shaking",),
    ),
    "gelsight": Study(
        "fabric gelsight --groups 3 --trees 2",
        {
            "means": "known, counts; never touched",
            "means/known, counts": "video; vote; frame; trees; trees' vote",
            "attributes": "apple; pen; rug",
        },
        ("hardness, composed",),
    ),
    "contactile": Study(
        "fabric contactile --simulated --size 5,6,2 --rows least-squares,resnet-biotac,kernels,ratios "
        "--weights W --biotac DATA --epochs 1 --biotac-epochs 1 --every 24 --take 1",
        {
            "rows/0": "key; system; paper; difference; parts",
            "rows/0/parts": "protocol 1 → 2; protocol 1 → 1, held out",
            "rows/0/parts/protocol 1 → 2": "score; exact; share_error; calibration_error; "
            "always; inferred; heads; fabric",
        },
        ("80.6", "1 epochs (the paper has 50)", "simulated:"),
    ),
    "tasks": Study(
        "transfer tasks --sets biotac-20,roboskin-20 --weights W --counts 1,2 --sources roboskin-20 --epochs 1 "
        "--plot P.png",
        {"rows/0": "dataset; system; tuned on; points", "rows/0/points/1": "mean; sd; folds; gain; gain sd"},
        ("vision tuned on RoboSkin-20",),
    ),
    "sensors": Study(
        "transfer sensors --counts 0,1",
        {
            "rows/0": "direction; way; name; points",
            "rows/0/points/1": "mean; sd; folds; gain; gain sd",
            "agreement": "spectra; kernels",
        },
        ("RoboSkin-20 → BioTac-20", "chance: 20.0 %"),
    ),
}


def made_up_series(path: Path) -> None:
    """Waves of two frequencies, of 20 to 40 readings."""
    rng = np.random.default_rng(0)
    lengths, label = rng.integers(20, 40, 24), np.arange(24) % 2
    waves = [np.sin(np.arange(n) * (1 + k) / 3 + rng.uniform(0, 6)) for n, k in zip(lengths, label, strict=True)]
    arrays = {"lengths": lengths, "label": label, "test": np.arange(24) >= 16, "range": np.array([-1.0, 1.0])}
    arrays["readings"] = np.concatenate(waves).astype(np.float32)[:, None]
    np.savez(path, **{f"Waves/{part}": array for part, array in arrays.items()})


@pytest.fixture
def words_of(made_up: None, gelsight: Path, weights: str, small_sets: Any, tmp_path: Path) -> Any:
    """A command with the files of this test in it."""
    made_up_series(tmp_path / "S.npz")
    materials = list(dict.fromkeys(small_sets["roboskin-20"].materials))
    lines = ["material,shaking", *(f"{name},{i % 2}" for i, name in enumerate(materials))]
    (tmp_path / "G.csv").write_text("\n".join(lines))
    files = {"W": weights, "DATA": gelsight} | {name: tmp_path / name for name in ("S.npz", "G.csv", "P.png")}
    return lambda words: [files.get(word, word) for word in words.split()]


def reached(result: Any, place: str) -> set[str]:
    for key in place.split("/"):
        result = result[int(key) if isinstance(result, list) else key]
    return {*result}


@pytest.mark.parametrize("name", STUDIES)
def test_a_quick_run_ends_with_its_columns_and_is_not_done_again(name, words_of, gelsight, tmp_path, monkeypatch):
    pytest.importorskip("sklearn")
    study = STUDIES[name]
    words = [*words_of(study.words), "--run", tmp_path / "run"]
    words += ["--data", gelsight] if "contactile" not in study.words else []
    words += ["--quick"] if name not in ("slide", "quantities") else []
    first = run(*words, "--json", tmp_path / "a.json")
    assert first.exit_code == 0, first.output
    shown = re.sub(r"\s+", " ", first.output)
    assert all(said in shown for said in study.says), first.output
    result = json.loads((tmp_path / "a.json").read_text())
    assert result.keys() >= NOTED
    assert all(reached(result, place) == {*keys.split("; ")} for place, keys in study.holds.items())
    assert study.shows(result)
    assert str(tmp_path) not in (tmp_path / "a.json").read_text()
    monkeypatch.setattr(SystemStudy, "_system", None)  # nothing is measured anew: it is read back, with its times
    monkeypatch.setattr("scroll_tactile.learner.TactileLearner.observe", None)
    monkeypatch.setattr("subprocess.Popen", None)
    if name == "sensors":
        monkeypatch.undo()  # it compares all touches of the sensors in the end
        return
    again = run(*words, "--json", tmp_path / "b.json")
    assert again.exit_code == 0, again.output
    kept = json.loads((tmp_path / "b.json").read_text())
    measured = result.keys() - {"date", "load_average", "load_average_after", "likeness"}
    assert {key: kept[key] for key in measured} == {key: result[key] for key in measured}


def test_what_is_noted_can_be_given(words_of, gelsight, tmp_path):
    words = ["table1", "--systems", "svm-spikes", "--sets", "biotac-20", "--quick", "--data", gelsight]
    own = ["--system", "examples.own_system:NearestMean"]
    assert run(*words, *own, "--json", tmp_path / "a.json").exit_code == 0
    first = json.loads((tmp_path / "a.json").read_text())
    assert first["command"] == (
        "python -m examples.paper table1 --data DATA --sets biotac-20 --systems svm-spikes "
        "--system examples.own_system:NearestMean --folds all --device cpu --precision float32 --seed 0 --quick"
    )
    noted = [gelsight if word == "DATA" else word for word in first["command"].split()[3:]]
    assert run(*noted, "--json", tmp_path / "b.json").exit_code == 0
    assert untimed(json.loads((tmp_path / "b.json").read_text())["rows"]) == untimed(first["rows"])


def test_ours_have_no_schedule(words_of, gelsight, tmp_path):
    common = ["--data", gelsight, "--quick", "--json", tmp_path / "a.json"]
    few = ["--features", 64, "--sizes", 8, "--epochs", 1, "--no-peers", "--curve", 0]
    digests = set()
    for schedule in ("class-by-class", "shuffled"):
        assert run("continual", "roboskin-20", *common, *few, "--schedule", schedule).exit_code == 0
        cells = json.loads((tmp_path / "a.json").read_text())["cells"]
        tuned = cells["RoboSkin-20, fold 0, f* 8"]
        assert tuned["buffer_of_another_order"] and tuned["exemplars"] == 8
        digests.add((tuned["digest"], tuned["buffer_digest"], tuned["tuned_digest"]))
        digests.add((cells["RoboSkin-20, fold 0, f"]["digest"], tuned["buffer_digest"], tuned["tuned_digest"]))
    assert len(digests) == 1


def test_a_picture_of_each_study_of_each_set(words_of, gelsight, tmp_path):
    pytest.importorskip("matplotlib")
    words = ["strengths", "paper", "--systems", "ours", "--data", gelsight, "--quick", "--folds", "0"]
    assert run(*words, "--plot", tmp_path / "p.png").exit_code == 0
    drawn = {f"p-{name}-20-{study}.png" for name in ("biotac", "roboskin") for study in ("length", "speed", "noise")}
    assert {path.name for path in tmp_path.glob("p*.png")} == drawn
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in tmp_path.glob("p*.png"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("table1 --sets biotac-50 --systems svm", "biotac-20-blocked"),
        ("table1 --systems cnn", "least-squares-random"),
        ("table1 --systems svm --sets roboskin-20 --folds 9", "out of [0, 1, 2]"),
        ("table1 --systems svm --sets roboskin-20 --folds first", "--folds as all, or numbers"),
        ("table1 --systems svm --json none/x.json", "folder that exists"),
        ("table1 --system examples.own_system:Missing", "no Missing"),
        ("table1 --systems svm --sets roboskin-20 --precision half", "a precision out of"),
        ("table1 --systems svm --sets roboskin-20 --device abacus", "a device that torch can use"),
        ("activation", "expected --weights"),
        ("strengths weather", "expected STUDY out of length"),
        ("strengths speed --systems least-squares", "ours, svm, svm-spikes, conv-lstm, snn, resnet"),
        ("strengths speed --systems resnet-pretrained", "give --weights"),
        ("strengths session --sets roboskin-20", "blocked"),
        ("replay nose-20", "expected DATASET out of biotac-20"),
        ("replay roboskin-20 --schedule backwards", "expected a schedule"),
        ("replay roboskin-20 --blocked", "blocked"),
        ("continual roboskin-20 --sizes 0,3", "each of the 5 materials"),
        ("continual roboskin-20 --sizes 20,many", "came '20,many'"),
        ("continual roboskin-20 --embedding vision", "needs --weights"),
        ("continual roboskin-20 --weights resnet18", "has no weights"),
        ("continual roboskin-20 --embedding sound", "or module:factory; came 'sound'"),
        ("continual roboskin-20 --embedding vision --weights none.pth", "none.pth"),
        ("metrics roboskin-20 --robots ten", "expected --robots"),
        ("metrics roboskin-20 --robots 0", "1 or more robots"),
        ("robustness --set biotac-50", "came 'biotac-50'"),
        ("robustness --series none.npz", "no such file"),
        ("robustness --before tests", "no scroll_tactile"),
        ("fabric attributes --grades none.csv", "none.csv"),
        ("fabric contactile --rows svm", "expected --rows out of"),
        ("fabric contactile --rows least-squares", "need --weights"),
        ("fabric contactile --rows resnet-biotac --weights resnet18", "need --biotac"),
        ("fabric contactile --rows kernels --size 3,4", "three whole numbers"),
        ("transfer tasks --weights W --sets felt", "expected --sets out of biotac-20"),
        ("transfer tasks --weights W --sets biotac-20", "two data sets or more"),
        ("transfer tasks --weights W --sets biotac-20,roboskin-20 --sources felt", "expected --sources out of"),
        ("transfer tasks --weights W --sets biotac-20,roboskin-20 --counts few", "expected --counts"),
        ("transfer sensors --ways magic", "expected --ways out of alone"),
    ],
)
def test_what_cannot_be_is_one_red_line(words, message, words_of, gelsight):
    data = [] if "contactile" in words else ["--data", gelsight]
    assert message in refused(*words_of(words), *data)
