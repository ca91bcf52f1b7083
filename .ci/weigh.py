"""Weighs the house: lines, statements and files of Python by room, beside what each may weigh at most.

`python .ci/weigh.py` prints the table, and ends with 1 where a room is above its ceiling in ceilings.toml or has none.
`--lower` writes what stands as the new ceilings where that is less; nothing here raises one.
A statement is an `ast.stmt`, but for imports and docstrings, so that nobody gains by cramming lines.
"""

from __future__ import annotations

import ast
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CEILINGS = Path(__file__).with_name("ceilings.toml")
HOUSES = {"scroll_tactile": 1, "scroll_tactile/clients": 1, "store": 0, "tests": 1, "examples": 1}
HEAD = "# The most that each room may weigh: lines, statements. `weigh.py --lower` lowers them when an issue ends.\n"


def room_of(file: Path) -> str:
    """The room of a file: a folder or file below the innermost of HOUSES, and `store` whole."""
    parts = file.relative_to(ROOT).parts
    house = max((name for name in HOUSES if parts[: name.count("/") + 1] == tuple(name.split("/"))), key=len)
    depth = house.count("/") + 1
    inner = len(parts) > depth + 1
    if not HOUSES[house] or (house in ("tests", "examples") and not inner):
        return house
    return "/".join(parts[: depth + 1])


def statements(source: str) -> int:
    """How many statements a file has, without imports and docstrings."""

    def counts(node: ast.stmt) -> bool:
        said = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return not (said or isinstance(node, (ast.Import, ast.ImportFrom)))

    return sum(isinstance(node, ast.stmt) and counts(node) for node in ast.walk(ast.parse(source)))


def weights() -> dict[str, list[int]]:
    """Room → lines, statements, files."""
    found: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0])
    for file in _files():
        source = file.read_text(encoding="utf-8")
        for place, more in enumerate((source.count("\n"), statements(source), 1)):
            found[room_of(file)][place] += more
    return dict(sorted(found.items()))


def _files() -> Iterator[Path]:
    for name in ("scroll_tactile", "store", "tests", "examples"):
        yield from (ROOT / name).rglob("*.py")


def main() -> int:
    """Print, compare, and lower where that is asked."""
    most = tomllib.loads(CEILINGS.read_text()) if CEILINGS.exists() else {}
    found, above = weights(), []
    print(f"{'room':40} lines of most  statements of most  files")
    for room, (lines, count, files) in found.items():
        ceiling = most.get(room, [0, 0])
        print(f"{room:40} {lines:5} {ceiling[0]:7} {count:11} {ceiling[1]:7} {files:6}")
        if lines > ceiling[0] or count > ceiling[1]:
            above.append(room)
    for name in ("scroll_tactile store", "tests", "examples"):
        of = [weight for room, weight in found.items() if room.split("/")[0] in name.split()]
        print(f"{name:40} {sum(w[0] for w in of):5} {'':7} {sum(w[1] for w in of):11} {'':7} {sum(w[2] for w in of):6}")
    if "--lower" in sys.argv:
        low = {room: [min(pair) for pair in zip(w, most.get(room, w), strict=False)] for room, w in found.items()}
        CEILINGS.write_text(HEAD + "".join(f'"{room}" = {pair}\n' for room, pair in low.items()))
    elif above:
        print(f"above its ceiling in .ci/ceilings.toml, or without one: {', '.join(above)}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
