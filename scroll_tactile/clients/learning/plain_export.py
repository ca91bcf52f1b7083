"""All that a memory holds, as plain files that any program reads: CSV, JSON and NumPy's own, without pickles."""

from __future__ import annotations

import copy
import csv
import json
import os
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError, plain_cell
from scroll_tactile.learner import TactileLearner
from scroll_tactile.memory.descriptions import Description, constituents_of
from scroll_tactile.quantities import Quantity
from scroll_tactile.results import Observation
from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["date_of", "export_plain"]

FORMAT = 2


def export_plain(
    learner: TactileLearner,
    folder: str | os.PathLike[str],
    progress: Callable[[str, int, int], object] = lambda what, done, of: None,
) -> None:
    """Write a memory into a new or empty folder; a file that is there is whole.

    - `observations.csv`: sequence, material, key (hash of the stream), time, and what became of it: kept, compacted
      (learned from, features given up), retracted; its source, where it has one; and a column for each quantity, such
      as "force [N] 0..10 step 0.01", and axis, such as "slip [label]". A time out of the calendar's
      years 1 to 9999 is written as seconds since 1970.
    - `statistics.npz`: `materials`; for each scale (a width of windows; 1048576 the whole touch and 1048577 its shape,
      see `signals.image`) of its rows, of which a touch adds one at each stage that the scale judges at (of a camera
      one a frame), `counts-<scale>` int64 (C,), `sums-<scale>` int64 (C, d) and `second-<scale>` Σ x xᵀ, int64 (d, d),
      of features x in units of bound · 2⁻²⁰.
    - `exemplars.csv`: material, rank, key, file; and `exemplars/`, their readings as .npy, (T, n) in the sensor's unit.
    - `descriptions.csv`: material, constituent, present (yes, no, unknown), share by mass where it was given; and
      `properties.csv`: material, property, value, unit. Only where anything was described.
    - In the tables a name, source or heading that a spreadsheet would compute, for it begins with = + - @, has an
      apostrophe in front, also behind a semicolon within (see `errors.plain_cell`).
    - `memory.json`: format 2, sensor, embedding, digest, date, and the number of touches. It is written last.

    The classifier of a scale follows with NumPy alone. With means m_y = sums / counts, N rows and n touches,
    S = second − Σ_y counts_y m_y m_yᵀ, t = tr S and q = Σ S_ij², its shrinkage is

        ρ = ((1 − 2/d) q + t²) / ((n + 1 − 2/d) (q − t² / d)), from 0.0001 to 0.99,

    and lda scores x by N / (1 − ρ) · (m_y K⁻¹ x − m_y K⁻¹ m_y / 2), K = S + ρ / (1 − ρ) · t / d · I (see
    `readouts.readout`). Format 1, of versions before 0.3, had a row for each window and named its number of folds.

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
    with learner._ledger.lock:  # whatever is observed meanwhile, both are of one state
        held, journal = copy.deepcopy(learner), learner.observations()
    progress("observations", 0, 1)
    header, rows = _observed(held.quantities, journal)
    _rows(target / "observations.csv", header, rows)
    if held.descriptions:
        header = ["material", "constituent", "present", "share"]
        _rows(target / "descriptions.csv", header, _described(held.descriptions))
        of = [(name, *pair) for name, told in held.descriptions.items() for pair in told.items()]
        properties = [[material, name, *value] for material, name, value in of if isinstance(value, list)]
        _rows(target / "properties.csv", ["material", "property", "value", "unit"], properties)
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
        "format": FORMAT,
        "touches": held.memory.statistics.touches,
    }
    (target / "memory.json").write_text(json.dumps(about, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def date_of(seconds: float) -> str | float:
    """A moment in seconds since 1970 as ISO 8601, UTC; the number where no calendar has it."""
    try:
        return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds")
    except (OSError, OverflowError, ValueError):
        return seconds


def _observed(quantities: Mapping[str, Quantity], journal: Sequence[Observation]) -> tuple[list[str], list[list[Any]]]:
    """The heading and the rows of the table of observations."""
    axes = sorted({axis for row in journal for axis in row.labels})
    noted = [*map(str, quantities.values()), *(f"{axis} [label]" for axis in axes)]
    return ["sequence", "material", "key", "time", "state", "source", *noted], [
        [
            *(row.sequence, row.material, row.key.hex(), date_of(row.time), row.state, row.source or ""),
            *(row.values.get(name, "") for name in quantities),
            *(row.labels.get(axis, "") for axis in axes),
        ]
        for row in journal
    ]


def _described(descriptions: Mapping[str, Description]) -> list[list[Any]]:
    return [
        [
            *(material, name, "unknown" if value is None else "yes" if value else "no"),
            value if isinstance(value, float) else "",
        ]
        for material, description in descriptions.items()
        for name, value in constituents_of(description).items()
    ]


def _arrays(statistics: Statistics) -> dict[str, npt.NDArray[Any]]:
    names, dimension = sorted(statistics.materials), statistics.dimension
    arrays: dict[str, npt.NDArray[Any]] = {"materials": np.array(names, dtype=np.str_)}
    lower = np.tril_indices(dimension)
    for scale in statistics.scales:
        places = [names.index(name) for name in statistics.names(scale)]
        counts, sums = np.zeros(len(names), np.int64), np.zeros((len(names), dimension), np.int64)
        counts[places], sums[places] = statistics.totals(scale, statistics.names(scale))
        second = np.zeros((dimension, dimension), np.int64)
        second[lower] = statistics.second(scale).packed()
        whole = second + np.tril(second, -1).T
        arrays |= {f"counts-{scale}": counts, f"sums-{scale}": sums, f"second-{scale}": whole}
    return arrays


def _rows(path: Path, header: list[str], rows: list[list[Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows(
            [plain_cell(cell) if isinstance(cell, str) else cell for cell in row] for row in [header, *rows]
        )
