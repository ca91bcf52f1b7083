"""`python -m examples.benchmarks`: speed beside error, side by side in one run."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer
from rich.table import Table

from examples.benchmarks.appending import run_appending, show_appending
from examples.benchmarks.buffers import run_buffers
from examples.benchmarks.fleet import run_fleet
from examples.benchmarks.interleaved import run_interleaved
from examples.benchmarks.live_decision import run_decisions, show_decisions
from examples.benchmarks.live_shift import run_shifts, show_shifts
from examples.benchmarks.node_latency import run_node, show_node
from examples.benchmarks.show_speed import show_interleaved, show_speed, show_vision
from examples.benchmarks.speed import Sizes, run_speed
from examples.benchmarks.timing import circumstances
from examples.benchmarks.vision_speed import run_vision
from examples.paper.commands.sets import Dataset, parse_folds, read, require_folders, write_result
from scroll_tactile import Kernels
from scroll_tactile.cli.terminal import Commands, console, percent, progress_bar, say
from scroll_tactile.libraries import missing

__all__ = ["app"]

app = typer.Typer(cls=Commands, no_args_is_help=True, help="Measure speed beside error, side by side in one run.")

Json = Annotated[Path | None, typer.Option(help="Write the result to this file.")]


def _written(context: typer.Context, path: Path | None, result: Mapping[str, Any]) -> None:
    """Write a result, with the command that makes it and what else ran meanwhile, where a file was asked for."""
    if path is None:
        return
    load = [round(load, 2) for load in os.getloadavg()] if hasattr(os, "getloadavg") else None
    write_result(path, {"command": _command(context), **result, "load_average_after": load})


def _command(context: typer.Context) -> str:
    """The command that is being run, with what was given to it; a path, which is of one machine, by its name."""
    words = [f"python -m examples.benchmarks {context.info_name}"]
    for parameter in context.command.params:
        name = str(parameter.name)
        source = context.get_parameter_source(name)
        if source is None or source.name == "DEFAULT" or name in ("json", "plot"):
            continue
        value = context.params[name]
        said = name.upper() if isinstance(value, Path) else str(getattr(value, "value", value))
        if parameter.param_type_name == "argument":
            words.append(said)
        else:
            words.append(f"--{name}" if value is True else f"--{name} {said}")
    return " ".join(words)


@app.command()
def speed(
    context: typer.Context,
    data: Annotated[
        Path | None, typer.Option(help="Folder of biotac_slide_20_50, or the one it lies in; else simulated touches.")
    ] = None,
    before: Annotated[
        Path | None, typer.Option(help="An older checkout of the project: the same calls, in turns, and their ratios.")
    ] = None,
    touches: Annotated[int, typer.Option(min=40, help="Of the everyday memory.")] = Sizes.touches,
    pairs: Annotated[int, typer.Option(min=2, help="Of an observation and a prediction.")] = Sizes.pairs,
    materials: Annotated[int, typer.Option(min=20, help="Of the large memory.")] = Sizes.materials,
    opening: Annotated[
        int, typer.Option(min=100, help="Touches of the largest memory opened: 1000000 take an hour.")
    ] = 100_000,
    seed: Annotated[int, typer.Option(min=0, help="Seed of simulated touches and of the order of recorded ones.")] = 0,
    json: Json = None,
) -> None:
    """Time a user's calls and measure what a memory takes, by the public interface alone.

    The whole takes half an hour or so, and with an older checkout more.
    """
    require_folders(json)
    opened = tuple(number for number in (10_000, 100_000) if number < opening)
    sizes = Sizes(touches=touches, pairs=pairs, materials=materials, opening=(*opened, opening))
    sizes = replace(sizes, before_materials=min(sizes.before_materials, materials))
    with progress_bar() as progress:
        result = run_speed(seed=seed, data=data, before=before, sizes=sizes, note=lambda what: progress(what, 0, 1))
    show_speed(result)
    _written(context, json, result)


@app.command()
def live(
    context: typer.Context,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder of biotac_slide_20_50, or the one it lies in: also shifts of its touches."),
    ] = None,
    hours: Annotated[float, typer.Option(min=0.01, help="How long each shift is.")] = 1.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the shifts, and of BioTac's folds.")] = 0,
    json: Json = None,
) -> None:
    """Send shifts of simulated and of recorded touches through a live session, reading by reading."""
    require_folders(json)
    with progress_bar() as progress:
        result = run_shifts(data, seconds=3600 * hours, seed=seed, note=lambda what: progress(what, 0, 1))
    show_shifts(result["shifts"])
    _written(context, json, result)


@app.command()
def decisions(
    context: typer.Context,
    data: Annotated[Path, typer.Option(help="Folder of biotac_slide_20_50, or the one it lies in.")],
    dataset: Annotated[list[Dataset] | None, typer.Option(help="One or more; all three unless given.")] = None,
    folds: Annotated[str, typer.Option(help="Which to test, with commas, or all.")] = "all",
    every: Annotated[int, typer.Option(min=1, help="Test one in so many of a fold's touches.")] = 1,
    folder: Annotated[Path | None, typer.Option(help="Keep finished folds here; the same again resumes.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of BioTac's folds.")] = 0,
    json: Json = None,
) -> None:
    """Measure early answers, touches of one thing together, and sets with a guarantee, on recorded sets.

    A fold takes half a minute, and as long again for every fifty touches.
    """
    require_folders(json)
    results = []
    with progress_bar() as progress:
        for name in dataset or [Dataset.BIOTAC, Dataset.ROBOSKIN, Dataset.UNMIXED]:
            recordings = read(name, data, seed)
            chosen = parse_folds(folds, recordings)
            results.append(run_decisions(recordings, chosen, every=every, folder=folder, progress=progress))
    show_decisions(results)
    _written(context, json, {"bench": "decisions", **circumstances(seed), "sets": results})


@app.command()
def ros2(
    context: typer.Context,
    seconds: Annotated[float, typer.Option(min=10.0, help="How long readings are sent.")] = 60.0,
    json: Json = None,
) -> None:
    """Send BioTac's readings at 100 Hz from another process to the ROS 2 node."""
    require_folders(json)
    with progress_bar() as progress:
        result = run_node(seconds, note=lambda what: progress(what, 0, 1))
    show_node(result)
    _written(context, json, result)


