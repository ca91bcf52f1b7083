"""An extension of griffe: docstrings that are prose become Markdown, with lists of what they name, and sessions."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

NAMED = re.compile(r"^(\w+(?:, \w+)*): ")  # "count: how many", at the beginning of a line


class Prose(Extension):
    """Every docstring as Markdown."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Rewrite the docstring of whatever was loaded."""
        if obj.docstring:
            obj.docstring.value = "\n\n".join(map(_paragraph, obj.docstring.value.split("\n\n")))


def _paragraph(text: str) -> str:
    """A session in a fence, names at the beginning of lines as a list, anything else as it is."""
    if text.startswith(">>> "):
        return f"```pycon\n{text}\n```"
    if not NAMED.match(text) or text.startswith("    "):
        return text
    items = [f"- {line}" if NAMED.match(line) else line for line in text.splitlines()]
    return "\n".join(NAMED.sub(r"**\1**: ", item[2:]).join(["- ", ""]) if item[:2] == "- " else item for item in items)
