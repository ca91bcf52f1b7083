"""How every command ends: its result as JSON, with the command and all else that made it, and its tables on screen."""

from __future__ import annotations

import json
import math
import os
import platform
import shlex
import textwrap
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import typer
from rich.markup import escape
from rich.table import Table

from examples.tables import Results
from scroll_tactile import __version__
from scroll_tactile.clients.cli.terminal import console, say
from scroll_tactile.errors import InputError

__all__ = ["circumstances", "noted", "origin", "show", "write", "write_result"]

LIBRARIES = ("torch", "numpy", "scipy", "zarr", "scikit-learn", "snntorch")
NOT_NOTED = ("json", "plot")
WIDE = 160  # characters that the widest table takes


def noted(context: typer.Context) -> str:
    """The command that is being run, with the value of every option that has one, as results keep it.

    A folder, which is of one machine, is noted as a word in capitals, and of a file its name.
    """
    names: list[str] = [str(context.info_name)]
    above: Any = context
    while above.parent is not None and above.parent.parent is not None:
        above = above.parent
        names.insert(0, str(above.info_name))
    words = ["python", "-m", str(context.find_root().command.name), *names]
    for parameter in context.command.params:
        if parameter.name not in NOT_NOTED and not getattr(parameter, "hidden", False):
            words += _spelled(parameter, context.params[str(parameter.name)])
    return shlex.join(words)


def _spelled(parameter: Any, value: Any) -> list[str]:
    option = max(parameter.opts, key=len)
    if value is False and value != parameter.default:
        return [parameter.secondary_opts[0]]
    if value is None or isinstance(value, bool):
        return [option] if value and value != parameter.default else []
    if isinstance(value, list | tuple):
        return [word for each in value for word in (option, str(each))]
    text = str(value)
    if isinstance(value, Path):
        text = value.name if value.is_file() else str(parameter.name).upper()
    elif parameter.name == "weights":  # a file, or a published name
        text = Path(text).name
    if parameter.param_type_name == "argument":
        return [text]
    return [f"{option}={text}"] if text.startswith("-") else [option, text]  # which would be read as an option


def circumstances(seed: int) -> dict[str, Any]:
    """What a result has to be read with: date, seed, versions, machine, and what else ran on it as it began.

    load_average: of the last 1, 5 and 15 minutes, in processes; above `cores` they waited for each other.
    """
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": seed,
        "versions": {"scroll-tactile": __version__, "python": platform.python_version(), **_versions()},
        "machine": f"{platform.machine()} {platform.system()}",
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load_average": _load(),
    }


def _versions() -> dict[str, str]:
    found = {}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _load() -> list[float] | None:
    return [round(load, 2) for load in os.getloadavg()] if hasattr(os, "getloadavg") else None


def origin(context: typer.Context) -> dict[str, Any]:
    """What made a result: the command, when, with which versions, on what machine."""
    return {"command": noted(context)} | circumstances(int(context.params.get("seed", 0)))


def write(context: typer.Context, result: Mapping[str, Any]) -> None:
    """Write a result with what made it where --json asks for it."""
    path = context.params["json"]
    if path is not None:
        write_result(path, origin(context) | dict(result) | {"load_average_after": _load()})


def write_result(path: Path, result: Mapping[str, Any]) -> None:
    """Write a result as JSON, whole or not at all: short values and numbers side by side, of six digits, NaN as null.

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
        return float(f"{value:.6g}") if math.isfinite(value) else None
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


def show(title: str, columns: Mapping[str, str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Print a table: a column's heading → its cell, filled from each row as cells of the texts' tables are.

    `{./accuracy|±}` is what a row has at "accuracy", as a mean and its spread; see `examples.tables`.
    """
    results = Results(())
    table = Table(*map(escape, columns), title=escape(title))
    for row in rows:
        table.add_row(*(escape(results.fill(cell, row)) for cell in columns.values()))
    # Cut off at 80 columns, as for want of a terminal's width, it would show nothing.
    screen = console()
    screen.width = max(WIDE, screen.width)
    screen.print(table)
