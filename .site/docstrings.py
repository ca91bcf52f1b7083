"""An extension of griffe: docstrings that are prose become Markdown, with lists of what they name, and sessions."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

NAMES = r"[a-z_]\w*(?:, \w+)*: "  # "count: how many", or "low, high: the range", where a sentence begins
BEGINS = re.compile(rf"(?:^|(?<=\. ))(?={NAMES})")


class Prose(Extension):
    """Every docstring as Markdown."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Rewrite the docstring of whatever was loaded."""
        if obj.docstring:
            obj.docstring.value = "\n\n".join(map(_paragraph, obj.docstring.value.split("\n\n")))


def _paragraph(text: str) -> str:
    """A session in a fence, what begins with a name as a list, anything else as it is."""
    if text.startswith(">>> "):
        return f"```pycon\n{text}\n```"
    if not re.match(NAMES, text):
        return text
    items = BEGINS.split(" ".join(text.split()))
    return "\n".join(re.sub(rf"^({NAMES[:-2]}):", r"- **\1**:", item.strip()) for item in items if item)
