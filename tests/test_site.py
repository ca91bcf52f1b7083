"""The site's own pages run, and show what is so."""

import re
from codeop import CommandCompiler
from pathlib import Path

import pytest
from pages import ENVIRONMENT, Page

ROOT = Path(__file__).parents[1]
DOCS = ROOT / ".site/docs"
RUNNING = ["tutorial.md", *sorted(f"howto/{path.name}" for path in (DOCS / "howto").glob("*.md"))]


@pytest.mark.parametrize("name", RUNNING)
def test_a_page_does_what_it_shows(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for variable, value in ENVIRONMENT.items():
        monkeypatch.setenv(variable, value)
    page = Page(DOCS / name)
    page.run()
    assert page.ran or page.left


@pytest.mark.parametrize(
    ("block", "message"),
    [
        ("```python\nprint(1)\n```", "nobody runs this block"),
        ("```pycon\n>>> 1 + 1\n3\n```", "Expected:"),
        ("```console\n$ scroll-tactile --version\nno number\n```", "expected:"),
        ("```console\n$ scroll-tactile predict nothing nothing.npy\n```", "Error: "),
    ],
)
def test_a_page_that_shows_what_is_not_so_fails(block, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = tmp_path / "page.md"
    page.write_text(f"# Page\n\n{block}\n")
    with pytest.raises(AssertionError, match=message):
        Page(page).run()


@pytest.mark.parametrize("path", [ROOT / "README.md", *(DOCS / name for name in RUNNING)], ids=lambda path: path.name)
def test_a_session_without_its_prompts_can_be_pasted_into_python(path, monkeypatch):
    """A block, such as that of a for, ends there with an empty line and nothing else."""
    monkeypatch.syspath_prepend(ROOT / ".site")
    from sources import sessions

    for session in re.findall(r"^```pycon\n(.*?)^```$", sessions(path.read_text(encoding="utf-8")), re.M | re.DOTALL):
        typed: list[str] = []
        for line in re.findall(r"^(?:>>> |\.\.\. ?)(.*)", session, re.MULTILINE):
            typed.append(line)
            if CommandCompiler()("\n".join(typed), symbol="single"):
                typed = []
        assert not typed, "\n".join(typed)


@pytest.mark.parametrize("name", RUNNING)
def test_a_page_begins_with_what_one_will_have(name):
    assert (DOCS / name).read_text(encoding="utf-8").split("\n\n")[1].startswith("At its end you will ")


def test_the_navigation_has_every_page():
    navigation = (ROOT / ".site/mkdocs.yml").read_text(encoding="utf-8")
    assert all(f"- {name}\n" in navigation for name in RUNNING)
