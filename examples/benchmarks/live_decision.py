"""`python -m examples.benchmarks decisions`: early answers, several touches of one thing, and sets with a guarantee.

Each fold of a recorded set is tested with what was learned from the others. A touch is predicted at the moments of its
decision rule and at its end. Earliness is the share of the touch that was felt before it was decided, all of it where
it was not; with accuracy it makes the harmonic mean that the literature compares (Schäfer and Leser 2020).
"""

from __future__ import annotations

import json as json_lines
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from examples.paper.readers.labelled import Recordings
from examples.paper.runs.options import Data, Folds, Json, Seed, folds_of, read
from examples.paper.runs.results import show, write
from examples.paper.studies.replay import novelty_area, rotations
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.clients.learning.metrics import calibration_error
from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.live.decision import decision_rule
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.judging import answer
from scroll_tactile.results import Prediction
from scroll_tactile.signals.stream import Stream

__all__ = ["decisions", "run_decisions"]

Record = dict[str, Any]
Progress = Callable[[str, int, int], object]
FloatArray = npt.NDArray[np.float64]

RISKS = (0.05, 0.01)
ERROR = 0.05  # of the sets of candidates
TWICE = 0.7  # the probability of the untuned rule, that has to be reached twice running
TOGETHER = (1, 2, 3)  # touches of one thing, for novelty
ECE_AT = (0.1, 0.2, 0.3, 0.5, 1.0)  # seconds

PEERS = Path(__file__).parent / "results" / "aeon-early.json"  # aeon goes with other packages: see `aeon_early`


def run_decisions(
    recordings: Recordings,
    folds: Sequence[int],
    *,
    every: int = 1,
    folder: Path | None = None,
    progress: Progress = lambda what, done, of: None,
) -> Record:
    """Measure a set.

    every: of the touches of a fold, one in so many is tested. folder: where finished folds are kept, so that a run that
    was cut short resumes. Raises InputError for a fold that is not there.
    """
    there = set(recordings.fold.tolist())
    if not folds or set(folds) - there:
        raise InputError(f"expected some of the folds {sorted(there)}; came {list(folds)}")
    found = []
    for fold in folds:
        kept = None if folder is None else folder / f"{recordings.name} fold {fold} every {every}.json"
        if kept is not None and kept.exists():
            found.append(json_lines.loads(kept.read_text()))
            continue
        record = _fold(recordings, fold, every, progress)
        if kept is not None:
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(json_lines.dumps(record))
        found.append(record)
    return {"set": recordings.name, "folds": list(folds), "every": every} | _summary(found)


def _learned(recordings: Recordings, fold: int, without: Iterable[str] = ()) -> TactileLearner:
    out = set(without)
    learner = TactileLearner(sensor=recordings.sensor, exemplars=0)
    for i in np.flatnonzero(recordings.fold != fold).tolist():
        if recordings.materials[i] not in out:
            learner.observe(recordings.materials[i], recordings.streams[i])
    learner.settle()
    return learner


def _fold(recordings: Recordings, fold: int, every: int, progress: Progress) -> Record:
    learner = _learned(recordings, fold)
    extractor = FeatureExtractor(learner.sensor, learner.embedding, learner.plan)
    model = learner.model()
    rules = [decision_rule(model, risk) for risk in RISKS]
    tested = np.flatnonzero(recordings.fold == fold)[::every].tolist()
    rate, moments = recordings.sensor.rate, rules[0].moments

    def predicted(stream: Stream) -> Prediction:
        # By the model that the rules are of: the learner's own would be fitted once more, to the same end.
        encoded = extractor.encode(stream, model.longest, lambda columns: model.scales_for(model.names, columns))
        return answer(model, extractor, model.names, [encoded], learner.settings.false_alarms)

    said: list[list[Prediction]] = []
    for done, i in enumerate(tested):
        stream = recordings.streams[i]
        said.append([predicted(stream.first(columns / rate)) for columns in moments if columns < len(stream)])
        said[-1].append(predicted(stream))
        progress(f"{recordings.name}, fold {fold}", done + 1, len(tested))
    truth = [recordings.materials[i] for i in tested]
    lengths = [len(recordings.streams[i]) for i in tested]
    columns = [[*(moment for moment in moments if moment < length), length] for length in lengths]
    decided = {
        str(rule.risk): [
            next((k for k, now in enumerate(of) if rule.decided(now, at[k])), None)
            for of, at in zip(said, columns, strict=True)
        ]
        for rule in rules
    }
    sets = [of[-1].candidates(ERROR) for of in said]
    return {
        "fold": fold,
        "truth": truth,
        "seconds": [[at / rate for at in of] for of in columns],
        "sure": [rule.sure for rule in rules],
        "probability": [[now.probability for now in of] for of in said],
        "right": [[now.material == own for now in of] for of, own in zip(said, truth, strict=True)],
        "known": [[now.known is not False for now in of] for of in said],
        "decided": decided,
        "covered": [own in found for own, found in zip(truth, sets, strict=True)],
        "sizes": [len(found) for found in sets],
        "novelty": _novelty(recordings, fold, every, progress),
    }


