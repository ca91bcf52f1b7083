"""All that a memory holds, as plain files that any program reads: CSV, JSON and NumPy's own, without pickles."""

from __future__ import annotations

import copy
import csv
import json
import os
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.memory.descriptions import Description
from scroll_tactile.results import Observation
from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.statistics import FOLDS, Statistics

__all__ = ["export_plain"]


def export_plain(
    learner: TactileLearner,
    folder: str | os.PathLike[str],
    progress: Callable[[str, int, int], object] = lambda what, done, of: None,
) -> None:
    """Write a memory into a new or empty folder; a file that is there is whole.

    - `observations.csv`: sequence, material, key (hash of the stream), time, and what became of it: kept, compacted
      (learned from, features given up), retracted. Only where the memory has a path.
    - `statistics.npz`: `materials`; for each scale (a width of windows) `counts-<scale>` int64 (C,), `sums-<scale>`
      int64 (C, d) and `second-<scale>` int64 (d, d), over all folds, of features in units of bound · 2⁻²⁰.
    - `exemplars.csv`: material, rank, key, file; and `exemplars/`, their readings as .npy, (T, n) in the sensor's unit.
    - `descriptions.csv`: material, constituent, present (yes, no, unknown), share by mass where it was given. Only
      where anything was described.
    - `memory.json`: sensor, embedding, digest, date. It is written last.

    Raises InputError for a folder that holds something or cannot be written; StoreError.
    """
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
        if any(target.iterdir()):
            raise InputError(f"{target} holds something already: give a new folder, nothing is written over")
        _write(learner, target, progress)
    except OSError as error:
        raise InputError(f"{error.filename or target} cannot be written: {error.strerror}") from error


def _write(learner: TactileLearner, target: Path, progress: Callable[[str, int, int], object]) -> None:
    held, journal = _one_state(learner)
    if learner.path is not None:
        progress("observations", 0, 1)
        rows = [[row.sequence, row.material, row.key.hex(), _date(row.time), row.state] for row in journal]
        _rows(target / "observations.csv", ["sequence", "material", "key", "time", "state"], rows)
    if held.descriptions:
        header = ["material", "constituent", "present", "share"]
        _rows(target / "descriptions.csv", header, _described(held.descriptions))
    progress("statistics", 0, 1)
    with (target / "statistics.npz").open("wb") as file:
        np.savez(file, allow_pickle=False, **_arrays(held.memory.statistics))
    ranked = held.ranked_exemplars().items()
    exemplars = [(name, rank, exemplar) for name, kept in ranked for rank, exemplar in enumerate(kept)]
    (target / "exemplars").mkdir()
    index: list[list[Any]] = []
    for number, (name, rank, exemplar) in enumerate(exemplars, start=1):
        file_name = f"exemplars/{number:06d}.npy"
        index.append([name, rank, exemplar.key.hex(), file_name])
        np.save(target / file_name, exemplar.readings, allow_pickle=False)
        progress("exemplars", number, len(exemplars))
    _rows(target / "exemplars.csv", ["material", "rank", "key", "file"], index)
    about = {
        "digest": held.digest(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "materials": held.materials,
        "sensor": held.sensor.model_dump(mode="json"),
        "embedding": {name: getattr(held.embedding, name) for name in ("name", "dimension", "bound", "fingerprint")},
        "unit": f"bound / 2**{BITS}",
        "folds": FOLDS,
    }
    (target / "memory.json").write_text(json.dumps(about, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def _one_state(learner: TactileLearner) -> tuple[TactileLearner, list[Observation]]:
    """A snapshot and the journal of the same state, whatever is observed meanwhile."""
    while True:
        held, journal = copy.deepcopy(learner), learner.observations()
        if learner.memory.sequence == held.memory.sequence:
            return held, journal


def _date(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds")


def _described(descriptions: Mapping[str, Description]) -> list[list[Any]]:
    def present(value: float | bool | None) -> str:
        return "unknown" if value is None else "yes" if value else "no"

    return [
        [material, name, present(value), value if isinstance(value, float) else ""]
        for material, description in descriptions.items()
        for name, value in description.items()
    ]


def _arrays(statistics: Statistics) -> dict[str, npt.NDArray[Any]]:
    arrays: dict[str, npt.NDArray[Any]] = {}
    names = sorted(statistics.materials)
    arrays["materials"] = np.array(names, dtype=np.str_)
    lower = np.tril_indices(statistics.dimension)
    for scale in statistics.scales:
        known = sorted({*names} & {*statistics.names(scale)})
        places = [names.index(name) for name in known]
        counts = np.zeros(len(names), np.int64)
        sums = np.zeros((len(names), statistics.dimension), np.int64)
        counts[places] = statistics.counts(scale, known).sum(axis=1)
        sums[places] = statistics.sums(scale, known).sum(axis=1)
        second = np.zeros((statistics.dimension, statistics.dimension), np.int64)
        second[lower] = statistics.total_second(scale)
        arrays |= {f"counts-{scale}": counts, f"sums-{scale}": sums}
        arrays[f"second-{scale}"] = second + np.tril(second, -1).T
    return arrays


def _rows(path: Path, header: list[str], rows: list[list[Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)
