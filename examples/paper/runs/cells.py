"""Studies of many cells, each a system on a fold of a data set: finished ones are written down, and not done again."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from examples.paper.readers.labelled import Recordings
from examples.paper.runs.runfile import RunFile
from scroll_tactile.clients.learning.metrics import Labelled, mean_and_spread
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.learner import TactileLearner
from scroll_tactile.signals.stream import Stream

__all__ = [
    "Cell",
    "Split",
    "data_digest",
    "held_back",
    "learn",
    "mean_curve",
    "over_folds",
    "pooled",
    "require_folds",
    "run_cells",
    "silent",
    "split",
]

Figures = dict[str, Any]


def silent(what: str, done: int, of: int) -> None:
    """Progress that is reported to nobody."""


@dataclass(frozen=True)
class Cell:
    """One thing to be measured: a system, by its key, on one fold of a data set."""

    dataset: str
    fold: int
    system: str

    @property
    def key(self) -> str:
        """What its figures are noted under."""
        return f"{self.dataset}, fold {self.fold}, {self.system}"


@dataclass(frozen=True)
class Split:
    """The touches of one fold: N to learn, and their materials; some to choose settings on; and those of the test.

    touch: of each touch of the test which recording it belongs to: frames of one video share it.
    """

    streams: list[Stream]
    materials: list[str]
    validation: list[Labelled]
    test: list[Labelled]
    touch: list[int]

    @property
    def test_streams(self) -> list[Stream]:
        """The streams of the test."""
        return [stream for _, stream in self.test]

    @property
    def truth(self) -> list[str]:
        """The materials of the test."""
        return [name for name, _ in self.test]


def split(recordings: Recordings, fold: int, seed: int, *, every: int = 1, share: float = 0.1) -> Split:
    """Split a data set for one fold: what is not tested is learned, but for a tenth of each material's recordings.

    seed: draws the validation. every: learn every so many recordings only. share: of the recordings of a material
    that go to the validation, at least one where there are three.

    Raises InputError for a fold that is not there, or one with materials that are missing from the other folds.
    """
    there = sorted(set(recordings.fold.tolist()))
    if fold not in there:
        raise InputError(f"expected a fold of {recordings.name} out of {there}; came {fold}")
    tested = recordings.fold == fold
    materials = np.array(recordings.materials)
    unknown = sorted(set(materials[tested].tolist()) - set(materials[~tested].tolist()))
    if unknown:
        raise InputError(
            f"expected all materials of fold {fold} of {recordings.name} in its other folds too; {unknown[:5]} are "
            "tested and never trained on. Deal the folds within each material"
        )
    # Frames of a video must not be parted; a number of a touch may stand for one in each fold.
    marks = zip(recordings.materials, recordings.fold.tolist(), recordings.repetition.tolist(), strict=True)
    groups = np.unique(["/".join(map(str, mark)) for mark in marks], return_inverse=True)[1]
    random = np.random.default_rng([seed, fold])
    held: set[int] = set()
    left_out: set[int] = set()
    for name in sorted(set(recordings.materials)):
        own = random.permutation(np.unique(groups[(materials == name) & ~tested]))
        left_out.update(own[np.arange(len(own)) % every != 0].tolist())
        own = own[::every]
        held.update(own[: held_back(len(own), share)].tolist())
    pick = [i for i in np.flatnonzero(~tested) if groups[i] not in held | left_out]
    validation = [i for i in np.flatnonzero(~tested) if groups[i] in held]
    test = np.flatnonzero(tested)
    labelled = list(zip(recordings.materials, recordings.streams, strict=True))
    return Split(
        streams=[recordings.streams[i] for i in pick],
        materials=[recordings.materials[i] for i in pick],
        validation=[labelled[i] for i in validation],
        test=[labelled[i] for i in test],
        touch=groups[test].tolist(),
    )


def held_back(count: int, share: float = 0.1) -> int:
    """How many of so many recordings of a material go to the validation: at least one where there are three."""
    return max(int(count >= 3), round(share * count))


def run_cells(
    folder: Path | None,
    plan: Mapping[str, Any],
    sets: Sequence[Recordings],
    cells: Sequence[Cell],
    measure: Callable[[Cell, Progress], Figures],
    progress: Progress = silent,
    also: Mapping[str, Any] = MappingProxyType({}),
) -> Iterator[tuple[Cell, Figures]]:
    """The figures of each cell in turn: read back where it was finished, else measured and noted at once.

    folder: of the notes, or None. plan: all that each figure depends on beside the data, in JSON's types; its "run"
    names the file. sets: of the data. also: what else cells depend on, by name, where more can be added later.
    progress: receives the cells done, the time left, and what the cell in hand is doing. A run that is killed loses
    the cell in hand.

    Raises InputError for a folder of another run or of other data, and what `measure` raises.
    """
    notes = RunFile(None if folder is None else folder / f"{plan['run'].replace(' ', '-')}.json", plan)
    for name, mark in (
        {f"recordings or folds of {item.name}": data_digest(item) for item in sets} | dict(also)
    ).items():
        _require_same(notes, name, json.loads(json.dumps(mark)))
    for number, cell in enumerate(cells):
        if cell.key not in notes.notes:
            done = {other: notes.notes[other.key]["seconds"] for other in cells if other.key in notes.notes}
            ahead = f"{number + 1}/{len(cells)}{time_left(done, cells[number:])}: {cell.key}"

            def report(what: str, i: int, of: int, ahead: str = ahead) -> None:
                progress(f"{ahead}: {what}", i, of)

            report("starting", 0, 1)
            begun = time.perf_counter()
            figures = measure(cell, report)
            notes.note(cell.key, figures | {"seconds": time.perf_counter() - begun})
        yield cell, notes.notes[cell.key]


def time_left(seconds: Mapping[Cell, float], ahead: Sequence[Cell]) -> str:
    """In words, how long cells will take, by what the same system took on the same set, else elsewhere, else any.

    Empty before anything was measured.
    """
    if not seconds:
        return ""
    total = 0.0
    for cell in ahead:
        if cell in seconds:
            continue
        same = [s for other, s in seconds.items() if other.system == cell.system]
        near = [s for other, s in seconds.items() if (other.system, other.dataset) == (cell.system, cell.dataset)]
        total += float(np.mean(near or same or [*seconds.values()]))
    return f", about {total / 60:.0f} min left" if total >= 90 else f", about {total:.0f} s left"


def learn(
    learner: TactileLearner, touches: Sequence[Labelled], progress: Progress = silent, what: str = "learning"
) -> TactileLearner:
    """The learner, when it has observed these touches."""
    for done, (material, stream) in enumerate(touches, start=1):
        learner.observe(material, stream)
        progress(what, done, len(touches))
    return learner


def data_digest(recordings: Recordings) -> str:
    """16 hex digits of a hash over all streams, materials and folds."""
    digest = blake2b(digest_size=8)
    for stream, material, fold in zip(recordings.streams, recordings.materials, recordings.fold.tolist(), strict=True):
        digest.update(stream.key + f"{material}\n{fold}\n".encode())
    return digest.hexdigest()


def require_folds(fold: npt.NDArray[np.intp], folds: Sequence[int]) -> None:
    """Raise InputError for folds that are not there, and for none. fold: of each touch."""
    there = sorted(set(fold.tolist()))
    if not folds or set(folds) - set(there):
        raise InputError(f"expected folds out of {there}; came {list(folds)}")


def _require_same(notes: RunFile, name: str, mark: Any) -> None:
    if notes.notes.setdefault(name, mark) != mark:
        raise InputError(
            f"the run in {notes.path} was begun with other {name} ({notes.notes[name]} there, {mark} here). Give the "
            "same, or take another folder"
        )


def over_folds(values: Sequence[float], weights: Sequence[float] | None = None) -> dict[str, Any]:
    """Over folds: "mean", weighted by their sizes, "sd", the standard deviation, None of one fold, and "folds"."""
    sd = mean_and_spread(values)[1] if len(values) > 1 else None
    return {"mean": float(np.average(values, weights=weights)), "sd": sd, "folds": len(values)}


def mean_curve(folds: Iterable[Iterable[tuple[int, float]]]) -> list[list[Any]]:
    """[place, mean, standard deviation] at each place of some folds' curves, which are (place, share) at the same."""
    columns = zip(*folds, strict=True)
    found = [(column[0][0], over_folds([share for _, share in column])) for column in columns]
    return [[place, figure["mean"], figure["sd"]] for place, figure in found]


def pooled(cells: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Right answers by all that were asked for, see `over_folds`: folds may differ in size."""
    return over_folds([cell["right"] / cell["tested"] for cell in cells], [cell["tested"] for cell in cells])
