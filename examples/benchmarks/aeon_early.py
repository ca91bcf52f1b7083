"""aeon's early classifiers, on the touches, folds and times of ours: `python -m examples.benchmarks.aeon_early`.

With `--data` it writes BioTac-20 to the file, which takes torch; without, it measures, in an environment of its own
(see `aeon_checks`). Both classify with MiniRocket at the moments of our decision rule: TEASER (Schäfer and Leser 2020)
with its one-class machines, chosen inside the training part, and a probability that has to be reached twice running.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from examples.paper.readers import biotac_slide
from scroll_tactile import __version__

__all__ = ["MOMENTS", "THRESHOLD"]

MOMENTS = (10, 20, 30, 50, 76, 100, 195, 400)  # readings of a BioTac: 0.1 to 4 s
THRESHOLD = 0.7
RATE = 100.0


def _measured(classifier: Any, series: Any, named: Any, touches: Any, names: Any) -> dict[str, float]:
    began = time.process_time()
    classifier.fit(series, named)
    spent = time.process_time() - began
    classifier.predict(touches)
    harmonic, accuracy, earliness = classifier.compute_harmonic_mean(classifier.get_state_info(), names)
    felt = float(earliness) * touches.shape[2] / RATE
    return {"harmonic": float(harmonic), "accuracy": float(accuracy), "seconds": felt, "fit_seconds": spent}


def _write(data: Path, file: Path) -> None:
    recordings = biotac_slide.load(data, "biotac")
    touches = np.stack([stream.readings.T[:, : MOMENTS[-1]] for stream in recordings.streams])
    np.savez_compressed(file, touches=touches, names=np.array(recordings.materials), fold=np.asarray(recordings.fold))


def _measure(file: Path, folds: list[int]) -> list[dict[str, Any]]:
    from aeon.classification.convolution_based import MiniRocketClassifier
    from aeon.classification.early_classification import TEASER, ProbabilityThresholdEarlyClassifier

    with np.load(file) as found:
        touches, names, fold = found["touches"].astype(np.float64), found["names"], found["fold"]
    makes: dict[str, Callable[[], Any]] = {
        "aeon: TEASER": lambda: TEASER(
            MiniRocketClassifier(random_state=0), classification_points=[*MOMENTS], random_state=0
        ),
        f"aeon: p ≥ {THRESHOLD} twice running": lambda: ProbabilityThresholdEarlyClassifier(
            MiniRocketClassifier(random_state=0), THRESHOLD, 2, [*MOMENTS], random_state=0
        ),
    }
    records = []
    for number in folds:
        train = fold != number
        for system, make in makes.items():
            figures = _measured(make(), touches[train], names[train], touches[~train], names[~train])
            records.append({"system": system, "fold": number, **figures})
            print(records[-1], flush=True)
    return records


def _means(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    systems = dict.fromkeys(record["system"] for record in records)
    of = {system: [record for record in records if record["system"] == system] for system in systems}
    keys = ("harmonic", "accuracy", "seconds", "fit_seconds")
    return [
        {"system": system, "folds": len(found)} | {key: float(np.mean([each[key] for each in found])) for key in keys}
        for system, found in of.items()
    ]


def _main() -> None:
    parser = argparse.ArgumentParser(description="Measure aeon's early classifiers on BioTac-20.")
    parser.add_argument("file", type=Path, help="The touches, an .npz file.")
    parser.add_argument("--data", type=Path, help="Folder of biotac_slide_20_50: write its touches, and do no more.")
    parser.add_argument("--folds", default="0", help="Which to test, with commas.")
    parser.add_argument("--json", type=Path, help="Write the result to this file.")
    options = parser.parse_args()
    if options.data is not None:
        _write(options.data, options.file)
        return
    records = _measure(options.file, [*map(int, options.folds.split(","))])
    packages = {name: version(name) for name in ("aeon", "numpy", "scikit-learn")}
    result = {
        "command": f"python -m examples.benchmarks.aeon_early FILE --folds {options.folds}",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": 0,
        "versions": {"scroll-tactile": __version__, **packages},
        "moments": MOMENTS,
        "records": records,
        "means": _means(records),
    }
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    _main()
