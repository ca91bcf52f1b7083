"""`schedules`: no order of learning makes a difference."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from examples.paper.commands.options import Seed
from examples.paper.readers.biotac_slide import load
from examples.paper.studies.schedules import Trial, try_schedules
from scroll_tactile.cli.terminal import console, progress_bar, say
from scroll_tactile.errors import InputError
from scroll_tactile.pipelines.classification import Labelled
from scroll_tactile.sensors import Sensor, read_sensor
from scroll_tactile.simulation.scene import Scene

__all__ = ["schedules"]


def schedules(
    data: Annotated[
        Path | None, typer.Option(help="Folder of biotac_slide_20_50, for real touches; simulated ones otherwise.")
    ] = None,
    sensor: Annotated[str, typer.Option(help="biotac or roboskin; simulated also contactile, or a JSON file.")] = (
        "biotac"
    ),
    count: Annotated[int, typer.Option(min=1, help="How many schedules to try.")] = 20,
    seed: Seed = 0,
    touches: Annotated[int, typer.Option(min=1, help="Touches of each material.")] = 6,
    materials: Annotated[int, typer.Option(min=2, max=20, help="How many of the twenty materials.")] = 20,
    features: Annotated[int, typer.Option(hidden=True, min=64)] = 1008,
) -> None:
    """Prove that no schedule matters: the same touches give the same memory, to the bit.

    Tries random orders, cut into batches, with the memory closed and opened again here and there, and split over two
    learners whose statistics are added. All must have one digest and give the same predictions.
    """
    chosen = read_sensor(sensor)
    train, test = _touches(data, chosen, touches, materials, seed)
    done: list[Trial] = []
    with progress_bar() as progress:

        def report(trial: Trial) -> None:
            done.append(trial)
            progress("schedules", len(done), count)

        trials = try_schedules(chosen, train, test, count=count, seed=seed, features=features, report=report)
    _show(trials, len(train), len(test), "simulated" if data is None else "real")


def _touches(
    data: Path | None, sensor: Sensor, touches: int, materials: int, seed: int
) -> tuple[list[Labelled], list[Labelled]]:
    """What is learned, and one touch of each material to be tested."""
    if data is None:
        scene = Scene(sensor, seed)
        names = scene.materials[:materials]
        train = [(name, scene.touch(name, i)) for name in names for i in range(touches)]
        return train, [(name, scene.touch(name, touches)) for name in names]
    name = sensor.name
    if name not in ("biotac", "roboskin"):
        raise InputError(f"expected --sensor biotac or roboskin for the data in {data}; came {name!r}")
    recordings = load(data, "biotac" if name == "biotac" else "roboskin")
    by_material: dict[str, list[Labelled]] = {}
    for material, stream in zip(recordings.materials, recordings.streams, strict=True):
        by_material.setdefault(material, []).append((material, stream))
    groups = list(by_material.values())[:materials]
    if touches >= min(map(len, groups)):
        raise InputError(f"expected fewer touches than there are of each material, 50; came {touches}")
    return [touch for group in groups for touch in group[:touches]], [group[touches] for group in groups]


def _show(trials: Sequence[Trial], touches: int, tested: int, kind: str) -> None:
    table = Table("schedule", "batches", "reopened", "second learner", "digest", "predictions")
    for i, trial in enumerate(trials):
        table.add_row(
            "plain" if i == 0 else str(i),
            str(trial.batches),
            str(trial.reopened),
            str(trial.split),
            trial.digest[:10],
            "same" if trial.same_predictions else "[red]differ[/]",
        )
    console().print(table)
    digests = {trial.digest for trial in trials}
    same = all(trial.same_predictions for trial in trials)
    say(
        f"{len(trials)} schedules of {touches} {kind} touches: {len(digests)} digest{'s' * (len(digests) > 1)}, "
        f"predictions for {tested} others {'the same to the bit' if same else 'differ'}"
    )
    if len(digests) > 1 or not same:
        raise InputError("schedules made a difference: please report this as a bug, with the seed")
