"""What mkdocs does beside its own work: pages of the repository are brought in, pictures drawn, and llms.txt written.

A page of the repository keeps its own links: those to other pages lead to them, to anything else they become its path.
"""

from __future__ import annotations

import base64
import inspect
import json
import posixpath
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from pymdownx.slugs import slugify

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]  # mkdocs puts it back

import api as public_names  # noqa: E402
import pictures  # noqa: E402

LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#]*)(#[^)\s]*)?\)")
INCLUDE = re.compile(r"^<!-- include: (\S+)#(.+) -->$", re.MULTILINE)
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
_texts: dict[str, str] = {}  # each page as Markdown, by its place


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fill the parts of the navigation that follow from folders; headings get the anchors that GitHub gives them."""
    config.mdx_configs["toc"]["slugify"] = slugify(case="lower")
    filled = {
        "Reference": ["reference/index.md", *(f"reference/{place}.md" for place in _reference())],
        "Examples": ["examples/index.md", *(f"examples/{path.stem}.md" for path in EXAMPLES)],
        "Decisions": ["decisions/index.md", *(f"decisions/{path.name}" for path in DECISIONS)],
    }
    for part in config.nav or ():
        (name,) = part
        part[name] = filled.get(name, part[name])
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the repository, and the pictures."""
    pages: dict[str, str | bytes] = {}
    for source, place in PAGES.items():
        if source.endswith(".md") and source not in ("README.md", "scroll_tactile/API.md"):
            pages[place] = linked((ROOT / source).read_text(encoding="utf-8"), source, place)
    pages |= {f"examples/{path.stem}.md": _program(path) for path in EXAMPLES}
    pages |= _notebook(ROOT / "examples/tour.ipynb")
    pages |= {f"reference/{place}.md": text for place, text in _reference().items()}
    pages |= {"reference/index.md": _overview(), "decisions/index.md": _decisions()}
    pages["pictures/answers.png"] = (ROOT / ".github/pictures/answers.png").read_bytes()
    with tempfile.TemporaryDirectory() as folder:
        pictures.draw(Path(folder))
        pages |= {f"results/results/{file.name}": file.read_bytes() for file in Path(folder).iterdir()}
    for place, content in pages.items():
        files.append(File.generated(config, place, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Put in what a page includes, and keep it for its Markdown."""
    place = page.file.src_uri
    text = INCLUDE.sub(lambda found: linked(_section(ROOT / found[1], found[2]), found[1], place), markdown)
    _texts[place] = text
    return text


def on_post_build(config: MkDocsConfig) -> None:
    """Write each page as Markdown beside it, llms.txt, and llms-full.txt."""
    site, name = Path(config.site_dir), config.site_name
    api = (ROOT / "scroll_tactile/API.md").read_text(encoding="utf-8")
    index, whole = [f"# {name}\n\n> {config.site_description}"], []
    for place in _texts:
        if place.startswith("reference/"):
            _texts[place] = _api_part(api, place)
    for part in config.nav or ():
        ((heading, places),) = part.items()
        index.append(f"\n## {heading}\n" if isinstance(places, list) else "")
        for place in places if isinstance(places, list) else [places]:
            (site / place).write_text(_texts[place], encoding="utf-8")
            title, summary = _about(_texts[place])
            index.append(f"- [{title}]({place}): {summary}")
            if heading not in ("Results", "Decisions"):
                whole.append(f"<!-- {place} -->\n\n{_texts[place].strip()}\n")
    (site / "llms.txt").write_text("\n".join(index) + "\n", encoding="utf-8")
    (site / "llms-full.txt").write_text("\n".join(whole), encoding="utf-8")


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


def _section(path: Path, heading: str) -> str:
    """What stands under a heading of second order."""
    found = re.search(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", path.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    if not found:
        raise PluginError(f"{path.name} has no heading {heading!r}")
    return found[1].strip()


def _program(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    return f"# {path.stem}\n\nRun from a clone: `python -m examples.{path.stem}`\n\n```python\n{text}```\n"


def _notebook(path: Path) -> dict[str, str | bytes]:
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


def _reference() -> dict[str, str]:
    """The pages of the reference: those names of tests/api.py that are classes and functions."""
    pages = {}
    for title, (module, names) in public_names.PARTS.items():
        listed = [name for name in names if not name.startswith("_") and not inspect.ismodule(getattr(module, name))]
        text = "\n\n".join(f"::: {_origin(module, name)}.{name}" for name in listed)
        pages[title.replace(".", "-")] = f"# {title}\n\n{text}\n"
    return pages


def _origin(module: Any, name: str) -> str:
    """The module in which a public name is made, where that is one of ours."""
    made = str(getattr(getattr(module, name), "__module__", ""))
    return made if made.startswith(("scroll_tactile", "store")) else str(module.__name__)


def _overview() -> str:
    parts = [f"## [{title}]({title.replace('.', '-')}.md)\n" for title in public_names.PARTS]
    return "# Reference\n\n" + "\n".join(parts)


def _api_part(api: str, place: str) -> str:
    """The part of API.md that a page of the reference shows in another form; all of it for the first."""
    title = Path(place).stem.replace("-", ".")
    return (
        api
        if title == "index"
        else f"# {title}\n\n"
        + (re.search(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", api, re.MULTILINE | re.DOTALL) or [""])[1]
    )


def _decisions() -> str:
    lines = [f"- [{path.stem[:4]}]({path.name}): {_about(path.read_text('utf-8'))[0]}" for path in DECISIONS]
    return "# Decisions\n\nThe problem, the choice, what was refused, and where it was measured.\n\n" + "\n".join(lines)


def _about(text: str) -> tuple[str, str]:
    """Title and first sentence of a page."""
    title = re.search(r"^# (.+)$", text, re.MULTILINE)
    rest = [part for part in text[title.end() if title else 0 :].split("\n\n") if part[:1].strip(" \n#`!<>|-:")]
    sentence = re.split(r"(?<=[.:])\s", " ".join(rest[0].split()))[0] if rest else ""
    return (title[1] if title else "Page"), re.sub(LINK, r"\2", sentence)