@app.command()
def vision(
    context: typer.Context,
    weights: Annotated[
        Path | None, typer.Option(help="A .safetensors or .pth file; random weights cost the same.")
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="BioTac_slide_20_50: also the accuracy of each runtime on RoboSkin. Minutes.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated touches and the random weights.")] = 0,
    quick: Annotated[bool, typer.Option(help="A few rounds: for a look, not for a report.")] = False,
    json: Json = None,
) -> None:
    """Time the vision embedding beside a bare forward pass of its network, in each runtime that is installed."""
    require_folders(json)
    with progress_bar() as progress:
        result = run_vision(
            weights=weights, data=data, seed=seed, rounds=5 if quick else 30, note=lambda what: progress(what, 0, 1)
        )
    show_vision(result)
    _written(context, json, result)


@app.command()
def buffers(
    context: typer.Context,
    dataset: Annotated[Dataset, typer.Argument(help="Which recordings.", show_default=False)],
    data: Annotated[Path, typer.Option(help="Folder of biotac_slide_20_50, or the one it lies in.")],
    seed: Annotated[int, typer.Option(min=0, help="Draws the orders, the random buffer and BioTac's folds.")] = 0,
    json: Json = None,
) -> None:
    """Compare ways of choosing exemplars: gap to the class means, overlap of two schedules, accuracy of f*."""
    require_folders(json)
    with progress_bar() as progress:
        recordings = read(dataset, data, seed)
        result = run_buffers(recordings, Kernels(), seed=seed, note=lambda what: progress(what, 0, 1))
    table = Table("exemplars", "way", "gap to full herding's", "overlap", "f*", "f", title=f"{recordings.name}, fold 0")
    for record in result["records"]:
        shares = [percent(record[name]) for name in ("overlap", "tuned", "f")]
        table.add_row(str(record["capacity"]), record["way"], f"{record['ratio']:.3f}", *shares)
    console().print(table)
    _written(context, json, result)


