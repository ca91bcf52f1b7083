#!/usr/bin/env python3
"""Imports point one way: a module may import only modules of its own room or of rooms below it.

Exits 1 and names each import that points up, or from `store` into `scroll_tactile`.
"""

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# From the bottom up; rooms on one line do not import each other.
LAYERS = [
    {"errors"},
    {"sensors"},
    {"streams"},
    {"images", "windows", "prediction"},
    {"augment", "contact"},
    {"copies"},
    {"embeddings", "ridge", "requests"},
    {"exemplars", "tuned", "packing", "descriptions", "filling"},
    {"memory", "tuning", "perception"},
    {"model", "identity", "history"},
    {"heads"},
    {"training", "following", "composing"},
    {"finetune", "ledger"},
    {"learner"},
    {"export", "plain"},
    {"datasets"},
    {"plots"},
    {
        "plots_activation",
        "plots_continual",
        "plots_efficiency",
        "plots_frontier",
        "plots_numerics",
        "plots_robustness",
        "plots_transfer",
    },
    {"pipelines"},
    {"bench"},
    {"cli", "__main__"},
    {""},  # the package's own __init__
]
RANK = {room: rank for rank, layer in enumerate(LAYERS) for room in layer}


def room_of(module: str) -> str:
    """The first name below the package: scroll_tactile.ridge.codes → ridge."""
    return [*module.split("."), ""][1]


def imported(tree: ast.Module) -> list[tuple[int, str]]:
    """(line, module) of every import, wherever it stands; `from scroll_tactile import x` counts as x."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(node.lineno, name.name) for name in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            if node.module == "scroll_tactile":
                found += [(node.lineno, f"scroll_tactile.{name.name}") for name in node.names]
            else:
                found.append((node.lineno, node.module))
    return found


def problems(path: Path) -> list[str]:
    """What is wrong with the imports of one file."""
    where = path.relative_to(ROOT)
    package, *rest = where.with_suffix("").parts
    own = "" if not rest or rest[0] == "__init__" else rest[0]
    wrong = []
    for line, module in imported(ast.parse(path.read_text())):
        top = module.split(".")[0]
        if package == "store" and top == "scroll_tactile":
            wrong.append(f"{where}:{line}: store knows nothing of scroll_tactile")
        if package != "scroll_tactile" or top != "scroll_tactile":
            continue
        room = room_of(module)
        # A public name taken from the package itself, such as `sensors` or `Kernels`, lies where it is defined.
        if room not in RANK:
            wrong.append(f"{where}:{line}: {module}: import it from the module that defines it")
        elif room != own and RANK[room] >= RANK[own]:
            wrong.append(f"{where}:{line}: {own or 'the package'} imports {room}, which does not lie below it")
    return wrong


def main() -> int:
    """Check every file of both packages."""
    files = sorted([*ROOT.glob("scroll_tactile/**/*.py"), *ROOT.glob("store/**/*.py")])
    wrong = [line for path in files for line in problems(path)]
    print("\n".join(wrong) or f"imports of {len(files)} files point one way")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
