"""What mkdocs does beside its own work: pages of the repository are brought in, pictures drawn, and llms.txt written.

A page of the repository keeps its own links: those to other pages lead to them, to anything else they become its path.
"""

from __future__ import annotations

import inspect
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from pymdownx.slugs import slugify

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / part) for part in ("", "tests")]  # mkdocs puts it back

import api as public_names  # noqa: E402
import pictures  # noqa: E402
from sources import DECISIONS, EXAMPLES, PAGES, ROOT, about, linked, notebook, program, section, sessions  # noqa: E402

INCLUDE = re.compile(r"^<!-- include: (\S+)#(.+) -->$", re.MULTILINE)
_texts: dict[str, str] = {}  # each page as Markdown, by its place


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fill the parts of the navigation that follow from folders; headings get the anchors that GitHub gives them."""
    config.mdx_configs["toc"]["slugify"] = slugify(case="lower")
    filled = {
        "Reference": ["reference/index.md", *(f"reference/{place}.md" for place in _reference())],
        "Examples": ["examples/index.md", *(f"examples/{path.stem}.md" for path in EXAMPLES)],
        "Decisions": ["decisions/index.md", *(f"decisions/{path.name}" for path in DECISIONS)],
    }
    config.nav = _filled(config.nav or [], filled)
    return config


def _filled(parts: list[Any], filled: dict[str, list[str]]) -> list[Any]:
    """A navigation whose empty parts have what belongs there."""
    return [
        {
            name: filled.get(name) or (_filled(own, filled) if isinstance(own, list) else own)
            for name, own in part.items()
        }
        if isinstance(part, dict)
        else part
        for part in parts
    ]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the repository, and the pictures."""
    pages: dict[str, str | bytes] = {}
    for source, place in PAGES.items():
        if source.endswith(".md") and source not in ("README.md", "scroll_tactile/API.md"):
            pages[place] = linked((ROOT / source).read_text(encoding="utf-8"), source, place)
    pages |= {f"examples/{path.stem}.md": program(path) for path in EXAMPLES}
    pages |= notebook(ROOT / "examples/tour.ipynb")
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
    text = INCLUDE.sub(lambda found: linked(section(ROOT / found[1], found[2]), found[1], place), markdown)
    _texts[place] = text
    return sessions(text)


def on_post_build(config: MkDocsConfig) -> None:
    """Write each page as Markdown beside it, llms.txt, and llms-full.txt."""
    site, name = Path(config.site_dir), config.site_name
    api = (ROOT / "scroll_tactile/API.md").read_text(encoding="utf-8")
    index, whole = [f"# {name}\n\n> {config.site_description}"], []
    for place in _texts:
        if place.startswith("reference/"):
            _texts[place] = _api_part(api, place)
    for depth, words in _walked(config.nav or []):
        if not words.endswith(".md"):
            index.append(f"\n{'#' * depth} {words}\n")
            continue
        (site / words).write_text(_texts[words], encoding="utf-8")
        title, summary = about(_texts[words])
        index.append(f"- [{title}]({words}): {summary}")
        if not words.startswith(("results/", "decisions/")):
            whole.append(f"<!-- {words} -->\n\n{_texts[words].strip()}\n")
    (site / "llms.txt").write_text("\n".join(index) + "\n", encoding="utf-8")
    (site / "llms-full.txt").write_text("\n".join(whole), encoding="utf-8")


def _walked(parts: list[Any], depth: int = 2) -> Iterator[tuple[int, str]]:
    """The headings and places of a navigation, in order, each with its depth."""
    for part in parts:
        for name, own in part.items() if isinstance(part, dict) else [("", part)]:
            if isinstance(own, list):
                yield depth, name
                yield from _walked(own, depth + 1)
            else:
                yield depth, own


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
    return made if made.startswith("scroll_tactile") else str(module.__name__)


def _overview() -> str:
    parts = [f"## [{title}]({title.replace('.', '-')}.md)\n" for title in public_names.PARTS]
    return "# Reference\n\n" + "\n".join(parts)


def _api_part(api: str, place: str) -> str:
    """The part of API.md that a page of the reference shows in another form; all of it for the first."""
    title = Path(place).stem.replace("-", ".")
    if title == "index":
        return api
    part = section(ROOT / "scroll_tactile/API.md", title)
    return f"# {title}\n\nThe public names of `{title}`, and what their docstrings promise.\n\n{part}\n"


def _decisions() -> str:
    lines = [f"- [{path.stem[:4]}]({path.name}): {about(path.read_text('utf-8'))[0]}" for path in DECISIONS]
    return "# Decisions\n\nThe problem, the choice, what was refused, and where it was measured.\n\n" + "\n".join(lines)
