"""Pages of the repository as pages of the site: what is brought in, and where its links then lead."""

from __future__ import annotations

import ast
import base64
import json
import posixpath
import re
from pathlib import Path

from mkdocs.exceptions import PluginError

__all__ = ["DECISIONS", "EXAMPLES", "PAGES", "ROOT", "about", "linked", "notebook", "program", "section", "sessions"]

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#]*)(#[^)\s]*)?\)")
SESSION = re.compile(r"^```(?:python|pycon)\n(>>> .*?)^```$", re.MULTILINE | re.DOTALL)
BLOCK_ENDS = re.compile(r"^(\.\.\. +\S.*\n)(?!\.\.\.)", re.MULTILINE)
FENCE = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)
PAGES = {  # of the repository → of the site
    "README.md": "index.md",
    "examples/tour.ipynb": "tour.md",
    "examples/README.md": "examples/index.md",
    "examples/paper/RESULTS.md": "results/paper.md",
    "examples/paper/NOTES.md": "results/notes.md",
    "examples/benchmarks/RESULTS.md": "results/benchmarks.md",
    "scroll_tactile/ARCHITECTURE.md": "about/architecture.md",
    "store/FORMAT.md": "about/format.md",
    ".github/CONTRIBUTING.md": "about/contributing.md",
    "scroll_tactile/CHANGELOG.md": "about/changelog.md",
    "scroll_tactile/API.md": "reference/index.md",
    ".github/decisions": "decisions/index.md",
    ".github/pictures/answers.png": "pictures/answers.png",
}
EXAMPLES = sorted(path for path in (ROOT / "examples").glob("*.py") if path.stem not in ("__init__", "tables"))
DECISIONS = sorted((ROOT / ".github/decisions").glob("*.md"))
PAGES |= {f"examples/{path.name}": f"examples/{path.stem}.md" for path in EXAMPLES}
PAGES |= {f".github/decisions/{path.name}": f"decisions/{path.name}" for path in DECISIONS}
NO_TEXT = ("#", "```", "|", "<!--", "- ", "![", "python", "scroll-tactile ")  # how paragraphs begin that say nothing


def sessions(text: str) -> str:
    """A text whose sessions can be copied: known as such, a block ends with the empty line that Python waits for.

    Where only a bracket goes on, the empty line does no harm.
    """
    return SESSION.sub(lambda found: "```pycon\n" + BLOCK_ENDS.sub(r"\1...\n", found[1]) + "```", text)


def linked(text: str, source: str, place: str) -> str:
    """A text of the repository with its links as they are in the site; fences stay as they are.

    source: where in the repository it stands. place: where in the site it will.
    """

    def lead(found: re.Match[str]) -> str:
        image, words, target, anchor = found[1], found[2], found[3], found[4] or ""
        if "://" in target or not target:
            return found[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if not (ROOT / path).exists() and not image:
            raise PluginError(f"{source}: a link to {target}, which is not there")
        to = PAGES.get(path) or (f"results/results/{posixpath.basename(path)}" if image else None)
        if to is None:
            return f"{words} (`{path}`)" if words.strip("`") not in (path, posixpath.basename(path)) else f"`{path}`"
        return f"{image}[{words}]({posixpath.relpath(to, posixpath.dirname(place) or '.')}{anchor})"

    parts = FENCE.split(text)
    return "".join(part if i % 2 else LINK.sub(lead, part) for i, part in enumerate(parts))


def section(path: Path, heading: str) -> str:
    """What stands under a heading of second order."""
    found = re.search(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", path.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    if not found:
        raise PluginError(f"{path.name} has no heading {heading!r}")
    return found[1].strip()


def program(path: Path) -> str:
    """A program's page: its first sentence, how to run it, and its text."""
    text = path.read_text(encoding="utf-8")
    first = (ast.get_docstring(ast.parse(text)) or "").split("\n\n")[0]
    return (
        f"# {path.stem}\n\n{first}\n\nRun it from a clone: `python -m examples.{path.stem}`\n\n```python\n{text}```\n"
    )


def notebook(path: Path) -> dict[str, str | bytes]:
    """A notebook's cells and what they gave, and its pictures."""
    parts, pictures = [], {}
    for i, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
        text = "".join(cell["source"])
        parts.append(
            f"```python\n{text}\n```" if cell["cell_type"] == "code" else linked(text, "examples/x", "tour.md")
        )
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if "image/png" in data:
                pictures[f"pictures/tour-{i}.png"] = base64.b64decode(data["image/png"])
                parts.append(f"![what the cell draws](pictures/tour-{i}.png)")
            else:
                shown = "".join(output.get("text") or data["text/plain"])
                parts.append(f"```text\n{shown.rstrip()}\n```")
    return {"tour.md": "\n\n".join(parts), **pictures}


def about(text: str) -> tuple[str, str]:
    """Title and first sentence of a page."""
    title = re.search(r"^# (.+)$", text, re.MULTILINE)
    paragraphs = [part.strip(" \n") for part in text[title.end() if title else 0 :].split("\n\n")]
    first = next((part for part in paragraphs if part and not part.startswith(NO_TEXT)), "")
    sentence = re.split(r"(?<=\.)\s(?=[A-Z])", " ".join(first.split()))[0]
    return (title[1] if title else "Page"), re.sub(LINK, r"\2", sentence)
