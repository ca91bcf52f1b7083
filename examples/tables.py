"""The tables of the texts, made from the results: `python -m examples.tables`, and `--check`, which writes nothing.

`python -m examples.tables NAME --format latex` prints one, as Markdown, CSV or LaTeX (with booktabs); `--results RUN`
makes it of what `python -m examples.paper all --run RUN` measured.

A text marks where a table stands: `<!-- table: NAME -->`, anything, `<!-- /table -->`. `tables.toml`, beside the
results, says what the table NAME holds:

- `head`: the headings.
- `each`: a lookup of a list; it makes a row of each element, or of those with `where = "field=value"`.
- `rows`: otherwise, the rows, each a list of words.
- `cells`: what a row shows; without it a row's words are its cells. `$0`, `$1` … stand for the words of the row, or
  `$name` for the element's fields.
- `above`, `below`: further rows, of cells. `text`: a paragraph behind the table.
- `commands = false`: leave out the commands that made the results, which another table then shows.

A cell is text with lookups in braces: `{STEM:KEY/KEY|STEP|STEP}` looks into STEM.json, `{./KEY}` into the element. A
KEY is a name, a place in a list, or `field=value;field=value`, the first element of a list with these. STEPs are those
of STEPS, `*N`, `/N`, or a format of Python's. `{PATH or PATH|STEP}` takes the second where the first finds nothing. A
lookup that finds nothing is an error; `{?…}` then leaves its cell empty, or shows what stands behind `??` in it.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scroll_tactile.errors import InputError

__all__ = [
    "FORMATS",
    "ROOMS",
    "TEXTS",
    "Results",
    "Table",
    "duration",
    "filled",
    "made",
    "main",
    "read_tables",
    "seconds_of",
    "table_of",
]

HERE = Path(__file__).parent
ROOMS = (HERE / "paper", HERE / "benchmarks")
TEXTS = (HERE.parent / "README.md", *(room / "RESULTS.md" for room in ROOMS))

MARK = re.compile(r"<!-- table: (\S+) -->\n(.*?)<!-- (/?)table", re.DOTALL)
LOOKUP = re.compile(r"\{(\??)([^{}]*)\}")


def _spread(found: Mapping[str, Any], scale: float = 100.0, digits: int = 1) -> str:
    """A mean, and behind ± its standard deviation, or error, where more than one fold was measured."""
    mean = f"{scale * found['mean']:.{digits}f}"
    spread = found["sd"] if "sd" in found else found["error"]
    return mean if spread is None or found.get("folds") == 1 else f"{mean} ± {scale * spread:.{digits}f}"


STEPS: dict[str, Callable[[Any], Any]] = {
    "%": lambda share: f"{100 * share:.1f}",
    "rest": lambda share: 1 - share,
    "±": _spread,
    "±3": lambda found: _spread(found, 1.0, 3),
    "len": len,
    "max": max,
    "sum": lambda found: sum(found.values() if isinstance(found, dict) else found),
}


class Missing(Exception):
    """A lookup found nothing."""


class Results:
    """The results of some folders by the names of their files, each read once. used: in order of their first use."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._files = {file.stem: file for folder in folders for file in sorted(folder.glob("results/*.json"))}
        self._read: dict[str, Any] = {}
        self.used: list[str] = []

    def of(self, stem: str) -> Any:
        """What a file of results holds. Raises InputError where there is none of that name."""
        if stem not in self._files:
            raise InputError(f"expected a result {stem}.json; there are {', '.join(sorted(self._files))}")
        if stem not in self._read:
            self._read[stem] = json.loads(self._files[stem].read_text(encoding="utf-8"))
        if stem not in self.used:
            self.used.append(stem)
        return self._read[stem]

    def look_up(self, path: str, element: Any = None) -> Any:
        """What a path leads to, `None` included. Raises Missing where it leads nowhere."""
        stem, _, keys = path.partition(":")
        found, keys = (element, path[2:]) if path.startswith("./") else (self.of(stem), keys)
        for key in keys.split("/"):
            found = _step_into(found, key)
        return found

    def _first_of(self, paths: Sequence[str], element: Any) -> Any:
        """What the first of some paths that leads to something leads to. Raises Missing where none does."""
        for path in paths:
            try:
                found = self.look_up(path, element)
            except Missing:
                continue
            if found is not None:
                return found
        raise Missing(paths)

    def fill(self, template: str, element: Any = None) -> str:
        """A template with its lookups done; empty where an optional one found nothing and offers nothing instead."""
        parts: list[str] = []
        end = 0
        for match in LOOKUP.finditer(template):
            asked, _, instead = match[2].partition("??")
            paths, *steps = asked.strip().split("|")
            try:
                found = self._first_of(paths.split(" or "), element)
                for step in steps:
                    found = _apply(step, found)
            except Missing:
                if not match[1]:
                    raise InputError(f"expected something at {match[0]}; the results have nothing there") from None
                if "??" not in match[2]:
                    return ""
                found = instead.strip()
            parts += [template[end : match.start()], str(found)]
            end = match.end()
        return "".join([*parts, template[end:]])


def _step_into(found: Any, key: str) -> Any:
    if isinstance(found, Mapping):
        if key in found:
            return found[key]
    elif isinstance(found, list) and "=" in key:
        if chosen := [element for element in found if _has(element, key)]:
            return chosen[0]
    elif isinstance(found, list) and key.isdigit() and int(key) < len(found):
        return found[int(key)]
    raise Missing(key)


def _has(element: Any, conditions: str) -> bool:
    """Whether an element meets all of `field=value;field=value`."""
    for condition in conditions.split(";"):
        field, _, wanted = condition.partition("=")
        value = _step_into(element, field)
        if (value if isinstance(value, str) else json.dumps(value)) != wanted:
            return False
    return True


def _apply(step: str, found: Any) -> Any:
    if step in STEPS:
        return STEPS[step](found)
    if step[0] in "*/":
        return found * float(step[1:]) if step[0] == "*" else found / float(step[1:])
    return format(found, step)


