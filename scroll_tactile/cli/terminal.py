"""What the commands share: how they print, how errors end them, and how they show progress."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from typer.core import TyperGroup

from scroll_tactile.errors import InputError, ScrollTactileError
from scroll_tactile.results import Prediction
from store import NotAStoreError, Store, StoreError

if TYPE_CHECKING:
    from scroll_tactile.learner import TactileLearner
    from scroll_tactile.sensors import Sensor

__all__ = [
    "Commands",
    "confusion_text",
    "console",
    "opened",
    "opened_for_upkeep",
    "percent",
    "progress_bar",
    "say",
    "verdict",
    "write_json",
]

INTERRUPTED = 130  # what a shell reports for a command ended by ctrl-C: 128 + SIGINT


def console(*, error: bool = False) -> Console:
    """A console on the standard output, or error, of this moment (tests exchange them)."""
    return Console(stderr=error, highlight=False, soft_wrap=not error and not sys.stdout.isatty())


def say(text: str) -> None:
    """Print a line in rich's markup."""
    console().print(text)


class Commands(TyperGroup):
    """Commands whose expected errors are one red line, with exit code 1, and whose ctrl-C is 130."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command that was asked for."""
        try:
            return super().invoke(ctx)
        except (ScrollTactileError, StoreError) as error:
            text = " ".join(str(error).split())
            notes = " ".join(getattr(error, "__notes__", []))
            Console(stderr=True, highlight=False, soft_wrap=True).print(
                f"[bold red]Error:[/] [red]{escape(text)}{escape(' ' + notes) if notes else ''}[/]"
            )
            raise typer.Exit(1) from error
        except KeyboardInterrupt:
            Console(stderr=True, highlight=False, soft_wrap=True).print(
                "[yellow]Interrupted.[/] What was observed is kept where there is a memory; start again to go on."
            )
            raise typer.Exit(INTERRUPTED) from None


def opened(path: Path, *, sensor: Sensor | None = None, mode: Literal["write", "read"] = "write") -> TactileLearner:
    """A memory, or a new one where there is nothing and a sensor is given. Raises what `TactileLearner.open` raises."""
    from scroll_tactile.learner import TactileLearner

    try:
        return TactileLearner.open(path, sensor=sensor, mode=mode)
    except (InputError, NotAStoreError) as error:
        if (path.exists() and not path.is_dir()) or mode == "read" or sensor is not None:
            raise
        what = f"there is no memory in {path}; to make one, say which sensor it is for, with --sensor"
        raise InputError(what) from error


def opened_for_upkeep(path: Path, *, mode: Literal["write", "read"] = "write") -> TactileLearner:
    """A memory of any embedding, for all that needs none: showing, retracting, merging, compacting, exporting."""
    from scroll_tactile.learner import TactileLearner
    from scroll_tactile.memory.identity import AbsentEmbedding, Identity

    with Store.open(path, mode="read") as store:
        identity = Identity.read(store)
    return TactileLearner.open(path, embedding=AbsentEmbedding(identity), mode=mode)


def percent(share: float) -> str:
    """A share as a percentage."""
    return f"{100 * share:.1f} %"


def verdict(prediction: Prediction) -> str:
    """A prediction in words."""
    if prediction.material is None:
        return "never felt anything yet"
    name = escape(prediction.material)
    if prediction.known:
        return f"[bold green]{name}[/] with {percent(prediction.probability)} (novelty {prediction.novelty:.1f})"
    return f"[bold yellow]never felt this[/]; nearest is {name} (novelty {prediction.novelty:.1f})"


@contextmanager
def progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """A bar on the standard error; yields what is to be told (what is being done, steps done, steps in all)."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console(error=True), transient=True) as progress:
        task = progress.add_task("starting", total=None)
        yield lambda what, done, of: progress.update(task, description=what, completed=done, total=of)


def confusion_text(names: Sequence[str], counts: np.ndarray) -> str:
    """Counts of (truth, said), shape (C, C), as a table of characters; a column is the row of the same number.

    A dot is none.
    """
    wide = max(map(len, names)) + 3
    head = " " * wide + "".join(f"{at + 1:>3}" for at in range(len(names)))
    rows = [
        f"{at + 1:>2} {name:<{wide - 3}}" + "".join(f"{count or '·':>3}" for count in counts[at].tolist())
        for at, name in enumerate(names)
    ]
    return "\n".join([head, *rows])


def write_json(path: Path, result: dict[str, Any]) -> None:
    """Write a result, whole or not at all. Raises InputError where the file cannot be written."""
    text = json.dumps(result, indent=2, ensure_ascii=False) + "\n"
    try:
        draft = path.with_name(path.name + ".new")
        draft.write_text(text, encoding="utf-8")
        draft.replace(path)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from error
