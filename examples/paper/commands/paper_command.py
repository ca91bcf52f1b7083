"""`table1`, `efficiency` and `activation`: the paper's own systems, and ours beside them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table

from examples.paper.commands.options import (
    QUICK_EPOCHS,
    QUICK_SETS,
    SETS,
    Data,
    Device,
    Epochs,
    Folds,
    InPrecision,
    Json,
    OwnEmbeddings,
    OwnSystems,
    Plot,
    PrecisionChoice,
    Quick,
    Run,
    Seed,
    Sets,
    Systems,
    Weights,
    Where,
    choose_folds,
    choose_systems,
    close,
    own_keys,
    read_sets,
    say_conditions,
)
from examples.paper.commands.sets import draw_into, require_folders, with_spread
from examples.paper.plots import draw_activation, draw_efficiency
from examples.paper.runs.study import SystemStudy
from examples.paper.studies.activation_study import ActivationStudy
from examples.paper.studies.efficiency import Efficiency, curves
from examples.paper.studies.table1 import PAPER, Table1, rows, without_losses
from examples.paper.systems.catalogue import SYSTEMS
from scroll_tactile.cli.terminal import console, percent, progress_bar, say
from scroll_tactile.errors import InputError

__all__ = ["activation", "efficiency", "table1"]


CURVES = ("resnet", "resnet-pretrained", "kernels-lda", "vision-lda", "kernels+vision-lda")
EPOCH_COLUMNS = (1, 2, 5, 10, 20)  # of the table of efficiency


def table1(
    data: Data,
    weights: Weights = None,
    sets: Sets = None,
    systems: Systems = None,
    own_systems: OwnSystems = None,
    own_embeddings: OwnEmbeddings = None,
    folds: Folds = None,
    epochs: Epochs = None,
    device: Where = Device.CPU,
    precision: InPrecision = PrecisionChoice.FLOAT32,
    seed: Seed = 0,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
) -> None:
    """Table I: every system on every data set, with the paper's figure beside ours and the difference.

    100 epochs, five folds: hours on a GPU, days without. --systems and --folds take parts of it, --run adds them up.
    """
    require_folders(json)
    keys = choose_systems(systems, tuple(SYSTEMS), weights, own_keys(own_systems, own_embeddings))
    with progress_bar() as progress:
        progress("reading", 0, 1)
        read = read_sets(sets, tuple(SETS), data, seed, quick)
        study = Table1(
            read,
            keys,
            weights,
            epochs or (QUICK_EPOCHS if quick else 100),
            device.value,
            seed,
            quick,
            run,
            precision.value,
        )
        results = list(study.run(choose_folds(folds, read, quick), progress))
    found = rows(results)
    for recordings in read:
        _show_table(recordings.name, found, study)
    if any(item.sensor.camera for item in read):
        say(
            "GelSight frames are those of PhysiCLeAR, split by video: the paper's GelSight-45 is not public, and its "
            "figures stand beside nothing of ours: "
            + "; ".join(f"{SYSTEMS[k]} {percent(p['GelSight-45'])}" for k, p in PAPER.items() if "GelSight-45" in p)
            + ". Ours read frames with Frames: kernels are its counts, vision its network"
        )
    kept = [(cell, without_losses(figures)) for cell, figures in results]
    close(study, kept, json, {"rows": found}, sets, folds)


def efficiency(
    data: Data,
    weights: Weights = None,
    sets: Sets = None,
    systems: Systems = None,
    own_systems: OwnSystems = None,
    own_embeddings: OwnEmbeddings = None,
    folds: Folds = None,
    epochs: Epochs = None,
    device: Where = Device.CPU,
    precision: InPrecision = PrecisionChoice.FLOAT32,
    seed: Seed = 0,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
    plot: Plot = None,
) -> None:
    """Learning efficiency: the test after each of 20 epochs of the ResNets; ours after 1 to 40 touches of a material.

    Of the paper's figure there are curves only, no numbers; its final accuracies are those of table1.
    """
    require_folders(json, plot)
    keys = choose_systems(systems, CURVES, weights, own_keys(own_systems, own_embeddings))
    with progress_bar() as progress:
        progress("reading", 0, 1)
        read = read_sets(sets, QUICK_SETS, data, seed, quick)
        few = epochs or (QUICK_EPOCHS if quick else 20)
        study = Efficiency(read, keys, weights, few, device.value, seed, quick, run, precision.value)
        results = list(study.run(choose_folds(folds, read, quick), progress))
    found = curves(results)
    for recordings in read:
        mine = [curve for curve in found if curve["dataset"] == recordings.name]
        _show_curves(f"{recordings.name}: after so many epochs", [item for item in mine if item["by"] == "epochs"])
        title = f"{recordings.name}: one pass, after so many touches of each material"
        _show_curves(title, [item for item in mine if item["by"] == "streams"])
    close(study, results, json, {"curves": found}, sets, folds)
    draw_into(plot, lambda file: draw_efficiency(file, found))


def activation(
    data: Data,
    weights: Weights = None,
    sets: Sets = None,
    epochs: Epochs = None,
    device: Where = Device.CPU,
    precision: InPrecision = PrecisionChoice.FLOAT32,
    seed: Seed = 0,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
    plot: Plot = None,
) -> None:
    """Feature activation: what excites the first block, pre-trained and fine-tuned on each sensor; and how alike it is.

    The paper shows the images only. Here each two networks are compared: by the cosine of their stem's filters, by
    whether two sensors moved them the same way, and by what their first blocks make of the same touches (CKA).
    """
    require_folders(json, plot)
    if weights is None:
        raise InputError("expected --weights: without a trained ResNet there is nothing to be fine-tuned")
    with progress_bar() as progress:
        progress("reading", 0, 1)
        read = read_sets(sets, QUICK_SETS, data, seed, quick)
        few = epochs or (QUICK_EPOCHS if quick else 20)
        study = ActivationStudy(
            read, ("resnet-pretrained",), weights, few, device.value, seed, quick, run, precision.value
        )
        results = list(study.run({item.name: [0] for item in read}, progress))
        networks = study.networks()
        likeness = study.likeness(networks)
        images = study.looks(networks, progress) if plot is not None else {}
    table = Table("of", "and", "filters", "moved the same way", "first blocks (CKA)")
    for pair in likeness:
        figures = ("" if math.isnan(pair[name]) else f"{pair[name]:.3f}" for name in ("filters", "moved", "blocks"))
        table.add_row(pair["one"], pair["two"], *figures)
    console().print(table)
    say_conditions(study)
    close(study, results, json, {"likeness": likeness}, sets, None)
    if plot is not None:
        draw_activation(plot, images)
        say(f"plot: {plot}")


def _show_table(dataset: str, found: Sequence[Mapping[str, Any]], study: SystemStudy) -> None:
    table = Table("system", "paper", "here", "difference", "folds", "seconds", title=dataset)
    for row in found:
        figures = row["sets"].get(dataset)
        if figures is None:
            continue
        paper, apart = figures["paper"], figures["difference"]
        vote = f" (vote of a recording {percent(figures['vote'])})" if "vote" in figures else ""
        table.add_row(
            row["system"],
            "" if paper is None else percent(paper),
            with_spread(figures) + vote,
            "" if apart is None else f"{100 * apart:+.1f}",
            str(figures["folds"]),
            f"{figures['seconds']:.0f}",
        )
    console().print(table)
    say_conditions(study)


def _show_curves(title: str, found: Sequence[Mapping[str, Any]]) -> None:
    if not found:
        return
    places = sorted({int(point[0]) for curve in found for point in curve["points"]})
    if found[0]["by"] == "epochs":
        places = sorted({i for i in places if i in EPOCH_COLUMNS} | {places[-1]})
    table = Table("system", *map(str, places), "folds", title=title)
    for curve in found:
        shares = {int(i): percent(mean) for i, mean, _ in curve["points"]}
        table.add_row(curve["system"], *(shares.get(i, "") for i in places), str(curve["folds"]))
    console().print(table)
