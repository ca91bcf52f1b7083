"""`continual`: f and f* for every size of the exemplar buffer, beside other continual learners."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from examples.paper.commands.options import (
    QUICK_EVERY,
    Data,
    Device,
    FewMaterials,
    Folds,
    Json,
    Plot,
    Run,
    Seed,
    Where,
)
from examples.paper.commands.sets import (
    Dataset,
    command_line,
    draw_into,
    origin,
    parse_folds,
    read,
    require_folders,
    write_result,
)
from examples.paper.plots import draw_continual
from examples.paper.readers.labelled import Recordings
from examples.paper.runs.cells import thinned
from examples.paper.studies.continual import summary
from examples.paper.studies.continual_study import Continual, Size
from examples.paper.studies.replay import PUBLISHED, subset
from examples.paper.systems.own import is_own, own_embedding
from scroll_tactile import Embedding, Joined, Kernels, Vision
from scroll_tactile.cli.terminal import console, percent, progress_bar, say
from scroll_tactile.errors import InputError

__all__ = ["continual"]

SIZES = "0,20,50,100,200,400,all"
QUICK_SIZES = "0,40"


class EmbeddingChoice(StrEnum):
    """The embeddings."""

    KERNELS = "kernels"
    VISION = "vision"
    BOTH = "kernels+vision"


class Order(StrEnum):
    """The schedules that continual learning is measured under; names of `arrange`."""

    CLASSES = "class-by-class"
    SHUFFLED = "shuffled"


def continual(
    dataset: Annotated[Dataset, typer.Argument(help="Which recordings.", show_default=False)],
    data: Data,
    weights: Annotated[
        str | None, typer.Option(help="Of the vision embedding: a file, or a published name such as resnet18.")
    ] = None,
    embedding: Annotated[
        str, typer.Option(help=f"The frozen features: {', '.join(EmbeddingChoice)}, or one's own, as module:factory.")
    ] = EmbeddingChoice.KERNELS,
    schedule: Annotated[Order, typer.Option(help="The order in which touches are learned.")] = Order.CLASSES,
    sizes: Annotated[
        str | None, typer.Option(help=f"Exemplars in the buffer, all: every touch. {SIZES}, unless given.")
    ] = None,
    folds: Folds = None,
    seed: Seed = 0,
    epochs: Annotated[
        int | None, typer.Option(min=1, help="Of a fine-tune; the learner's own choice unless given.")
    ] = None,
    curve: Annotated[
        int, typer.Option(min=0, help="Measure after every so many twentieths of the pass; 0: only at its end.")
    ] = 1,
    tuned_curve: Annotated[
        bool, typer.Option("--tuned-curve", help="Measure f* there too: a fine-tune at each. Slow.")
    ] = False,
    peers: Annotated[bool, typer.Option(help="Measure other methods on the same features.")] = True,
    device: Where = Device.CPU,
    quick: Annotated[bool, typer.Option("--quick", help="One fold of every fifth touch: for a look.")] = False,
    run: Run = None,
    json: Json = None,
    plot: Plot = None,
    materials: FewMaterials = 20,
    features: Annotated[
        int | None, typer.Option(min=64, help="Of the kernels: 1008 alone and 1260 beside vision, unless given.")
    ] = None,
) -> None:
    """Learn a recorded set in one pass, and measure f and f* for every size of the exemplar buffer.

    f is the closed form, which no buffer and no order changes; f* is fine-tuned from it on the exemplars alone. Beside
    them: the ridge floor, what was published, and other continual learners on the same features and folds.
    """
    require_folders(json, plot)
    chosen_sizes = parse_sizes(sizes or (QUICK_SIZES if quick else SIZES))
    # Beside vision 1260 kernels have 98.7 % of RoboSkin, 1008 have 98.6; both have 99.5 of BioTac.
    kernels = features or (1260 if embedding == EmbeddingChoice.BOTH else 1008)
    frozen = _embedding(embedding, weights, kernels)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        recordings = read(dataset, data, seed)
        if materials < 20:
            recordings = subset(recordings, materials)
        if quick:
            recordings = thinned(recordings, QUICK_EVERY)
        task = Continual(
            recordings,
            frozen,
            schedule.value,
            seed,
            chosen_sizes,
            curve=curve,
            tuned_curve=tuned_curve,
            epochs=epochs,
            peers=peers,
            device=device.value,
            folder=run,
        )
        chosen = parse_folds(folds or ("0" if quick else "all"), recordings)
        results: list[dict[str, Any]] = []
        for done in task.run(chosen, lambda what, i, of: progress(f"fold {chosen[len(results)]}: {what}", i, of)):
            results.append(done)
    published = PUBLISHED.get(recordings.name) if materials == 20 else None
    _show(recordings, results, published)
    if quick:
        say(f"[yellow]quick:[/] one touch of {QUICK_EVERY}, in training and test")
    if json is not None:
        settings: dict[str, Any] = {"embedding": str(embedding), "weights": None if weights is None else Path(weights)}
        of_kernels = embedding in (EmbeddingChoice.KERNELS, EmbeddingChoice.BOTH)
        settings |= {"features": kernels if of_kernels else None}
        settings |= {"schedule": schedule.value, "sizes": ",".join(map(str, chosen_sizes)), "folds": folds}
        settings |= {"quick": quick, "seed": seed, "curve": curve, "device": device.value, "epochs": epochs}
        settings |= {"tuned_curve": tuned_curve, "no_peers": not peers, "run": None if run is None else "RUN"}
        command = command_line("continual", dataset.value, data="DATA", **settings)
        rows = summary(results)
        write_result(json, origin(command, recordings) | task.plan | {"means": rows, "folds": results})
    if plot is not None:
        _plot(plot, f"{recordings.name}, {frozen.name}, {schedule.value}", results, published)


def parse_sizes(text: str) -> tuple[Size, ...]:
    """The sizes of --sizes: numbers from 0, or "all". Raises InputError for anything else."""
    sizes: list[Size] = []
    for part in text.split(","):
        word = part.strip()
        if word != "all" and not (word.isascii() and word.isdigit()):
            raise InputError(f"expected --sizes as numbers of exemplars or all, such as 0,20,400,all; came {text!r}")
        sizes.append("all" if word == "all" else int(word))
    return tuple(dict.fromkeys(sizes))


def _embedding(choice: str, weights: str | None, features: int) -> Embedding:
    if choice not in list(EmbeddingChoice) and not is_own(choice):
        known = ", ".join(EmbeddingChoice)
        raise InputError(f"expected --embedding out of {known}, or as module:factory; came {choice!r}")
    if choice == EmbeddingChoice.KERNELS or is_own(choice):
        if weights is not None:
            raise InputError(
                f"--embedding {choice} has no weights; came {weights!r}. Choose vision, or leave --weights out"
            )
        return Kernels(dimension=features) if choice == EmbeddingChoice.KERNELS else own_embedding(choice)
    if weights is None:
        raise InputError(
            f"--embedding {choice} needs --weights: a file in torchvision's or Meta-Dataset's layout, or a "
            "published name such as resnet18"
        )
    vision = Vision(weights)
    return vision if choice == EmbeddingChoice.VISION else Joined(Kernels(dimension=features), vision)


def _show(recordings: Recordings, results: Sequence[Mapping[str, Any]], published: tuple[float, float] | None) -> None:
    count = "1 fold" if len(results) == 1 else f"{len(results)} folds"
    table = Table("method", "buffer", "accuracy", "forgetting", "kept", title=f"{recordings.name}, one pass, {count}")
    for row in summary(results):
        if row["method"] == "nearest mean":
            table.add_section()
        kept = f"{row['kept']} of {len(results)}" if row["method"] == "f*" else ""
        accuracy, forgetting = _shown(row["accuracy"], len(results)), _shown(row["forgetting"], len(results))
        table.add_row(row["method"], row["size"] or "", accuracy, forgetting, kept)
    if published is not None:
        table.add_section()
        table.add_row("published: fine-tuned offline", "", percent(published[1]))
        table.add_row("published: ridge on vision", "", percent(published[0]))
    console().print(table)
    for fold in results:
        same = "[green]yes[/]" if fold["equals_offline"] else "[red]no[/]"
        say(f"fold {fold['fold']}: f equals offline training: {same}; digest {fold['digest'][:16]}")
        for size, part in fold["tuned"].items():
            if "buffer_digest" in part:
                _show_tuned(size, part)


def _show_tuned(size: str, part: Mapping[str, Any]) -> None:
    kept = "kept" if part["kept"] else "not kept"
    buffer = "[green]yes[/]" if part["buffer_of_another_order"] else "[red]no[/]"
    say(
        f"  f* {size}: {part['exemplars']} exemplars of {part['bytes_per_exemplar'] / 1000:.1f} KB, the same in "
        f"another order: {buffer}; {part['mode']}, {part['epochs']} epochs, {part['seconds']:.1f} s; {kept}: "
        f"{escape(part['reason'])}; digest {(part['tuned_digest'] or 'none')[:16]}"
    )


def _shown(figure: Mapping[str, float] | None, folds: int) -> str:
    if figure is None:
        return ""
    return percent(figure["mean"]) + (f" ± {100 * figure['sd']:.1f}" if folds > 1 else "")


def _lines(published: tuple[float, float] | None) -> dict[str, float]:
    if published is None:
        return {}
    ridge, tuned = published
    return {"published: ResNet fine-tuned offline": tuned, "published: ridge on a frozen vision model": ridge}


def _plot(plot: Path, title: str, results: Sequence[Mapping[str, Any]], published: tuple[float, float] | None) -> None:
    draw_into(plot, lambda file: draw_continual(file, summary(results), title=title, lines=_lines(published)))
