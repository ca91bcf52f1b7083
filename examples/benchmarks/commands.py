"""`scroll-tactile bench`: speed beside error."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from examples.benchmarks.buffer_study import run_buffers
from examples.benchmarks.frontier import measure_frontier
from examples.benchmarks.interleaved import run_interleaved
from examples.benchmarks.numerics.comparison import find_nist, run_numerics
from examples.benchmarks.numerics.plots_numerics import draw_numerics
from examples.benchmarks.numerics.show_numerics import show_numerics
from examples.benchmarks.plots_frontier import draw_frontier
from examples.benchmarks.show_speed import show_speed
from examples.benchmarks.speed import run_speed
from examples.benchmarks.timing import circumstances
from examples.benchmarks.vision_speed import run_vision
from examples.paper.commands.sets import Dataset, read, require_folders
from examples.paper.tables.tables import made_from_results
from scroll_tactile.cli.terminal import Commands, console, percent, progress_bar, say, write_json
from scroll_tactile.embeddings import Kernels
from scroll_tactile.errors import InputError

__all__ = ["bench"]

bench = typer.Typer(cls=Commands, no_args_is_help=True, help="Measure speed beside error, side by side in one run.")


@bench.command()
def speed(
    observations: Annotated[int, typer.Option(min=1000, help="Size of the large memory.")] = 100_000,
    rounds: Annotated[int, typer.Option(min=5, help="How often each is timed; the least counts.")] = 50,
    data: Annotated[
        Path | None, typer.Option(help="BioTac_slide_20_50: also error against time on both recorded sets. Minutes.")
    ] = None,
    quick: Annotated[bool, typer.Option(help="Of the recorded sets one fold and two widths.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated touches, and of the peers.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the result to this file.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw error against time into this file; needs --data.")] = None,
) -> None:
    """Time a prediction, an update, λ and a large memory beside what they are to be compared with.

    With --data, also the frontier: width of the embedding, readout and length of a touch, and other libraries'
    learners on the same features. Filling the large memory takes a few minutes; 10000 observations take twenty seconds.
    """
    require_folders(json, plot)
    if plot is not None and data is None:
        raise InputError("expected --data with --plot: what is drawn is measured on recorded touches")
    with progress_bar() as progress:
        result = run_speed(seed=seed, observations=observations, rounds=rounds, note=lambda what: progress(what, 0, 1))
        if data is not None:
            sets = [read(dataset, data, seed) for dataset in (Dataset.BIOTAC, Dataset.ROBOSKIN)]
            result |= measure_frontier(sets, seed=seed, quick=quick, note=lambda what: progress(what, 0, 1))
    show_speed(result)
    if plot is not None:
        draw_frontier(plot, result["frontier"], result["peers"], default=result["knee"]["default"])
        say(f"drawn to {plot}")
    if json is not None:
        write_json(json, result)
        say(f"written to {json}")


@bench.command()
def vision(
    weights: Annotated[
        Path | None, typer.Option(help="A .safetensors or .pth file; random weights cost the same.")
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="BioTac_slide_20_50: also the accuracy of each runtime on RoboSkin. Minutes.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated touches and the random weights.")] = 0,
    quick: Annotated[bool, typer.Option(help="A few rounds: for a look, not for a report.")] = False,
    json: Annotated[Path | None, typer.Option(help="Write the result to this file.")] = None,
) -> None:
    """Time the vision embedding beside a bare forward pass of its network, in each runtime that is installed."""
    with progress_bar() as progress:
        result = run_vision(
            weights=weights, data=data, seed=seed, rounds=5 if quick else 30, note=lambda what: progress(what, 0, 1)
        )
    table = Table("what", "image", "ms", "median", "ratio", "to one thread", "error of features")
    for record in result["records"]:
        error = record["relative_error"]
        table.add_row(
            record["case"],
            record["image"],
            f"{record['milliseconds']:.2f}",
            f"{record['median_milliseconds']:.2f}",
            f"{record['ratio']:.2f}",
            f"{record['ratio_to_one_thread']:.2f}",
            "" if error is None else f"{error:.1e}",
        )
    console().print(table)
    for name, share in result["accuracy"].items():
        say(f"RoboSkin-20, fold 0, {name}: {percent(share)}")
    if json is not None:
        write_json(json, result)
        say(f"written to {json}")


@bench.command()
def buffers(
    dataset: Annotated[Dataset, typer.Argument(help="Which recordings.", show_default=False)],
    data: Annotated[Path, typer.Option(help="Folder of biotac_slide_20_50, or the one it lies in.")],
    seed: Annotated[int, typer.Option(min=0, help="Draws the orders, the random buffer and BioTac's folds.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the result to this file.")] = None,
) -> None:
    """Compare ways of choosing exemplars: gap to the class means, overlap of two schedules, accuracy of f*."""
    with progress_bar() as progress:
        recordings = read(dataset, data, seed)
        result = run_buffers(recordings, Kernels(), seed=seed, note=lambda what: progress(what, 0, 1))
    table = Table("exemplars", "way", "gap to full herding's", "overlap", "f*", "f", title=f"{recordings.name}, fold 0")
    for record in result["records"]:
        shares = [percent(record[name]) for name in ("overlap", "tuned", "f")]
        table.add_row(str(record["capacity"]), record["way"], f"{record['ratio']:.3f}", *shares)
    console().print(table)
    if json is not None:
        write_json(json, result)
        say(f"written to {json}")


@bench.command()
def interleaved(
    streams: Annotated[int, typer.Option(min=100, help="Learned before anything is timed.")] = 2000,
    pairs: Annotated[int, typer.Option(min=10, help="Of an observation and a prediction, timed.")] = 300,
    interleavings: Annotated[int, typer.Option(min=100, help="Of the run that shows that nothing drifts.")] = 100_000,
    seed: Annotated[int, typer.Option(min=0, help="Draws the streams.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the result to this file.")] = None,
) -> None:
    """Time observing and asking in turns, 50 materials and 512 features, beside other learners."""
    with progress_bar() as progress:
        result = run_interleaved(
            streams=streams,
            pairs=pairs,
            interleavings=interleavings,
            seed=seed,
            note=lambda what: progress(what, 0, 1),
        )
    table = Table("learner", "ms a pair", "times ours", "wrong", title=f"{streams} streams, 50 materials, 512 features")
    for record in result["records"]:
        if not record["measured"]:
            table.add_row(record["learner"], "", "", f"not measured: {record['why']}")
            continue
        table.add_row(
            record["learner"],
            f"{record['milliseconds']:.2f}",
            f"{record['times_ours']:.1f}",
            percent(record["wrong"]),
        )
    console().print(table)
    drift = result["drift"]
    say(
        f"after {drift['interleavings']} interleavings the weights differ from those solved anew by "
        f"{drift['largest_relative_difference']:.0e} at most; by the paper's recursion {drift['of_the_recursion']:.0e}"
    )
    if json is not None:
        write_json(json, result)
        say(f"written to {json}")


@bench.command()
def tables(
    readme: Annotated[Path, typer.Option(help="The text whose tables are made.")] = Path("README.md"),
    results: Annotated[Path, typer.Option(help="The folder of results.")] = Path("examples/paper/results"),
    check: Annotated[bool, typer.Option(help="Write nothing; fail where a table is not as the results say.")] = False,
) -> None:
    """Make the README's tables from the files of results, between the marks <!-- name --> and <!-- /name -->."""
    try:
        text = readme.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{readme} cannot be read: {error.strerror}") from error
    made = made_from_results(text, results)
    if made == text:
        say(f"{readme} is as {results} says")
        return
    if check:
        raise InputError(f"{readme} is not as {results} says: make its tables with scroll-tactile bench tables")
    readme.write_text(made, encoding="utf-8")
    say(f"written to {readme}")


@bench.command()
def numerics(
    json: Annotated[Path | None, typer.Option(help="Write the result to this file.")] = None,
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
    """Compare the exact form with RLS, QR and plain sums on hard cases: errors in weights against the truth, and time.

    The whole takes some minutes.
    """
    require_folders(json, plot)
    with progress_bar() as progress:
        result = run_numerics(seed=seed, quick=quick, data=data, nist=nist or find_nist(data), progress=progress)
    show_numerics(result)
    if plot is not None:
        draw_numerics(plot, result["records"], title=f"Speed against error, seed {seed}{', quick' * quick}")
        say(f"drawn to {plot}")
    if json is not None:
        options = f"{' --quick' * quick}{f' --data {data}' if data else ''} --seed {seed}"
        write_json(json, {"command": f"scroll-tactile bench numerics{options}", **circumstances(seed), **result})
        say(f"written to {json}")