def _bound(template: str, words: Mapping[str, Any]) -> str:
    return re.sub(r"\$(\w+)", lambda match: str(words[match[1]]), template)


@dataclass(frozen=True)
class Table:
    """A table as it is shown: head and rows of Markdown, a paragraph, and (a note, a command) of each result in it.

    used: the names of all results that were looked into, whether their commands are shown or not.
    """

    head: list[str]
    rows: list[list[str]]
    text: str
    commands: list[tuple[str, str]]
    used: list[str]


def table_of(name: str, tables: Mapping[str, Any], folders: Sequence[Path] = ROOMS) -> Table:
    """The table of a name. Raises InputError where it, or what it looks up, is not there."""
    if name not in tables:
        raise InputError(f"expected a table out of {', '.join(sorted(tables))}; came {name!r}")
    table, results = tables[name], Results(folders)
    try:
        rows = [[results.fill(cell) for cell in row] for row in table.get("above", ())]
        if "each" in table:
            for element in results.look_up(table["each"]):
                if "where" in table and not _has(element, table["where"]):
                    continue
                cells = (_bound(cell, element) for cell in table["cells"])
                rows.append([results.fill(cell, element) for cell in cells])
        for row in table.get("rows", ()):
            words = {str(i): word for i, word in enumerate(row)}
            rows.append([results.fill(_bound(cell, words)) for cell in table.get("cells", row)])
        rows += [[results.fill(cell) for cell in row] for row in table.get("below", ())]
        text = results.fill(table.get("text", "")).strip()
    except (InputError, KeyError, TypeError, ValueError, Missing) as error:
        raise InputError(f"table {name!r}: {error}") from error
    head = table["head"]
    if wrong := next((row for row in rows if len(row) != len(head)), None):
        raise InputError(f"table {name!r}: expected rows of {len(head)} cells; came {wrong}")
    shown = [stem for stem in results.used if table.get("commands", True)]
    commands = [(_origin(f"{stem}.json", results.of(stem)), str(results.of(stem)["command"])) for stem in shown]
    return Table(head, rows, text, commands, results.used)


def _origin(file: str, made_by: Mapping[str, Any]) -> str:
    """A result's file, how long it took, its seed, the project's version and the date."""
    seconds, version = seconds_of(made_by), made_by.get("versions", {}).get("scroll-tactile")
    parts = ["time not noted" if seconds is None else duration(seconds)]
    parts += [f"seed {made_by['seed']}"] if "seed" in made_by else []
    parts += [f"version {version}"] if version else []
    return f"{file}: {', '.join([*parts, str(made_by['date'])[:10]] if 'date' in made_by else parts)}"


def seconds_of(made_by: Mapping[str, Any]) -> float | None:
    """How long a result took: what it notes, or what its cells, folds or parts do, together; None where none do."""
    if "seconds" in made_by:
        return float(made_by["seconds"])
    found: list[float | None] = []
    for name in ("cells", "folds", "parts", "records", "sets"):
        within = made_by.get(name)
        each = within.values() if isinstance(within, Mapping) else within if isinstance(within, list) else ()
        found += [seconds_of(part) for part in each if isinstance(part, Mapping)]
    known = [seconds for seconds in found if seconds is not None]
    return sum(known) if known else None