@app.command()
def interleaved(
    context: typer.Context,
    streams: Annotated[int, typer.Option(min=100, help="Learned before anything is timed.")] = 2000,
    pairs: Annotated[int, typer.Option(min=10, help="Of an observation and a prediction, timed.")] = 300,
    seed: Annotated[int, typer.Option(min=0, help="Draws the streams.")] = 0,
    json: Json = None,
) -> None:
    """Time observing and predicting in turns, 50 materials and 512 features, beside other learners."""
    require_folders(json)
    with progress_bar() as progress:
        result = run_interleaved(
            streams=streams,
            pairs=pairs,
            seed=seed,
            note=lambda what: progress(what, 0, 1),
        )
    show_interleaved(result)
    _written(context, json, result)


@app.command()
def log(
    context: typer.Context,
    rounds: Annotated[int, typer.Option(min=1, help="Of 240 rows, each way in its turn.")] = 40,
    folder: Annotated[Path | None, typer.Option(help="On the disk to measure; the system's temporary one.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Draws the rows.")] = 0,
    json: Json = None,
) -> None:
    """Time a durable row of 4.3 kB, and count the bytes it makes the disk write: the log beside a table of SQLite."""
    require_folders(json)
    with progress_bar() as progress, TemporaryDirectory(dir=folder) as scratch:
        result = run_appending(Path(scratch), rounds=rounds, seed=seed, note=lambda what: progress(what, 0, 1))
    show_appending(result)
    _written(context, json, result)


@app.command()
def fleet(
    context: typer.Context,
    touches: Annotated[int, typer.Option(min=20, help="Recordings, simulated, learned three times.")] = 2000,
    runs: Annotated[int, typer.Option(min=1, help="With workers that die and touches that come twice.")] = 200,
    flips: Annotated[int, typer.Option(min=1, help="Of one bit of a packed memory.")] = 500,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated touches.")] = 0,
    json: Json = None,
) -> None:
    """Measure a fleet's memory: workers against a plain loop, merges by size, and what can go wrong."""
    require_folders(json)
    with progress_bar() as progress:
        result = run_fleet(touches, runs, flips, seed, note=lambda what: progress(what, 0, 1))
    for name in ("plain", "workers_1", "workers_2"):
        for what, value in result[name].items():
            say(f"{name}, {what}: {value:.4g}".replace("_", " "))
    for merge in result["merges"]:
        say(f"{merge['touches']} touches, {merge['bytes']} bytes: merged in {merge['seconds']:.3f} s")
    sound = sum(result["sound_flips"].values())
    say(f"equal: {result['equal_runs']} of {result['runs']} runs; sound: {sound} of {flips} flips")
    _written(context, json, result)


@app.command()
def numerics(
    context: typer.Context,
    json: Json = None,
    plot: Annotated[Path | None, typer.Option(help="Draw speed against error into this file.")] = None,
    quick: Annotated[bool, typer.Option(help="Every case and method, small: under a minute.")] = False,
    data: Annotated[
        Path | None, typer.Option(help="Folder with biotac_slide_20_50: also cases of real features.")
    ] = None,
    nist: Annotated[
        Path | None, typer.Option(help="NIST's linear regressions, nist_strd.json; looked for with the data.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the made-up cases, batches and schedules.")] = 0,
) -> None:
    """Compare exact sums with RLS, QR and plain ones on hard cases: errors in weights against the truth, and time.

    The whole takes ten minutes or so.
    """
    require_folders(json, plot)
    if find_spec("flint") is None:
        raise missing("python-flint", "bench", "the comparison with exact sums")
    from examples.benchmarks.numerics.comparison import find_nist, run_numerics
    from examples.benchmarks.numerics.plots_numerics import draw_numerics
    from examples.benchmarks.numerics.show_numerics import show_numerics

    with progress_bar() as progress:
        result = run_numerics(seed=seed, quick=quick, data=data, nist=nist or find_nist(data), progress=progress)
    show_numerics(result)
    if plot is not None:
        draw_numerics(plot, result["records"], title=f"Speed against error, seed {seed}{', quick' * quick}")
        say(f"drawn to {plot}")
    _written(context, json, result)


if __name__ == "__main__":
    app(prog_name="python -m examples.benchmarks")
