"""What the commands of the robustness studies share: what is asked for, measured and told."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from rich.table import Table

from examples.paper.commands.sets import draw_into, leave_out, named, origin, parse_folds
from examples.paper.plots.plots_robustness import draw_robustness
from examples.paper.runs.study import columns_averaged, weights_digest
from examples.paper.studies.baselines import BASELINES, baseline
from examples.paper.studies.robustness_study import NAMES, PAPER, SITTING, Make, Progress, Robustness, ours, summary
from examples.paper.systems.catalogue import EPOCHAL, NEED_WEIGHTS, Catalogue
from examples.paper.systems.descent import Course, Precision
from examples.paper.systems.trained import require_device
from scroll_tactile.cli.terminal import console, percent, say, write_json
from scroll_tactile.datasets import Recordings
from scroll_tactile.errors import InputError

__all__ = ["ALL", "CHOICES", "OURS", "Asked", "choose", "measure", "tell"]

ALL = "all"
OURS = "ours"
CHOICES = (OURS, *BASELINES)


@dataclass(frozen=True)
class Asked:
    """What a command was asked for, beside the recordings. command: its words that are not options."""

    command: Sequence[str]
    systems: Sequence[str]
    weights: str | None = None
    epochs: int = 100
    device: str = "cpu"
    precision: Precision = "float32"
    folds: str = "all"
    seed: int = 0
    quick: bool = False
    run: Path | None = None
    json: Path | None = None
    plot: Path | None = None

    def words(self) -> str:
        """The command, to be given again."""
        options: dict[str, Any] = {"--systems": ",".join(self.systems), "--folds": self.folds, "--seed": self.seed}
        if any(key in EPOCHAL for key in self.systems):
            options |= {"--epochs": self.epochs, "--device": self.device, "--precision": self.precision}
        options |= {} if self.weights is None else {"--weights": Path(self.weights).name}
        words = [*self.command, "--data", "DATA", *(str(part) for option in options.items() for part in option)]
        return shlex.join([*words, *["--quick"] * self.quick])

    def catalogue(self, recordings: Recordings) -> Catalogue:
        """What the paper's systems are made with."""
        every = columns_averaged(recordings.sensor) if self.quick else 1
        course = Course.in_proportion(self.epochs, self.precision)
        return Catalogue(self.weights, course, self.device, every, self.seed)

    def made(self, recordings: Recordings) -> tuple[dict[str, Make], dict[str, Any]]:
        """The systems by name, and what each depends on."""
        catalogue = self.catalogue(recordings)
        both = {
            key: ours(recordings.sensor) if key == OURS else baseline(key, catalogue, self.seed) for key in self.systems
        }
        needed = {} if self.weights is None else {"weights": weights_digest(self.weights)}
        settings = {key: said | (needed if key in NEED_WEIGHTS else {}) for key, (_, said) in both.items()}
        return {key: make for key, (make, _) in both.items()}, settings


@dataclass
class Found:
    """Means and records over all sets, and what each set's depend on."""

    sets: dict[str, Any] = field(default_factory=dict)
    means: list[dict[str, Any]] = field(default_factory=list)
    records: list[dict[str, Any]] = field(default_factory=list)


def choose(given: str | None, weights: str | None) -> tuple[str, ...]:
    """The systems of --systems; without it all that can be made, and a word on the others.

    Raises InputError for systems that there are not, and those that need weights which are not given.
    """
    if given is None:
        return CHOICES if weights is not None else leave_out(CHOICES, NEED_WEIGHTS, "--weights")
    keys = named("--systems", given, CHOICES)
    if weights is None and (lacking := [key for key in keys if key in NEED_WEIGHTS]):
        raise InputError(f"{', '.join(lacking)} need the weights of a trained ResNet: give --weights")
    return keys