def duration(seconds: float) -> str:
    """Seconds in words: 40 s, 12 min, 3.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 90 * 60 else f"{seconds / 3600:.1f} h"


def _markdown(table: Table) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in (table.head, *table.rows)]
    lines.insert(1, "|---" * len(table.head) + "|")
    parts = ["\n".join(line.replace("|  |", "| |").replace("|  |", "| |") for line in lines), table.text]
    if table.commands:
        parts.append("```sh\n" + "\n".join(f"# {note}\n{command}" for note, command in table.commands) + "\n```")
    return "\n\n".join(part for part in parts if part)


def _csv(table: Table) -> str:
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerows([re.sub(r"\*\*|`|\\(?=\*)", "", cell) for cell in row] for row in (table.head, *table.rows))
    return lines.getvalue().rstrip("\n")


# What is special to LaTeX, or not in its usual fonts; the backslash is one of the characters, so each is done once.
LATEX = {character: f"\\{character}" for character in "&%$#_{}"}
LATEX |= {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
LATEX |= {"±": r"$\pm$", "×": r"$\times$", "→": r"$\rightarrow$", "λ": r"$\lambda$", "…": r"\ldots{}", "–": "--"}
LATEX |= {"−": "$-$", "α": r"$\alpha$", "Δ": r"$\Delta$", "≤": r"$\leq$", "²": "$^2$", "°": r"$^\circ$"}


def _latex_cell(cell: str) -> str:
    plain = re.sub(r"\\(?=\*)", "", cell.replace("**", "\0").replace("`", "\1"))
    text = "".join(LATEX.get(character, character) for character in plain)
    text = re.sub("\0([^\0]*)\0", r"\\textbf{\1}", text)
    return re.sub("\1([^\1]*)\1", r"\\texttt{\1}", text)


def _latex(table: Table) -> str:
    head, *rows = [" & ".join(map(_latex_cell, row)) + r" \\" for row in (table.head, *table.rows)]
    lines = [f"% {line}" for note, command in table.commands for line in (note, command)]
    lines += [rf"\begin{{tabular}}{{l{'r' * (len(table.head) - 1)}}}", r"\toprule", head, r"\midrule"]
    return "\n".join([*lines, *rows, r"\bottomrule", r"\end{tabular}"])


FORMATS: dict[str, Callable[[Table], str]] = {"markdown": _markdown, "csv": _csv, "latex": _latex}
"""How a table can be written."""


def made(name: str, tables: Mapping[str, Any], folders: Sequence[Path] = ROOMS, form: str = "markdown") -> str:
    """The table of a name, written in one of FORMATS. Raises what `table_of` raises."""
    return FORMATS[form](table_of(name, tables, folders))


def filled(text: str, tables: Mapping[str, Any], folders: Sequence[Path] = ROOMS) -> str:
    """A text with all its marked tables made. Raises InputError for a mark without an end, and what `made` raises."""

    def put(match: re.Match[str]) -> str:
        if not match[3]:
            raise InputError(f"the table {match[1]!r} has no end: expected <!-- /table --> before the next")
        return f"<!-- table: {match[1]} -->\n{made(match[1], tables, folders)}\n<!-- /table"

    if text.count("<!-- table: ") != len(MARK.findall(text)):
        raise InputError("expected <!-- /table --> behind every <!-- table: NAME -->; the last has none")
    return MARK.sub(put, text)


def read_tables(folders: Sequence[Path] = ROOMS) -> dict[str, Any]:
    """Name → description, of every `tables.toml`. Raises InputError where two have one name."""
    tables: dict[str, Any] = {}
    for folder in folders:
        described = tomllib.loads((folder / "tables.toml").read_text(encoding="utf-8"))
        if twice := tables.keys() & described.keys():
            raise InputError(f"expected tables of different names; {sorted(twice)} come twice")
        tables |= described
    return tables


def main(words: Sequence[str] | None = None, texts: Sequence[Path] = TEXTS) -> None:
    """Make the tables of all texts; with --check, exit 1 where one is not as the results say."""
    parser = argparse.ArgumentParser(prog="python -m examples.tables", description="Make all tables from the results.")
    parser.add_argument("--check", action="store_true", help="write nothing; fail where a table is not as it would be")
    parser.add_argument("names", nargs="*", metavar="NAME", help="print these tables, and write nothing")
    parser.add_argument("--format", choices=FORMATS, default="markdown", help="of what is printed")
    parser.add_argument("--results", type=Path, metavar="RUN", help="a folder of `python -m examples.paper all --run`")
    asked = parser.parse_args(words)
    check, tables = asked.check, read_tables()
    if asked.names:
        try:
            folders = ROOMS if asked.results is None else (asked.results,)
            print("\n\n".join(made(name, tables, folders, asked.format) for name in asked.names))
        except InputError as error:
            raise SystemExit(f"Error: {error}") from error
        return
    if asked.results is not None:
        parser.error("--results makes the tables that are named: give their names too")
    for path in texts:
        text = path.read_text(encoding="utf-8")
        new = filled(text, tables)
        if new == text:
            print(f"{path.name}: as the results say")
        elif check:
            raise SystemExit(f"{path} is not as the results say: run python -m examples.tables")
        else:
            path.write_text(new, encoding="utf-8")
            print(f"{path}: written")


if __name__ == "__main__":
    main()
