"""What the commands share: the recorded sets, which folds, the noted command, and how a result notes its making."""

from __future__ import annotations

import json
import math
import platform
import shlex
import textwrap
from collections.abc import Callable, Collection, Mapping, Sequence
from datetime import UTC, datetime
from enum import StrEnum
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from rich.markup import escape

from examples.paper import drawing
from examples.paper.readers.biotac_slide import load
from examples.paper.readers.labelled import Recordings
from scroll_tactile import __version__
from scroll_tactile.cli.terminal import percent, say
from scroll_tactile.errors import InputError
from scroll_tactile.libraries import missing

__all__ = [
    "Dataset",
    "command_line",
    "draw_into",
    "leave_out",
    "named",
    "origin",
    "parse_folds",
    "read",
    "require_folders",
    "with_spread",
    "write_result",
]


_OPTIONAL = {"scikit-learn": "sklearn", "snntorch": "snntorch"}  # what made some results; distribution → module


class Dataset(StrEnum):
    """The recorded sets."""

    BIOTAC = "biotac-20"
    BIOTAC_ALL = "biotac-20-all"  # all that the sensor measures, not its electrodes alone: none of the paper's sets
    ROBOSKIN = "roboskin-20"
    UNMIXED = "roboskin-20-unmixed"  # in the order of time, which the published arrays are not in


def read(dataset: Dataset, data: Path, seed: int) -> Recordings:
    """Read a recorded set. Raises DatasetError for a folder that is not laid out as published."""
    sensors: dict[Dataset, Literal["biotac", "biotac-all", "roboskin"]] = {
        Dataset.BIOTAC: "biotac",
        Dataset.BIOTAC_ALL: "biotac-all",
        Dataset.ROBOSKIN: "roboskin",
        Dataset.UNMIXED: "roboskin",
    }
    return load(data, sensors[dataset], seed, unmixed=dataset is Dataset.UNMIXED)


def parse_folds(folds: str, recordings: Recordings) -> list[int]:
    """The folds that --folds asks for: "all", or numbers. Raises InputError for anything else."""
    if folds == "all":
        return sorted(set(recordings.fold.tolist()))
    try:
        return list(dict.fromkeys(int(part) for part in folds.split(",")))
    except ValueError:
        raise InputError(f"expected --folds all, or numbers such as 0 or 0,1; came {folds!r}") from None


def named(option: str, asked: str, known: Collection[str]) -> tuple[str, ...]:
    """The names that an option asks for, with commas between; each once. Raises InputError for unknown ones."""
    names = tuple(dict.fromkeys(part.strip() for part in asked.split(",")))
    if strange := [name for name in names if name not in known]:
        raise InputError(f"expected {option} out of {', '.join(known)}; came {', '.join(map(repr, strange))}")
    return names


def leave_out(keys: Sequence[str], needing: Collection[str], option: str) -> tuple[str, ...]:
    """The keys without those that need an option which was not given; a word on these."""
    if out := [key for key in keys if key in needing]:
        say(f"[yellow]Left out without {option}:[/] {', '.join(out)}")
    return tuple(key for key in keys if key not in out)


def command_line(*words: str, **options: Any) -> str:
    """The command to be noted in a result: `python -m examples.paper`, words and options, without a machine's paths.

    options: `biotac_epochs=4` is --biotac-epochs 4, True a flag; None and False are left out. Of a file its name is
    kept; a folder is to be given as a word in capitals.

    >>> command_line("table1", data="DATA", weights=Path("/home/me/resnet.pth"), quick=True, folds=None)
    'python -m examples.paper table1 --data DATA --weights resnet.pth --quick'
    """
    spelled = ["python", "-m", "examples.paper", *words]
    for name, value in options.items():
        if value is None or value is False:
            continue
        option = f"--{name.replace('_', '-')}"
        text = value.name if isinstance(value, Path) else str(value)
        # What begins with a dash would be read as an option.
        spelled += [option] if value is True else [f"{option}={text}"] if text.startswith("-") else [option, text]
    return shlex.join(spelled)


def with_spread(figure: Mapping[str, Any] | None, *, share: bool = True) -> str:
    """A mean, and its standard deviation over folds where there are several; empty for None. share: in percent."""
    if figure is None:
        return ""
    mean, sd = figure["mean"], figure["sd"]
    if share:
        return percent(mean) + ("" if sd is None else f" ± {100 * sd:.1f}")
    return f"{mean:.4f}" + ("" if sd is None else f" ± {sd:.4f}")


def draw_into(plot: Path | None, draw: Callable[[Path], object]) -> bool:
    """Draw a picture into the file that was asked for, and say so; whether it could be: not without matplotlib."""
    if plot is None:
        return True
    if not drawing.available():
        say(f"[yellow]No picture:[/] {escape(str(missing('matplotlib', 'plots', 'it')))}")
        return False
    draw(plot)
    say(f"plot: {plot}")
    return True


def require_folders(*files: Path | None) -> None:
    """Raise InputError, before anything is measured, where a file could not be written for want of its folder."""
    for file in files:
        if file is not None and not file.absolute().parent.is_dir():
            raise InputError(f"expected {file} in a folder that exists; {file.absolute().parent} does not")


def origin(command: str, recordings: Recordings | None = None) -> dict[str, Any]:
    """What made a result: the command, when, with which versions, on what machine, and from which sensor, of one."""
    versions = {"scroll-tactile": __version__} | {name: version(name) for name in ("torch", "numpy", "scipy")}
    versions |= {name: version(name) for name, module in _OPTIONAL.items() if find_spec(module)}
    made = {
        "command": command,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions | {"python": platform.python_version()},
        "machine": f"{platform.machine()} {platform.system()}",
    }
    return made if recordings is None else made | {"sensor": recordings.sensor.model_dump(mode="json")}


def write_result(path: Path, result: Mapping[str, Any]) -> None:
    """Write a result as JSON, whole or not at all: short values and numbers side by side, of eight digits, NaN as null.

    Raises InputError where the file cannot be written.
    """
    draft = path.with_name(path.name + ".new")
    try:
        draft.write_text(_laid_out(_rounded(result)) + "\n", encoding="utf-8")
        draft.replace(path)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from error
    say(f"figures: {path}")


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.8g}") if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _rounded(part) for key, part in value.items()}
    return [_rounded(part) for part in value] if isinstance(value, list | tuple) else value


def _laid_out(value: Any, indent: str = "") -> str:
    line = json.dumps(value, ensure_ascii=False)
    if len(indent) + len(line) <= 120 or not isinstance(value, dict | list):
        return line
    inner = indent + " "
    if isinstance(value, list) and '"' not in line:  # of numbers, or lists of them: a line each would be the most of it
        rows = textwrap.wrap(line[1:-1], 120 - len(inner), break_on_hyphens=False)
        return "[\n" + "\n".join(inner + row for row in rows) + "\n" + indent + "]"
    if isinstance(value, dict):
        rows = [f"{json.dumps(key, ensure_ascii=False)}: {_laid_out(part, inner)}" for key, part in value.items()]
    else:
        rows = [_laid_out(part, inner) for part in value]
    begin, end = "{}" if isinstance(value, dict) else "[]"
    return begin + "\n" + ",\n".join(inner + row for row in rows) + "\n" + indent + end