def measure(asked: Asked, sets: Sequence[Recordings], studies: Sequence[str], progress: Progress) -> Found:
    """All figures of these studies on these sets. Raises InputError for folds or a device that are not there."""
    require_device(asked.device)
    found = Found()
    for recordings in sets:
        systems, settings = asked.made(recordings)
        folder = None if asked.run is None else asked.run / recordings.name
        named = _named(studies, recordings)
        task = Robustness(recordings, systems, settings, named, seed=asked.seed, quick=asked.quick, folder=folder)
        chosen = parse_folds(asked.folds, recordings)[: 1 if asked.quick else None]
        about = {"dataset": recordings.name}
        records = [about | record for fold in task.run(chosen, progress) for record in fold]
        sensor = recordings.sensor.model_dump(mode="json")
        found.sets[recordings.name] = {**task.plan, "settings": settings, "sensor": sensor}
        found.records += records
        found.means += [about | row for row in summary(records)]
    return found


def _named(studies: Sequence[str], recordings: Recordings) -> list[str]:
    if list(studies) != [ALL]:
        return list(studies)
    if not recordings.ordered:
        say(f"[yellow]not measured:[/] {SITTING}: {recordings.name} is published without its order of recording")
    return [name for name in NAMES if name != SITTING or recordings.ordered]


def tell(asked: Asked, found: Found) -> None:
    """Show a table of each set, and write the JSON and the pictures."""
    for name in found.sets:
        _show(name, [row for row in found.means if row["dataset"] == name])
    if any(key in EPOCHAL for key in asked.systems):
        say(f"networks: {asked.epochs} epochs, on {asked.device}, ResNets in {asked.precision}")
    if asked.quick:
        say("[yellow]quick:[/] one fold, few strengths; the ResNets' images averaged to about 50 columns")
    if asked.json is not None:
        about = {"seed": asked.seed, "quick": asked.quick, "sets": found.sets}
        write_json(asked.json, origin(asked.words()) | about | {"means": found.means, "records": found.records})
        say(f"figures: {asked.json}")
    if asked.plot is None:
        return
    for name in found.sets:
        # One picture a set: lines of two sensors in one panel cannot be told apart.
        file = asked.plot if len(found.sets) == 1 else asked.plot.with_stem(f"{asked.plot.stem}-{name.lower()}")
        rows = [row for row in found.means if row["dataset"] == name]
        if not draw_into(file, partial(draw_robustness, rows=rows, title=f"{name}, learned from clean touches")):
            return


def _show(dataset: str, rows: Sequence[Mapping[str, Any]]) -> None:
    systems = list(dict.fromkeys((row["system"], row["augmented"]) for row in rows))
    folds = max(row["folds"] for row in rows)
    heads = [f"{system}, augmented" if augmented else system for system, augmented in systems]
    title = f"{dataset}, learned from clean touches, {folds} fold{'s' * (folds > 1)}"
    quoted = any((row["study"], row["strength"]) in PAPER for row in rows)
    table = Table("study", "strength", *heads, *(["paper", "ours − paper"] if quoted else []), title=title)
    cells = {(row["study"], row["strength"], row["system"], row["augmented"]): row for row in rows}
    for study in dict.fromkeys(row["study"] for row in rows):
        for strength in dict.fromkeys(row["strength"] for row in rows if row["study"] == study):
            said = [cells[study, strength, *system] for system in systems]
            shown = [percent(row["mean"]) + (f" ± {100 * row['sd']:.1f}" if row["folds"] > 1 else "") for row in said]
            mine = cells.get((study, strength, OURS, True))
            shown += _beside(dataset, PAPER.get((study, strength), {}), mine) if quoted else []
            table.add_row(study, "" if study == SITTING else f"{strength:g}", *shown)
        table.add_section()
    console().print(table)


def _beside(dataset: str, paper: Mapping[str, float], mine: Mapping[str, Any] | None) -> list[str]:
    """The paper's figure, of this set or, named, of another of the sensor; and the difference where it is this one."""
    sensor = dataset.partition("-")[0]
    for name, share in paper.items():
        if name == dataset:
            return [percent(share), "" if mine is None else f"{100 * (mine['mean'] - share):+.1f}"]
        if name.partition("-")[0] == sensor:
            return [f"{percent(share)} ({name})", ""]
    return ["", ""]