def _novelty(recordings: Recordings, fold: int, every: int, progress: Progress) -> dict[str, float]:
    """AUROC of novelty by the number of touches of one thing, a fifth of the materials never observed."""
    out = rotations(recordings.materials)[fold % 5]
    learner = _learned(recordings, fold, out)
    areas = {}
    for count in TOGETHER:
        novelty, new = [], []
        for material in sorted(set(recordings.materials)):
            mine = [i for i in np.flatnonzero(recordings.fold == fold).tolist() if recordings.materials[i] == material]
            starts = range(0, len(mine) - count + 1, max(1, every * count // 2))
            for start in starts:
                touches = [recordings.streams[i] for i in mine[start : start + count]]
                novelty.append(learner.predict(*touches).novelty)
                new.append(material in out)
        areas[str(count)] = novelty_area(novelty, new)
        progress(f"{recordings.name}, fold {fold}: novelty", count, len(TOGETHER))
    return areas


def _summary(found: Sequence[Record]) -> Record:
    by_risk = {str(risk): _decisions(found, [_of(record, str(risk)) for record in found]) for risk in RISKS}
    by_risk["untuned"] = _decisions(found, [_twice(record) for record in found])
    calibration = {}
    for seconds in ECE_AT:
        pairs = [
            (probability[k], right[k])
            for record in found
            for at, probability, right in zip(record["seconds"], record["probability"], record["right"], strict=True)
            for k in [min(range(len(at)), key=lambda k: abs(at[k] - seconds))]
        ]
        calibration[str(seconds)] = {
            "ece": calibration_error([p for p, _ in pairs], [bool(hit) for _, hit in pairs]),
            "accuracy": float(np.mean([right for _, right in pairs])),
        }
    truth = [name for record in found for name in record["truth"]]
    covered = [share for record in found for share in record["covered"]]
    by_material = {
        name: float(np.mean([held for held, own in zip(covered, truth, strict=True) if own == name]))
        for name in sorted(set(truth))
    }
    sizes = [size for record in found for size in record["sizes"]]
    novelty = {str(count): float(np.mean([record["novelty"][str(count)] for record in found])) for count in TOGETHER}
    return {
        "touches": len(truth),
        "decisions": by_risk,
        "calibration": calibration,
        "novelty_auroc": novelty,
        "coverage": float(np.mean(covered)),
        "least_coverage": min(by_material.values()),
        "coverage_by_material": by_material,
        "mean_size": float(np.mean(sizes)),
    }


def _of(record: Record, risk: str) -> list[int | None]:
    return [None if k is None else int(k) for k in record["decided"][risk]]


def _twice(record: Record) -> list[int | None]:
    """When an answer of TWICE or more came twice running: the rule that is not tuned."""
    return [
        next((k for k in range(1, len(of)) if min(of[k - 1 : k + 1]) >= TWICE), None) for of in record["probability"]
    ]


def _decisions(found: Sequence[Record], decided: Sequence[Sequence[int | None]]) -> Record:
    """Shares of wrong and undecided, accuracy with the answers at the end, earliness, and their harmonic mean."""
    wrong, undecided, right, felt, seconds = [], [], [], [], []
    for record, of in zip(found, decided, strict=True):
        for i, k in enumerate(of):
            last = len(record["right"][i]) - 1
            place = last if k is None else k
            if k is not None:
                wrong.append(not (record["right"][i][k] and record["known"][i][k]))
            undecided.append(k is None)
            right.append(record["right"][i][place])
            seconds.append(record["seconds"][i][place])
            felt.append(record["seconds"][i][place] / record["seconds"][i][last])
    accuracy, early, share = float(np.mean(right)), 1 - float(np.mean(felt)), float(np.mean(wrong)) if wrong else 0.0
    return {
        "wrong": share,
        "standard_error": float(np.sqrt(share * (1 - share) / max(len(wrong), 1))),
        "undecided": float(np.mean(undecided)),
        "accuracy": accuracy,
        "seconds": float(np.mean(seconds)),
        "harmonic": 2 * accuracy * early / max(accuracy + early, 1e-9),
    }


def decisions(
    context: typer.Context,
    data: Data,
    sets: Annotated[str, typer.Option(help="Which data sets.")] = "biotac-20,roboskin-20,roboskin-20-unmixed",
    folds: Folds = "all",
    every: Annotated[int, typer.Option(min=1, help="Test one in so many of a fold's touches.")] = 1,
    folder: Annotated[Path | None, typer.Option(help="Keep finished folds here; the same again resumes.")] = None,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Measure early answers, touches of one thing together, and sets with a guarantee, on recorded sets.

    A fold takes half a minute, and as long again for every fifty touches.
    """
    results = []
    with progress_bar() as progress:
        for recordings in read("--sets", sets, data, seed).values():
            chosen = folds_of(folds, recordings)
            results.append(run_decisions(recordings, chosen, every=every, folder=folder, progress=progress))
    rules = [
        {"set": result["set"], "rule": f"risk {rule}", **found}
        for result in results
        for rule, found in result["decisions"].items()
    ]
    peers = json_lines.loads(PEERS.read_text(encoding="utf-8"))["means"]
    rules += [{"set": "BioTac-20, as recorded", "rule": peer["system"], **peer} for peer in peers]
    columns = {
        "set": "{./set}",
        "rule": "{./rule}",
        "wrong of decided, %": "{?./wrong|%}",
        "±": "{?./standard_error|%}",
    }
    columns |= {"undecided, %": "{?./undecided|%}", "right, %": "{./accuracy|%}", "after, s": "{./seconds|.2f}"}
    show("decisions", columns | {"harmonic mean": "{./harmonic|.3f}"}, rules)
    columns = {"set": "{./set}"} | {f"ECE at {at} s": f"{{./calibration/{at}/ece|.3f}}" for at in ECE_AT}
    columns |= {f"AUROC, {count}": f"{{./novelty_auroc/{count}|.4f}}" for count in TOGETHER}
    columns |= {"coverage, %": "{./coverage|%}", "least": "{./least_coverage|%}", "mean size": "{./mean_size|.2f}"}
    show("early answers, novelty and sets", columns, results)
    write(context, {"bench": "decisions", "sets": results})
